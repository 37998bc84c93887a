"""The rules of lockstep, as properties of random graphs under random schedules."""

from __future__ import annotations

import random
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.check import check
from graph.diff import compare
from graph.errors import UserError
from graph.graphfile import Clock, Edge, Graph, OperatorEntry
from graph.inprocess import launch_in_process
from graph.launcher import launch
from graph.ledger import Mark
from graph.lockstep import Arrival, GapError, Lockstep
from graph.recording import Recording
from graph.wiring import wire
from tests.random_graphs import FIXED, TRIALS, Ledger, Network, graphs, reference


@settings(FIXED, max_examples=150)
@given(graphs(), st.integers(0, 10**6))
def test_every_schedule_gives_the_order_of_the_sequential_reference(graph: Graph, seed: int) -> None:
    assert [str(mistake) for mistake in check(graph).mistakes] == []
    wanted = reference(graph)
    for offset in range(3):
        steps = Network(graph, random.Random(seed + offset)).run()
        assert {name: [step.facts() for step in own] for name, own in steps.items()} == wanted


@settings(FIXED, max_examples=12)
@given(graphs(), st.integers(0, 10**6))
def test_real_graphs_in_one_process_say_what_the_reference_says(
    tmp_path_factory: pytest.TempPathFactory, graph: Graph, seed: int
) -> None:
    wanted = reference(graph)
    folder = tmp_path_factory.mktemp("random")
    for shuffle in (None, seed):
        verdict, path = launch_in_process(graph, record=folder / f"{shuffle}.mcap", shuffle=shuffle)
        assert (verdict.verdict, verdict.reasons) == ("COMPLETE", [])
        assert ledger_of(Recording(path), wanted) == wanted
    assert compare(Recording(folder / "None.mcap"), Recording(path)).equal


def ledger_of(recording: Recording, names: Iterable[str]) -> Ledger:
    ledger: Ledger = {name: [] for name in names}
    for operator, _, step in recording.steps(*ledger):
        ledger[operator].append(step.facts())
    return ledger


def launched(graph: Graph, path: Path) -> None:
    """Run a graph in processes of its own and hold every step against the reference."""
    wanted = reference(graph)
    outcome = launch(graph, record=path, quiet=True)
    assert (outcome.verdict.verdict, outcome.verdict.reasons) == ("COMPLETE", [])
    assert ledger_of(Recording(path), wanted) == wanted


@pytest.mark.slow
@settings(FIXED, max_examples=30)
@given(graphs())
def test_launched_graphs_say_what_the_reference_says(tmp_path_factory: pytest.TempPathFactory, graph: Graph) -> None:
    launched(graph, tmp_path_factory.mktemp("random") / "run.mcap")


def test_a_tangled_graph_in_processes_says_what_the_reference_says(tmp_path: Path) -> None:
    graph = _graph(
        Clock(end="one", ahead=7),
        two=_mix(
            {"a": Edge("one", "x"), "b": Edge("three", "y", 3), "fast": Edge("timer", "3ns")}, share=30, ends=True
        ),
        three=_mix({"a": Edge("two", "x"), "c": Edge("one", "y", 2), "d": Edge("two", "x", 4)}, share=40, starts=True),
        source=OperatorEntry(f"{TRIALS}:MixerSource", {}, {"share": 90, "stamps": [0, 1, 5, 9, 30, 31], "ends": True}),
        one=_mix(
            {"slow": Edge("timer", "5ns", 2), "b": Edge("two", "y", 3), "d": Edge("one", "x", 9)}, share=40, last=16
        ),
        four=_mix({"a": Edge("source", "x"), "b": Edge("three", "x"), "slow": Edge("timer", "4ns")}, ends=True),
        screen=OperatorEntry("tests.sample_operators:Screen", {"count": Edge("four", "x")}),
    )
    assert check(graph).mistakes == []
    assert sum(map(len, reference(graph).values())) > 100
    launched(graph, tmp_path / "run.mcap")


def _graph(clock: Clock, **operators: OperatorEntry) -> Graph:
    return Graph(clock, operators, "small", ".")


def _mix(inputs: dict[str, Edge], **config: Any) -> OperatorEntry:
    return OperatorEntry(f"{TRIALS}:Mixer", inputs, {"share": 100} | config)


@pytest.mark.parametrize("stamps", [[], [0], [3, 7]])
def test_a_source_that_runs_dry_ends_the_run_at_its_last_item(stamps: list[int]) -> None:
    graph = _graph(
        Clock(end="source"),
        source=OperatorEntry(f"{TRIALS}:MixerSource", {}, {"share": 100, "ends": True, "stamps": stamps}),
        reader=_mix({"a": Edge("source", "x"), "fast": Edge("timer", "1ns")}),
    )
    wanted = reference(graph)
    assert wanted["reader"][-1][1:3] == ("end", max(stamps, default=0))
    for seed in range(40):
        steps = Network(graph, random.Random(seed)).run()
        assert {name: [step.facts() for step in own] for name, own in steps.items()} == wanted


