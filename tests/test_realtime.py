"""The schedule of realtime against a clock that the test turns: order, queues, ticks, deadlines, nothing unnoted."""

from __future__ import annotations

from collections import Counter
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graph.graphfile import Clock, Edge, Graph, OperatorEntry
from graph.ledger import INFINITY, Skip
from graph.realtime import Realtime
from graph.wiring import wire

FIXED = settings(
    derandomize=True, deadline=None, database=None, max_examples=100, suppress_health_check=list(HealthCheck)
)
MIXER = "tests.trial_operators:Mixer"


def schedule(duration: int | None = None, run: str = MIXER, **inputs: Edge) -> Realtime:
    """Return the schedule of one operator that is fed by others and by timers; ports: slow, a, b, fast, c, d."""
    operators = {
        "own": OperatorEntry(run, inputs),
        "p": OperatorEntry(MIXER, {"slow": Edge("timer", "1ns")}),
        "q": OperatorEntry(MIXER, {"slow": Edge("timer", "1ns")}),
    }
    return Realtime(wire(Graph(Clock(mode="realtime", duration=duration), operators, "trial", "."))[0])


def handled(realtime: Realtime, now: int) -> list[tuple[str, int, int]]:
    """Handle everything that may be handled at a time: (port, stamp, sequence)."""
    found = []
    while (arrival := realtime.next(now)) is not None:
        port = realtime.spec.inputs[arrival.port].port if arrival.port >= 0 else "stream"
        found.append((port, arrival.time, arrival.sequence))
    return found


def feed(realtime: Realtime, topic: str, *stamps: int, first: int = 0) -> None:
    for sequence, stamp in enumerate(stamps, first):
        realtime.deliver(topic, 0, sequence, stamp, b"")


def test_what_has_arrived_is_handled_by_stamp_then_port_then_sequence() -> None:
    realtime = schedule(a=Edge("p", "x"), b=Edge("q", "x"), fast=Edge("timer", "10ns"))
    feed(realtime, "q/x", 3, 10)
    feed(realtime, "p/x", 3, 3, 12)
    assert handled(realtime, 10) == [
        ("a", 3, 0), ("a", 3, 1), ("b", 3, 0), ("b", 10, 1), ("fast", 10, 1), ("a", 12, 2),
    ]  # fmt: skip


def test_one_queue_keeps_the_latest_another_drops_its_oldest() -> None:
    realtime = schedule(a=Edge("p", "x", queue="latest"), b=Edge("p", "x", queue=2), c=Edge("p", "x"))
    feed(realtime, "p/x", *range(12))
    taken = handled(realtime, 100)
    assert [item[2] for item in taken if item[0] == "a"] == [11]
    assert [item[2] for item in taken if item[0] == "b"] == [10, 11]
    assert [item[2] for item in taken if item[0] == "c"] == list(range(2, 12))


def test_the_first_call_after_a_drop_notes_it() -> None:
    realtime = schedule(a=Edge("p", "x", queue="latest"))
    feed(realtime, "p/x", 1, 2, 3)
    first = realtime.next(10)
    assert first is not None
    assert first.skipped == (Skip("p/x", 0, 0, "queue"), Skip("p/x", 0, 1, "queue"))
    feed(realtime, "p/x", 4, first=3)
    second = realtime.next(10)
    assert second is not None
    assert second.skipped == ()


def test_ticks_that_came_while_busy_are_skips() -> None:
    realtime = schedule(fast=Edge("timer", "10ns"))
    assert handled(realtime, 0) == [("fast", 0, 0)]
    assert handled(realtime, 9) == []
    assert realtime.wake() == 10
    late = realtime.next(35)
    assert late is not None
    assert (late.time, late.sequence) == (30, 3)
    assert late.skipped == (Skip("timer/10ns", 0, 1, "missed"), Skip("timer/10ns", 0, 2, "missed"))
    assert realtime.wake() == 40


