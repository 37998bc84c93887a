"""Recorded operators in place of live ones: the rest of the graph cannot tell."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from graph.check import require
from graph.contract import Source, ports_of
from graph.diff import compare
from graph.errors import UserError
from graph.graphfile import Graph
from graph.inprocess import launch_in_process
from graph.loading import load_class
from graph.playback import Playback, playback_of, stand_in
from graph.recording import Recording
from graph.recover import recover
from tests.conftest import CHAIN
from tests.sample_operators import Counter, Scans

Record = Callable[..., Recording]


def played(graph: Graph, path: Path) -> Recording:
    return Recording(launch_in_process(require(graph), record=path)[1])


def different(one: Recording, two: Recording) -> set[str]:
    return {item.operator for item in compare(one, two).operators if item.different}


def test_a_playback_is_a_source_with_the_outputs_of_the_class_it_stands_in_for() -> None:
    kind = load_class("graph.playback:tests.sample_operators.Counter")
    assert kind is playback_of(Counter)
    assert issubclass(kind, Source)
    assert issubclass(kind, Playback)
    assert ports_of(kind).outputs == ports_of(Counter).outputs
    assert ports_of(kind).inputs == {}
    assert playback_of(Scans).__name__ == "PlaybackOfScans"


@pytest.mark.parametrize("run", ["graph.playback:tests.sample_operators.Cuonter", "graph.playback:nowhere.Counter"])
def test_a_class_that_is_not_there_is_named(run: str) -> None:
    with pytest.raises(UserError):
        load_class(run)


@pytest.mark.parametrize(
    "names", [["counter"], ["relay"], ["counter", "relay", "feedback", "maker"], ["adder"], ["blobs", "feedback"]]
)
def test_the_other_operators_say_the_same(record: Record, tmp_path: Path, names: list[str]) -> None:
    recording = record()
    copy = played(stand_in(recording.graph, recording.path, names), tmp_path / "played.mcap")
    assert copy.verdict.verdict == "COMPLETE"
    assert different(recording, copy) <= set(names)
    assert list(copy.messages()) == list(recording.messages())


def test_what_was_said_at_the_end_is_said_again(record: Record, tmp_path: Path) -> None:
    text = """
clock: {end: one}
operators:
  one: {run: tests.trial_operators:Mixer, inputs: {slow: timer/10hz}, config: {last: 5, starts: true, ends: true}}
  two: {run: tests.trial_operators:Mixer, inputs: {a: one/x, b: {from: one/y, delay: 10ms}, slow: timer/7hz}}
"""
    recording = record(text)
    copy = played(stand_in(recording.graph, recording.path, ["one"]), tmp_path / "played.mcap")
    assert different(recording, copy) <= {"one"}
    assert copy.verdict.end == recording.verdict.end


def test_a_playback_of_a_run_that_a_person_ended_ends_where_that_did(record: Record, tmp_path: Path) -> None:
    """A run by duration holds no End of the operator which the next graph waits for."""
    recording = record(CHAIN.replace("end: counter", "duration: 1s"))
    graph = stand_in(recording.graph, recording.path, ["counter"])
    graph.clock.duration, graph.clock.end = None, "counter"
    copy = played(graph, tmp_path / "played.mcap")
    assert copy.verdict.end == recording.verdict.end
    assert different(recording, copy) <= {"counter"}


def test_a_playback_of_a_crashed_run_ends_with_its_last_call(record: Record, tmp_path: Path) -> None:
    recording = record()
    data = recording.path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) - 100])
    recover(tmp_path / "cut.mcap", tmp_path / "back.mcap")
    copy = played(stand_in(recording.graph, tmp_path / "back.mcap", ["counter"]), tmp_path / "played.mcap")
    assert copy.verdict.end == recording.verdict.end


def test_recorded_sources_play_too(record: Record, tmp_path: Path) -> None:
    recording = record(
        "clock: {end: scans}\noperators:\n  scans: {run: tests.sample_operators:Scans}\n"
        "  relay: {run: tests.sample_operators:Relay, inputs: {count: scans/count}}"
    )
    copy = played(stand_in(recording.graph, recording.path, ["scans"]), tmp_path / "played.mcap")
    assert different(recording, copy) <= {"scans"}
    assert recording.verdict.end == 900_000_000


def test_what_cannot_stand_in_is_refused_by_name(record: Record) -> None:
    recording = record()
    with pytest.raises(UserError, match=r"there is no operator 'cuonter' in chain.*did you mean 'counter'"):
        stand_in(recording.graph, recording.path, ["cuonter"])
    digests = record(CHAIN.replace("config: {size: 3000}}", "config: {size: 3000}, record: digest}"), name="d.mcap")
    with pytest.raises(UserError, match=r"d\.mcap holds messages of maker as digests only"):
        stand_in(digests.graph, digests.path, ["maker"])
    smaller = record(CHAIN.replace("  blobs:", "  others:"), name="small.mcap")
    with pytest.raises(UserError, match=r"there is no operator 'blobs' in .*small\.mcap"):
        stand_in(recording.graph, smaller.path, ["blobs"])
