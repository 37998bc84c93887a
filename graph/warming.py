"""Compile ahead what the first launch and the first test would wait for: the kernels of all operators of a folder.

Example: `python -m graph.warming operators`. Numba keeps what it compiles beside the sources, but looks only at the
file of a kernel itself; so what an earlier version of any file left is thrown away first. Whatever cannot be compiled,
such as an operator whose extra is not installed, is said and left out: it will be named again where it is needed.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from graph.contract import Operator
from graph.errors import UserError
from graph.loading import load_module

CACHES = ("*.nbi", "*.nbc")  # index and code, as numba names them


def forget(folder: Path) -> int:
    """Throw away what numba has compiled of the sources in a folder; return how many files that were."""
    files = [file for pattern in CACHES for file in folder.rglob(f"__pycache__/{pattern}")]
    for file in files:
        file.unlink(missing_ok=True)
    return len(files)


def operators_of(package: str) -> Iterator[tuple[str, type[Operator] | UserError]]:
    """Iterate over the operators of a package that compile something: `module:Class`, and the class or why not."""
    for file in sorted(Path(package).glob("*.py")):
        if "def warm_up" not in file.read_text():
            continue
        name = f"{package}.{file.stem}"
        try:
            module = load_module(name)
        except UserError as error:
            yield name, error
            continue
        for kind in vars(module).values():
            own = inspect.isclass(kind) and issubclass(kind, Operator) and kind.__module__ == name
            if own and "warm_up" in vars(kind):
                yield f"{name}:{kind.__qualname__}", kind


def warm(package: str) -> None:
    """Compile the kernels of a package's operators, and say so meanwhile."""
    for name, kind in operators_of(package):
        print(f"compiling the kernels of {name} ... ", end="", flush=True)
        begun = time.monotonic()
        try:
            if isinstance(kind, UserError):
                raise kind
            kind.warm_up()
        except Exception as error:
            print(f"left out: {' '.join(str(error).split()) or type(error).__name__}")
        else:
            print(f"{time.monotonic() - begun:.0f} s")


def main(packages: list[str]) -> int:
    """Forget and compile anew, package by package of the working directory. Exit code 0: nothing depends on it."""
    for folder in sorted({path.parent for path in Path().glob("*/__init__.py")}):
        forget(folder)
    for package in packages:
        warm(package)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
