"""A raster on the world: square cells whose borders lie on whole multiples of the resolution."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt


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


def resampled(
    cells: npt.NDArray[Any], origin: npt.ArrayLike, resolution: float, target: Lattice
) -> npt.NDArray[np.int8]:
    """Put a foreign grid (origin in metres, any resolution) onto a raster; the greatest value wins, -1 where none is.

    Cells larger than the raster's are spread over all that they cover; smaller ones are gathered.
    """
    x0, y0 = np.asarray(origin, np.float64)
    parts = max(1, math.ceil(resolution / target.resolution - 1e-6))
    result = np.full((target.rows, target.columns), -1, np.int8)
    for part_row in range(parts):
        centre_y = y0 + (np.arange(cells.shape[0]) + (part_row + 0.5) / parts) * resolution
        rows = np.floor(centre_y / target.resolution + 1e-6).astype(int) - target.first_row
        for part_column in range(parts):
            centre_x = x0 + (np.arange(cells.shape[1]) + (part_column + 0.5) / parts) * resolution
            columns = np.floor(centre_x / target.resolution + 1e-6).astype(int) - target.first_column
            keep_row, keep_column = (rows >= 0) & (rows < target.rows), (columns >= 0) & (columns < target.columns)
            where = np.ix_(rows[keep_row], columns[keep_column])
            np.maximum.at(result, where, cells[np.ix_(keep_row, keep_column)].astype(np.int8))
    return result
