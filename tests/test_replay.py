"""Replay: equal to the bit, or the first divergence by name; swapped operators compared field by field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from graph.check import require
from graph.diff import compare
from graph.errors import UserError
from graph.inprocess import launch_in_process
from graph.override import override
from graph.playback import stand_in
from graph.recording import Recording
from graph.replay import replay
from graph.rerecord import Rerecorder, run_for
from graph.wiring import wire
from tests.conftest import CHAIN

Record = Callable[..., Recording]


def test_every_operator_says_again_what_it_said(record: Record) -> None:
    report = replay(record())
    assert report.equal
    assert [item.operator for item in report.operators] == ["counter", "relay", "adder", "feedback", "maker", "blobs"]
    assert sum(item.messages for item in report.operators) > 100
    assert not report.warnings


@pytest.mark.parametrize("cheat", ["WallClock", "Unseeded"])
def test_an_operator_that_cheats_is_caught_by_name(record: Record, cheat: str) -> None:
    report = replay(record(swaps=(f"relay=tests.sample_operators:{cheat}",), sets=()))
    by_name = {item.operator: item for item in report.operators}
    assert not report.equal
    first = by_name["relay"].first
    assert first is not None
    assert (first.step, first.stamp, first.port) == (1, 0, "relay/count")
    assert first.fields[0].field == "value"
    assert first.fields[0].largest
    assert by_name["relay"].divergent == 30
    assert by_name["counter"].equal
    assert by_name["adder"].equal  # it was fed what was recorded, and did with it what it had done


def test_changed_settings_are_fed_by_the_ledger_and_compared(record: Record) -> None:
    recording = record()
    graph = override(recording.graph, ["relay.offset=7"], [])
    report = replay(recording, graph=graph, changed=["relay"])
    (item,) = report.operators
    assert item.first is not None
    assert str(item.first) == "step 1 at 0.000 s, relay/count: value was 1, is 7, largest difference 6"


def test_a_swapped_operator_is_fed_by_rule_and_compared_field_by_field(record: Record) -> None:
    recording = record()
    same = override(recording.graph, [], ["relay=tests.sample_operators:Slow"])
    (item,) = replay(recording, graph=same, swapped=["relay"]).operators
    assert item.swapped
    assert item.fields["count.value"] == {"equal": 30, "compared": 30, "median": 0.0, "largest": 0.0}
    other = override(recording.graph, ["relay.offset=3"], ["relay=tests.sample_operators:Slow"])
    (item,) = replay(recording, graph=other, swapped=["relay"]).operators
    assert item.fields["count.value"] == {"equal": 0, "compared": 30, "median": 2.0, "largest": 2.0}
    assert item.fields["count"] == {"compared": 30, "only_recorded": 0, "only_replayed": 0}


def test_an_operator_that_raises_in_replay_is_reported_with_its_place(record: Record) -> None:
    recording = record()
    graph = override(recording.graph, ["relay.at=5"], ["relay=tests.sample_operators:Failing"])
    by_rule = replay(recording, graph=graph, swapped=["relay"]).operators[0]
    by_ledger = replay(recording, graph=graph, changed=["relay"]).operators[0]
    for item in (by_rule, by_ledger):
        assert item.first is not None
        assert "raised RuntimeError: failed at 5, as configured (sample_operators.py:" in str(item.first)
    assert by_ledger.unjudged == 25


DIGESTS = CHAIN.replace("config: {size: 3000}}", "config: {size: 3000}, record: digest}")


def test_digests_are_held_against_what_their_producer_says_again(record: Record) -> None:
    recording = record(DIGESTS)
    assert recording.counts.get("maker/blob", 0) == 0
    assert recording.verdict.verdict == "COMPLETE"
    report = replay(recording, operators=["blobs"])
    assert [(item.operator, item.equal) for item in report.operators] == [("maker", True), ("blobs", True)]


def test_what_lies_downstream_of_a_divergence_is_not_judged(record: Record) -> None:
    recording = record(DIGESTS)
    graph = override(recording.graph, ["maker.seed=4"], [])
    maker, blobs = replay(recording, graph=graph, operators=["maker", "blobs"], changed=["maker"]).operators
    assert maker.first is not None
    assert "digest only" in maker.first.what
    assert blobs.first is None
    assert blobs.unjudged == 16
    assert not blobs.equal


def test_a_recording_of_a_replay_holds_what_is_said_now(record: Record, tmp_path: Path) -> None:
    recording = record()
    graph = override(recording.graph, ["relay.offset=9"], [])
    out = tmp_path / "again.mcap"
    with Rerecorder(recording, out, run_for(recording, recording.run.graph, wire(graph)), ["relay"]) as rerecorder:
        replay(recording, graph=graph, changed=["relay"], keep=rerecorder.keep)
        rerecorder.finish()
    again = Recording(out)
    assert again.verdict.reasons[0] == "relay replayed on run.mcap: not one run"
    difference = {item.operator: item.different for item in compare(recording, again).operators}
    assert difference.pop("relay") == 60
    assert not any(difference.values())


def test_recorded_operators_stand_in_for_themselves(record: Record, tmp_path: Path) -> None:
    recording = record()
    graph = require(stand_in(recording.graph, recording.path, ["counter", "maker"]))
    _, path = launch_in_process(graph, record=tmp_path / "played.mcap")
    played = Recording(path)
    assert played.verdict.verdict == "COMPLETE"
    difference = {item.operator: item.different for item in compare(recording, played).operators}
    assert {name for name, count in difference.items() if count} <= {"counter", "maker"}
    assert [entry for entry in played.messages()] == [entry for entry in recording.messages()]


def test_unknown_names_and_sources_are_refused_by_name(record: Record) -> None:
    recording = record()
    with pytest.raises(UserError, match=r"no operator 'relais' in .*did you mean 'relay'"):
        replay(recording, operators=["relais"])
    source = record(
        "clock: {end: scans}\noperators:\n  scans: {run: tests.sample_operators:Scans}\n"
        "  relay: {run: tests.sample_operators:Relay, inputs: {count: scans/count}}",
        name="source.mcap",
    )
    with pytest.raises(UserError, match="'scans' is a source"):
        replay(source, operators=["scans"])
    assert [item.operator for item in replay(source).operators] == ["relay"]
    assert replay(source).equal
