"""How far it is from every cell to the nearest occupied one: exact Euclidean, up to a limit."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

MOST_CELLS = 127  # twice its square is the largest that 16 bits hold


@njit(cache=True)
def _squared(occupied: npt.NDArray[np.bool_], limit: int) -> npt.NDArray[np.int16]:
    """Return squared distances in cells, true below limit^2: along each row first, then over the rows around."""
    rows, columns = occupied.shape
    along = np.empty((rows, columns), np.int16)
    for row in range(rows):
        last = -limit
        for column in range(columns):
            if occupied[row, column]:
                last = column
            along[row, column] = min(column - last, limit)
        last = columns + limit
        for column in range(columns - 1, -1, -1):
            if occupied[row, column]:
                last = column
            nearest = min(along[row, column], last - column)
            along[row, column] = nearest * nearest
    result = along.copy()
    for row in range(rows):
        for step in range(1, limit):
            square = np.int16(step * step)
            for other in (row - step, row + step):
                if other < 0 or other >= rows:
                    continue
                for column in range(columns):
                    candidate = np.int16(along[other, column] + square)
                    result[row, column] = min(result[row, column], candidate)
    return result


def distance_to(occupied: npt.NDArray[np.bool_], resolution: float, limit: float) -> npt.NDArray[np.float32]:
    """Return the distance in metres from each cell's centre to that of the nearest occupied cell, at most `limit`.

    occupied (rows, columns). Exact below the limit, which costs time: the work grows with limit / resolution.
    Raises ValueError for a limit of more than MOST_CELLS cells.
    """
    cells = int(np.ceil(limit / resolution)) + 1
    if cells > MOST_CELLS:
        raise ValueError(f"A limit of {limit} m is {cells} cells of {resolution} m; at most {MOST_CELLS} are measured")
    squares = _squared(occupied, cells)
    return np.minimum(np.sqrt(squares.astype(np.float32)) * np.float32(resolution), np.float32(limit))
