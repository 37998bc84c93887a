"""The frustum grid of a frame: how far each direction is seen to be free."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float32]

LEAST_MARGIN = 0.03  # metres
TILES = 360  # of a turn, for the coarse look at what lies behind everything


class Frustums(NamedTuple):
    """A depth image in elevation (rows from below) and azimuth (columns from -pi); depths in metres."""

    free: Floats  # (rows, columns) smallest range less the margin; 0 where nothing was measured
    farthest: Floats  # (TILES,) largest entry of `free` of each degree of azimuth
    lowest: float  # elevation of the lower edge of row 0, radians
    height: float  # of a row, radians
    width: float  # of a column, radians


@njit(cache=True, error_model="numpy")
def frustum_grid(rho: Floats, theta: Floats, phi: Floats, height: float, width: float) -> Frustums:
    """Keep the smallest range of each frustum and take the margin off (paper eq. 2).

    rho, theta, phi: range, elevation, azimuth of the points of a frame (n,). height, width: of a frustum, radians. Rows
    are laid so that the lowest beam runs through the middle of row 0. The margin is the half height of the frustum at
    that range: a surface seen at less than 45 degrees of incidence is never taken for free space.
    """
    columns = max(1, round(2.0 * math.pi / width))
    width = 2.0 * math.pi / columns
    low, high = math.inf, -math.inf
    for i in range(len(theta)):
        low, high = min(low, theta[i]), max(high, theta[i])
    if not low <= high:
        low, high = 0.0, 0.0
    low -= 0.5 * height
    rows = int((high - low) / height) + 1
    nearest = np.full((rows, columns), np.inf, np.float32)
    for i in range(len(rho)):
        row = min(rows - 1, int((theta[i] - low) * (1.0 / height)))
        column = min(columns - 1, max(0, int((phi[i] + math.pi) * (1.0 / width))))
        nearest[row, column] = min(nearest[row, column], rho[i])
    farthest = np.zeros(TILES, np.float32)
    for row in range(rows):
        for column in range(columns):
            rho_0 = nearest[row, column]
            free = np.float32(0.0)
            if rho_0 < np.inf:
                free = max(np.float32(0.0), np.float32(rho_0 - max(LEAST_MARGIN, 0.5 * rho_0 * height)))
            nearest[row, column] = free
            first, last = column * TILES // columns, ((column + 1) * TILES - 1) // columns
            for tile in range(first, last + 1):
                farthest[tile] = max(farthest[tile], free)
    return Frustums(nearest, farthest, low, height, width)
