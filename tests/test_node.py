"""A node: what an operator may return, what becomes of it, and what the step says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from graph import End, Operator, Source, Summary
from graph.codec import decode, digest, encode
from graph.contract import ContractError, ports_of
from graph.ledger import Emitted, Ref, Skip, Step
from graph.lockstep import Arrival
from graph.messages import Tick
from graph.node import Emission, Node, OutputError
from graph.wiring import Input, NodeSpec
from tests.sample_operators import Count, CountOutputs, Sum


def node_of(operator: Operator, incarnation: int = 0) -> Node:
    """Return a node whose inputs come from an operator `other`, ticks from a timer."""
    ports = ports_of(type(operator))
    inputs = tuple(
        Input(port, "timer/10hz", "timer", period=10**8) if kind is Tick else Input(port, f"other/{port}", "other")
        for port, kind in ports.inputs.items()
    )
    spec = NodeSpec(
        name="trial",
        order=0,
        run="",
        root=".",
        config={},
        kind="operator",
        inputs=inputs,
        outputs=tuple(ports.outputs),
        record={},
        consumers=(),
        heard=(),
        threads=1,
        restart="never",
        mode="lockstep",
        pace="max",
        duration=None,
        end=None,
        ahead=10**9,
    )
    return Node(spec, operator, incarnation)


def count(value: int) -> Count:
    return Count(measured_at=0, value=value)


class Two(msgspec.Struct):
    """Two outputs."""

    one: Count | None = None
    two: Sum | None = None


class Saying(Operator):
    """Return whatever it was given."""

    Outputs = Two

    def __init__(self, said: Any, at_end: Any = None) -> None:
        super().__init__()
        self.said, self.at_end, self.heard = said, at_end, []

    def on_count(self, count: Count) -> Any:
        self.heard.append(count)
        return self.said

    def on_tick(self, tick: Tick) -> Any:
        self.heard.append(tick)

    def on_end(self) -> Any:
        return self.at_end


def say(said: Any) -> tuple[list[Emission], Step]:
    emissions: list[Emission] = []
    node = node_of(Saying(said))
    return emissions, node.feed(
        "count", Ref("other/count", 0, 3), b"\x82\xabmeasured_at\x00\xa5value\x07", 50, emissions.append
    )


def both(one: int | None, two: float | None) -> Two:
    return Two(None if one is None else count(one), None if two is None else Sum(measured_at=0, value=two))


def generated() -> Iterator[Any]:
    yield both(1, None)
    yield [both(2, 0.5), None]
    yield End("enough")


@pytest.mark.parametrize(
    ("said", "ports", "ended"),
    [
        (None, [], None),
        (both(None, None), [], None),
        (both(1, None), [("one", 0)], None),
        (both(1, 2.0), [("one", 0), ("two", 0)], None),
        ([both(1, 2.0), both(3, None)], [("one", 0), ("two", 0), ("one", 1)], None),
        ((both(1, None), End("done")), [("one", 0)], "done"),
        (End(), [], ""),
        (generated(), [("one", 0), ("one", 1), ("two", 0)], "enough"),
    ],
    ids=range(8),
)
def test_what_a_call_returns_is_emitted_in_order_and_noted(
    said: Any, ports: list[tuple[str, int]], ended: str | None
) -> None:
    emissions, step = say(said)
    assert [(item.port, item.sequence) for item in emissions] == ports
    assert step.emitted == tuple(Emitted(item.port, item.sequence, digest(item.payload)) for item in emissions)
    assert {item.stamp for item in emissions} <= {50}
    assert (step.index, step.port, step.stamp, step.ended) == (0, "count", 50, ended)
    assert step.consumed == (Ref("other/count", 0, 3),)
    assert step.wall_duration >= 0


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        (3, "trial: on_count wants to return Outputs, End, None or an iterator of them; it gave a int"),
        ([both(1, None), "text"], "it gave a str"),
        (count(3), "it gave a Count"),
        (Summary(a=1), "it gave a Summary"),
        (Two(one=Sum(measured_at=0, value=1.0)), "trial/one wants Count; on_count gave a Sum"),  # type: ignore[arg-type]
    ],
)
def test_what_is_no_output_is_refused_by_name(said: Any, sentence: str) -> None:
    with pytest.raises(OutputError, match=sentence):
        say(said)


def test_steps_and_sequences_count_on_from_call_to_call() -> None:
    node = node_of(Saying(both(1, None)))
    emissions: list[Emission] = []
    payload = encode(count(7))
    steps = [node.start(emissions.append)]
    steps += [node.feed("count", Ref("other/count", 0, n), payload, n, emissions.append) for n in range(3)]
    steps.append(node.finish(9, emissions.append, (Skip("other/count", 0, 3, "unhandled"),)))
    assert [(step.index, step.port, step.stamp) for step in steps] == [
        (0, "start", 0), (1, "count", 0), (2, "count", 1), (3, "count", 2), (4, "end", 9),
    ]  # fmt: skip
    assert [item.sequence for item in emissions] == [0, 1, 2]
    assert node.counts == {"one": 3, "two": 0}
    assert steps[-1].skipped == (Skip("other/count", 0, 3, "unhandled"),)


def test_ticks_are_born_with_the_stamp_of_the_call_and_skips_are_noted() -> None:
    node = node_of(Saying(None))
    port = list(ports_of(Saying).inputs).index("tick")
    skipped = (Skip("timer/10hz", 0, 3, "missed"),)
    step = node.handle(Arrival(400, port, 4, 0, None, skipped, late=True), 400, lambda emission: None)
    (tick,) = node.operator.heard  # type: ignore[attr-defined]
    assert (tick.measured_at, tick.index) == (400, 4)
    assert (step.consumed, step.skipped, step.late) == ((Ref("timer/10hz", 0, 4),), skipped, True)


def test_messages_are_decoded_before_they_are_handed_over() -> None:
    operator = Saying(None)
    payload = encode(count(7))
    node_of(operator).feed("count", Ref("other/count", 0, 0), payload, 5, lambda emission: None)
    assert (operator.heard[0].measured_at, operator.heard[0].value) == (0, 7)
    assert decode(payload, Count).value == 7


def test_summaries_take_the_numbers_of_numpy_and_refuse_what_is_none() -> None:
    node = node_of(Saying(None, Summary(a=np.float64(1.5), b=np.int32(2), c={"p50": np.float32(0.5)}, d=np.arange(2))))
    node.finish(0, lambda emission: None)
    assert node.summary == {"a": 1.5, "b": 2, "c": {"p50": 0.5}, "d": [0, 1]}
    assert type(node.summary["a"]) is float
    with pytest.raises(OutputError, match=r"a Summary holds numbers by name, .* it was given a Saying"):
        node_of(Saying(None, Summary(a=Saying(None)))).finish(0, lambda emission: None)


class Streaming(Source):
    """Give what it was given."""

    Outputs = CountOutputs

    def __init__(self, items: list[tuple[int, Any]]) -> None:
        super().__init__()
        self.items = items

    def stream(self) -> Iterator[tuple[int, Any]]:
        yield from self.items


def test_a_source_is_read_item_by_item() -> None:
    node = node_of(Streaming([(0, CountOutputs(count(1))), (7, [CountOutputs(count(2)), End()])]))
    emissions: list[Emission] = []
    steps = []
    while (stamp := node.peek()) is not None:
        steps.append(node.handle(Arrival(stamp, -1, 0, 0, None), stamp, emissions.append))
    assert [(step.port, step.stamp, step.consumed, step.ended) for step in steps] == [
        ("stream", 0, (), None), ("stream", 7, (), ""),
    ]  # fmt: skip
    assert [decode(item.payload, Count).value for item in emissions] == [1, 2]


@pytest.mark.parametrize("stamps", [[-1], [3, 3], [3, 2]])
def test_stamps_of_a_stream_increase_strictly(stamps: list[int]) -> None:
    node = node_of(Streaming([(stamp, None) for stamp in stamps]))
    for _ in stamps[:-1]:
        node.peek()
    with pytest.raises(OutputError, match="trial: stamps of a stream increase strictly from 0"):
        node.peek()


def test_ports_are_in_the_order_of_the_class_body_base_classes_first() -> None:
    class First(Operator):
        def on_b(self, count: Count) -> None: ...

        def on_a(self, count: Count) -> None: ...

    class Second(First):
        def on_c(self, count: Count | None) -> None: ...

        def on_a(self, count: Sum) -> None: ...  # type: ignore[override]

    assert list(ports_of(Second).inputs.items()) == [("b", Count), ("a", Sum), ("c", Count)]


def test_a_method_that_is_no_port_is_refused_by_name() -> None:
    class Untyped(Operator):
        def on_count(self, count) -> None: ...  # type: ignore[no-untyped-def]

    class Plain(Operator):
        def on_count(self, count: int) -> None: ...

    with pytest.raises(ContractError, match=r"Untyped\.on_count wants exactly one annotated parameter"):
        ports_of(Untyped)
    with pytest.raises(ContractError, match=r"Plain\.on_count wants one message type"):
        ports_of(Plain)


class Listening(Saying):
    """A Saying that promises to say nothing at one port."""

    def on_count(self, count: Count) -> None:
        self.heard.append((count.value, self.stamp))
        return self.said  # type: ignore[no-any-return]


def test_a_method_annotated_to_return_none_is_held_to_it() -> None:
    assert ports_of(Listening).silent == {"count"}
    assert ports_of(Saying).silent == frozenset()
    for said, complaint in ((None, None), (both(1, None), "Two"), (End(), "End")):
        node = node_of(Listening(said))
        arrival = Arrival(50, 0, 0, 0, encode(count(7)))
        if complaint is None:
            assert node.handle(arrival, 50, lambda emission: None).emitted == ()
            assert node.operator.heard == [(7, 50)]  # type: ignore[attr-defined]
            continue
        with pytest.raises(OutputError, match=f"trial: on_count is annotated to return None.* it gave a {complaint}"):
            node.handle(arrival, 50, lambda emission: None)
