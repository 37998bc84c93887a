"""A swapped operator under replay: it has no ledger, so its inputs are merged by the rule of lockstep."""

from __future__ import annotations

import functools
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.codec import decode
from graph.evolution import require_schema
from graph.ledger import INFINITY, Mark, Step
from graph.lockstep import Lockstep
from graph.node import Emission, Node, build_operator
from graph.recording import Recording
from graph.threads import set_threads
from graph.wiring import NodeSpec

Key = tuple[str, int, int]  # topic, incarnation, sequence
Keep = Callable[[str, int, list[Emission], Step, Any], None]


class Swapped:
    """Runs an operator of another class on recorded messages, and compares its outputs field by field.

    remade: finds a message that was recorded as a digest only and has been made anew. keep: called with (operator,
    incarnation, emissions, step, summary) of each call.
    """

    def __init__(
        self,
        recording: Recording,
        spec: NodeSpec,
        remade: Callable[[str, int, int], bytes | None],
        keep: Keep | None = None,
    ) -> None:
        self.recording, self.remade, self.keep = recording, remade, keep
        self.spec = msgspec.structs.replace(spec, end=None, consumers=())
        set_threads(spec.threads)
        self.node = Node(self.spec, build_operator(self.spec))
        self.schedule = Lockstep(self.spec)
        self.counts: dict[str, int] = {edge.topic: 0 for edge in spec.inputs if edge.period is None}
        self.steps = self.messages = self.stamp = 0
        self.seconds = 0.0
        self.error = ""
        self.started = False
        self.made: dict[str, dict[int, msgspec.Struct]] = {port: {} for port in spec.outputs}  # by measured_at or stamp
        self.fields: dict[str, list[float]] = {}
        self.pairs: dict[str, int] = dict.fromkeys(spec.outputs, 0)
        self.recorded_only: dict[str, int] = dict.fromkeys(spec.outputs, 0)
        for edge in spec.inputs:
            if edge.topic in recording.types:
                require_schema(recording, edge.topic, self.node.input_types[edge.port])
        self.emissions: list[Emission] = []  # of the call under way

    def advance(self, stamp: int, said: dict[Key, bytes], steps: Sequence[tuple[str, int, Step]]) -> None:
        """Take in what was emitted at a stamp, then run what is due through it, then compare what was said at it."""
        if self.error:
            return
        for operator, incarnation, step in steps:
            for item in step.emitted:
                topic = f"{operator}/{item.port}"
                if topic not in self.counts:
                    continue
                payload = said.get((topic, incarnation, item.sequence)) or self.remade(
                    topic, incarnation, item.sequence
                )
                if payload is not None:
                    self.schedule.deliver(topic, incarnation, self.counts[topic], stamp, payload)
                    self.counts[topic] += 1
        self._run_to(stamp)
        self._compare(stamp, said)

    def _run_to(self, stamp: int) -> None:
        for edge in self.schedule.edges:
            edge.watermark = max(edge.watermark, stamp + edge.edge.delay)
        self.schedule.allow(min(stamp, self.recording.verdict.end))
        if not self.started:
            self.schedule.started = self.started = True
            self._call(lambda: self.node.start(self._emit))
        while not self.error and (arrival := self.schedule.next()) is not None:
            self._call(functools.partial(self.node.handle, arrival, arrival.time, self._emit))

    def _emit(self, emission: Emission) -> None:
        self.messages += 1
        self.emissions.append(emission)
        message = decode(emission.payload, self.node.output_types[emission.port])
        self.made[emission.port][getattr(message, "measured_at", emission.stamp)] = message

    def _call(self, call: Callable[[], Step]) -> None:
        set_threads(self.spec.threads)
        begin = time.perf_counter()
        try:
            step = call()
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            self.error = f"it raised {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            return
        self.seconds += time.perf_counter() - begin
        self.steps += 1
        self.stamp = step.stamp
        if self.keep is not None:
            self.keep(self.spec.name, 0, self.emissions, step, self.node.summary)
        self.emissions.clear()

    def _compare(self, stamp: int, said: dict[Key, bytes]) -> None:
        for (topic, _, _), payload in said.items():
            operator, _, port = topic.partition("/")
            if operator != self.spec.name or port not in self.made:
                continue
            old = decode(payload, self.node.output_types[port])
            new = self.made[port].pop(getattr(old, "measured_at", stamp), None)
            if new is None:
                self.recorded_only[port] += 1
                continue
            self.pairs[port] += 1
            for name in old.__struct_fields__:
                self._field(f"{port}.{name}", getattr(old, name), getattr(new, name))

    def _field(self, name: str, old: Any, new: Any) -> None:
        """Note the largest difference of one field in one pair of messages; NaN where there is none to speak of."""
        try:
            a, b = np.asarray(old, np.float64), np.asarray(new, np.float64)
            gap = float(np.abs(a - b).max(initial=0.0)) if a.shape == b.shape else float("nan")
        except (TypeError, ValueError):
            gap = 0.0 if old == new else float("nan")
        self.fields.setdefault(name, []).append(gap)

    def finish(self) -> None:
        """Run what is left through the end, then on_end."""
        for edge in self.schedule.edges:
            edge.mark(Mark(INFINITY, (0,) * (edge.edge.index + 1)))
        if not self.error:
            self._run_to(self.recording.verdict.end)
            self._call(lambda: self.node.finish(self.recording.verdict.end, self._emit))

    def comparison(self) -> dict[str, dict[str, Any]]:
        """Return, for each output and field: messages compared, median and largest difference, and those alone."""
        report: dict[str, dict[str, Any]] = {}
        for port, pairs in self.pairs.items():
            report[port] = {
                "compared": pairs,
                "only_recorded": self.recorded_only[port],
                "only_replayed": len(self.made[port]),
            }
        for name, gaps in self.fields.items():
            values = np.array(gaps)
            known = values[~np.isnan(values)]
            report[name] = {"equal": int((known == 0).sum()), "compared": len(values)}
            if len(known):
                report[name] |= {"median": float(np.median(known)), "largest": float(known.max())}
            if len(known) < len(values):
                report[name]["not_comparable"] = len(values) - len(known)
        return report
