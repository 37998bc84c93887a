"""Pictures of training and evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.figure import Figure

from operators.kpconv.settings import CLASSES


def draw_curves(history: list[dict[str, Any]], path: Path) -> None:
    """Draw loss and recalls over the steps."""
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [entry["step"] for entry in history]
    left.plot(steps, [entry["loss"] for entry in history], label="training")
    for name in CLASSES:
        right.plot(steps, [entry["recall"].get(name, np.nan) for entry in history], label=name)
    held = [entry for entry in history if "held_out" in entry]
    if held:
        best = [entry["held_out"]["mean"] for entry in held]
        right.plot([entry["step"] for entry in held], best, "k.--", label="held out, mean")
    for axis, title in ((left, "loss"), (right, "recall")):
        axis.set(xlabel="step", title=title)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    right.set_ylim(0, 1)
    figure.savefig(path, dpi=120)


def draw_evaluation(report: dict[str, Any], path: Path) -> None:
    """Draw the confusion matrix, rows normalized, and the reliability curve."""
    figure = Figure(figsize=(9.5, 4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1))
    names = list(report["confusion"])
    shares = np.array([list(row.values()) for row in report["confusion"].values()])
    left.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for (row, column), value in np.ndenumerate(shares):
        color = "white" if value > 0.5 else "black"
        left.text(column, row, f"{100 * value:.1f}", ha="center", va="center", color=color)
    left.set_xticks(range(len(CLASSES)), CLASSES)
    left.set_yticks(range(len(names)), names)
    left.set(xlabel="prediction", ylabel="truth", title="confusion, % of the row")
    curve = report["reliability"]
    filled = np.array(curve["points"]) > 0
    right.plot([0, 1], [0, 1], "k:", lw=1)
    right.plot(np.array(curve["confidence"])[filled], np.array(curve["accuracy"])[filled], "o-")
    right.set(xlabel="confidence", ylabel="share right", xlim=(0.2, 1), ylim=(0.2, 1))
    right.set_title(f"reliability, error {100 * report['calibration_error']:.1f} %")
    right.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
