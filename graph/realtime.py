"""Realtime: what has arrived is handled in order, what is too old is skipped, and the ledger says so.

Also the schedule of every sink, in lockstep too: it takes the latest and holds back nobody.
"""

from __future__ import annotations

from collections import deque

from graph.ledger import INFINITY, Skip
from graph.lockstep import Arrival
from graph.wiring import NodeSpec


class Realtime:
    """The schedule of one operator against a clock. Times are nanoseconds since the start of the run."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec = spec
        self.queues: list[deque[Arrival]] = [deque() for _ in spec.inputs]
        self.limits = [1 if edge.queue == "latest" or spec.kind == "sink" else int(edge.queue) for edge in spec.inputs]
        self.ticks = [0] * len(spec.inputs)  # number of the next tick
        self.skips: list[Skip] = []
        self.received: dict[str, int] = {edge.topic: 0 for edge in spec.inputs if edge.period is None}
        self.stream: int | None = None  # stamp of the next item of a source
        self.handled = 0
        self.stopped = False  # timers and sources give nothing more

    def deliver(self, topic: str, incarnation: int, sequence: int, stamp: int, payload: bytes | memoryview) -> None:
        """Take a message off the wire; a full queue gives up its oldest."""
        self.received[topic] += 1
        for port, edge in enumerate(self.spec.inputs):
            if edge.topic != topic:
                continue
            waiting = self.queues[port]
            waiting.append(Arrival(stamp + edge.delay, port, sequence, incarnation, payload))
            while len(waiting) > self.limits[port]:
                old = waiting.popleft()
                self.skips.append(Skip(topic, old.incarnation, old.sequence, "queue"))

    def offer(self, stamp: int) -> None:
        """Queue the next item of a source's stream; INFINITY says that there are no more."""
        self.stream = None if stamp >= INFINITY else stamp

    def resume(self, now: int) -> None:
        """Begin in the midst of a run: the ticks so far were for an incarnation before this one."""
        self.handled = now
        self.ticks = [0 if edge.period is None else now // edge.period + 1 for edge in self.spec.inputs]

    def next(self, now: int) -> Arrival | None:
        """Return what to handle now, and forget it; None if nothing has arrived or is due."""
        best: Arrival | None = None
        for waiting in self.queues:
            if waiting and (best is None or waiting[0] < best):
                best = waiting[0]
        for tick in self._due(now):
            if best is None or tick < best:
                best = tick
        if (
            not self.stopped
            and self.stream is not None
            and self.stream <= now
            and (best is None or self.stream < best.time)
        ):
            best = Arrival(self.stream, -1, 0, 0, None)
        if best is None:
            return None
        if best.port < 0:
            self.stream = None
            delay = 0
        else:
            edge = self.spec.inputs[best.port]
            delay = edge.delay
            if edge.period is None:
                self.queues[best.port].popleft()
            else:
                for missed in range(self.ticks[best.port], best.sequence):
                    self.skips.append(Skip(edge.topic, 0, missed, "missed"))
                self.ticks[best.port] = best.sequence + 1
        late = delay > 0 and now > best.time
        time = max(best.time - delay, self.handled)  # a delay is a deadline here, not a wait
        self.handled = time
        return best._replace(time=time, skipped=self.take_skips(), late=late)

    def _due(self, now: int) -> list[Arrival]:
        """List the latest due tick of each timer."""
        if self.stopped:
            return []
        due = []
        until = now if self.spec.duration is None else min(now, self.spec.duration)
        for port, edge in enumerate(self.spec.inputs):
            if edge.period is not None and (number := until // edge.period) >= self.ticks[port]:
                due.append(Arrival(number * edge.period + edge.delay, port, number, 0, None))
        return due

    def wake(self) -> int:
        """Return when the next tick or item is due; INFINITY if never."""
        if self.stopped:
            return INFINITY
        times = [
            self.ticks[port] * edge.period for port, edge in enumerate(self.spec.inputs) if edge.period is not None
        ]
        if self.spec.duration is not None:
            times = [time for time in times if time <= self.spec.duration]
        return min([*times, INFINITY if self.stream is None else self.stream])

    def take_skips(self) -> tuple[Skip, ...]:
        """Return the skips since the last call, and forget them."""
        skips, self.skips = tuple(self.skips), []
        return skips

    def leave(self, why: str = "unhandled") -> tuple[Skip, ...]:
        """Give up what still waits: nobody will handle it."""
        for edge, waiting in zip(self.spec.inputs, self.queues, strict=True):
            self.skips += [Skip(edge.topic, old.incarnation, old.sequence, why) for old in waiting]
            waiting.clear()
        return self.take_skips()
