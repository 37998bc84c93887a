"""Five operators in lockstep: ticks a second, and the share of a tick that is runtime and not operator."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from graph.check import require
from graph.launcher import launch
from graph.recording import Recording

TICKS = 1500
WORK = 0.02  # seconds an operator works in the row that tells the runtime's share
WORKING_TICKS = 100

HEAD = """
clock: {{mode: lockstep, pace: {pace}, end: beat}}
operators:
  beat: {{run: benchmarks.stations:Beat, inputs: {{tick: timer/{hertz}hz}}, config: {{count: {ticks}}}}}
"""
LINK = "  pass{n}: {{run: benchmarks.stations:Pass, inputs: {{number: {before}/number}}, config: {{work: {work}}}}}\n"


def run(ticks: int, work: float, pace: str, hertz: int) -> tuple[np.ndarray, np.ndarray]:
    """Run the chain. Returns when each tick began in the first operator and ended in the last, in seconds: (ticks,)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.yaml"
        text = HEAD.format(ticks=ticks, pace=pace, hertz=hertz)
        for n, before in enumerate(("beat", "pass0", "pass1", "pass2")):
            text += LINK.format(n=n, before=before, work=work)
        path.write_text(text)
        outcome = launch(require(path), record=Path(folder) / "chain.mcap", quiet=True)
        if outcome.verdict.verdict != "COMPLETE":
            raise RuntimeError(f"the run was {outcome.verdict.verdict}: {outcome.verdict.reasons}")
        steps = [(name, step) for name, _, step in Recording(outcome.recording).steps()]
    begun = [step.wall_start for name, step in steps if (name, step.port) == ("beat", "tick")]
    ended = [step.wall_start + step.wall_duration for name, step in steps if (name, step.port) == ("pass3", "number")]
    return np.array(begun[:ticks]) / 1e9, np.array(ended[:ticks]) / 1e9


def rows() -> list[dict[str, Any]]:
    """Measure an empty chain at full speed, and a paced one whose operators work."""
    begun, ended = run(TICKS, 0.0, "max", 100)
    empty = TICKS / (ended[-1] - begun[0])
    begun, ended = run(WORKING_TICKS, WORK, "realtime", 10)
    tick = float(np.median(ended - begun))
    return [
        {"name": "five-operator chain, lockstep", "value": empty, "unit": "ticks/s"},
        {"name": "five-operator chain, time a tick", "value": 1e3 / empty, "unit": "ms"},
        {
            "name": f"share of a tick that is runtime, four operators of {WORK * 1e3:g} ms",
            "value": 100.0 * (1.0 - 4 * WORK / tick),
            "unit": "%",
        },
    ]
