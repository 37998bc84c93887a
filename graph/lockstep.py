"""Lockstep: conservative discrete-event simulation of one operator, without threads, sockets or clocks.

The rules are those of Chandy, Misra and Bryant. A message with stamp s arrives over an edge with delay d at s + d.
Arrivals are handled in the order (arrival, port, sequence), and only once no earlier one can still come. Whoever owns
a `Lockstep` feeds it messages and marks in any interleaving; what it hands out never depends on the interleaving.
Two things let operators work at the same time whom plain rules would make wait for each other: an arrival waits only
for what may come before it, by time or by port; and no promise waits for what arrives where nothing is ever said.
"""

from __future__ import annotations

import heapq
from collections import deque
from typing import NamedTuple

from graph.ledger import INFINITY, Mark, Skip
from graph.wiring import Input, NodeSpec


class GapError(RuntimeError):
    """A message that was announced never came."""


def endless(name: str | None) -> str:
    """Say in a sentence that the operator which is to end the run will never be called again."""
    return f"clock.end names {name}; nothing is left to do, and it has not said End"


class Arrival(NamedTuple):
    """Something to handle: its order, and its content."""

    time: int  # s + d, nanoseconds: the stamp of the call
    port: int  # index into the inputs
    sequence: int
    incarnation: int
    payload: bytes | memoryview | None  # None for a tick, and for an item of a source
    skipped: tuple[Skip, ...] = ()
    late: bool = False


class _Edge:
    """What has come over one edge, and how far its producer is."""

    def __init__(self, edge: Input, port: int) -> None:
        self.edge, self.port = edge, port
        self.received = 0  # messages, in sequence
        self.watermark = -1 + edge.delay
        self.marks: deque[tuple[int, int]] = deque()  # (announced count, watermark) still short of messages

    def mark(self, mark: Mark) -> None:
        self.marks.append((mark.counts[self.edge.index], mark.watermark))
        self.settle()

    def settle(self) -> None:
        while self.marks and self.marks[0][0] <= self.received:
            self.watermark = max(self.watermark, self.marks.popleft()[1] + self.edge.delay)

    def gap(self) -> str | None:
        if not self.marks:
            return None
        return f"{self.edge.topic} number {self.received} of {self.marks[-1][0]}"


