"""Where odometry says the robot was, at any time near the last two messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from graph.geometry import Matrix, exponential, interpolate, inverse
from operators.pointmap.deskew import deskew

LEVEL = 1e-9  # metres, or one minus the cosine of a tilt


class Trail:
    """The last two poses of the odometry, and its last velocity."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.poses: list[Matrix] = []
        self.linear = 0.0
        self.angular = 0.0

    def add(self, stamp: int, odom_from_base: npt.NDArray[Any], linear: float, angular: float) -> None:
        """Remember a pose (4, 4) at a stamp (ns) with its velocities (m/s, rad/s); drops poses that are not older."""
        older = [n for n, known in enumerate(self.stamps) if known < stamp][-1:]
        self.stamps = [*(self.stamps[n] for n in older), stamp]
        self.poses = [*(self.poses[n] for n in older), np.array(odom_from_base, np.float64)]
        self.linear, self.angular = linear, angular

    def at(self, stamp: int) -> Matrix:
        """Return the pose (4, 4) at a stamp (ns): between the two last interpolated, else carried from the nearer."""
        if not self.stamps:
            return np.eye(4)
        first, last = self.stamps[0], self.stamps[-1]
        if stamp >= last:
            return self.poses[-1]
        if stamp <= first:
            return self.poses[0]
        return interpolate(self.poses[0], self.poses[-1], (stamp - first) / (last - first))

    def level(self) -> bool:
        """Say whether the odometry knows no height and no tilt: then the robot drives on one level floor."""
        return all(abs(pose[2, 3]) < LEVEL and abs(pose[2, 2] - 1.0) < LEVEL for pose in self.poses)

    def motion(self, seconds: float) -> Matrix:
        """Return now_from_then (4, 4) of the base over so many seconds of steady driving and turning."""
        result = np.eye(4)
        turn = self.angular * seconds
        chord = self.linear * seconds * float(np.sinc(turn / (2.0 * np.pi)))
        result[:3, :3] = exponential([0.0, 0.0, turn])
        result[:2, 3] = chord * math.cos(0.5 * turn), chord * math.sin(0.5 * turn)
        return result

    def steady(
        self, points: npt.NDArray[Any], time_offset: npt.NDArray[Any] | None, base_from_lidar: npt.NDArray[Any]
    ) -> npt.NDArray[Any]:
        """Return the points (n, 3) of a rolling scan as if all were measured at offset 0.

        time_offset: (n,) seconds, or None for an instantaneous scan. base_from_lidar: (4, 4).
        """
        if time_offset is None or not len(points):
            return points
        finite = time_offset[np.isfinite(time_offset)]
        period = float(np.abs(finite).max()) if len(finite) else 0.0
        if period == 0.0:
            return points
        start_from_end = inverse(base_from_lidar) @ self.motion(period) @ base_from_lidar
        return deskew(points, time_offset, start_from_end, period)
