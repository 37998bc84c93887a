"""What stands near the robot and is nobody: cells of the floor that the lidar saw filled before it was too near."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

CELL = 0.1  # metres
SIDE = 64  # cells of the torus: more than a frame reaches, so that no two of its places fall together
KEPT = 20.0  # seconds for which a cell is filled that nobody looks at again
SURE = 20  # by which weight of sightings something stands in a cell: who passes is not there for so long
MOST = 40  # weight that a cell can have: a few frames in which it is taken for somebody do not make it so
AROUND = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]


class Things:
    """The cells around the robot where something stands, on a torus: what it comes to replaces what it left."""

    def __init__(self) -> None:
        self._cell = np.full((SIDE, SIDE, 2), np.iinfo(np.int64).min, np.int64)  # whose place it is just now
        self._seen = np.full((SIDE, SIDE), -np.inf)  # seconds, when something was last seen there
        self._weight = np.zeros((SIDE, SIDE), np.int64)  # of the sightings, up to SURE

    def observe(self, places: Floats, seconds: float, weight: int = SURE) -> None:
        """Take in that something was seen at places (n, 2; world, metres) at a time; each cell counts but once."""
        cell, row, column = _cells(places)
        known = self._known(cell, row, column, seconds)
        self._weight[row, column] = np.minimum(np.where(known, self._weight[row, column], 0) + weight, MOST)
        self._cell[row, column] = cell
        self._seen[row, column] = seconds

    def doubt(self, places: Floats, seconds: float, weight: int) -> None:
        """Take in that somebody was seen at places (n, 2; world, metres) at a time: less is said for things there."""
        cell, row, column = _cells(places)
        known = self._known(cell, row, column, seconds)
        row, column = row[known], column[known]
        self._weight[row, column] = np.maximum(self._weight[row, column] - weight, 0)

    def explain(self, places: Floats, seconds: float, *, beside: bool = True) -> Flags:
        """Say which places (n, 2), seen at a time, lie in a filled cell, or beside one; the cells are seen again."""
        cell = np.floor(places / CELL).astype(np.int64)
        explained = np.zeros(len(places), np.bool_)
        for step in AROUND if beside else [(0, 0)]:
            there = cell + step
            row, column = (there % SIDE).T
            here = self._known(there, row, column, seconds) & (self._weight[row, column] >= SURE)
            if step == (0, 0):
                self._seen[row[here], column[here]] = seconds
            explained |= here
        return explained

    def _known(self, cell: Ints, row: Ints, column: Ints, seconds: float) -> Flags:
        """Say which cells (n, 2) have been seen filled, and not too long ago."""
        mine = (self._cell[row, column] == cell).all(axis=1)
        return np.asarray(mine & (seconds - self._seen[row, column] <= KEPT))


def _cells(places: Floats) -> tuple[Ints, Ints, Ints]:
    """Return the cells (m, 2) of places (n, 2; metres), each once, and their rows and columns (m,) on the torus."""
    cell = np.unique(np.floor(places / CELL).astype(np.int64), axis=0)
    row, column = (cell % SIDE).T
    return cell, row, column
