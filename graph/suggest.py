"""Say what is wrong with a value, and what was probably meant: every fault of it, by name."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import msgspec

KeyPath = tuple[str, ...]
Hook = Callable[[type, Any], Any]

_LISTED = 12  # names; a longer list helps nobody
_UNIONS = (typing.Union, types.UnionType)


class Fault(NamedTuple):
    """One thing wrong in a tree of mappings, lists and scalars."""

    path: KeyPath
    text: str
    key: bool = False  # the key is at fault, not its value


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known name that was probably meant, if one is near enough; a package that both share counts not."""

    def likeness(name: str) -> float:
        (parent, _, own), (other, _, last) = word.lower().rpartition("."), name.lower().rpartition(".")
        pair = (own, last) if parent == other else (word.lower(), name.lower())
        return difflib.SequenceMatcher(None, *pair).ratio()

    best = max(known, key=likeness, default=None)
    return best if best is not None and likeness(best) >= 0.6 else None


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return the end of a sentence about an unknown name: `; did you mean 'frame'? There are frame, goal`."""
    names = sorted(known)
    if not names:
        return "; there are none"
    meant = nearest(word, names)
    if len(names) == 1:
        return f"; did you mean '{meant}'?" if meant else f"; there is {names[0]}"
    shown = ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")
    return f"; did you mean '{meant}'? There are {shown}" if meant else f"; there are {shown}"


def given(value: Any) -> str:
    """Describe a value that was given, in few words."""
    match value:
        case None:
            return "nothing"
        case bool():
            return str(value).lower()
        case dict():
            return "a mapping" if value else "an empty mapping"
        case list():
            return "a list" if value else "an empty list"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def wants(text: str, **constraints: Any) -> msgspec.Meta:
    """Annotate a type with what it wants, for the sentence of a fault and for the JSON Schema."""
    return msgspec.Meta(description=text, extra={"wants": text}, **constraints)


def wanted(hint: Any) -> str:
    """Describe what a type hint accepts, in few words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        for meta in arguments[1:]:
            if isinstance(meta, msgspec.Meta) and "wants" in (meta.extra or {}):
                return str(meta.extra["wants"])  # type: ignore[index]
        bounds = [text for meta in arguments[1:] if isinstance(meta, msgspec.Meta) for text in _bounds(meta)]
        return " ".join([wanted(arguments[0]), *bounds])
    if hint in (None, types.NoneType):
        return "nothing"
    if origin in _UNIONS:
        return " or ".join(wanted(part) for part in arguments if part is not types.NoneType)
    if origin is typing.Literal:
        return " or ".join(given(choice) for choice in arguments)
    if origin is dict or hint is dict:
        return "a mapping"
    if origin in (list, tuple, set, frozenset):
        parts = [wanted(part) for part in arguments if part is not Ellipsis]
        alike = origin is not tuple or Ellipsis in arguments
        return f"a list of {parts[0]}" if alike and parts else f"a list of {len(parts)}: {', '.join(parts)}"
    if _is_struct(hint):
        return f"a mapping of {', '.join(field.encode_name for field in msgspec.structs.fields(hint)) or 'no keys'}"
    return hint.__name__ if isinstance(hint, type) else str(hint)


def _bounds(meta: msgspec.Meta) -> Iterator[str]:
    for word, limit in (
        ("of at least", meta.ge),
        ("above", meta.gt),
        ("of at most", meta.le),
        ("below", meta.lt),
        ("that is a multiple of", meta.multiple_of),
        ("of at least length", meta.min_length),
        ("of at most length", meta.max_length),
        ("that matches", meta.pattern),
    ):
        if limit is not None:
            yield f"{word} {limit}"


def _is_struct(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, msgspec.Struct)


def _branch(value: Any, hint: Any) -> Any:
    """Strip annotations, and choose the one part of a union that a mapping or a list is meant for."""
    while typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) not in _UNIONS:
        return hint
    parts = [_branch(value, part) for part in typing.get_args(hint)]
    if isinstance(value, dict):
        parts = [part for part in parts if _is_struct(part) or typing.get_origin(part) is dict]
    elif isinstance(value, list):
        parts = [part for part in parts if typing.get_origin(part) is list]
    else:
        return hint
    return parts[0] if len(parts) == 1 else hint


def _without_structs(hint: Any) -> Any:
    """Leave out of a union what only a mapping could be meant for."""
    if typing.get_origin(hint) not in _UNIONS:
        return hint
    rest = tuple(part for part in typing.get_args(hint) if not _is_struct(part))
    return typing.Union[rest] if rest else hint  # noqa: UP007


def faults(
    value: Any, hint: Any, path: KeyPath = (), *, shown: Callable[[KeyPath], str] = ".".join, hook: Hook | None = None
) -> Iterator[Fault]:
    """Yield everything that keeps a tree of builtins from being converted into a type, key by key.

    hint: a type that msgspec converts into. shown: names a path in the sentences. hook: msgspec's dec_hook.
    """
    branch = _branch(value, hint)
    origin, arguments = typing.get_origin(branch), typing.get_args(branch)
    if isinstance(value, dict) and _is_struct(branch) and branch.__struct_config__.tag is None:
        yield from _struct_faults(value, branch, path, shown, hook)
        return
    inner: list[Fault] = []
    if isinstance(value, dict) and origin is dict:
        for key, item in value.items():
            if (problem := _problem(key, arguments[0], hook)) is not None:
                text = f"{shown(path)} wants {problem}; it was given {given(key)}"
                inner.append(Fault((*path, key), text, key=True))
            inner += faults(item, arguments[1], (*path, key), shown=shown, hook=hook)
    elif isinstance(value, list) and origin is list:
        for index, item in enumerate(value):
            inner += faults(item, arguments[0], (*path, str(index)), shown=shown, hook=hook)
    yield from inner
    if not inner and (problem := _problem(value, hint, hook)) is not None:
        yield Fault(path, f"{shown(path)} wants {problem}; it was given {given(value)}")


def _struct_faults(
    value: dict[str, Any],
    kind: type[msgspec.Struct],
    path: KeyPath,
    shown: Callable[[KeyPath], str],
    hook: Hook | None,
) -> Iterator[Fault]:
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    for key, item in value.items():
        inner = (*path, key)
        if key in fields:
            yield from faults(item, fields[key].type, inner, shown=shown, hook=hook)
        else:
            yield Fault(inner, f"{shown(inner)} is not a known key{suggestion(key, fields)}", key=True)
    for key, field in fields.items():
        if field.required and key not in value:
            inner = (*path, key)
            yield Fault(inner, f"{shown(inner)} is missing; it wants {wanted(field.type)}", key=True)


def _problem(value: Any, hint: Any, hook: Hook | None) -> str | None:
    """Say what a type wants if a value cannot be converted into it."""
    try:
        msgspec.convert(value, hint, dec_hook=hook, str_keys=True)
    except msgspec.ValidationError:
        return wanted(hint if isinstance(value, (dict, list)) else _without_structs(hint))
    except (TypeError, RecursionError) as error:
        return f"a type that can be configured ({' '.join(str(error).split())})"
    return None
