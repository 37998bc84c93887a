"""Launch a graph: one process an operator, the router here, a barrier, a live line, and one recording at the end."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import IO, Any

import msgspec

from graph.errors import UserError
from graph.graphfile import Graph
from graph.inbox import Bell, Sample
from graph.lockstep import endless
from graph.merge import merge
from graph.recording import Verdict
from graph.ring import reserve, retire
from graph.run import Paths, describe
from graph.status import StatusLine
from graph.threads import environment
from graph.transport import Wire, free_port
from graph.wiring import NodeSpec, wire
from graph.words import Boot, Control, SharedRing, State

DRAIN = 5.0  # seconds that a stopped run gets to come to rest
LEAVE = 10.0  # seconds that a process gets to write its footer and go
LOOPBACK = "127.0.0.1"  # elsewhere others may listen, and the payloads go over the wire
POLL = 0.05  # seconds between two looks at the children
SILENCE = 0.3  # realtime: seconds without news after which a stopped run whose counts agree is at rest


class Outcome(msgspec.Struct):
    """How a run ended."""

    verdict: Verdict
    recording: Path
    sim_seconds: float
    wall_seconds: float
    states: dict[str, Any]  # operator: steps, p50_ms, p95_ms, skipped


def reserve_rings(specs: list[NodeSpec], bells: dict[str, Bell]) -> dict[str, SharedRing]:
    """Reserve a ring for each topic that somebody listens to; its writer rings the bells of its readers."""
    readers: dict[str, list[str]] = {}
    for spec in specs:
        for topic in dict.fromkeys(edge.topic for edge in spec.inputs if edge.period is None):
            readers.setdefault(topic, []).append(spec.name)
    return {
        topic: SharedRing(
            reserve(len(names)), tuple(names), tuple(bells[name].ringing for name in names if name in bells)
        )
        for topic, names in readers.items()
    }


class Child:
    """One operator's process: its log goes to a file and to the screen."""

    def __init__(self, boot: Boot, threads: int, log: Path, say: Callable[[str], None]) -> None:
        self.spec, self.incarnation, self.log_path = boot.spec, boot.incarnation, log
        self.say = say
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "graph.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, **environment(threads), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C is for the launcher alone
            pass_fds=boot.descriptors(),
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(msgspec.json.encode(boot) + b"\n")
        self.process.stdin.flush()
        self.reader = threading.Thread(target=self._tee, args=(self.process.stdout,), daemon=True)
        self.reader.start()

    def _tee(self, stream: IO[bytes]) -> None:
        with self.log_path.open("ab", buffering=0) as log:
            for line in stream:
                log.write(line)
                self.say(f"[{self.spec.name}] {line.decode(errors='replace').rstrip()}")

    def ended(self) -> int | None:
        """Return the exit code of a process that is gone."""
        return self.process.poll()

    def kill(self) -> None:
        """End the process now, and wait for it."""
        self.process.kill()
        self.process.wait()

    def close(self) -> None:
        """End what the process has started and left behind, and wait for the last line of the log."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)  # its session began with it
        self.reader.join(timeout=2.0)


class Launcher:
    """One run of one graph. Everything below happens in the thread that calls `launch`."""

    def __init__(
        self,
        graph: Graph,
        *,
        record: Path | None = None,
        host: str = LOOPBACK,
        log_level: str = "warning",
        command: str = "",
        quiet: bool = False,
    ) -> None:
        self.graph = graph
        self.specs = wire(graph)
        self.by_name = {spec.name: spec for spec in self.specs}
        self.paths = Paths.choose(graph.name, record)
        self.run = describe(graph, self.specs, command)
        self.prefix = f"retracer/{secrets.token_hex(4)}"
        try:
            self.endpoint = f"tcp/{host}:{free_port(host)}"
        except OSError as error:
            raise UserError(f"nobody can listen on {host}: {error.strerror}") from error
        self.log_level = log_level
        self.status = StatusLine([spec.name for spec in self.specs], quiet=quiet)
        self.children: dict[str, Child] = {}
        self.shards: list[Path] = []
        self.ready: set[str] = set()
        self.states: dict[str, State] = {}
        self.news_at = time.monotonic()
        self.reasons: list[str] = []
        self.interrupts = 0
        self.realtime = graph.clock.mode == "realtime"
        near = host == LOOPBACK
        self.bells = {spec.name: Bell() for spec in self.specs if near and spec.kind != "sink" and spec.inputs}
        self.rings = reserve_rings(self.specs, self.bells) if near else {}

    # processes

    def spawn(self, spec: NodeSpec, incarnation: int = 0) -> None:
        """Start one operator's process."""
        shard = self.paths.shards / f"{spec.name}.{incarnation}.mcap"
        mine = {f"{spec.name}/{port}" for port in spec.outputs} | {edge.topic for edge in spec.inputs}
        rings = {topic: ring for topic, ring in self.rings.items() if topic in mine}
        bell = self.bells[spec.name].ends if spec.name in self.bells else None
        boot = Boot(spec, self.endpoint, self.prefix, str(shard), incarnation, self.log_level, rings, bell)
        self.shards.append(shard)
        self.children[spec.name] = Child(boot, spec.threads, self.paths.shards / f"{spec.name}.log", self.status.say)

    def _interrupted(self, number: int, frame: FrameType | None) -> None:
        self.interrupts += 1

    def tell(self, word: Control) -> None:
        """Say a word to all operators."""
        self.wire.tell("control", word)

    def listen(self, timeout: float) -> None:
        """Take in the operators' reports for at most `timeout` seconds, and look after the children."""
        until = time.monotonic() + timeout
        while (left := until - time.monotonic()) > 0:
            for sample in self.wire.inbox.take(left):
                self._take(sample)
        self._look_after()
        self.status.show()

    def _take(self, sample: Sample) -> None:
        kind, _, name = sample.key.partition("/")
        if kind == "ready" and sample.alive:
            self.ready.add(name)
            if name in self.children and self.children[name].incarnation > 0:  # brought back: the run is under way
                self.tell(Control("start", self.origin))
        elif kind == "state":
            state = msgspec.msgpack.decode(sample.payload, type=State)
            self.states[name] = state
            self.news_at = time.monotonic()
            self.status.take(name, state.stamp, state.steps, state.durations, state.skipped)

    def _look_after(self) -> None:
        for name, child in list(self.children.items()):
            code = child.ended()
            if code is None or (code == 0 and self.leaving):
                continue
            child.close()
            how = f"{name} {_ending(code)}"
            if child.spec.kind == "sink":
                self.status.say(f"{how}; the run goes on without it")
                for ring in self.rings.values():
                    if name in ring.readers:
                        retire(ring.descriptor, ring.readers.index(name))
                del self.children[name]
            elif self.realtime and child.spec.restart == "on-failure" and name in self.ready and not self.stopping:
                self.status.say(f"{how}; starting it again")
                self.spawn(child.spec, child.incarnation + 1)
            else:
                self.reasons.append(how)
                raise Failure(how)

    # phases

    def launch(self) -> Outcome:
        """Run the graph to its end. Whatever happens, no process is left behind and the shards are merged."""
        self.paths.shards.mkdir(parents=True)
        (self.paths.shards / "run.json").write_bytes(msgspec.json.encode(self.run))
        before = signal.signal(signal.SIGINT, self._interrupted)
        terminate = signal.signal(signal.SIGTERM, self._interrupted)
        begin = time.monotonic()
        self.stopping = self.leaving = False
        self.origin = 0
        try:
            with Wire(self.endpoint, self.prefix, router=True) as self.wire:
                self.wire.watch("ready/*")
                self.wire.subscribe("state/*")
                try:
                    self._start()
                    begin = time.monotonic()
                    self._run()
                    self._finish()
                except Failure as failure:
                    self.status.say(f"stopping: {failure}")
                finally:
                    wall = time.monotonic() - begin
                    for child in self.children.values():
                        if child.ended() is None:
                            child.kill()
                        child.close()
            return self._merge(wall)
        finally:
            signal.signal(signal.SIGINT, before)
            signal.signal(signal.SIGTERM, terminate)
            self.status.close()
            for ring in self.rings.values():
                os.close(ring.descriptor)
            for bell in self.bells.values():
                bell.close()

    def _start(self) -> None:
        """Start all processes; nothing begins before every one has declared its ports."""
        for spec in self.specs:
            self.spawn(spec)
        while (waiting := set(self.children) - self.ready) and not self.interrupts:
            self.status.phase = f"starting {', '.join(sorted(waiting))} (the first start compiles, for a minute or so)"
            self.listen(POLL)
        if self.interrupts:
            self.reasons.append("it was interrupted before it began")
            raise Failure("interrupted")
        self.status.begin()
        self.origin = time.monotonic_ns()
        self.tell(Control("start", self.origin))

    def _working(self) -> list[str]:
        """Name the operators that must come to an end by themselves."""
        return [spec.name for spec in self.specs if spec.kind != "sink"]

    def _finished(self) -> bool:
        return all(
            (state := self.states.get(name)) is not None and state.phase == "finished" for name in self._working()
        )

    def _run(self) -> None:
        """Follow the run until it ends by itself, or is stopped."""
        duration = self.graph.clock.duration
        while not self._finished():
            self.listen(POLL)
            if self.interrupts:
                self._stop()
                return
            if self.realtime:
                ended = any(state.end is not None for state in self.states.values())
                if ended or (duration is not None and time.monotonic_ns() - self.origin > duration):
                    self._stop()
                    return
            elif self._dormant():
                self.reasons.append(endless(self.graph.clock.end))
                self._stop()
                return

    def _dormant(self) -> bool:
        """Say whether a lockstep run has come to rest without an end: nothing to do, and nothing under way."""
        states = [self.states.get(name) for name in self._working()]
        return all(state is not None and state.dormant for state in states) and self._settled()

    def _stop(self) -> None:
        """Stop timers and sources, and let what is under way come to rest within DRAIN seconds."""
        self.stopping = True
        before = self.interrupts
        deadline = time.monotonic() + DRAIN
        self.status.phase = "stopping"
        if self.realtime:
            self.tell(Control("stop"))
            while not self._at_rest() and time.monotonic() < deadline and self.interrupts == before:
                self.listen(POLL)
            self.tell(Control("finish"))  # what is left now, the operators note as unhandled
        else:
            self.tell(Control("pause"))
            self._await(
                lambda: all(self._phase(name) in ("paused", "finished") for name in self._working()), deadline, before
            )
            end = max((state.stamp for name, state in self.states.items() if name in self._working()), default=0)
            self.tell(Control("end", max(end, 0)))
        self._await(self._finished, deadline + (LEAVE if self.realtime else 0), before)

    def _phase(self, name: str) -> str:
        state = self.states.get(name)
        return state.phase if state else "starting"

    def _await(self, condition: Callable[[], bool], deadline: float, interrupts: int) -> None:
        while not condition():
            if self.interrupts > interrupts:
                self.reasons.append("it was interrupted twice and killed")
                raise Failure("interrupted twice")
            if time.monotonic() > deadline:
                busy = [name for name in self._working() if self._phase(name) not in ("finished", "idle", "paused")]
                self.reasons.append(f"{', '.join(busy) or 'the graph'} did not come to rest in time")
                raise Failure(self.reasons[-1])
            self.listen(POLL)

    def _at_rest(self) -> bool:
        """Say whether a stopped realtime run has nothing under way: all idle, and every edge's counts agree."""
        if any(self._phase(name) not in ("idle", "finished") for name in self._working()):
            return False
        if any(child.incarnation for child in self.children.values()):
            return time.monotonic() - self.news_at > SILENCE
        return self._settled()

    def _settled(self) -> bool:
        """Say whether every operator has received what the others say they have put; sinks aside."""
        return all(
            self.states[spec.name].received.get(edge.topic, 0) == self.states[edge.producer].counts[edge.index]
            for spec in self.specs
            if spec.kind != "sink"
            for edge in spec.inputs
            if edge.period is None
        )

    def _finish(self) -> None:
        """Let every process go: only now, since others may have been reading their memory."""
        self.stopping = self.leaving = True
        self.tell(Control("exit"))
        deadline = time.monotonic() + LEAVE
        while any(child.ended() is None for child in self.children.values()):
            if time.monotonic() > deadline:
                late = [name for name, child in self.children.items() if child.ended() is None]
                self.reasons += [f"{name} did not leave" for name in late if self.by_name[name].kind != "sink"]
                return
            self.listen(POLL)

    def _merge(self, wall: float) -> Outcome:
        self.status.phase = "merging the shards"
        self.status.show(force=True)
        logs = [self.paths.shards / f"{spec.name}.log" for spec in self.specs]
        shards = [path for path in self.shards if path.exists()]
        verdict = merge(
            shards,
            self.paths.recording,
            self.run,
            reasons=self.reasons,
            crashed=bool(self.reasons),
            wall_seconds=wall,
            logs=[log for log in logs if log.exists()],
        )
        shutil.rmtree(self.paths.shards)
        return Outcome(verdict, self.paths.recording, verdict.end / 1e9, wall, self.status.statistics())


def _ending(code: int) -> str:
    if code < 0:
        return f"was ended by signal {-code} ({signal.Signals(-code).name})"
    return f"failed (exit code {code})" if code else "left before the end"


class Failure(Exception):
    """The run cannot go on; the reason is noted already."""


def launch(graph: Graph, **options: Any) -> Outcome:
    """Run a checked graph in processes of its own. See Launcher for the options."""
    return Launcher(graph, **options).launch()
