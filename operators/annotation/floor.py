"""Which points of a map are ground."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from operators.annotation.session import Floats
from operators.pointmap import VoxelMap, height_above

Booleans = npt.NDArray[np.bool_]


def floor_points(points: Floats, plane: npt.NDArray[np.float64], tolerance: float, clearance: float) -> Booleans:
    """Say which of the points (n, 3) are ground: near the plane, and apart from everything that is not.

    plane: (a, b, c) of z = a x + b y + c. tolerance: metres from it. clearance: metres to the nearest point that is not
    ground; it keeps the feet of walls and furniture out.
    """
    heights = height_above(plane, points)
    floor = np.abs(heights) < tolerance
    beside = np.ascontiguousarray(points[~floor & (np.abs(heights) < tolerance + clearance)])
    if not len(beside):
        return floor
    others = VoxelMap(min(0.03, clearance))
    others.insert(beside, np.zeros_like(beside), np.zeros(len(beside), np.float32), 0)
    near_edge = np.flatnonzero(floor & (np.abs(heights) > tolerance - clearance))
    found, _ = others.nearest(points[near_edge], clearance)
    floor[near_edge[found >= 0]] = False
    return floor
