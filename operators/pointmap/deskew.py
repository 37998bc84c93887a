"""Undo the motion of the sensor during a rolling scan."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from graph.geometry import logarithm

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]


@njit(cache=True, error_model="numpy")
def carry(points: Floats, fraction: Doubles, turn: Doubles, shift: Doubles) -> Floats:
    """Move each point (n, 3) by its fraction (n,) of a rotation vector (3,) and of a translation (3,)."""
    moved = np.empty_like(points)
    wx, wy, wz = turn[0], turn[1], turn[2]
    angle = math.sqrt(wx * wx + wy * wy + wz * wz)
    scale = 1.0 / angle if angle > 1e-12 else 0.0
    ax, ay, az = wx * scale, wy * scale, wz * scale
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        sine, cosine = math.sin(fraction[i] * angle), math.cos(fraction[i] * angle)
        along = (ax * x + ay * y + az * z) * (1.0 - cosine)
        moved[i, 0] = x * cosine + (ay * z - az * y) * sine + ax * along + fraction[i] * shift[0]
        moved[i, 1] = y * cosine + (az * x - ax * z) * sine + ay * along + fraction[i] * shift[1]
        moved[i, 2] = z * cosine + (ax * y - ay * x) * sine + az * along + fraction[i] * shift[2]
    return moved


def deskew(points: npt.NDArray[Any], time_offset: npt.NDArray[Any], start_from_end: Doubles, period: float) -> Floats:
    """Bring the points of a rolling scan to where the sensor stood at offset 0.

    points: (n, 3) metres, each in the sensor's frame at its own time. time_offset: (n,) seconds, may be negative.
    start_from_end: (4, 4) pose of the sensor at offset `period` (seconds) in its frame at offset 0; between them, and
    beyond, the motion is taken as steady. Returns float32 (n, 3).
    """
    if not period > 0.0:
        raise ValueError(f"the two poses of a de-skew must lie apart in time; their distance is {period} s")
    fraction = np.ascontiguousarray(time_offset, np.float64) / period
    turn = logarithm(start_from_end[:3, :3])
    shift = np.ascontiguousarray(start_from_end[:3, 3], np.float64)
    return carry(np.ascontiguousarray(points, np.float32), fraction, turn, shift)
