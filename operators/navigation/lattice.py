"""A raster on the world: square cells whose borders lie on whole multiples of the resolution."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit


class Lattice(NamedTuple):
    """A rectangle of cells; that of (row, column) begins at resolution * (first_column + column, first_row + row)."""

    resolution: float  # metres
    first_row: int
    first_column: int
    rows: int
    columns: int

    @property
    def origin(self) -> tuple[float, float]:
        """World position of the lower left corner, x and y in metres."""
        return self.first_column * self.resolution, self.first_row * self.resolution

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Return (row, column) of the cell that holds a world position; it may lie outside."""
        return (
            math.floor(y / self.resolution) - self.first_row,
            math.floor(x / self.resolution) - self.first_column,
        )

    def centre(self, row: Any, column: Any) -> tuple[Any, Any]:
        """Return the world position (x, y) of cells' centres; row and column are numbers or arrays."""
        return (
            (self.first_column + column + 0.5) * self.resolution,
            (self.first_row + row + 0.5) * self.resolution,
        )

    def inside(self, row: int, column: int) -> bool:
        """Say whether a cell belongs to the raster."""
        return 0 <= row < self.rows and 0 <= column < self.columns

    def covers(self, x: float, y: float, margin: float = 0.0) -> bool:
        """Say whether the square of half side `margin` around a world position lies inside."""
        return self.inside(*self.cell(x - margin, y - margin)) and self.inside(*self.cell(x + margin, y + margin))

    def coarse(self, factor: int) -> Lattice:
        """Return the raster of cells `factor` times as long. Raises ValueError when the borders do not coincide."""
        if any(number % factor for number in self[1:]):
            raise ValueError(f"A raster of {self[1:]} cells does not divide by {factor}")
        return Lattice(self.resolution * factor, *(number // factor for number in self[1:]))


def lattice_around(resolution: float, lower: npt.ArrayLike, upper: npt.ArrayLike, *, block: int = 1) -> Lattice:
    """Return the smallest raster of whole blocks of cells that covers a box (x, y in metres)."""
    low = np.floor(np.asarray(lower, np.float64) / (resolution * block)).astype(int) * block
    high = (np.floor(np.asarray(upper, np.float64) / (resolution * block)).astype(int) + 1) * block
    return Lattice(resolution, int(low[1]), int(low[0]), int(high[1] - low[1]), int(high[0] - low[0]))


def union(a: Lattice, b: Lattice) -> Lattice:
    """Return the smallest raster that covers two of one resolution."""
    first_row, first_column = min(a.first_row, b.first_row), min(a.first_column, b.first_column)
    rows = max(a.first_row + a.rows, b.first_row + b.rows) - first_row
    columns = max(a.first_column + a.columns, b.first_column + b.columns) - first_column
    return Lattice(a.resolution, first_row, first_column, rows, columns)


def moved(cells: npt.NDArray[Any], source: Lattice, target: Lattice, fill: float) -> npt.NDArray[Any]:
    """Copy cells (rows, columns, ...) of one raster onto another of its resolution; `fill` where there are none."""
    result = np.full((target.rows, target.columns, *cells.shape[2:]), fill, cells.dtype)
    row, column = source.first_row - target.first_row, source.first_column - target.first_column
    top, left = max(row, 0), max(column, 0)
    bottom, right = min(row + source.rows, target.rows), min(column + source.columns, target.columns)
    if bottom > top and right > left:
        result[top:bottom, left:right] = cells[top - row : bottom - row, left - column : right - column]
    return result


@njit(cache=True)
def _spread(
    cells: npt.NDArray[np.int8],
    corner: tuple[float, float],
    size: float,
    parts: int,
    result: npt.NDArray[np.int8],
    first: tuple[int, int],
    resolution: float,
) -> None:
    for row in range(cells.shape[0] * parts):
        y = corner[1] + (row + 0.5) * size / parts
        to_row = math.floor(y / resolution + 1e-6) - first[0]
        if to_row < 0 or to_row >= result.shape[0]:
            continue
        for column in range(cells.shape[1] * parts):
            x = corner[0] + (column + 0.5) * size / parts
            to_column = math.floor(x / resolution + 1e-6) - first[1]
            if 0 <= to_column < result.shape[1]:
                value = cells[row // parts, column // parts]
                result[to_row, to_column] = max(result[to_row, to_column], value)


def resampled(
    cells: npt.NDArray[np.int8], origin: npt.ArrayLike, resolution: float, target: Lattice
) -> npt.NDArray[np.int8]:
    """Put a foreign grid (origin in metres, any resolution) onto a raster; the greatest value wins, -1 where none is.

    Cells larger than the raster's are spread over all that they cover; smaller ones are gathered.
    """
    x, y = (float(number) for number in np.asarray(origin, np.float64))
    parts = max(1, math.ceil(resolution / target.resolution - 1e-6))
    result = np.full((target.rows, target.columns), -1, np.int8)
    own = np.array(cells, np.int8)  # a copy: messages are read-only, which is another type to numba
    _spread(own, (x, y), resolution, parts, result, (target.first_row, target.first_column), target.resolution)
    return result


class Box(NamedTuple):
    """A rectangle of a raster's cells: from the first to before the last."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def empty(self) -> bool:
        """Say whether it holds no cell."""
        return self.bottom <= self.top or self.right <= self.left

    def grown(self, cells: int, lattice: Lattice) -> Box:
        """Return the box with a margin, cut to a raster."""
        return Box(
            max(self.top - cells, 0),
            min(self.bottom + cells, lattice.rows),
            max(self.left - cells, 0),
            min(self.right + cells, lattice.columns),
        )

    def joined(self, other: Box) -> Box:
        """Return the smallest box that holds both."""
        if self.empty or other.empty:
            return other if self.empty else self
        return Box(
            min(self.top, other.top),
            max(self.bottom, other.bottom),
            min(self.left, other.left),
            max(self.right, other.right),
        )
