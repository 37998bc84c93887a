"""The likelihood field: how well the end points of a scan fit a map (Thrun, Burgard, Fox 2005, section 6.4)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.montecarlo.map_file import FREE, FREE_THRESHOLD, OCCUPIED_THRESHOLD, GridMap, MapError
from operators.navigation.distance import MOST_CELLS, distance_to

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


class LikelihoodField(NamedTuple):
    """The cubed probability of an end point in each cell of a map."""

    cubed: Floats  # (rows, columns)
    outside: float  # of an end point beyond the map
    origin: Doubles  # (2,) metres
    resolution: float  # metres a cell


def likelihood_field(
    grid: GridMap,
    *,
    z_hit: float = 0.5,
    z_rand: float = 0.5,
    sigma_hit: float = 0.2,
    max_dist: float = 2.0,
    range_max: float = 30.0,
) -> LikelihoodField:
    """Compute (z_hit exp(-d^2 / (2 sigma_hit^2)) + z_rand / range_max)^3 of each cell, d metres from something.

    Distances end at max_dist. Raises MapError for a map in which nothing is occupied, or whose cells are too
    fine or too coarse.
    """
    occupied = grid.cells > 100 * OCCUPIED_THRESHOLD
    if not occupied.any():
        raise MapError("the map has no occupied cell, so nothing can be told from a scan")
    if grid.resolution > max_dist:
        raise MapError(
            f"the map has cells of {grid.resolution:g} m, which is more than laser_likelihood_max_dist, "
            f"{max_dist:g} m; a map for scans has cells of some centimetres"
        )
    if max_dist / grid.resolution > MOST_CELLS - 2:
        raise MapError(
            f"the map has cells of {grid.resolution:g} m; laser_likelihood_max_dist, {max_dist:g} m, "
            f"may be {MOST_CELLS - 2} cells at most"
        )
    distance = distance_to(occupied, grid.resolution, max_dist).astype(np.float64)
    chance = z_hit * np.exp(-(distance**2) / (2.0 * sigma_hit**2)) + z_rand / range_max
    outside = z_hit * math.exp(-(max_dist**2) / (2.0 * sigma_hit**2)) + z_rand / range_max
    return LikelihoodField((chance**3).astype(np.float32), outside**3, grid.origin, grid.resolution)


def free_places(grid: GridMap) -> Doubles:
    """Return the centres (n, 2) of the free cells, metres in the world. Raises MapError if there are none."""
    rows, columns = np.nonzero((grid.cells >= FREE) & (grid.cells < 100 * FREE_THRESHOLD))
    if not len(rows):
        raise MapError("the map has no free cell, so the robot can be nowhere")
    return grid.origin + grid.resolution * (np.stack([columns, rows], axis=1) + 0.5)


def weigh(poses: Doubles, ends: Doubles, field: LikelihoodField) -> Doubles:
    """Return the likelihood (n,) of a scan at each pose (n, 3): x, y, heading. ends: (m, 2) in the base frame.

    One plus the sum of the cubed probabilities, as amcl of ROS has it: an average of beams, no product of them, since
    neighbouring beams are anything but independent.
    """
    return _weigh(poses, ends, field.cubed, field.outside, field.origin, 1.0 / field.resolution)


@njit(cache=True, error_model="numpy")
def _weigh(poses: Doubles, ends: Doubles, cubed: Floats, outside: float, origin: Doubles, scale: float) -> Doubles:
    rows, columns = cubed.shape
    result = np.empty(len(poses))
    for i in range(len(poses)):
        cosine, sine = math.cos(poses[i, 2]) * scale, math.sin(poses[i, 2]) * scale
        x, y = (poses[i, 0] - origin[0]) * scale, (poses[i, 1] - origin[1]) * scale
        total = 1.0
        for beam in range(len(ends)):
            ex, ey = ends[beam, 0], ends[beam, 1]
            px, py = x + cosine * ex - sine * ey, y + sine * ex + cosine * ey
            if px >= 0.0 and py >= 0.0 and px < columns and py < rows:
                total += cubed[int(py), int(px)]
            else:
                total += outside
        result[i] = total
    return result
