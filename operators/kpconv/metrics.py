"""How good predictions are: confusion, IoU, calibration, and what would make the robot collide."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from operators.kpconv.grid import Floats
from operators.kpconv.links import Bytes
from operators.kpconv.settings import CLASSES

TRUTHS = ("ground", "wall", "door", "table", "chair", "moving person", "still person")  # truth 1 to 7
LABEL_OF_TRUTH = np.array([0, 1, 2, 3, 3, 3, 4, 3], np.uint8)  # truth to label; doors move between sessions: longT
SHORT = 4
NEAR = 3.0  # metres within which a furniture's deletion matters most
PERSON_NEAR, PERSON_POINTS = 5.0, 20  # a walking person who must be seen: metres, points
BINS = 10  # of the reliability curve

Longs = npt.NDArray[np.int64]


class Tally:
    """Counts over frames; everything that evaluation reports is computed from it."""

    def __init__(self) -> None:
        self.confusion: Longs = np.zeros((len(TRUTHS), len(CLASSES)), np.int64)
        self.near: Longs = np.zeros((len(TRUTHS), len(CLASSES)), np.int64)  # points within NEAR
        self.people, self.seen = 0, 0  # walking, near, with enough points; of these with most points shortT
        self.bins: npt.NDArray[np.float64] = np.zeros((BINS, 3))  # points, sum of confidence, number right
        self.frames = 0

    def add(
        self,
        labels: Bytes,
        scores: Floats,
        truth: Bytes,
        distance: Floats,
        moving: npt.NDArray[np.bool_] | None = None,
        instance: npt.NDArray[np.int32] | None = None,
    ) -> None:
        """Count one frame: predicted labels (n,), scores (n, 4), truth (n,) 0 to 7, metres from the robot (n,)."""
        self.frames += 1
        known = (truth > 0) & (labels > 0)
        flat = (truth.astype(np.int64) - 1) * len(CLASSES) + labels - 1
        for counts, chosen in ((self.confusion, known), (self.near, known & (distance < NEAR))):
            counts[...] += np.bincount(flat[chosen], minlength=counts.size).reshape(counts.shape)
        confidence = scores[known].max(1, initial=0.0)
        right = labels[known] == LABEL_OF_TRUTH[truth[known]]
        place = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
        for column, weights in enumerate((None, confidence, right)):
            self.bins[:, column] += np.bincount(place, weights, minlength=BINS)
        if moving is not None and instance is not None:
            self.add_people(labels, truth, distance, moving, instance)

    def add_people(
        self,
        labels: Bytes,
        truth: Bytes,
        distance: Floats,
        moving: npt.NDArray[np.bool_],
        instance: npt.NDArray[np.int32],
    ) -> None:
        """Count walking people who are near, and those of them whose points are mostly shortT."""
        walking = (truth == TRUTHS.index("moving person") + 1) & moving & (distance < PERSON_NEAR)
        people, whose = np.unique(instance[walking], return_inverse=True)
        points = np.bincount(whose, minlength=len(people))
        short = np.bincount(whose, labels[walking] == SHORT, minlength=len(people))
        enough = points >= PERSON_POINTS
        self.people += int(enough.sum())
        self.seen += int((enough & (2 * short > points)).sum())

    def report(self) -> dict[str, Any]:
        """Return everything as numbers: name to number, or to a dict of them."""
        rows = self.confusion.sum(1, keepdims=True)
        shares = self.confusion / np.maximum(rows, 1)
        by_label = np.zeros((len(CLASSES), len(CLASSES)), np.int64)
        for truth, row in enumerate(self.confusion):
            by_label[LABEL_OF_TRUTH[truth + 1] - 1] += row
        right = np.diag(by_label)
        union = by_label.sum(0) + by_label.sum(1) - right
        near = self.near.sum(1)
        structure, furniture = [0, 1], [3, 4]
        counts = self.bins[:, 0]
        filled = counts > 0
        confidence = np.where(filled, self.bins[:, 1] / np.maximum(counts, 1), 0.0)
        accuracy = np.where(filled, self.bins[:, 2] / np.maximum(counts, 1), 0.0)
        return {
            "frames": self.frames,
            "points": int(self.confusion.sum()),
            "confusion": {
                name: dict(zip(CLASSES, map(float, row), strict=True)) for name, row in zip(TRUTHS, shares, strict=True)
            },
            "truth_points": dict(zip(TRUTHS, map(int, rows[:, 0]), strict=True)),
            "recall": {
                name: float(shares[i, LABEL_OF_TRUTH[i + 1] - 1]) for i, name in enumerate(TRUTHS) if rows[i, 0]
            },
            "iou": {name: share(right[i], union[i]) for i, name in enumerate(CLASSES)},
            "recall_of_labels": {name: share(right[i], by_label[i].sum()) for i, name in enumerate(CLASSES)},
            "structure_called_shortT": share(self.confusion[structure, SHORT - 1].sum(), rows[structure].sum()),
            "near_furniture_called_shortT": share(self.near[furniture, SHORT - 1].sum(), near[furniture].sum()),
            "near_walkers": self.people,
            "near_walkers_seen": share(self.seen, self.people),
            "calibration_error": float((counts * np.abs(confidence - accuracy)).sum() / max(counts.sum(), 1.0)),
            "reliability": {
                "confidence": confidence.tolist(),
                "accuracy": accuracy.tolist(),
                "points": counts.astype(int).tolist(),
            },
        }


def share(part: Any, whole: Any) -> float:
    """Return part / whole, zero where there is nothing."""
    return float(part) / float(whole) if whole else 0.0


def table(report: dict[str, Any]) -> str:
    """Lay out the confusion matrix: seven truth classes by four predictions, rows normalized."""
    lines = [f"{'truth':>14} | " + " ".join(f"{name:>9}" for name in CLASSES) + " |     points"]
    for name, row in report["confusion"].items():
        cells = " ".join(f"{100 * value:8.2f}%" for value in row.values())
        lines.append(f"{name:>14} | {cells} | {report['truth_points'][name]:10d}")
    lines.append(f"{'IoU':>14} | " + " ".join(f"{100 * value:8.2f}%" for value in report["iou"].values()) + " |")
    return "\n".join(lines)