def test_an_operator_that_can_never_say_end_is_named(tmp_path: Path) -> None:
    graph = _graph(
        Clock(end="mixer"),
        source=OperatorEntry(f"{TRIALS}:MixerSource", {}, {"share": 100, "stamps": [1, 2]}),
        mixer=_mix({"a": Edge("source", "x", 1)}, last=1000),
    )
    with pytest.raises(UserError, match=r"clock\.end names mixer; nothing is left to do, and it has not said End"):
        launch_in_process(graph, record=tmp_path / "endless.mcap")


def test_arrivals_of_one_stamp_come_in_the_order_of_ports_then_sequences() -> None:
    graph = _graph(
        Clock(duration=10),
        one=_mix({"slow": Edge("timer", "5ns")}),
        two=_mix({"slow": Edge("timer", "5ns")}),
        both=_mix({"b": Edge("two", "x"), "a": Edge("one", "x"), "fast": Edge("timer", "5ns")}),
    )
    schedule = Lockstep(next(spec for spec in wire(graph) if spec.name == "both"))
    schedule.started = True
    for topic in ("two/x", "one/x"):
        schedule.deliver(topic, 0, 0, 5, b"first")
        schedule.deliver(topic, 0, 1, 5, b"second")
    for name in ("one", "two"):
        assert [(arrival.time, arrival.port) for arrival in _drained(schedule)] == []
        schedule.mark(name, Mark(5, (2, 0)))
    ports = [schedule.spec.inputs[arrival.port].port for arrival in _drained(schedule)]
    assert ports == ["fast", "a", "a", "b", "b", "fast"]


def _drained(schedule: Lockstep) -> list[Arrival]:
    return list(iter(schedule.next, None))


def test_a_message_out_of_turn_is_a_gap_and_one_announced_in_vain_is_named() -> None:
    graph = _graph(Clock(duration=10), one=_mix({"slow": Edge("timer", "5ns")}), two=_mix({"a": Edge("one", "x")}))
    schedule = Lockstep(wire(graph)[1])
    schedule.mark("one", Mark(4, (2, 0)))
    assert schedule.gaps() == ["one/x number 0 of 2"]
    assert schedule.edges_at() == -1
    with pytest.raises(GapError, match="two: one/x number 0 is missing; number 1 came"):
        schedule.deliver("one/x", 0, 1, 0, b"")
    for sequence in range(2):
        schedule.deliver("one/x", 0, sequence, 0, b"")
    assert (schedule.gaps(), schedule.edges_at()) == ([], 4)


def test_a_source_that_a_person_stopped_is_asked_no_more() -> None:
    graph = _graph(Clock(duration=100), source=OperatorEntry(f"{TRIALS}:MixerSource", {}, {"stamps": [1]}))
    schedule = Lockstep(wire(graph)[0])
    schedule.started = True
    schedule.offer(10)
    schedule.finish_at(20)
    schedule.offer(15)
    assert [arrival.time for arrival in _drained(schedule)] == [10]
    assert schedule.complete()


def test_an_arrival_waits_only_for_what_may_come_before_it() -> None:
    graph = _graph(
        Clock(duration=100),
        one=_mix({"slow": Edge("timer", "5ns")}),
        both=_mix({"slow": Edge("timer", "5ns", 5), "a": Edge("one", "x", 5), "fast": Edge("timer", "1ns", 10)}),
    )
    schedule = Lockstep(wire(graph)[1])
    schedule.started = True
    ports = [edge.port for edge in schedule.spec.inputs]
    assert ports == ["slow", "a", "fast"]
    for watermark, due in ((-1, [(5, "slow")]), (3, []), (4, [(10, "slow")]), (5, [(10, "fast")])):
        schedule.mark("one", Mark(watermark, (0, 0)))  # what a may still bring comes 5 ns after that, and after `slow`
        assert [(arrival.time, ports[arrival.port]) for arrival in _drained(schedule)] == due


def test_what_is_only_listened_to_holds_up_no_promise_but_those_who_run_ahead() -> None:
    graph = _graph(
        Clock(duration=100),
        one=_mix({"slow": Edge("timer", "5ns")}),
        both=OperatorEntry(
            f"{TRIALS}:Listener", {"slow": Edge("timer", "5ns"), "a": Edge("one", "x", 2)}, {"share": 100}
        ),
    )
    schedule = Lockstep(wire(graph)[1])
    schedule.started = True
    schedule.mark("one", Mark(0, (0, 0)))
    assert [arrival.time for arrival in _drained(schedule)] == [0]
    assert (schedule.watermark(), schedule.through()) == (4, 2)
