"""The paper's last experiment in numbers: how far off each localizer is without labels, and with them."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

Labels = Literal["none", "network", "truth"]

METHODS = {
    "amcl": "operators.amcl:Amcl",
    "gmapping": "operators.gmapping:Gmapping",
    "pointmap": "operators.localizer:Localizer",
}
NAMES = {"amcl": "AMCL", "gmapping": "Gmapping", "pointmap": "PointMap*"}
LABELS: tuple[Labels, ...] = ("none", "network", "truth")
PAPER = {"amcl": 3.8, "gmapping": 3.0, "pointmap": 2.7}  # error without labels over error with them, in hard


class Run(NamedTuple):
    """One tour with one localizer."""

    table: str  # "driven": with this localizer in the loop; "same": on a recording that all localizers share
    scenario: str
    tour: str
    method: str
    labels: str
    errors: list[float]  # metres at 10 Hz, in the plane
    ending: str  # why the tour was over, "" where nothing was driven
    reached: int
    targets: int
    update_ms: float  # median wall-clock time of a call with a frame

    @property
    def failed(self) -> bool:
        """Say whether the tour did not get to its end, or the robot was lost on it (2 m, as in the paper)."""
        return self.ending not in ("", "tour finished") or (not self.ending and max(self.errors, default=0.0) > 2.0)


def quantiles(errors: list[float]) -> dict[str, float]:
    """Return mean and quantiles in metres."""
    values = np.array(errors) if errors else np.full(1, np.nan)
    marks = {"p25": 25, "median": 50, "p75": 75, "p95": 95, "max": 100}
    return {"mean": float(values.mean())} | {name: float(np.percentile(values, share)) for name, share in marks.items()}


def pooled(runs: list[Run], **which: str) -> list[float]:
    """Return the errors of all runs that are as named, one after the other."""
    return [
        error for run in runs if all(getattr(run, key) == value for key, value in which.items()) for error in run.errors
    ]


def table(runs: list[Run], name: str) -> list[dict[str, Any]]:
    """Return a line for each scenario and method: errors by labels, factors, failures, times."""
    lines = []
    mine = [run for run in runs if run.table == name]
    for scenario, method in dict.fromkeys((run.scenario, run.method) for run in mine):
        group = [run for run in mine if (run.scenario, run.method) == (scenario, method)]
        line: dict[str, Any] = {"scenario": scenario, "method": method, "labels": {}}
        for labels in dict.fromkeys(run.labels for run in group):
            these = [run for run in group if run.labels == labels]
            line["labels"][labels] = quantiles(pooled(these)) | {
                "tours": len(these),
                "failed": sum(run.failed for run in these),
                "update_ms": float(np.median([run.update_ms for run in these])),
            }
        known = line["labels"]
        for labels in ("network", "truth"):
            if "none" in known and labels in known:
                line[f"factor_{labels}"] = known["none"]["mean"] / known[labels]["mean"]
        if "network" in known and "truth" in known:
            line["network_over_truth"] = known["network"]["mean"] / known["truth"]["mean"]
        if scenario == "hard":
            line["factor_paper"] = PAPER[method]
        lines.append(line)
    return lines