class Lockstep:
    """The schedule of one operator: which arrival may be handled now, and what may be promised to the others."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec = spec
        self.edges = [_Edge(edge, port) for port, edge in enumerate(spec.inputs) if edge.period is None]
        self.timers = [
            (port, edge.period, edge.delay) for port, edge in enumerate(spec.inputs) if edge.period is not None
        ]
        self.pending: list[Arrival] = [Arrival(delay, port, 0, 0, None) for port, _, delay in self.timers]
        heapq.heapify(self.pending)
        self.periods = {port: period for port, period, _ in self.timers}
        self.silent = {port for port, edge in enumerate(spec.inputs) if edge.silent}
        self.flow = dict.fromkeys((c for c in spec.consumers if c != spec.name), -1)
        self.control = INFINITY if spec.end in (None, spec.name) else -1  # how far the operator that ends the run is
        self.end = INFINITY if spec.duration is None else spec.duration
        self.started = False
        self.finished = False
        self.handled = -1  # stamp of the last call
        self.streaming = spec.kind == "source"
        self.stream_stamp = -1 if self.streaming else INFINITY  # nothing below comes from the own stream
        self.promised = -1

    def deliver(self, topic: str, incarnation: int, sequence: int, stamp: int, payload: bytes | memoryview) -> None:
        """Take a message off the wire. Raises GapError if one before it is missing."""
        for edge in self.edges:
            if edge.edge.topic != topic:
                continue
            if sequence != edge.received:
                raise GapError(f"{self.spec.name}: {topic} number {edge.received} is missing; number {sequence} came")
            edge.received += 1
            heapq.heappush(self.pending, Arrival(stamp + edge.edge.delay, edge.port, sequence, incarnation, payload))
            edge.settle()

    def mark(self, operator: str, mark: Mark) -> None:
        """Take another operator's mark: as its consumer, and as one whose run it may end."""
        for edge in self.edges:
            if edge.edge.producer == operator:
                edge.mark(mark)
        if operator == self.spec.end and operator != self.spec.name:
            if mark.end is not None:
                self.end = min(self.end, mark.end)
            self.control = max(self.control, mark.watermark)

    def consumer_at(self, operator: str, watermark: int) -> None:
        """Take a consumer's own watermark, which bounds how far ahead of it this operator may run."""
        if operator in self.flow:
            self.flow[operator] = max(self.flow[operator], watermark)

    def offer(self, stamp: int, payload: bytes | memoryview | None = None) -> None:
        """Queue the next item of a source's stream; INFINITY: there are no more, which ends a run that it is to end."""
        if not self.streaming:
            return  # a person stopped the run
        if stamp >= INFINITY:
            self.streaming, self.stream_stamp = False, INFINITY
            if self.spec.end == self.spec.name:
                self.finish_at(max(self.handled, 0))
            return
        self.stream_stamp = stamp
        heapq.heappush(self.pending, Arrival(stamp, -1, 0, 0, payload))

    def edges_at(self) -> int:
        """Return the stamp through which everything that can ever arrive is here."""
        horizon = min((edge.watermark for edge in self.edges), default=INFINITY)
        return min(horizon, self.stream_stamp)

    def _first(self, arrival: Arrival) -> bool:
        """Say whether nothing can still come that is to be handled before an arrival."""
        time, port = arrival.time, arrival.port
        for edge in self.edges:
            if edge.port != port and edge.watermark < (time if edge.port < port else time - 1):
                return False  # what comes over one edge comes in order
        return True

    def next(self) -> Arrival | None:
        """Return the arrival that may be handled now, and forget it; None if there is none yet."""
        if not self.pending or not self.started:
            return None
        time = self.pending[0].time
        if time > min(self.end, self.stream_stamp, self.control) or not self._first(self.pending[0]):
            return None
        if any(watermark < time - self.spec.ahead for watermark in self.flow.values()):
            return None
        arrival = heapq.heappop(self.pending)
        self.handled = time
        if (period := self.periods.get(arrival.port)) is not None:
            heapq.heappush(self.pending, arrival._replace(time=time + period, sequence=arrival.sequence + 1))
        return arrival

    def allow(self, stamp: int) -> None:
        """Allow arrivals through a stamp and no further, for now; replay uses it to walk through a recording."""
        self.end = stamp

    def finish_at(self, stamp: int) -> None:
        """Let the run end at a stamp: by this operator's own End, or because a person stopped it."""
        self.end = min(self.end, stamp)
        self.streaming, self.stream_stamp = False, INFINITY

    def complete(self) -> bool:
        """Say whether everything through the end has been handled, so that on_end may run."""
        if self.end == INFINITY or self.finished or not self.started:
            return False
        if self.pending and self.pending[0].time <= self.end:
            return False
        return min(self.edges_at(), self.control) >= self.end

    def through(self) -> int:
        """Return the stamp through which this operator has handled everything; it bounds who waits for it."""
        return self._reached(self.edges, self.pending[0].time if self.pending else INFINITY)

    def watermark(self) -> int:
        """Return the stamp through which this operator has emitted all it ever will."""
        if not self.silent:
            return self.through()
        speaking = [edge for edge in self.edges if edge.port not in self.silent]
        waiting = (arrival.time for arrival in self.pending if arrival.port not in self.silent)
        return self._reached(speaking, min(waiting, default=INFINITY))

    def _reached(self, edges: list[_Edge], waiting: int) -> int:
        """Return how far the operator is with some of its edges. waiting: stamp of what has arrived there first."""
        if self.finished:
            return INFINITY
        if not self.started:
            return -1
        # on_end speaks at the end, which is not known before the operator that ends the run has passed it
        horizon = min(self.stream_stamp, self.end - 1, self.control)
        for edge in edges:
            horizon = min(horizon, edge.watermark)
        if waiting < INFINITY:
            return min(horizon, waiting - 1)
        if self.streaming and self.spec.end == self.spec.name:
            return min(horizon, self.handled - 1)  # the last item may have been the last: then the run ends at it
        return horizon

    def news(self, counts: tuple[int, ...]) -> Mark | None:
        """Return the mark to tell the others, if it promises more than the last; `counts` as in Mark."""
        if (watermark := self.watermark()) <= self.promised:
            return None
        self.promised = watermark
        return Mark(watermark, counts, self.end if self.spec.end == self.spec.name and self.end < INFINITY else None)

    @property
    def received(self) -> dict[str, int]:
        """Return the number of messages that have come of each topic."""
        return {edge.edge.topic: edge.received for edge in self.edges}

    def dormant(self) -> bool:
        """Say whether only a message from another operator can make this one do something again."""
        return self.started and self.end == INFINITY and not self.pending and not self.streaming

    def gaps(self) -> list[str]:
        """Name the messages that were announced and have not come."""
        return [gap for edge in self.edges if (gap := edge.gap()) is not None]
