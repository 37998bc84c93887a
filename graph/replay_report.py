"""What came of a replay: equal, or the first divergence of each operator by name."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from graph.compare import Difference
from graph.provenance import cpu_class, file_digest, versions
from graph.recording import Recording


class Divergence(msgspec.Struct):
    """The first place where a replayed operator says something else than it said."""

    step: int
    stamp: int
    port: str  # the output that differs, or the input whose call did
    what: str
    fields: list[Difference]

    def __str__(self) -> str:
        detail = "; ".join(map(str, self.fields)) or self.what
        return f"step {self.step} at {self.stamp / 1e9:.3f} s, {self.port}: {detail}"

    @property
    def largest(self) -> float:
        """Return the largest difference; infinity where something else than a number differs."""
        gaps = [field.largest for field in self.fields]
        return max((math.inf if gap is None else gap for gap in gaps), default=math.inf)


class OperatorReplay(msgspec.Struct):
    """What came of replaying one operator."""

    operator: str
    steps: int = 0
    messages: int = 0
    divergent: int = 0  # steps that said something else
    unjudged: int = 0  # steps fed with what had diverged upstream and is recorded as digest only
    first: Divergence | None = None
    largest: float = 0.0  # difference in any step; infinite where more than numbers differ
    seconds: float = 0.0  # of computing
    times_real_time: float = 0.0
    swapped: bool = False
    fields: dict[str, dict[str, Any]] = {}  # swapped: summary of each field, against what was recorded

    @property
    def equal(self) -> bool:
        return self.first is None and self.unjudged == 0

    def diverge(self, divergence: Divergence) -> None:
        """Note a step that said something else."""
        self.divergent += 1
        self.first = self.first or divergence
        self.largest = max(self.largest, divergence.largest)


class Replay(msgspec.Struct):
    """What came of replaying a recording."""

    recording: str
    equal: bool
    operators: list[OperatorReplay]
    warnings: list[str]


def warnings(recording: Recording) -> list[str]:
    """Say what is not as it was when the recording was made, so that other bits are no surprise."""
    found = []
    if recording.run.cpu != cpu_class():
        found.append(f"recorded on another class of processor ({recording.run.cpu}); bits may differ")
    here = versions()
    other = [
        f"{name} {version} then, {here.get(name, 'none')} now"
        for name, version in recording.run.versions.items()
        if here.get(name) != version
    ]
    if other:
        found.append(f"recorded with other versions: {', '.join(other)}")
    for name, sha in recording.run.files.items():
        path = Path(name)
        if not path.exists():
            found.append(f"{name}, which the graph names, is not there any more")
        elif file_digest(path) != sha:
            found.append(f"{name} has changed since")
    return found


def lines(report: Replay) -> Iterator[str]:
    """Lay a report out for a terminal."""
    for warning in report.warnings:
        yield f"note: {warning}"
    for item in report.operators:
        speed = f"{item.steps} steps, {item.messages} messages, {item.times_real_time:.1f} x real time"
        if item.swapped:
            yield f"{item.operator}: swapped, {speed}" + (f"; {item.first}" if item.first else "")
            for field, summary in item.fields.items():
                yield f"  {field}: " + ", ".join(f"{key} {value}" for key, value in summary.items())
        elif item.first is not None:
            yield f"{item.operator}: DIVERGES in {item.divergent} of {item.steps} steps, first at {item.first}"
        elif item.unjudged:
            yield f"{item.operator}: not judged ({item.unjudged} steps lie downstream of a divergence)"
        else:
            yield f"{item.operator}: equal to the bit, {speed}"