def test_a_delay_is_a_deadline_not_a_wait() -> None:
    realtime = schedule(a=Edge("p", "x", 5), fast=Edge("timer", "10ns", 5))
    feed(realtime, "p/x", 20)
    found = [realtime.next(24), realtime.next(24)]
    assert [(item.time, item.late) for item in found if item is not None] == [(20, False), (20, False)]
    feed(realtime, "p/x", 28, first=1)
    overdue = realtime.next(34)
    assert overdue is not None
    assert (overdue.time, overdue.late) == (28, True)
    tick = realtime.next(36)
    assert tick is not None
    assert (tick.time, tick.sequence, tick.late) == (30, 3, True)


def test_stamps_of_calls_never_go_back() -> None:
    realtime = schedule(a=Edge("p", "x"), fast=Edge("timer", "10ns"))
    assert handled(realtime, 40) == [("fast", 40, 4)]
    feed(realtime, "p/x", 5)
    assert handled(realtime, 41) == [("a", 40, 0)]


def test_timers_end_with_the_duration_and_with_a_stop() -> None:
    realtime = schedule(25, fast=Edge("timer", "10ns"))
    assert handled(realtime, 100) == [("fast", 20, 2)]
    assert realtime.wake() == INFINITY
    realtime = schedule(fast=Edge("timer", "10ns"), a=Edge("p", "x"))
    realtime.stopped = True
    feed(realtime, "p/x", 1)
    assert handled(realtime, 100) == [("a", 1, 0)]  # what is under way is handled still


def test_an_operator_that_is_brought_back_begins_with_the_next_tick() -> None:
    realtime = schedule(fast=Edge("timer", "10ns"))
    realtime.resume(57)
    assert handled(realtime, 58) == []
    tick = realtime.next(60)
    assert tick is not None
    assert (tick.time, tick.sequence, tick.skipped) == (60, 6, ())


def test_a_stream_is_handled_when_it_is_due() -> None:
    realtime = schedule(run="tests.trial_operators:MixerSource")
    realtime.offer(30)
    assert realtime.next(29) is None
    assert realtime.wake() == 30
    assert handled(realtime, 31) == [("stream", 30, 0)]
    realtime.offer(INFINITY)
    assert realtime.wake() == INFINITY


def test_a_sink_keeps_the_latest_of_each_input() -> None:
    realtime = schedule(run="tests.sample_operators:Screen", count=Edge("p", "x"))
    feed(realtime, "p/x", 1, 2, 3)
    assert handled(realtime, 10) == [("count", 3, 2)]


@settings(FIXED)
@given(st.data())
def test_every_message_is_handled_once_or_skipped_once(data: st.DataObject) -> None:
    queues: list[Any] = [data.draw(st.sampled_from(["latest", 1, 3, 10])) for _ in range(3)]
    realtime = schedule(a=Edge("p", "x", 2, queues[0]), b=Edge("p", "x", 0, queues[1]), c=Edge("q", "y", 0, queues[2]))
    sent: Counter[str] = Counter()
    taken: Counter[tuple[str, int]] = Counter()
    skipped: Counter[tuple[str, int]] = Counter()
    now = last = 0
    for act in data.draw(st.lists(st.sampled_from(["p/x", "q/y", "handle"]), max_size=60)):
        now += data.draw(st.integers(0, 3))
        if act != "handle":
            feed(realtime, act, now, first=sent[act])
            sent[act] += 1
        elif (arrival := realtime.next(now)) is not None:
            assert arrival.time >= last
            last = arrival.time
            taken[realtime.spec.inputs[arrival.port].topic, arrival.sequence] += 1
            skipped.update((skip.topic, skip.sequence) for skip in arrival.skipped)
    skipped.update((skip.topic, skip.sequence) for skip in realtime.leave())
    ports = {"p/x": 2, "q/y": 1}
    wanted = {(topic, sequence): ports[topic] for topic, count in sent.items() for sequence in range(count)}
    assert dict(taken + skipped) == wanted
    assert realtime.received == {"p/x": sent["p/x"], "q/y": sent["q/y"]}
