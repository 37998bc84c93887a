"""The process of one operator: `python -m graph.worker`, told by one line on stdin what to be."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path

import msgspec

from graph.errors import UserError
from graph.inbox import INLINE, Sample
from graph.ledger import INFINITY, Mark, Step
from graph.lifeline import outlive_nobody, read_boot
from graph.lockstep import GapError, Lockstep
from graph.memory import keep_pages, spare_garbage_collection
from graph.node import STREAM, Emission, Node, build_operator
from graph.realtime import Realtime
from graph.ring import RingReader, RingWriter
from graph.shard import Shard, schemas_of
from graph.threads import set_threads
from graph.transport import Wire
from graph.words import Boot, Control, Phase, State

GAP_PATIENCE = 5.0  # seconds of the consumer's own running time
LAST = b"last"  # the mark of what an operator says in realtime when the run is over
REST = 1e-3  # seconds that a large message gets to reach its readers before the disk gets it; both take the cores
STATE_PERIOD = 0.1  # seconds between two reports to the launcher
FLOW_PARTS = 4  # a consumer reports its watermark upstream each quarter of `ahead`


class Worker:
    """Owns the wire, the schedule, the node and the shard, and moves bytes between them, in one thread."""

    def __init__(self, boot: Boot, wire: Wire) -> None:
        self.boot, self.wire, self.spec = boot, wire, boot.spec
        set_threads(self.spec.threads)
        rings = {
            topic.partition("/")[2]: RingWriter(ring.descriptor, len(ring.readers), ring.bells)
            for topic, ring in boot.rings.items()
            if topic.partition("/")[0] == self.spec.name
        }
        self.node = Node(self.spec, build_operator(self.spec), boot.incarnation, rings)
        set_threads(self.spec.threads)
        self.shard = Shard(Path(boot.shard), self.spec, schemas_of(self.node.output_types), boot.incarnation)
        self.lockstep = Lockstep(self.spec) if self.spec.mode == "lockstep" and self.spec.kind != "sink" else None
        self.realtime = None if self.lockstep else Realtime(self.spec)
        self.emissions: list[Emission] = []
        self.phase: Phase = "running"
        self.origin: int | None = None  # the start of the run on the monotonic clock
        self.closing = False  # realtime: on_end shall run
        self.leaving = False
        self.stopping = False
        self.flowed = -1
        self.durations: list[int] = []
        self.skipped = 0
        self.last_words: list[Sample] = []
        self.taken_leave = False
        self.own_end: int | None = None
        self.reported: tuple[object, ...] = ()
        self.report_at = 0.0
        self.demand = threading.Semaphore(0)
        self.failure: BaseException | None = None  # of the stream
        self._subscribe()

    def _subscribe(self) -> None:
        spec, wire = self.spec, self.wire
        wire.subscribe("control")
        for topic in dict.fromkeys(edge.topic for edge in spec.inputs if edge.period is None):
            wire.subscribe(f"data/{topic}", self._ring(topic))
        if self.lockstep is not None:
            listened = [*spec.producers, *([spec.end] if spec.end not in (None, spec.name) else [])]
            for name in dict.fromkeys(listened):
                wire.subscribe(f"mark/{name}")
            for name in self.lockstep.flow:
                wire.subscribe(f"flow/{name}")
            wire.announce(f"mark/{spec.name}")
            wire.announce(f"flow/{spec.name}")
        for port in spec.outputs:
            wire.announce(f"data/{spec.name}/{port}")
        wire.announce(f"state/{spec.name}")
        if spec.kind == "source":
            threading.Thread(target=self._pull, daemon=True).start()
        spare_garbage_collection()
        wire.declare_ready(spec.name)

    def _ring(self, topic: str) -> RingReader | None:
        if (ring := self.boot.rings.get(topic)) is None:
            return None
        copy = self.spec.kind == "sink"  # a slow one shall not keep the memory that the others need
        return RingReader(ring.descriptor, len(ring.readers), ring.readers.index(self.spec.name), copy=copy)

    # what comes in

    def _pull(self) -> None:
        """Fetch the next item of the stream whenever there is demand; in its own thread, for drivers that block."""
        try:
            while True:
                self.demand.acquire()
                stamp = self.node.peek()
                self.wire.inbox.put(Sample("stream", b"", (0, 0, INFINITY if stamp is None else stamp)))
                if stamp is None:
                    return
        except BaseException as error:
            self.failure = error
            self.wire.inbox.put(Sample("failed", b"", (0, 0, 0)))

    def drain(self, timeout: float | None) -> bool:
        """Take in what has come, waiting at most `timeout` seconds for the first. Say whether anything came."""
        took = False
        if timeout and self.shard.held:
            took = self._take_all(min(timeout, REST))
            if not took:
                self.shard.settle()
        return took or self._take_all(timeout or 0.0)

    def _take_all(self, timeout: float) -> bool:
        samples = self.wire.inbox.take(timeout)
        for sample in samples:
            self._take(sample)
        return bool(samples)

    def _take(self, sample: Sample) -> None:
        kind, _, rest = sample.key.partition("/")
        if kind == "data":
            if sample.mark == LAST and self.spec.kind != "sink" and not self.taken_leave:
                self.last_words.append(sample)
                return
            incarnation, sequence, stamp = sample.envelope
            schedule = self.lockstep or self.realtime
            assert schedule is not None
            schedule.deliver(rest, incarnation, sequence, stamp, sample.payload)
            if sample.mark and self.lockstep is not None:
                self.lockstep.mark(rest.partition("/")[0], msgspec.msgpack.decode(sample.mark, type=Mark))
        elif kind == "mark" and self.lockstep is not None:
            self.lockstep.mark(rest, msgspec.msgpack.decode(sample.payload, type=Mark))
        elif kind == "flow" and self.lockstep is not None:
            self.lockstep.consumer_at(rest, sample.envelope[2])
        elif kind == "stream":
            (self.lockstep or self.realtime).offer(sample.envelope[2])  # type: ignore[union-attr]
            if self.realtime and sample.envelope[2] == INFINITY and self.spec.end == self.spec.name:
                self.own_end = self.realtime.handled
        elif kind == "failed":
            assert self.failure is not None
            raise self.failure
        elif kind == "control":
            self._obey(msgspec.msgpack.decode(sample.payload, type=Control))

    def _obey(self, word: Control) -> None:
        if word.kind == "start":
            self.origin = word.stamp
        elif word.kind == "pause":
            self.phase = "paused"
            self.report(force=True)
        elif word.kind == "end":
            self.phase = "running"
            if self.lockstep is not None:
                self.lockstep.finish_at(word.stamp)
        elif word.kind == "stop":
            self.stopping = True
            if self.realtime is not None:
                self.realtime.stopped = True
        elif word.kind == "finish":
            self.closing = True
        elif word.kind == "exit":
            self.leaving = True

    # what goes out

    def emit(self, emission: Emission) -> None:
        """Put a message on the wire, and remember it for the shard.

        In lockstep most wait with it until this call's mark has come, so it waits for that, too: they travel as one.
        Where the run goes on after this process was killed, the shard comes first: else nobody could replay the others.
        """
        if self.lockstep is None and self.spec.restart == "on-failure":
            self.shard.leave([emission])
            self._put(emission, LAST if self.phase == "ending" else b"")
            return
        if self.lockstep is None:
            self._put(emission, LAST if self.phase == "ending" else b"")
        self.emissions.append(emission)

    def _put(self, emission: Emission, mark: bytes = b"") -> None:
        envelope = (self.boot.incarnation, emission.sequence, emission.stamp)
        place = INLINE
        if emission.place is not None:
            place = emission.place
            self.node.rings[emission.port].publish(place, mark)
        self.wire.put(f"data/{self.spec.name}/{emission.port}", emission.payload, envelope, mark, place)

    def promise(self) -> None:
        """Put what the call emitted, and tell the neighbours how far this operator is, if that has changed."""
        assert self.lockstep is not None
        mark = self.lockstep.news(tuple(self.node.counts.values()))
        told = b"" if mark is None else msgspec.msgpack.encode(mark)
        for emission in self.emissions:
            self._put(emission, told)
        if told and not any(emission.port in self.spec.heard for emission in self.emissions):
            self.wire.put(f"mark/{self.spec.name}", told)
        through = self.lockstep.through()
        if through >= self.flowed + self.spec.ahead // FLOW_PARTS and through > self.flowed:
            self.flowed = through
            self.wire.put(f"flow/{self.spec.name}", b"", (0, 0, through))

    def after(self, step: Step) -> None:
        """Promise, then write what the call did into the shard."""
        if self.lockstep is not None:
            self.promise()
        summary, self.node.summary = self.node.summary, None
        self.shard.hold(self.emissions, step, summary)
        self.emissions = []
        self.durations.append(step.wall_duration)
        self.skipped += len(step.skipped)

    def report(self, *, force: bool = False) -> None:
        """Tell the launcher the state: at most ten times a second while running, at once when the phase changes."""
        now = time.monotonic()
        if not force and now < self.report_at:
            return
        schedule = self.lockstep or self.realtime
        assert schedule is not None
        received = schedule.received
        dormant = self.lockstep is not None and self.lockstep.dormant()
        facts = (self.phase, self.node.index, self.own_end, dormant, tuple(received.values()))
        if facts == self.reported and not force:
            return
        self.reported, self.report_at = facts, now + STATE_PERIOD
        state = State(
            self.phase,
            schedule.handled,
            self.node.index,
            tuple(self.durations),
            tuple(self.node.counts.values()),
            received,
            dormant,
            self.own_end,
            self.skipped,
        )
        self.durations.clear()
        self.wire.tell(f"state/{self.spec.name}", state)

    # the two ways of time

    def run(self) -> None:
        """Wait for the start, run to the end, and stay until the launcher lets go: others may still read our memory."""
        while self.origin is None and not self.leaving:
            self.drain(1.0)
        if not self.leaving:
            if self.lockstep is not None:
                self.run_lockstep(self.lockstep)
            else:
                assert self.realtime is not None
                try:
                    self.run_realtime(self.realtime)
                except BaseException:
                    self.shard.leave(self.emissions)  # the others may have had them
                    raise
        self.phase = "finished"
        self.report(force=True)
        while not self.leaving:
            self.drain(1.0)
        self.shard.close()

    def run_lockstep(self, schedule: Lockstep) -> None:
        """Handle every arrival that is due, in order, until complete through the end."""
        node, starved = self.node, 0.0
        step = node.start(self.emit)
        schedule.started = True
        if self.spec.kind == "source":
            self.demand.release()
        self.after(step)
        while not self.leaving:
            self.drain(0)
            arrival = schedule.next() if self.phase == "running" else None
            if arrival is not None:
                starved = 0.0
                if arrival.payload is None:
                    self.pace(arrival.time)
                if self.leaving:
                    return
                self.shard.settle()
                step = node.handle(arrival, arrival.time, self.emit)
                if step.port == STREAM:
                    self.demand.release()
                if step.ended is not None and self.spec.end == self.spec.name:
                    schedule.finish_at(arrival.time)
                self.after(step)
                del arrival  # its payload makes room in the ring
                self.report()
                continue
            if schedule.complete() and self.phase == "running":
                break
            self.promise()
            self.report()
            waited = time.thread_time()
            if not self.drain(0.5 if not schedule.gaps() else 0.1) and schedule.gaps():
                starved += 0.1 + time.thread_time() - waited
                if starved > GAP_PATIENCE:
                    raise GapError(f"{self.spec.name}: never came: {', '.join(schedule.gaps())}")
        if self.leaving:
            return
        self.shard.settle()
        step = node.finish(schedule.end, self.emit)
        schedule.finished = True
        self.after(step)

    def pace(self, stamp: int) -> None:
        """Wait until a stamp that is born here, a tick's or a source's, is due, where the clock says pace: realtime."""
        if self.spec.pace == "realtime":
            assert self.origin is not None
            while (
                (ahead := self.origin + stamp - time.monotonic_ns()) > 0 and not self.leaving and self.phase != "paused"
            ):
                self.drain(ahead / 1e9)

    def run_realtime(self, schedule: Realtime) -> None:
        """Handle what has arrived, the earliest first, until told to finish."""
        node, origin = self.node, self.origin
        assert origin is not None
        if self.boot.incarnation:
            schedule.resume(time.monotonic_ns() - origin)
        self.after(node.start(self.emit, schedule.handled))
        if self.spec.kind == "source":
            self.demand.release()
        while not (self.leaving or self.closing):
            self.drain(0)
            now = time.monotonic_ns() - origin
            arrival = schedule.next(now)
            if arrival is None:
                if self.stopping:
                    self.phase = "idle"
                self.report(force=self.stopping and not self.wire.inbox.empty())
                self.drain(min(max((schedule.wake() - now) / 1e9, 1e-4), 0.05))
                continue
            self.phase = "running"
            self.shard.settle()
            step = node.handle(arrival, arrival.time, self.emit)
            if step.port == STREAM:
                self.demand.release()
            if step.ended is not None and self.spec.end == self.spec.name:
                self.own_end = arrival.time
                schedule.stopped = True
            self.after(step)
            self.report()
        self.drain(0)
        if self.spec.kind == "sink":
            while (arrival := schedule.next(time.monotonic_ns() - origin)) is not None:
                self.after(node.handle(arrival, arrival.time, self.emit))
        self.shard.settle()
        self.phase = "ending"
        last = node.finish(schedule.handled, self.emit, schedule.leave())
        self.phase = "finished"
        self.report(force=True)
        while not self.leaving:
            self.drain(1.0)
        self.taken_leave = True
        for sample in self.last_words:  # what others said in their on_end
            self._take(sample)
        late = schedule.leave("end")
        self.after(msgspec.structs.replace(last, skipped=last.skipped + late))


def main() -> int:
    """Run one operator to its end. Exit code 0 only then; a traceback goes to stderr."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the launcher
    keep_pages()
    boot = read_boot()
    outlive_nobody()
    logging.basicConfig(level=boot.log_level.upper(), format="%(levelname)s %(name)s: %(message)s")
    try:
        with Wire(boot.endpoint, boot.prefix, bell=boot.bell) as wire:
            Worker(boot, wire).run()
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    except (Exception, SystemExit):
        traceback.print_exc()
        sys.stderr.flush()
        return 1
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # not even a stuck native thread may keep the process
