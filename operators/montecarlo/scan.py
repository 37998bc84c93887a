"""A point cloud as a 2-D scan: the nearest return of each bearing, within a band of heights."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.angles import arctangent

Doubles = npt.NDArray[np.float64]

MIN_HEIGHT, MAX_HEIGHT = 0.07, 1.06  # metres above the floor
ANGLE_INCREMENT = 0.01  # radians, of which a turn has 629
MAX_RANGE = 30.0  # metres


class Band(msgspec.Struct, forbid_unknown_fields=True):
    """What of a cloud a 2-D scan sees."""

    min_height: float = MIN_HEIGHT  # metres above the floor
    max_height: float = MAX_HEIGHT
    angle_increment: float = ANGLE_INCREMENT  # radians
    range_max: float = MAX_RANGE  # metres


class Scan2D(NamedTuple):
    """One return a bin of bearings, the first bin from -pi on; axes are those of the base."""

    ranges: Doubles  # (bins,) metres from the sensor, inf where nothing was met
    ends: Doubles  # (bins, 2) metres in the base frame, NaN where nothing was met
    sensor: Doubles  # (2,) metres, the sensor's place in the base frame

    def returns(self) -> Doubles:
        """Return the end points (n, 2) of the bins that met something, base frame, metres."""
        return np.ascontiguousarray(self.ends[np.isfinite(self.ranges)])


def flatten(
    points: npt.NDArray[Any],
    base_from_lidar: npt.NDArray[Any],
    *,
    min_height: float = MIN_HEIGHT,
    max_height: float = MAX_HEIGHT,
    angle_increment: float = ANGLE_INCREMENT,
    range_max: float = MAX_RANGE,
) -> Scan2D:
    """Keep of each bearing the nearest of the points (n, 3), lidar frame, within a band of heights above the floor.

    base_from_lidar: (4, 4). Points that are not finite, or at range_max or beyond, are no returns. Raises ValueError
    for a band or an increment that holds nothing.
    """
    if not min_height < max_height:
        raise ValueError(f"a 2-D scan wants min_height below max_height; they are {min_height} and {max_height} m")
    if not 0.0 < angle_increment <= math.pi:
        raise ValueError(f"a 2-D scan wants an angle_increment above 0 and up to pi; it is {angle_increment} rad")
    bins = math.ceil(2.0 * math.pi / angle_increment)
    pose = np.ascontiguousarray(base_from_lidar, np.float64)
    nearest = _nearest(points, pose, min_height, max_height, angle_increment, range_max, bins)
    return Scan2D(nearest[:, 0].copy(), nearest[:, 1:].copy(), pose[:2, 3].copy())


@njit(cache=True, error_model="numpy")
def _nearest(
    points: npt.NDArray[Any], pose: Doubles, low: float, high: float, increment: float, farthest: float, bins: int
) -> Doubles:
    """Return range, x and y (bins, 3) of the nearest point of each bin."""
    found = np.full((bins, 3), np.nan)
    found[:, 0] = np.inf
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        height = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not low <= height <= high:  # also what is not a number
            continue
        dx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
        dy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
        distance = math.sqrt(dx * dx + dy * dy)
        if not 0.0 < distance < farthest:
            continue
        place = min(bins - 1, max(0, int((arctangent(dy, dx) + math.pi) / increment)))
        if distance < found[place, 0]:
            found[place, 0], found[place, 1], found[place, 2] = distance, pose[0, 3] + dx, pose[1, 3] + dy
    return found
