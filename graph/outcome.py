"""What a launch prints at the end: the verdict, where the recording is, and what the operators say of themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graph.recording import Recording, Verdict


def report(path: Path, verdict: Verdict, states: dict[str, Any], wall_seconds: float) -> dict[str, Any]:
    """Gather the outcome: the runtime's facts, then each operator's summary by name, and its numbers at the top level.

    An entry of a summary that no other operator has stands at the top level too (`targets`, `collisions`, ...).
    """
    told: dict[str, Any] = {
        "verdict": verdict.verdict,
        "reasons": verdict.reasons,
        "recording": str(path),
        "sim_seconds": round(verdict.end / 1e9, 3),
        "wall_seconds": round(wall_seconds, 3),
        "operators": states,
    }
    summaries = Recording(path).summaries()
    told["summaries"] = summaries
    for summary in summaries.values():
        for name, value in summary.items():
            told.setdefault(name, value)
    return told


def text(told: dict[str, Any], verdict: Verdict) -> str:
    """Lay the outcome out for a terminal."""
    speed = told["sim_seconds"] / max(told["wall_seconds"], 1e-9)
    lines = []
    for operator, summary in told["summaries"].items():
        lines += [f"{operator}: " + ", ".join(f"{name} {_number(value)}" for name, value in summary.items())]
    lines += [f"  because {reason}" for reason in verdict.reasons]
    lines += [
        f"{verdict.verdict}: {told['sim_seconds']:.1f} s in {told['wall_seconds']:.1f} s, {speed:.1f} x real time",
        f"recording: {told['recording']}",
    ]
    return "\n".join(lines)


def _number(value: Any) -> str:
    if isinstance(value, dict):
        return "(" + ", ".join(f"{name} {_number(item)}" for name, item in value.items()) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
