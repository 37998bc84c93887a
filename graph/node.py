"""One operator at work: bytes in, one call, bytes out, and the step that the ledger keeps of it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from graph.codec import decode, digest, encode_into
from graph.contract import End, Operator, Source, Summary, ports_of
from graph.errors import UserError
from graph.ledger import Emitted, Ref, Skip, Step
from graph.loading import build_config, load_class
from graph.lockstep import Arrival
from graph.messages import Tick
from graph.ring import LARGE, RingWriter
from graph.wiring import NodeSpec

START, END, STREAM = "start", "end", "stream"


class Emission(NamedTuple):
    """A message on its way out."""

    port: str
    sequence: int
    stamp: int
    payload: bytes | memoryview
    place: int | None = None  # in the ring of its topic


class OutputError(TypeError):
    """An operator returned what it may not."""


Emit = Callable[[Emission], None]


def _plain(value: Any) -> Any:
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise OutputError(f"a Summary holds numbers by name, and dicts of them; it was given a {type(value).__name__}")


def build_operator(spec: NodeSpec) -> Operator:
    """Import, warm up and construct the operator of a spec. Raises UserError by name, also for a bad config."""
    kind = load_class(spec.run, spec.root)
    kind.warm_up()
    config = build_config(kind, spec.config, Path(spec.root))
    try:
        return kind(config)
    except (ValueError, OSError) as error:  # a file, a scenario, a number that cannot be
        logging.getLogger(spec.name).debug("cannot be made", exc_info=True)
        raise UserError(f"{spec.name}: {error}") from error


class Node:
    """Runs the calls of one operator; owns its sequences and its step index, and nothing about time."""

    def __init__(
        self, spec: NodeSpec, operator: Operator, incarnation: int = 0, rings: dict[str, RingWriter] | None = None
    ) -> None:
        self.spec, self.operator, self.incarnation = spec, operator, incarnation
        ports = ports_of(type(operator))
        self.input_types, self.output_types, self.silent = ports.inputs, ports.outputs, ports.silent
        self.handlers = {port: getattr(operator, f"on_{port}") for port in ports.inputs}
        self.counts = dict.fromkeys(ports.outputs, 0)
        self.rings = rings or {}  # by output port
        self.sizes = dict.fromkeys(ports.outputs, 0)  # of the last payloads, where there is a ring
        self.index = 0
        self.summary: Summary | None = None
        self.stream: Iterator[tuple[int, Any]] | None = None
        self.peeked: Any = None
        self.last_stamp = -1  # of the stream

    def peek(self) -> int | None:
        """Fetch the next item of a source's stream and return its stamp; None when there are no more.

        Raises OutputError where stamps do not increase strictly.
        """
        assert isinstance(self.operator, Source)
        if self.stream is None:
            self.stream = iter(self.operator.stream())
        item = next(self.stream, None)
        if item is None:
            return None
        stamp, self.peeked = int(item[0]), item[1]
        if stamp <= self.last_stamp:
            raise OutputError(
                f"{self.spec.name}: stamps of a stream increase strictly from 0; {stamp} comes after {self.last_stamp}"
            )
        self.last_stamp = stamp
        return stamp

    def start(self, emit: Emit, stamp: int = 0) -> Step:
        """Run on_start, at stamp 0 or when an operator is brought back."""
        return self._run(START, stamp, self.operator.on_start, (), emit)

    def finish(self, stamp: int, emit: Emit, skipped: tuple[Skip, ...] = ()) -> Step:
        """Run on_end, at the stamp at which the run ends; `skipped` names what nobody will handle."""
        return self._run(END, stamp, self.operator.on_end, (), emit, skipped=skipped)

    def handle(self, arrival: Arrival, stamp: int, emit: Emit) -> Step:
        """Decode one arrival, call its on_ method at a stamp, and emit what it returns."""
        if arrival.port < 0:
            item, self.peeked = self.peeked, None
            return self._run(STREAM, stamp, lambda: item, (), emit, late=arrival.late)
        edge = self.spec.inputs[arrival.port]
        ref = Ref(edge.topic, arrival.incarnation, arrival.sequence)
        return self.feed(edge.port, ref, arrival.payload, stamp, emit, skipped=arrival.skipped, late=arrival.late)

    def feed(
        self,
        port: str,
        ref: Ref,
        payload: bytes | memoryview | None,
        stamp: int,
        emit: Emit,
        *,
        skipped: tuple[Skip, ...] = (),
        late: bool = False,
    ) -> Step:
        """Call on_<port> with a message given as bytes; None stands for a tick, which is born here."""
        handler, kind = self.handlers[port], self.input_types[port]

        def call() -> Any:
            if payload is None:
                return handler(Tick(measured_at=stamp, index=ref.sequence))
            return handler(decode(payload, kind))

        return self._run(port, stamp, call, (ref,), emit, skipped=skipped, late=late)

    def _run(
        self,
        port: str,
        stamp: int,
        call: Callable[[], Any],
        consumed: tuple[Ref, ...],
        emit: Emit,
        *,
        skipped: tuple[Skip, ...] = (),
        late: bool = False,
    ) -> Step:
        wall_start, begin = time.time_ns(), time.perf_counter_ns()
        emitted: list[Emitted] = []
        ended: str | None = None
        self.operator.stamp = stamp
        result = call()
        if result is not None and port in self.silent:
            raise OutputError(
                f"{self.spec.name}: on_{port} is annotated to return None, so nobody waits for what it says; it gave "
                f"a {type(result).__name__}"
            )
        for item in self._items(result, port):
            if isinstance(item, End):
                ended = item.reason
                continue
            for emission in self._messages(item, port, stamp):
                emitted.append(Emitted(emission.port, emission.sequence, digest(emission.payload)))
                emit(emission)
        step = Step(
            self.index,
            port,
            stamp,
            consumed,
            skipped,
            tuple(emitted),
            ended,
            late,
            wall_start,
            time.perf_counter_ns() - begin,
        )
        self.index += 1
        return step

    def _items(self, result: Any, port: str) -> Iterator[Any]:
        if result is None:
            return
        if isinstance(result, Summary) and port == END:
            self.summary = Summary(msgspec.to_builtins(dict(result), enc_hook=_plain))
            return
        if isinstance(result, msgspec.Struct):
            yield result
        elif isinstance(result, (Iterator, list, tuple)):
            for item in result:
                yield from self._items(item, port)
        else:
            raise OutputError(self._complaint(result, port))

    def _messages(self, outputs: Any, port: str, stamp: int) -> Iterator[Emission]:
        if not isinstance(outputs, self.operator.Outputs):
            raise OutputError(self._complaint(outputs, port))
        for name, kind in self.output_types.items():
            message = getattr(outputs, name)
            if message is None:
                continue
            if type(message) is not kind:
                raise OutputError(
                    f"{self.spec.name}/{name} wants {kind.__name__}; on_{port} gave a {type(message).__name__}"
                )
            sequence = self.counts[name]
            self.counts[name] = sequence + 1
            yield self._encoded(Emission(name, sequence, stamp, b""), message)

    def _encoded(self, emission: Emission, message: msgspec.Struct) -> Emission:
        """Encode a message where its readers find it: in the ring if it is large and there is room, else in bytes."""
        port, place = emission.port, None
        if (ring := self.rings.get(port)) is None:
            return emission._replace(payload=encode_into(message, None))

        def room(size: int) -> memoryview | None:
            nonlocal place
            self.sizes[port] = size
            envelope = (self.incarnation, emission.sequence, emission.stamp)
            if size < LARGE or (found := ring.allocate(size, envelope)) is None:
                return None
            place, memory = found
            return memory

        if self.sizes[port] >= LARGE:
            ring.call()  # most likely this one is large too
        return emission._replace(payload=encode_into(message, room), place=place)

    def _complaint(self, given: Any, port: str) -> str:
        wanted = "Outputs, End, None or an iterator of them" + (", or a Summary" if port == END else "")
        return f"{self.spec.name}: on_{port} wants to return {wanted}; it gave a {type(given).__name__}"
