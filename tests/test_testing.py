"""The helpers for tests: an operator on hand-made messages, a recording against its text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from graph.override import override
from graph.recording import Recording
from graph.replay import replay
from graph.testing import reference, run_operator, tolerable
from tests.conftest import ROOT
from tests.sample_operators import Adder, Count, Failing, Relay

pytest_plugins = ["pytester"]

Record = Callable[..., Recording]


def count(value: int, at: int = 0) -> Count:
    return Count(measured_at=at, value=value)


def test_an_operator_runs_on_hand_made_messages() -> None:
    said = run_operator(Adder, [("left", count(3)), ("right", count(4, 7))], Adder.Config(scale=2.0))
    assert [(port, message.value, message.measured_at) for port, message in said] == [("sum", 14.0, 7)]
    with pytest.raises(KeyError, match="Adder has no input 'middle'; it has left, right"):
        run_operator(Adder, [("middle", count(1))])
    with pytest.raises(RuntimeError, match="failed at 5"):
        run_operator(Failing, [("count", count(5))])
    assert run_operator(Relay, []) == []


def test_a_reference_says_what_a_recording_says(record: Record) -> None:
    text = reference(record())
    assert text == reference(record(name="again.mcap"))
    assert "counter/count: 30 messages" in text
    assert "counter/count.value: mean 14.5" in text
    assert "screen" not in text
    assert text != reference(record(name="other.mcap", sets=("relay.offset=100",)))


def test_the_marker_holds_a_recording_against_its_text(
    record: Record, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = record()
    monkeypatch.chdir(pytester.path)
    (pytester.path / "run.mcap").write_bytes(recording.path.read_bytes())
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.replay("run.mcap")
        def test_run(replayed):
            assert replayed.equal

        @pytest.mark.replay("run.mcap")
        def test_without_the_fixture(): ...

        @pytest.mark.replay("none.mcap")
        def test_nothing(): ...
        """
    )
    pytester.makeini("[pytest]\naddopts = -p graph.testing")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    missing = pytester.runpytest_inprocess()
    missing.assert_outcomes(errors=3)
    missing.stdout.fnmatch_lines(["*run.txt is missing; pytest --update-references writes it*"])
    missing.stdout.fnmatch_lines(["*none.mcap: no such recording"])
    pytester.runpytest_inprocess("--update-references").assert_outcomes(passed=2, errors=1)
    pytester.runpytest_inprocess().assert_outcomes(passed=2, errors=1)
    text = Path(pytester.path / "run.txt")
    text.write_text(text.read_text().replace("30 messages", "31 messages"))
    changed = pytester.runpytest_inprocess()
    changed.stdout.fnmatch_lines(["*run.txt says something else*"])


def test_elsewhere_every_step_must_lie_within_the_tolerance(record: Record) -> None:
    recording = record()
    near, far = (override(recording.graph, [f"adder.scale={scale}"], []) for scale in (1.000001, 1.1))
    report = replay(recording, graph=near, changed=["adder"])
    (adder,) = report.operators
    assert adder.first is not None
    assert 0.0 < adder.first.largest < adder.largest < 1e-3  # the sums grow
    assert not tolerable(report)  # here bits count
    report.warnings.append("recorded on another class of processor")
    assert tolerable(report)
    report = replay(recording, graph=far, changed=["adder"])
    report.warnings.append("recorded on another class of processor")
    assert not tolerable(report)
