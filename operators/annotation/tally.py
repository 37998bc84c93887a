"""How labels compare with the truth of a simulator, each class alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from operators.annotation.session import GROUND, LABELS, LONG_TERM, PERMANENT, SHORT_TERM, Labels

TRUTHS = ("unknown", "ground", "wall", "door", "table", "chair", "moving person", "still person")  # truth 0 to 7
DOOR, WALKER = TRUTHS.index("door"), TRUTHS.index("moving person")
RIGHT = {
    "ground": GROUND,
    "wall": PERMANENT,
    "door": LONG_TERM,  # one that stands otherwise in another session
    "door never moved": PERMANENT,
    "table": LONG_TERM,
    "chair": LONG_TERM,
    "moving person": SHORT_TERM,
    "person standing a moment": SHORT_TERM,
    "still person": LONG_TERM,
}
LEAST_DOOR = 200  # points of a door that say how it stands
APART = 0.35  # metres between the middles of what was seen of a door
TURNED = math.radians(15.0)
MOMENTS = 6  # count, x, y, xx, xy, yy

Counts = dict[str, list[int]]  # truth class to points by label 0 to 4


class Doors(NamedTuple):
    """What was seen of each door of one session."""

    counts: dict[int, list[int]]  # instance to points by label
    moments: dict[int, list[float]]  # of the points on the floor plan, world


class Tally:
    """Points by truth and label, frame by frame."""

    def __init__(self) -> None:
        self.counts: npt.NDArray[np.int64] = np.zeros((len(TRUTHS) + 1, len(LABELS)), np.int64)  # last: standing
        self.doors = Doors({}, {})
        self.frames = 0

    def add(
        self,
        labels: Labels,
        truth: Labels | None,
        moving: npt.NDArray[np.bool_] | None,
        instance: npt.NDArray[np.int32] | None,
        world: npt.NDArray[Any],
    ) -> None:
        """Count a frame: labels (n,) 0 to 4, truth (n,) 0 to 7, and where its points (n, 3) are in the world."""
        self.frames += 1
        kind = np.zeros(len(labels), np.int64) if truth is None else truth.astype(np.int64)
        if truth is not None and instance is not None:
            self._add_doors(labels, kind, instance, world)
        if moving is not None:
            kind = np.where((kind == WALKER) & ~moving, len(TRUTHS), kind)
        size = self.counts.size
        self.counts += np.bincount(kind * len(LABELS) + labels, minlength=size).reshape(self.counts.shape)

    def _add_doors(
        self, labels: Labels, kind: npt.NDArray[Any], instance: npt.NDArray[np.int32], world: npt.NDArray[Any]
    ) -> None:
        chosen = np.flatnonzero(kind == DOOR)
        for number in np.unique(instance[chosen]).tolist():
            own = chosen[instance[chosen] == number]
            x, y = world[own, 0].astype(np.float64), world[own, 1].astype(np.float64)
            moments = [len(own), x.sum(), y.sum(), (x * x).sum(), (x * y).sum(), (y * y).sum()]
            counts = np.bincount(labels[own], minlength=len(LABELS)).tolist()
            known = self.doors.moments.setdefault(number, [0.0] * MOMENTS)
            known[:] = [a + float(b) for a, b in zip(known, moments, strict=True)]
            total = self.doors.counts.setdefault(number, [0] * len(LABELS))
            total[:] = [a + b for a, b in zip(total, counts, strict=True)]

    def numbers(self) -> dict[str, Any]:
        """Return all counts as plain numbers by name, for a Summary."""
        names = [*TRUTHS, "person standing a moment"]
        doors = {
            str(number): {**_named(self.doors.counts[number]), "moments": dict(zip("nxyabc", moments, strict=True))}
            for number, moments in sorted(self.doors.moments.items())
        }
        return {
            "frames": self.frames,
            "points": {name: _named(row) for name, row in zip(names, self.counts.tolist(), strict=True)},
            "doors": doors,
        }


def _named(row: Sequence[int]) -> dict[str, int]:
    return dict(zip(LABELS, row, strict=True))


def stands(moments: dict[str, float]) -> tuple[float, float, float]:
    """Return the middle of a door leaf and the direction in which it runs, in [0, pi), from its moments."""
    n = moments["n"]
    x, y = moments["x"] / n, moments["y"] / n
    xx, xy, yy = moments["a"] / n - x * x, moments["b"] / n - x * y, moments["c"] / n - y * y
    return x, y, 0.5 * math.atan2(2.0 * xy, xx - yy) % math.pi


def moved_doors(sessions: Iterable[dict[str, Any]]) -> set[str]:
    """Name the doors (instances) that stand otherwise in one session than in another."""
    seen: dict[str, list[tuple[float, float, float]]] = {}
    for session in sessions:
        for number, door in session["doors"].items():
            if door["moments"]["n"] >= LEAST_DOOR:
                seen.setdefault(number, []).append(stands(door["moments"]))
    moved = set()
    for number, places in seen.items():
        for x, y, direction in places[1:]:
            x0, y0, direction0 = places[0]
            turn = abs(direction - direction0)
            if math.dist((x, y), (x0, y0)) > APART or min(turn, math.pi - turn) > TURNED:
                moved.add(number)
    return moved


def by_truth(sessions: Sequence[dict[str, Any]], moved: set[str]) -> Counts:
    """Sum the points of sessions by truth class and label; doors apart, by whether they ever moved."""
    total = {name: np.zeros(len(LABELS), np.int64) for name in RIGHT}
    for session in sessions:
        for name, row in session["points"].items():
            if name in total and name != "door":
                total[name] += [row[label] for label in LABELS]
        for number, door in session["doors"].items():
            total["door" if number in moved else "door never moved"] += [door[label] for label in LABELS]
    return {name: row.tolist() for name, row in total.items()}


def measures(counts: Counts, unknown: Sequence[int] = (0,) * len(LABELS)) -> dict[str, Any]:
    """Return recall of all points and of the labelled ones by truth class, precision by label, and coverage.

    unknown: points without truth, by label; they count for the coverage alone. Empty classes are left out.
    """
    rows = {name: np.array(row, np.int64) for name, row in counts.items()}
    everything = sum(rows.values(), np.array(unknown, np.int64))
    told = {name: row for name, row in rows.items() if row.sum()}
    right = np.zeros(len(LABELS), np.int64)
    for name, row in told.items():
        right[RIGHT[name]] += row[RIGHT[name]]
    known = sum(told.values(), np.zeros(len(LABELS), np.int64))
    static = rows["ground"] + rows["wall"]
    return {
        "coverage": share(everything[1:].sum(), everything.sum()),
        "recall": {name: share(row[RIGHT[name]], row.sum()) for name, row in told.items()},
        "recall_labelled": {name: share(row[RIGHT[name]], row[1:].sum()) for name, row in told.items()},
        "precision": {label: share(right[n], known[n]) for n, label in enumerate(LABELS) if n and known[n]},
        "ground_and_wall_called_shortT": share(static[SHORT_TERM], static.sum()),
        "points": {name: int(row.sum()) for name, row in told.items()},
    }


def share(part: Any, whole: Any) -> float:
    """Return part / whole, zero where there is nothing."""
    return round(float(part) / float(whole), 5) if whole else 0.0
