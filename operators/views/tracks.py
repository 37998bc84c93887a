"""How far a localizer is off: its pose beside the true pose of the same time."""

from __future__ import annotations

import bisect

import numpy as np

from graph.geometry import Matrix, interpolate


class Track:
    """Poses in the order of time, interpolated between their stamps; the latest `limit` of them."""

    def __init__(self, limit: int = 10_000) -> None:
        self.limit = limit
        self._stamps: list[int] = []
        self._poses: list[Matrix] = []

    def add(self, stamp: int, world_from_base: Matrix) -> None:
        """Note a pose at a stamp in nanoseconds; one at or before the last stamp takes its place in the order."""
        place = bisect.bisect_left(self._stamps, stamp)
        known = place < len(self._stamps) and self._stamps[place] == stamp
        self._stamps[place : place + known] = [stamp]
        self._poses[place : place + known] = [world_from_base]
        if len(self._stamps) > 2 * self.limit:
            del self._stamps[: -self.limit], self._poses[: -self.limit]

    def at(self, stamp: int) -> Matrix | None:
        """Return the pose (4, 4) at a stamp in nanoseconds; None before the first and after the last."""
        place = bisect.bisect_left(self._stamps, stamp)
        if place == len(self._stamps):
            return None
        if self._stamps[place] == stamp:
            return self._poses[place]
        if place == 0:
            return None
        before, after = self._stamps[place - 1], self._stamps[place]
        return interpolate(self._poses[place - 1], self._poses[place], (stamp - before) / (after - before))


def localization_error(world_from_base: Matrix, true_world_from_base: Matrix) -> float:
    """Return the distance in the plane, in metres, between an estimated and a true pose."""
    return float(np.linalg.norm(world_from_base[:2, 3] - true_world_from_base[:2, 3]))
