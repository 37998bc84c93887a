"""Points on the floor, gathered: to whom they are nearest, and in which clumps the rest lies."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

NOBODY = -1


@njit(cache=True)
def nearest_of(points: Floats, places: Floats, gates: Floats) -> Ints:
    """Return for each point (n, 2) the index of the nearest place (k, 2) within its gate (k,) in metres, or NOBODY."""
    result = np.full(len(points), NOBODY, np.int64)
    for i in range(len(points)):
        least = np.inf
        for j in range(len(places)):
            x, y = points[i, 0] - places[j, 0], points[i, 1] - places[j, 1]
            square = x * x + y * y
            if square < least and square < gates[j] * gates[j]:
                least, result[i] = square, j
    return result


@njit(cache=True)
def clumps(points: Floats, cell: float) -> Ints:
    """Return for each point (n, 2) the number of its clump: points in cells of `cell` metres that touch, corners too.

    Clumps are numbered from 0 in the order of their first points.
    """
    result = np.full(len(points), NOBODY, np.int64)
    if len(points) == 0:
        return result
    low_x, low_y = points[:, 0].min(), points[:, 1].min()
    columns = math.floor((points[:, 0].max() - low_x) / cell) + 3
    rows = math.floor((points[:, 1].max() - low_y) / cell) + 3
    grid = np.full(rows * columns, NOBODY, np.int64)  # NOBODY: empty; len(points): taken, not yet numbered
    cells = np.empty(len(points), np.int64)
    for i in range(len(points)):
        row, column = int((points[i, 1] - low_y) / cell) + 1, int((points[i, 0] - low_x) / cell) + 1
        cells[i] = row * columns + column
        grid[cells[i]] = len(points)
    stack = np.empty(rows * columns, np.int64)
    count = 0
    for i in range(len(points)):
        if grid[cells[i]] == len(points):
            stack[0], height = cells[i], 1
            grid[cells[i]] = count
            while height > 0:
                height -= 1
                here = stack[height]
                for down in range(-1, 2):
                    for right in range(-1, 2):
                        there = here + down * columns + right
                        if grid[there] == len(points):
                            grid[there] = count
                            stack[height] = there
                            height += 1
            count += 1
        result[i] = grid[cells[i]]
    return result


def centres(points: Floats, group: Ints, count: int) -> tuple[Floats, Ints]:
    """Return the mean (count, 2) and the number (count,) of the points (n, 2) of each group; the mean of none is 0."""
    taken = group >= 0
    number = np.bincount(group[taken], minlength=count)
    sums = np.stack([np.bincount(group[taken], points[taken, axis], count) for axis in range(2)], axis=1)
    return sums / np.maximum(number, 1)[:, None], number
