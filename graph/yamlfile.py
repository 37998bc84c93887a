"""YAML with the line of every key and value: what stands where, and what is no YAML.

Scalars follow YAML 1.2 (`on` and `yes` are text, `1e-3` is a number, `10:30` is text), as editors read them.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from graph.suggest import KeyPath, suggestion

_MOST_VALUES = 100_000  # aliases of aliases grow without bound

_TAG = "tag:yaml.org,2002:"
_SCALARS = (
    ("null", r"|~|null|Null|NULL", "~nN"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("merge", r"<<", "<"),
)
_RESOLVERS: dict[str, list[tuple[str, re.Pattern[str]]]] = {"": [(f"{_TAG}null", re.compile(r"^$"))]}
for _name, _pattern, _first in _SCALARS:
    for _character in _first:
        _RESOLVERS.setdefault(_character, []).append((_TAG + _name, re.compile(f"^(?:{_pattern})$")))


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers = _RESOLVERS


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers = _RESOLVERS

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_str(self, data: str) -> yaml.ScalarNode:
        """Escape the line breaks that only YAML 1.1 knows: in any other style PyYAML folds them into spaces."""
        rare = any(character in data for character in "\x85\u2028\u2029")
        return self.represent_scalar(f"{_TAG}str", data, style='"' if rare else None)


_Dumper.add_representer(str, _Dumper.represent_str)


class Place(NamedTuple):
    """Where something stands in a file; counted from 1, as editors do."""

    line: int
    column: int


class YamlError(Exception):
    """Text that is not the YAML which was asked for."""

    def __init__(self, text: str, place: Place | None = None) -> None:
        super().__init__(text)
        self.place = place or Place(0, 0)


class Tree:
    """The builtins of one YAML text, with the places of its keys and values, and what was wrong with them."""

    def __init__(self, text: str) -> None:
        """Parse. Raises YamlError if the text is no YAML; lesser flaws are collected in `flaws`."""
        self.keys: dict[KeyPath, Place] = {}
        self.values: dict[KeyPath, Place] = {}
        self.flaws: list[tuple[Place, str]] = []
        self.flawed: set[KeyPath] = set()  # values that could not be read, and are None
        self._open: set[int] = set()  # collections being read, against aliases to themselves
        self._flattened: set[int] = set()
        node = _compose(text)
        self.empty = node is None
        self.data = None if node is None else self._read(node, ())

    def place(self, path: KeyPath, *, key: bool = False) -> Place:
        """Return where a value (or its key) stands, or else the nearest thing around it."""
        first, second = (self.keys, self.values) if key else (self.values, self.keys)
        for end in range(len(path), 0, -1):
            if (place := first.get(path[:end]) or second.get(path[:end])) is not None:
                return place
            first, second = self.keys, self.values
        return Place(0 if self.empty else 1, 0 if self.empty else 1)

    def _flaw(self, node: yaml.Node, text: str) -> None:
        self.flaws.append((_place(node.start_mark), text))

    def _read(self, node: yaml.Node, path: KeyPath) -> Any:
        self.values[path] = _place(node.start_mark)
        if len(self.values) > _MOST_VALUES:
            raise YamlError(f"more than {_MOST_VALUES} values, aliases counted", _place(node.start_mark))
        if isinstance(node, yaml.ScalarNode):
            try:
                return _scalar(node)
            except ValueError as error:
                self._flaw(node, str(error))
                self.flawed.add(path)
                return None
        if id(node) in self._open:
            raise YamlError("an alias stands within what it stands for", _place(node.start_mark))
        self._open.add(id(node))
        result: Any
        if isinstance(node, yaml.MappingNode):
            result = self._read_mapping(node, path)
        else:
            result = [self._read(item, (*path, str(index))) for index, item in enumerate(node.value)]
        self._open.discard(id(node))
        return result

    def _read_mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Any]:
        if id(node) not in self._flattened:
            self._flattened.add(id(node))
            self._flatten(node)
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                self._flaw(key_node, "a key wants to be one word; this is a collection")
                continue
            key = key_node.value
            self.keys[(*path, key)] = _place(key_node.start_mark)
            result[key] = self._read(value_node, (*path, key))
        return result

    def _flatten(self, node: yaml.MappingNode) -> None:
        """Report keys that stand twice, then put in what `<<` merges."""
        seen: dict[str, Place] = {}
        for key_node, _ in node.value:
            if isinstance(key_node, yaml.ScalarNode):
                first = seen.setdefault(key_node.value, _place(key_node.start_mark))
                if first != _place(key_node.start_mark):
                    self._flaw(
                        key_node, f"'{key_node.value}' stands here for the second time; first in line {first.line}"
                    )
        try:
            _Loader("").flatten_mapping(node)
        except yaml.MarkedYAMLError as error:
            raise YamlError(_problem(error), _place(error.problem_mark or node.start_mark)) from error


def _compose(text: str) -> yaml.Node | None:
    try:
        return yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        raise YamlError(_problem(error), _place(error.problem_mark or error.context_mark)) from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise YamlError(f"not YAML: it holds the character {error.character!r}", Place(line, 1)) from error
    except RecursionError:
        raise YamlError("not YAML that anybody can read: nested too deeply") from None


def _problem(error: yaml.MarkedYAMLError) -> str:
    parts = [part for part in (error.context, error.problem) if part]
    tab = "; indent with spaces" if "'\\t'" in (error.problem or "") else ""
    begun, here = error.context_mark, error.problem_mark
    since = f" (begun in line {begun.line + 1})" if begun and here and begun.line != here.line else ""
    return f"not YAML: {', '.join(parts)}{since}{tab}"


def _place(mark: Any) -> Place:
    return Place(mark.line + 1, mark.column + 1) if mark is not None else Place(0, 0)


def _scalar(node: yaml.ScalarNode) -> Any:
    kind, text = node.tag.removeprefix(_TAG), node.value
    result: Any
    match kind:
        case "null":
            return None
        case "bool":
            return text.lower() == "true"
        case "int":
            digits = text.lstrip("+-")
            result = int(text, {"0x": 16, "0o": 8}.get(digits[:2], 10))
            if not -(2**63) <= result < 2**63:
                raise ValueError(f"{text} is a number beyond 64 bits")
        case "float":
            result = float(text.replace(".inf", "inf").replace(".nan", "nan")) if text[-1:].isalpha() else float(text)
            if not math.isfinite(result):
                raise ValueError(f"{text} is no finite number")
        case "str" | "merge":
            return text
        case _:
            raise ValueError(f"the tag {node.tag.replace(_TAG, '!!')} has no meaning here")
    return result


def read_text(path: Path) -> str:
    """Read a text file. Raises YamlError in one sentence: no such file, a directory, not UTF-8."""
    try:
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        folder = path.parent
        near = [file.name for kind in ("*.yaml", "*.yml") for file in folder.glob(kind)] if folder.is_dir() else []
        raise YamlError(f"there is no such file{suggestion(path.name, near) if near else ''}") from None
    except IsADirectoryError:
        near = [file.name for file in path.glob("*.yaml")]
        raise YamlError(f"this is a directory; a YAML file is wanted{suggestion('', near) if near else ''}") from None
    except UnicodeDecodeError as error:
        raise YamlError(f"not text: byte {error.start} is not UTF-8") from None
    except OSError as error:
        raise YamlError(f"it cannot be read: {error.strerror}") from None


def dump(data: Any) -> str:
    """Write builtins as YAML that `Tree` reads back equal; keys keep their order."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=120, default_flow_style=None, allow_unicode=True)
