"""A graph in one process, without Zenoh: the same schedules, the same bytes, for debuggers and for tests."""

from __future__ import annotations

import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from graph.errors import UserError
from graph.graphfile import Graph
from graph.ledger import INFINITY, Mark, Step
from graph.lockstep import Lockstep, endless
from graph.merge import merge
from graph.node import STREAM, Emission, Node, build_operator
from graph.realtime import Realtime
from graph.recording import Verdict
from graph.run import Paths, describe
from graph.shard import Shard, schemas_of
from graph.threads import set_threads
from graph.wiring import NodeSpec, wire


class Local:
    """One operator of an in-process run: its node, its schedule, its shard."""

    def __init__(self, spec: NodeSpec, shard: Path, deliver: Callable[[NodeSpec, Emission], None]) -> None:
        self.spec = spec
        set_threads(spec.threads)
        self.node = Node(spec, build_operator(spec))
        self.shard = Shard(shard, spec, schemas_of(self.node.output_types))
        self.schedule: Lockstep | Realtime = Realtime(spec) if spec.kind == "sink" else Lockstep(spec)
        self.deliver = deliver
        self.emissions: list[Emission] = []
        self.through = -1  # how far it is, as the others know
        self.done = False

    def emit(self, emission: Emission) -> None:
        self.emissions.append(emission)
        self.deliver(self.spec, emission)

    def write(self, step: Step) -> None:
        summary, self.node.summary = self.node.summary, None
        self.shard.write(self.emissions, step, summary)
        self.emissions.clear()

    def begin(self) -> None:
        set_threads(self.spec.threads)
        self.write(self.node.start(self.emit))
        if isinstance(self.schedule, Lockstep):
            self.schedule.started = True
            self.fetch()

    def fetch(self) -> None:
        """Look at the next item of a source's stream."""
        if self.spec.kind == "source" and isinstance(self.schedule, Lockstep):
            stamp = self.node.peek()
            self.schedule.offer(INFINITY if stamp is None else stamp)

    def advance(self, now: int) -> bool:
        """Make one call if one is due; say whether one was. now: how far the run is, which is the clock of a sink."""
        schedule = self.schedule
        if self.done:
            return False
        arrival = schedule.next() if isinstance(schedule, Lockstep) else schedule.next(now)
        set_threads(self.spec.threads)
        if arrival is not None:
            step = self.node.handle(arrival, arrival.time, self.emit)
            if step.port == STREAM:
                self.fetch()
            if step.ended is not None and self.spec.end == self.spec.name and isinstance(schedule, Lockstep):
                schedule.finish_at(arrival.time)
            self.write(step)
            return True
        if isinstance(schedule, Lockstep) and schedule.complete():
            step = self.node.finish(schedule.end, self.emit)
            schedule.finished = self.done = True
            self.write(step)
            return True
        return False

    def mark(self) -> Mark | None:
        """Return the mark to tell the others, if it is news."""
        return self.schedule.news(tuple(self.node.counts.values())) if isinstance(self.schedule, Lockstep) else None


def launch_in_process(
    graph: Graph,
    *,
    record: Path | None = None,
    shuffle: int | None = None,
    command: str = "",
    progress: Callable[[float], None] = lambda seconds: None,
) -> tuple[Verdict, Path]:
    """Run a checked lockstep graph in this process; returns the verdict and the path of the recording.

    shuffle: a seed that draws which operator goes next, for tests; None goes round. An operator's exception passes
    through, for the debugger. Raises UserError for a realtime graph, which needs processes.
    """
    if graph.clock.mode != "lockstep":
        raise UserError("--in-process runs lockstep graphs; this one says clock.mode: realtime")
    specs = wire(graph)
    paths = Paths.choose(graph.name, record)
    paths.shards.mkdir(parents=True)
    run = describe(graph, specs, command)
    locals_: list[Local] = []

    def deliver(spec: NodeSpec, emission: Emission) -> None:
        topic = f"{spec.name}/{emission.port}"
        for other in locals_:
            if any(edge.topic == topic for edge in other.spec.inputs):
                other.schedule.deliver(topic, 0, emission.sequence, emission.stamp, emission.payload)

    begin = time.monotonic()
    try:
        locals_ += [Local(spec, paths.shards / f"{spec.name}.0.mcap", deliver) for spec in specs]
        for item in locals_:
            item.begin()
            _spread(item, locals_)
        order = random.Random(shuffle)
        while not all(item.done for item in locals_ if item.spec.kind != "sink"):
            busy = False
            turn = list(locals_) if shuffle is None else order.sample(locals_, len(locals_))
            for item in turn:
                busy |= item.advance(_now(locals_))
                busy |= _spread(item, locals_)
            if all(item.schedule.dormant() for item in locals_ if isinstance(item.schedule, Lockstep)):
                raise UserError(endless(graph.clock.end))
            progress(max(item.schedule.handled for item in locals_) / 1e9)
            if not busy:
                raise RuntimeError("deadlock: no operator can go on; this is a bug of the runtime")
        for item in locals_:
            if isinstance(item.schedule, Realtime):
                while item.advance(_now(locals_)):
                    pass
                item.write(item.node.finish(item.schedule.handled, item.emit, item.schedule.leave()))
            item.shard.close()
        shards = [paths.shards / f"{spec.name}.0.mcap" for spec in specs]
        verdict = merge(shards, paths.recording, run, wall_seconds=time.monotonic() - begin)
    finally:
        shutil.rmtree(paths.shards, ignore_errors=True)
    return verdict, paths.recording


def _now(locals_: list[Local]) -> int:
    return max([0, *(item.schedule.handled for item in locals_ if isinstance(item.schedule, Lockstep))])


def _spread(item: Local, locals_: list[Local]) -> bool:
    """Tell an operator's mark to all, and how far it is; say whether it was news."""
    mark = item.mark()
    through = item.schedule.through() if isinstance(item.schedule, Lockstep) else item.through
    if mark is None and through <= item.through:
        return False
    item.through = through
    for other in locals_:
        if isinstance(other.schedule, Lockstep):
            if mark is not None:
                other.schedule.mark(item.spec.name, mark)
            other.schedule.consumer_at(item.spec.name, through)
    return True
