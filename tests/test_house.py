"""The rules of the house as tests: which way imports point, how long files are, what is named where."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LONGEST = 400  # lines
SHADOWING = {"operator", "queue", "copy", "types", "random", "select", "signal", "struct", "token", "logging"}
VAGUE = {"utils", "util", "common", "helpers", "helper", "base", "manager", "misc"}
ONLY_IN = {  # package: where it may be imported
    "zenoh": ("graph/", "benchmarks/"),
    "pybullet": ("sim/", "benchmarks/"),
    "embreex": ("sim/", "benchmarks/"),
    "rerun": ("operators/views/",),
    "torch": ("operators/kpconv/", "operators/segmenter.py", "benchmarks/", "experiments/"),
}


def sources() -> list[Path]:
    """Every Python file of the packages, as far as git knows or would add it."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / line for line in listed.stdout.splitlines() if (ROOT / line).exists()]


FILES = [path for path in sources() if path.relative_to(ROOT).parts[0] in ("graph", "operators", "sim", "experiments")]


def imports(path: Path) -> Iterator[str]:
    """Name every module that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def may(path: str, module: str) -> bool:
    """Say whether a file may import one of our own modules."""
    top = module.split(".", maxsplit=1)[0]
    parts = Path(path).parts
    if top not in ("graph", "operators", "sim", "experiments", "benchmarks", "tests"):
        return True
    if top in ("tests", "benchmarks"):
        return False
    if parts[0] == "graph":
        return top == "graph"
    if parts[0] == "sim":
        is_command = Path(path).name.endswith("_command.py")
        return top == "sim" or module.startswith("graph.geometry") or (is_command and top == "graph")
    if parts[0] == "operators" and len(parts) == 2:  # a program
        return top in ("graph", "operators") or (top == "sim" and parts[1] == "simulator.py")
    if parts[0] == "operators":  # a library, or a command beside it, which is a program
        if Path(path).name.endswith("_command.py"):
            return top in ("graph", "operators")
        return module.startswith("graph.geometry") or top == "operators"
    return True


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_one_way(path: Path) -> None:
    name = str(path.relative_to(ROOT))
    for module in imports(path):
        assert may(name, module), f"{name} imports {module}"
        for package, places in ONLY_IN.items():
            if module.split(".")[0] == package:
                assert name.startswith(places), f"{name} imports {module}"


def test_libraries_of_operators_import_each_other_in_one_direction() -> None:
    arrows: dict[str, set[str]] = {}
    for path in FILES:
        parts = path.relative_to(ROOT).parts
        if parts[0] != "operators" or len(parts) < 3 or parts[-1].endswith("_command.py"):
            continue
        for module in imports(path):
            other = module.split(".")
            if other[0] == "operators" and len(other) > 2 and other[1] != parts[1]:
                arrows.setdefault(parts[1], set()).add(other[1])

    def reach(start: str, seen: frozenset[str] = frozenset()) -> set[str]:
        found: set[str] = set()
        for other in arrows.get(start, set()) - seen:
            found |= {other} | reach(other, seen | {other})
        return found

    for library in arrows:
        assert library not in reach(library), f"{library} imports itself in a circle"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_are_nouns_of_at_most_400_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= LONGEST
    assert path.stem not in SHADOWING | VAGUE


def test_public_functions_and_classes_say_what_they_do() -> None:
    silent = []
    for path in FILES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                decorated = any("overload" in ast.dump(item) for item in node.decorator_list)
                if not ast.get_docstring(node) and not decorated:
                    silent.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name}")
    assert not silent


def test_no_machine_and_no_registry_is_named() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    words = re.compile(
        "/" + "work/|" + "py" + r"pi\.org|" + "python" + r"hosted|" + "regis" + r"try\.npmjs|/ho" + "me/"
    )
    for name in listed:
        path = ROOT / name
        if path.suffix in (".py", ".md", ".yaml", ".toml", ".txt", "") and path.is_file():
            found = words.search(path.read_text(errors="ignore"))
            assert found is None, f"{name} names {found.group()}"


def test_large_files_stay_out_of_git() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split(
        "\n"
    )
    sizes = {name: (ROOT / name).stat().st_size for name in listed if name and (ROOT / name).is_file()}
    assert all(size < 4 * 2**20 for size in sizes.values()), max(sizes.items(), key=lambda item: item[1])
    assert sum(size for name, size in sizes.items() if name.startswith("recordings/")) < 20 * 2**20
