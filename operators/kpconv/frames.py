"""Labelled frames in memory, and the choice among their points that shows all classes equally often."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import transform
from operators.kpconv.grid import Floats
from operators.kpconv.links import Bytes
from operators.kpconv.settings import CLASSES

STEPS = 32767  # of a coordinate: 16 bits a number, 1 mm at 30 m, is finer than any lidar's noise


class LabelledFrame(NamedTuple):
    """One frame in the robot's base frame."""

    points: Floats  # (n, 3) metres
    labels: Bytes  # (n,) 0 to 4
    ring: Bytes | None  # (n,) beam
    origin: npt.NDArray[np.float64]  # (3,) of the lidar, metres


class Frames:
    """Frames of one or several sessions, packed to 8 bytes a point."""

    def __init__(self) -> None:
        self.packed: list[tuple[npt.NDArray[np.int16], float]] = []
        self.labels: list[Bytes] = []
        self.rings: list[Bytes | None] = []
        self.origins: list[npt.NDArray[np.float64]] = []
        self.counts: list[npt.NDArray[np.int64]] = []  # of labels 1 to 4 in each frame
        self.totals: npt.NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.packed)

    def __getitem__(self, index: int) -> LabelledFrame:
        packed, step = self.packed[index]
        points = packed.astype(np.float32) * np.float32(step)
        return LabelledFrame(points, self.labels[index], self.rings[index], self.origins[index])

    def add(
        self, points_lidar: Floats, labels: Bytes, base_from_lidar: npt.NDArray[Any], ring: Bytes | None = None
    ) -> None:
        """Keep a frame: points (n, 3) in the lidar's frame, labels (n,) 0 to 4. Drops points that are not finite."""
        good = np.isfinite(points_lidar).all(1)
        points = transform(base_from_lidar, points_lidar[good])
        step = max(float(np.abs(points).max(initial=0.0)), 1e-3) / STEPS
        self.packed.append((np.round(points / step).astype(np.int16), step))
        self.labels.append(labels[good].copy())
        self.rings.append(None if ring is None else ring[good].copy())
        self.origins.append(np.array(base_from_lidar, np.float64)[:3, 3])
        self.counts.append(np.bincount(labels[good], minlength=len(CLASSES) + 1)[1:].astype(np.int64))
        self.totals = None

    def draw(self, generator: np.random.Generator) -> tuple[int, int]:
        """Draw a class that occurs, each alike, and one of its points. Returns the numbers of the frame and the point.

        Raises ValueError if no point has a class.
        """
        if self.totals is None:
            self.totals = np.cumsum(np.reshape(self.counts, (-1, len(CLASSES))), 0)
        if not len(self.totals) or not self.totals[-1].any():
            raise ValueError(f"{len(self)} frames were given; none has a point of the classes {', '.join(CLASSES)}")
        present = np.flatnonzero(self.totals[-1])
        label = int(present[generator.integers(len(present))])
        drawn = int(generator.integers(self.totals[-1, label]))
        frame = int(np.searchsorted(self.totals[:, label], drawn, side="right"))
        inside = drawn - int(self.totals[frame - 1, label] if frame else 0)
        return frame, int(np.flatnonzero(self.labels[frame] == label + 1)[inside])
