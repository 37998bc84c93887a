"""Five operators in lockstep: ticks a second, and the share of a tick that is runtime and not operator."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from graph.check import require
from graph.launcher import launch
from graph.recording import Recording

TICKS = 1500
WORK = 0.005  # seconds an operator works in the row that tells the runtime's share

HEAD = """
clock: {{mode: lockstep, end: beat}}
operators:
  beat: {{run: benchmarks.stations:Beat, inputs: {{tick: timer/100hz}}, config: {{count: {ticks}}}}}
"""
LINK = "  pass{n}: {{run: benchmarks.stations:Pass, inputs: {{number: {before}/number}}, config: {{work: {work}}}}}\n"


def run(ticks: int, work: float) -> tuple[float, float]:
    """Run the chain; returns ticks a second, and the mean of an operator's busy seconds a tick by the ledger."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.yaml"
        text = HEAD.format(ticks=ticks)
        for n, before in enumerate(("beat", "pass0", "pass1", "pass2")):
            text += LINK.format(n=n, before=before, work=work)
        path.write_text(text)
        outcome = launch(require(path), record=Path(folder) / "chain.mcap", quiet=True)
        if outcome.verdict.verdict != "COMPLETE":
            raise RuntimeError(f"the run was {outcome.verdict.verdict}: {outcome.verdict.reasons}")
        steps = [(name, step) for name, _, step in Recording(outcome.recording).steps()]
    begin = min(step.wall_start for _, step in steps if step.index == 1)
    end = max(step.wall_start + step.wall_duration for _, step in steps if step.port != "end")
    busy = sum(step.wall_duration for name, step in steps if name.startswith("pass")) / 4 / ticks
    return ticks / ((end - begin) / 1e9), busy / 1e9


def rows() -> list[dict[str, Any]]:
    """Measure an empty chain, and one whose operators work on two cores."""
    empty, _ = run(TICKS, 0.0)
    loaded, busy = run(300, WORK)
    cores = 2
    least = 4 * busy / cores  # seconds a tick if nothing but operators ran
    return [
        {"name": "five-operator chain, lockstep", "value": empty, "unit": "ticks/s"},
        {"name": "five-operator chain, time a tick", "value": 1e3 / empty, "unit": "ms"},
        {
            "name": f"share of a tick that is runtime ({WORK * 1e3:g} ms operators)",
            "value": 100.0 * max(0.0, 1.0 - loaded * least),
            "unit": "%",
        },
    ]
