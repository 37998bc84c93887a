"""Compiling ahead: every operator that can be is warmed up, what cannot is said, and stale code is thrown away."""

from __future__ import annotations

from pathlib import Path

import pytest

from graph.warming import forget, main

WARM = """
from pathlib import Path

from graph import Operator


class Quick(Operator):
    @classmethod
    def warm_up(cls) -> None:
        Path("warmed").write_text("yes")


class Broken(Operator):
    @classmethod
    def warm_up(cls) -> None:
        raise ValueError("no such\\nluck")
"""


def test_what_can_be_compiled_is_and_what_cannot_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package = tmp_path / "warmers"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "able.py").write_text(WARM)
    (package / "poor.py").write_text("import no_such_extra\ndef warm_up(): ...\n")
    (package / "idle.py").write_text("raise RuntimeError('it has nothing to compile and is not even imported')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["warmers"]) == 0
    assert (tmp_path / "warmed").exists()
    said = capsys.readouterr().out.splitlines()
    assert [line.partition(" ... ")[0] for line in said] == [
        "compiling the kernels of warmers.able:Quick",
        "compiling the kernels of warmers.able:Broken",
        "compiling the kernels of warmers.poor",
    ]
    assert said[1].endswith("left out: no such luck")
    assert "left out: warmers.poor cannot be imported: it needs the module 'no_such_extra'" in said[2]


def test_only_compiled_kernels_are_thrown_away(tmp_path: Path) -> None:
    cache = tmp_path / "icp" / "__pycache__"
    cache.mkdir(parents=True)
    for name in ("icp.align-1.py311.nbi", "icp.align-1.py311.1.nbc", "icp.cpython-311.pyc"):
        (cache / name).touch()
    (tmp_path / "mine.nbc").touch()
    assert forget(tmp_path) == 2
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == ["icp.cpython-311.pyc", "mine.nbc"]
    assert forget(tmp_path) == 0
