"""Replay: feed operators what their ledger says they consumed, and compare what they say with what they said."""

from __future__ import annotations

import itertools
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from graph.codec import CodecError, decode
from graph.compare import differences
from graph.errors import UserError
from graph.evolution import require_schema
from graph.graphfile import Graph
from graph.ledger import Ref, Step
from graph.node import END, START, Emission, Node, build_operator
from graph.recording import Entry, Recording
from graph.replay_report import Divergence, OperatorReplay, Replay, warnings
from graph.shard import STEP, SUMMARY
from graph.suggest import suggestion
from graph.swap import Keep, Key, Swapped
from graph.threads import set_threads
from graph.wiring import NodeSpec, wire


class _Retraced:
    """One operator under replay by its ledger: a fresh node for each incarnation."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec = spec
        self.report = OperatorReplay(spec.name)
        self.nodes: dict[int, Node] = {}
        self.waiting: list[tuple[int, Step]] = []  # of the current stamp, in order
        self.broken = False  # it raised: nothing after that can be replayed
        self.tainted = False  # it was fed with something that had diverged
        self.emissions: list[Emission] = []

    def node(self, incarnation: int) -> Node:
        if incarnation not in self.nodes:
            set_threads(self.spec.threads)
            self.nodes[incarnation] = Node(self.spec, build_operator(self.spec), incarnation)
        return self.nodes[incarnation]


def replay(
    recording: Recording,
    *,
    operators: Sequence[str] = (),
    graph: Graph | None = None,
    changed: Iterable[str] = (),
    swapped: Iterable[str] = (),
    keep: Keep | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Replay:
    """Run operators again and compare.

    operators: which; by default every one but sources and sinks, or those that were changed or swapped. graph: the
    recorded graph with changes applied. changed: operators with other settings, fed by their ledger. swapped: operators
    with another class, fed by rule 2. keep: called with (operator, incarnation, emissions, step, summary) of each call.
    Raises UserError for unknown names and for schemas that cannot be read.
    """
    recording.require_ledger()
    specs = {spec.name: spec for spec in (recording.run.specs if graph is None else wire(graph))}
    changed, swapped = list(changed), list(swapped)
    names = list(operators) or [*changed, *swapped]
    for name in names:
        if name not in specs:
            raise UserError(f"there is no operator '{name}' in {recording.path}{suggestion(name, list(specs))}")
        if specs[name].kind == "source":
            raise UserError(f"'{name}' is a source: it touched the world, and a replay does not run it again")
    names = names or [name for name, spec in specs.items() if spec.kind == "operator"]
    helpers = _producers_of_digests(recording, specs, names)
    run = _Run(recording, specs, [name for name in dict.fromkeys([*names, *helpers]) if name not in swapped], keep)
    others = [Swapped(recording, specs[name], run.payload, keep) for name in swapped]
    run.go(others, progress)
    reports = [run.retraced[name].report for name in run.retraced] + [
        _swap_report(other, recording) for other in others
    ]
    seconds = recording.verdict.end / 1e9
    for report in reports:
        report.times_real_time = round(seconds / report.seconds, 2) if report.seconds > 0 else 0.0
    return Replay(str(recording.path), all(report.equal for report in reports), reports, warnings(recording))


def _producers_of_digests(recording: Recording, specs: dict[str, NodeSpec], names: Sequence[str]) -> list[str]:
    """Name the operators that must run as well, since their messages were recorded as digests only."""
    recorded = {spec.name: spec for spec in recording.run.specs}
    found: list[str] = []
    todo = list(names)
    while todo:
        spec = specs[todo.pop()]
        for edge in spec.inputs:
            if edge.period is not None or edge.producer in found:
                continue
            _, _, port = edge.topic.partition("/")
            producer = recorded.get(edge.producer)
            if producer is None or producer.record.get(port) != "digest":
                continue
            if producer.kind == "source":
                raise UserError(
                    f"{edge.topic} comes from a source and was recorded as digests only: {spec.name} cannot be fed"
                )
            if edge.producer not in names:
                found.append(edge.producer)
                todo.append(edge.producer)
    return found


class _Run:
    """Walks through a recording stamp by stamp, holding each message until its last consumer has had it."""

    def __init__(
        self, recording: Recording, specs: dict[str, NodeSpec], names: Sequence[str], keep: Keep | None
    ) -> None:
        self.recording, self.keep = recording, keep
        self.retraced = {name: _Retraced(specs[name]) for name in specs if name in names}
        self.held: dict[Key, bytes] = {}
        self.uses: Counter[str] = Counter()  # topic: ports that want each message of it
        self.left: dict[Key, int] = {}
        self.diverged: set[Key] = set()  # regenerated payloads that are not what they were
        for item in self.retraced.values():
            for edge in item.spec.inputs:
                if edge.period is None:
                    self.uses[edge.topic] += 1
                    self._require(edge.topic, item.node(0).input_types[edge.port])
            for port, kind in item.node(0).output_types.items():
                self._require(f"{item.spec.name}/{port}", kind)

    def _require(self, topic: str, kind: type[Any]) -> None:
        if topic in self.recording.types:
            require_schema(self.recording, topic, kind)

    def payload(self, topic: str, incarnation: int, sequence: int) -> bytes | None:
        """Return a message of the current stamp that was made anew, since it was recorded as a digest only."""
        return self.held.get((topic, incarnation, sequence))

    def go(self, others: Sequence[Swapped], progress: Callable[[float], None]) -> None:
        """Go through the recording once."""
        end = max(self.recording.verdict.end, 1)
        for stamp, group in itertools.groupby(self.recording.entries(), key=lambda entry: entry.stamp):
            said: dict[Key, bytes] = {}  # what the recording says at this stamp
            summaries: dict[str, bytes] = {}
            steps: list[tuple[str, int, Step]] = []
            for entry in group:
                self._take(entry, said, summaries, steps)
            self._work(said, summaries)
            for other in others:
                other.advance(stamp, said, steps)
            progress(min(stamp / end, 1.0))
        for other in others:
            other.finish()

    def _take(
        self, entry: Entry, said: dict[Key, bytes], summaries: dict[str, bytes], steps: list[tuple[str, int, Step]]
    ) -> None:
        if entry.port == STEP:
            step = entry.step()
            steps.append((entry.operator, entry.incarnation, step))
            if entry.operator in self.retraced:
                self.retraced[entry.operator].waiting.append((entry.incarnation, step))
        elif entry.port == SUMMARY:
            summaries[entry.operator] = entry.payload
        else:
            key = (entry.topic, entry.incarnation, entry.sequence)
            said[key] = entry.payload
            self._hold(key, entry.payload)

    def _hold(self, key: Key, payload: bytes) -> None:
        if self.uses[key[0]]:
            self.held[key] = payload
            self.left[key] = self.uses[key[0]]

    def _release(self, key: Key) -> None:
        if key in self.left:
            self.left[key] -= 1
            if self.left[key] == 0:
                del self.left[key], self.held[key]
                self.diverged.discard(key)

    def _work(self, said: dict[Key, bytes], summaries: dict[str, bytes]) -> None:
        """Do all steps of one stamp; an operator waits for those whose messages must be made anew."""
        busy = True
        while busy:
            busy = False
            for item in self.retraced.values():
                while item.waiting and (item.broken or self._fed(item.waiting[0][1])):
                    incarnation, step = item.waiting.pop(0)
                    self._step(item, incarnation, step, said, summaries)
                    busy = True
        for item in self.retraced.values():
            for _, step in item.waiting:
                item.report.unjudged += 1
                item.broken = True
                for missing in filter(self._missing, step.consumed):
                    what = f"{missing.topic} number {missing.sequence}, which it consumed, is not in the recording"
                    item.report.first = item.report.first or Divergence(step.index, step.stamp, step.port, what, [])
            item.waiting.clear()

    def _missing(self, ref: Ref) -> bool:
        return not ref.topic.startswith("timer/") and (ref.topic, ref.incarnation, ref.sequence) not in self.held

    def _fed(self, step: Step) -> bool:
        return not any(self._missing(ref) for ref in step.consumed)

    def _step(
        self, item: _Retraced, incarnation: int, step: Step, said: dict[Key, bytes], summaries: dict[str, bytes]
    ) -> None:
        report = item.report
        report.steps += 1
        report.messages += len(step.emitted)
        if item.broken:
            report.unjudged += 1
            return
        item.tainted |= any((ref.topic, ref.incarnation, ref.sequence) in self.diverged for ref in step.consumed)
        node = item.node(incarnation)
        emissions: list[Emission] = []
        set_threads(item.spec.threads)
        begin = time.perf_counter()
        try:
            done = self._call(node, step, emissions.append)
        except Exception as error:
            item.broken = True
            place = traceback.extract_tb(error.__traceback__)[-1]
            what = f"it raised {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            report.diverge(Divergence(step.index, step.stamp, step.port, what, []))
            return
        report.seconds += time.perf_counter() - begin
        for ref in (*step.consumed, *(Ref(*msgspec.structs.astuple(skip)[:3]) for skip in step.skipped)):
            self._release((ref.topic, ref.incarnation, ref.sequence))
        divergence = self._judge(item, incarnation, step, done, emissions, said)
        if divergence is None and step.port == END:
            divergence = _summary_divergence(step, node.summary, summaries.get(item.spec.name))
        if item.tainted:
            report.unjudged += 1
        elif divergence is not None:
            report.diverge(divergence)
        self._pass_on(item, incarnation, step, emissions, said)
        if self.keep is not None:
            self.keep(item.spec.name, incarnation, emissions, done, node.summary)
        node.summary = None

    def _call(self, node: Node, step: Step, emit: Callable[[Emission], None]) -> Step:
        if step.port == START:
            return node.start(emit, step.stamp)
        if step.port == END:
            return node.finish(step.stamp, emit, step.skipped)
        (ref,) = step.consumed
        payload = None if ref.topic.startswith("timer/") else self.held[ref.topic, ref.incarnation, ref.sequence]
        return node.feed(step.port, ref, payload, step.stamp, emit, skipped=step.skipped, late=step.late)

    def _judge(
        self,
        item: _Retraced,
        incarnation: int,
        step: Step,
        done: Step,
        emissions: Sequence[Emission],
        said: dict[Key, bytes],
    ) -> Divergence | None:
        """Compare one replayed call with the recorded one."""
        for was, now, emission in itertools.zip_longest(step.emitted, done.emitted, emissions):
            if was is None or now is None:
                extra = was if now is None else now
                assert extra is not None
                what = f"number {extra.sequence} {'was said and is not' if now is None else 'was not said before'}"
                return Divergence(step.index, step.stamp, f"{item.spec.name}/{extra.port}", what, [])
            if was == now:
                continue
            port = f"{item.spec.name}/{was.port}"
            if (was.port, was.sequence) != (now.port, now.sequence):
                what = f"number {was.sequence} was said; {now.port} number {now.sequence} is"
                return Divergence(step.index, step.stamp, port, what, [])
            old = said.get((port, incarnation, was.sequence))
            if old is None:
                return Divergence(step.index, step.stamp, port, "other bytes (recorded as a digest only)", [])
            kind = item.node(incarnation).output_types[was.port]
            try:
                fields = list(differences(decode(old, kind), decode(emission.payload, kind)))
            except CodecError as error:
                return Divergence(step.index, step.stamp, port, f"cannot be read: {error}", [])
            if fields:  # else only fields with defaults were added since
                return Divergence(step.index, step.stamp, port, "other values", fields)
        if step.ended != done.ended:
            what = f"the end was {step.ended!r}, is {done.ended!r}"
            return Divergence(step.index, step.stamp, f"{item.spec.name}/{step.port}", what, [])
        return None

    def _pass_on(
        self, item: _Retraced, incarnation: int, step: Step, emissions: Sequence[Emission], said: dict[Key, bytes]
    ) -> None:
        """Hold what was recorded as a digest only for those who consumed it, and note whether it is what it was."""
        digests = {(emitted.port, emitted.sequence): emitted.digest for emitted in step.emitted}
        for emission in emissions:
            key = (f"{item.spec.name}/{emission.port}", incarnation, emission.sequence)
            if key in said or (emission.port, emission.sequence) not in digests:
                continue
            said[key] = bytes(emission.payload)
            self._hold(key, said[key])
            if item.tainted or item.report.first is not None:
                self.diverged.add(key)


def _summary_divergence(step: Step, summary: Any, recorded: bytes | None) -> Divergence | None:
    was = msgspec.msgpack.decode(recorded) if recorded is not None else {}
    now = msgspec.msgpack.decode(msgspec.msgpack.encode(summary)) if summary is not None else {}
    fields = list(differences(was, now))
    return Divergence(step.index, step.stamp, "summary", "other values", fields) if fields else None


def _swap_report(other: Swapped, recording: Recording) -> OperatorReplay:
    report = OperatorReplay(other.spec.name, swapped=True, steps=other.steps, messages=other.messages)
    report.seconds, report.fields = other.seconds, other.comparison()
    if other.error:
        report.first = Divergence(other.steps, other.stamp, other.spec.name, other.error, [])
    return report
