"""The bench: what it writes, and what it says of modules that do not exist or cannot run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import __main__ as bench


def test_rows_are_merged_by_name_and_peer() -> None:
    old = [{"name": "a", "peer": "x", "value": 1}, {"name": "a", "peer": "y", "value": 2}]
    new = [{"name": "a", "peer": "x", "value": 3}]
    assert bench.merged(old, new) == [{"name": "a", "peer": "y", "value": 2}, {"name": "a", "peer": "x", "value": 3}]


def test_a_row_shows_its_peer_and_ratio() -> None:
    row = {"name": "rays", "value": 9.0, "unit": "Mrays/s", "peer": "PyBullet", "peer_value": 0.3, "ratio": 30.0}
    assert bench.line(row).split() == ["rays", "9.000", "Mrays/s", "PyBullet", "0.300", "ratio", "30.00"]


def test_every_benchmark_is_found_and_unknown_ones_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert {"transport", "chain"} <= set(bench.modules())
    assert bench.main(["transprt"]) == 2
    assert "there is no benchmark 'transprt'; there are annotation," in capsys.readouterr().err


def test_a_module_that_cannot_run_says_why_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from benchmarks import chain, transport

    def missing() -> list[dict[str, object]]:
        raise RuntimeError("dora is not installed")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(transport, "rows", missing)
    monkeypatch.setattr(chain, "rows", lambda: [{"name": "chain", "value": 500.0, "unit": "ticks/s"}])
    assert bench.main(["transport", "chain"]) == 1
    assert "transport could not run: RuntimeError: dora is not installed" in capsys.readouterr().err
    (row,) = json.loads((tmp_path / "build" / "bench.json").read_text())
    assert row == {"name": "chain", "value": 500.0, "unit": "ticks/s", "peer": None, "peer_value": None, "ratio": None}
