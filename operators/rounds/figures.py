"""Pictures of the report, as PNG that a page can hold."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

COLOURS = {"ground": "#d9cdbd", "permanent": "#344e70", "longT": "#2ea054", "shortT": "#e22828", "uncertain": "#999999"}
LABELS = ("uncertain", "ground", "permanent", "longT", "shortT")
ROUND_COLOURS = ("#c9d3e0", "#9db4d0", "#6f93bf", "#42719f", "#2a4b73", "#1a2f4b")
SEEN = 9.0  # metres around the robot that a frame's picture shows


def embedded(figure: Figure) -> str:
    """Return a figure as the source of an <img>."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def error_boxes(boxes: Sequence[dict[str, Any]], groups: Sequence[str], scenarios: Sequence[str]) -> str:
    """Draw the localization error in cm: a box for each round, scenario by scenario, without fliers."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axis = figure.subplots()
    width = 0.8 / max(1, len(groups))
    for place, scenario in enumerate(scenarios):
        for number, group in enumerate(groups):
            found = [box for box in boxes if (box["group"], box["scenario"]) == (group, scenario) and box["n"]]
            if not found:
                continue
            stats = {key: found[0][key] for key in ("whislo", "q1", "med", "q3", "whishi")}
            at = place + (number - (len(groups) - 1) / 2) * width
            axis.bxp(
                [stats],
                positions=[at],
                widths=0.8 * width,
                showfliers=False,
                patch_artist=True,
                boxprops={"facecolor": ROUND_COLOURS[number % len(ROUND_COLOURS)]},
                medianprops={"color": "black"},
            )
    axis.set_xticks(range(len(scenarios)), scenarios)
    axis.set_ylabel("localization error, cm")
    axis.set_ylim(bottom=0.0)
    axis.grid(axis="y", alpha=0.3)
    handles = [
        axis.plot([], [], "s", color=ROUND_COLOURS[number % len(ROUND_COLOURS)], ms=9)[0]
        for number in range(len(groups))
    ]
    axis.legend(
        handles, groups, fontsize=8, ncols=len(groups), frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0)
    )
    return embedded(figure)


def confusion(matrices: Sequence[tuple[str, dict[str, dict[str, float]]]]) -> str:
    """Draw confusion matrices side by side: truth classes by predictions, rows normalized."""
    figure = Figure(figsize=(5.2 * len(matrices), 4), layout="constrained")
    axes = figure.subplots(1, len(matrices), squeeze=False)[0]
    for axis, (title, rows) in zip(axes, matrices, strict=True):
        names, classes = list(rows), list(next(iter(rows.values())))
        shares = np.array([[row[name] for name in classes] for row in rows.values()])
        axis.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for (row, column), value in np.ndenumerate(shares):
            axis.text(
                column,
                row,
                f"{100 * value:.1f}",
                ha="center",
                va="center",
                color="white" if value > 0.5 else "black",
                fontsize=9,
            )
        axis.set_xticks(range(len(classes)), classes)
        axis.set_yticks(range(len(names)), names)
        axis.set(title=f"{title}: % of each truth class")
    return embedded(figure)


def frames(
    points: npt.NDArray[np.float32], labellings: Sequence[tuple[str, npt.NDArray[np.uint8]]], floor: float = 0.0
) -> str:
    """Draw one frame from above, once for each labelling (title, labels of the points)."""
    figure = Figure(figsize=(4.4 * len(labellings), 4.6), layout="constrained")
    axes = figure.subplots(1, len(labellings), squeeze=False)[0]
    order = np.argsort(points[:, 2], kind="stable")
    for axis, (title, labels) in zip(axes, labellings, strict=True):
        for index, name in enumerate(LABELS):
            chosen = order[labels[order] == index]
            if len(chosen):
                axis.scatter(points[chosen, 0], points[chosen, 1], s=0.7 if index == 1 else 1.6, c=COLOURS[name], lw=0)
        axis.plot([0.21, -0.21, -0.21, 0.21], [0.0, 0.15, -0.15, 0.0], "k-", lw=1.5)
        axis.set(xlim=(-SEEN, SEEN), ylim=(-SEEN, SEEN), title=title, xticks=[], yticks=[])
        axis.set_aspect("equal")
    handles = [axes[0].plot([], [], "o", color=COLOURS[name])[0] for name in LABELS[1:]]
    axes[0].legend(handles, LABELS[1:], fontsize=8, loc="lower left")
    return embedded(figure)


def paths(records: Sequence[dict[str, Any]], scenarios: Sequence[str]) -> str:
    """Draw where the robot drove, a plan for each scenario; tours that failed are red."""
    figure = Figure(figsize=(3.4 * len(scenarios), 3.6), layout="constrained")
    axes = figure.subplots(1, len(scenarios), squeeze=False)[0]
    for axis, scenario in zip(axes, scenarios, strict=True):
        for record in records:
            if record["scenario"] == scenario and record["path"]:
                way = np.array(record["path"])
                failed = record["reached"] < record["targets"]
                axis.plot(*way.T, color="#e22828" if failed else "#344e70", lw=1.0, alpha=0.7)
                if failed:
                    axis.plot(*way[-1], "x", color="#e22828")
        axis.set(title=scenario, xticks=[], yticks=[])
        axis.set_aspect("equal")
    return embedded(figure)
