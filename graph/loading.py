"""Operators by name: `module:Class` to the class, a mapping to its Config, and what goes wrong on the way."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from graph.contract import ContractError, Operator, ports_of
from graph.errors import UserError
from graph.suggest import Fault, faults, suggestion

EXTRAS = {"pybullet": "sim", "pybullet_data": "sim", "embreex": "sim", "rerun": "view", "rerun_bindings": "view"}


class ConfigError(UserError):
    """Settings that an operator does not take: all of them."""

    def __init__(self, found: list[Fault]) -> None:
        self.faults = found
        super().__init__("\n".join(fault.text for fault in found))

    @property
    def mistakes(self) -> list[tuple[str, str]]:
        """Return (key, sentence) of each; nested keys as `a.b`."""
        return [(".".join(fault.path), fault.text) for fault in self.faults]


def load_class(run: str, root: str | Path | None = None) -> type[Operator]:
    """Import the operator class `module:Class`; modules are looked for in root, in the working directory, on the path.

    Raises UserError in one sentence: no such module or class, an import that fails, no operator, ports that are none.
    """
    name, colon, qualname = run.partition(":")
    if not colon or not name or not qualname:
        guess = ":".join(run.rsplit(".", 1)) if "." in run and not colon else "operators.planner:Planner"
        raise UserError(f"an operator is named module:Class (such as {guess}); this is '{run}'")
    module = load_module(name, _folders(root))
    found: Any = module
    for part in qualname.split("."):
        if not hasattr(found, part):
            raise UserError(f"{name} has no class '{qualname}'{suggestion(qualname, _operators_in(module))}")
        found = getattr(found, part)
    if not (inspect.isclass(found) and issubclass(found, Operator)):
        raise UserError(f"{run} is no operator: it does not derive from graph.Operator")
    if not (inspect.isclass(found.Config) and issubclass(found.Config, msgspec.Struct)):
        raise UserError(f"{run} is no operator: its Config is no msgspec.Struct")
    try:
        ports_of(found)
    except ContractError as error:
        raise UserError(f"{run}: {error}") from error
    except Exception as error:  # an annotation is any expression
        raise UserError(f"{run}: its ports cannot be read: {_one_line(error)}") from error
    return found


def _folders(root: str | Path | None) -> list[str]:
    """Put root and the working directory first on the path, as `python FILE` would; return them."""
    folders = [str(Path.cwd())] if root is None else [str(Path(root).resolve()), str(Path.cwd())]
    for folder in reversed(folders):
        if folder not in sys.path:
            sys.path.insert(0, folder)
    importlib.invalidate_caches()
    return folders


def load_module(name: str, folders: Sequence[str] = ()) -> Any:
    """Import a module. Raises UserError in one sentence that says what is missing, or what the import raised."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if name == missing or name.startswith(missing + "."):
            near = _modules_near(missing, folders)
            raise UserError(f"there is no module '{missing}'{suggestion(missing, near) if near else ''}") from None
        top = missing.partition(".")[0]
        if top in EXTRAS:
            command = f'pip install "retracer[{EXTRAS[top]}]"'
            raise UserError(f"{name} needs {top}, which is not installed; install it with: {command}") from error
        raise UserError(
            f"{name} cannot be imported: it needs the module '{missing}', which is not installed{_where(error)}"
        ) from error
    except (Exception, SystemExit) as error:
        raise UserError(f"{name} cannot be imported: {_one_line(error)}{_where(error)}") from error


def _modules_near(missing: str, folders: Sequence[str]) -> list[str]:
    """List the modules beside the one looked for, and those of its name in other packages, within some folders."""
    parent, dot, name = missing.rpartition(".")
    places = list(getattr(sys.modules.get(parent), "__path__", [])) if parent else folders
    own = [place for place in places if any(Path(place).is_relative_to(folder) for folder in folders)]
    found = [f"{parent}{dot}{module.name}" for module in pkgutil.iter_modules(own)]
    if parent:
        found += [f"{file.parent.name}.{name}" for folder in folders for file in Path(folder).glob(f"*/{name}.py")]
    return found


def _operators_in(module: Any) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, Operator) and value.__module__ == module.__name__
    ]


def _one_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")


def _where(error: BaseException) -> str:
    """Name file and line where an import failed, importlib's own frames aside."""
    if isinstance(error, SyntaxError):
        return "" if f"line {error.lineno}" in str(error) else f" ({error.filename}:{error.lineno})"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "importlib" not in frame.filename]
    own = [frame for frame in frames if frame.filename != __file__]
    return f" ({own[-1].filename}:{own[-1].lineno})" if own else ""


def build_config(kind: type[Operator], config: dict[str, Any], root: str | Path, *, operator: str = "") -> Any:
    """Build the Config of an operator class. Raises ConfigError with every unknown, missing and ill-typed setting.

    Relative paths are taken from root, the folder of the graph, if they exist there, and else as they are.
    operator: the name in the graph, for the sentences.
    """
    name = operator or kind.__qualname__

    def hook(wanted: type, value: Any) -> Any:
        if isinstance(wanted, type) and issubclass(Path, wanted) and isinstance(value, str):
            beside = Path(root) / value
            return beside if beside.exists() else Path(value)
        raise TypeError(f"{value!r} is no {wanted}")

    found = list(faults(config, kind.Config, shown=lambda path: ".".join((name, *path)), hook=hook))
    if not found:
        try:
            return msgspec.convert(config, kind.Config, dec_hook=hook, str_keys=True)
        except msgspec.ValidationError as error:  # of a __post_init__
            found = [Fault((), f"{name}: {_said(error)}")]
        except (TypeError, ValueError) as error:
            found = [Fault((), f"{name}: {_one_line(error)}")]
    raise ConfigError(found)


def _said(error: Exception) -> str:
    return " ".join(str(error).partition(" - at `$")[0].split())


def config_files(config: Any) -> list[Path]:
    """List the files that a config names, in the order of its fields, nested ones too; each once."""
    return list(dict.fromkeys(path for path in _paths(config) if path.is_file()))


def _paths(value: Any) -> Iterator[Path]:
    if isinstance(value, Path):
        yield value
    elif isinstance(value, msgspec.Struct):
        for field in value.__struct_fields__:
            yield from _paths(getattr(value, field))
    elif isinstance(value, dict):
        for item in value.values():
            yield from _paths(item)
    elif isinstance(value, (list, tuple, set, frozenset)):
        for item in sorted(value, key=str) if isinstance(value, (set, frozenset)) else value:
            yield from _paths(item)
