"""A 2-D occupancy map for planning: hits and free space as a running mean."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.angles import arctangent

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]

LOWEST_OBSTACLE, HIGHEST_OBSTACLE = 0.2, 1.2  # metres above the ground
SECTORS = 720  # of a turn, shifted by a half in every other scan: together they miss no cell up to 11 m
FARTHEST_FREE = 12.0  # metres; beyond, sectors are wider than cells and floor hits rare
MEMORY = 30  # looks; the running mean forgets older ones
MARGIN = 64  # cells by which the map grows beyond what is asked for


class Cells(NamedTuple):
    """The arrays of a grid, (rows, columns): row along y, column along x."""

    mean: Floats  # share of hits among the looks
    looks: Ints  # capped at MEMORY; 0 is unknown
    stamp: Ints  # last scan that touched the cell


@njit(cache=True, error_model="numpy")
def enter(cells: Cells, row: int, column: int, value: float, scan: int) -> None:
    """Take one look at a cell, at most once a scan."""
    if cells.stamp[row, column] == scan:
        return
    cells.stamp[row, column] = scan
    looks = min(cells.looks[row, column] + 1, MEMORY)
    cells.looks[row, column] = looks
    cells.mean[row, column] += (value - cells.mean[row, column]) / looks


@njit(cache=True, error_model="numpy")
def look(
    cells: Cells, points: Floats, heights: npt.NDArray[np.float64], ox: float, oy: float, resolution: float, scan: int
) -> None:
    """Enter one scan whose sensor stands at (ox, oy) of the grid.

    points: (n, 3) relative to the grid's corner, metres; heights: (n,) above the ground. A sector of the turn is free
    up to its first obstacle, or up to the farthest point seen on the floor.
    """
    near = np.full(SECTORS, np.inf)
    far = np.zeros(SECTORS)
    rows, columns = cells.mean.shape
    for i in range(len(points)):
        dx, dy = points[i, 0] - ox, points[i, 1] - oy
        sector = min(SECTORS - 1, int((arctangent(dy, dx) + math.pi) * (SECTORS / (2.0 * math.pi))))
        distance = math.sqrt(dx * dx + dy * dy)
        if heights[i] > LOWEST_OBSTACLE:
            if heights[i] < HIGHEST_OBSTACLE:
                near[sector] = min(near[sector], distance)
        elif heights[i] > -LOWEST_OBSTACLE:
            far[sector] = max(far[sector], distance)
    for i in range(len(points)):
        row, column = math.floor(points[i, 1] / resolution), math.floor(points[i, 0] / resolution)
        inside = 0 <= row < rows and 0 <= column < columns
        if inside and LOWEST_OBSTACLE < heights[i] < HIGHEST_OBSTACLE:
            enter(cells, row, column, 1.0, scan)
    for sector in range(SECTORS):
        angle = (sector + 0.25 + 0.5 * (scan % 2)) * 2.0 * math.pi / SECTORS - math.pi
        dx, dy = math.cos(angle), math.sin(angle)
        # An obstacle proves its sector free up to itself, less one cell; a floor point up to itself.
        free = near[sector] - resolution if near[sector] < np.inf else far[sector]
        for n in range(int(min(free, FARTHEST_FREE) / resolution) + 1):
            distance = n * resolution
            if distance > free:
                break
            row, column = math.floor((oy + dy * distance) / resolution), math.floor((ox + dx * distance) / resolution)
            if 0 <= row < rows and 0 <= column < columns:
                enter(cells, row, column, 0.0, scan)


class Occupancy:
    """A growing 2-D map of what stands 0.2 to 1.2 m above the floor."""

    def __init__(self, resolution: float = 0.05) -> None:
        if not resolution > 0.0:
            raise ValueError(f"the resolution of an occupancy map must be above 0 m; it is {resolution}")
        self.resolution = resolution
        self.corner = np.zeros(2, np.int64)  # column and row of cell [0, 0] in the world's grid
        self.cells = Cells(np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int32), np.zeros((0, 0), np.int32))
        self.scans = 0

    @property
    def origin(self) -> npt.NDArray[np.float64]:
        """Return the world coordinates (2,) of the grid's corner, metres."""
        return np.asarray(self.corner * self.resolution, np.float64)

    def add(self, points: npt.NDArray[Any], heights: npt.NDArray[np.float64], sensor: npt.NDArray[Any]) -> None:
        """Enter one scan: points (n, 3) in the world, their heights (n,) above the floor, the sensor's place (2,)."""
        if not len(points):
            return
        reach = np.concatenate([points[:, :2], np.asarray(sensor, np.float64)[None, :2]])
        self._cover(reach.min(axis=0), reach.max(axis=0))
        self.scans += 1
        shift = np.array([self.origin[0], self.origin[1], 0.0])
        local = (points.astype(np.float64) - shift).astype(np.float32)
        place = np.asarray(sensor, np.float64)[:2] - self.origin
        look(self.cells, local, heights, place[0], place[1], self.resolution, self.scans)

    def add_map(self, points: npt.NDArray[Any], heights: npt.NDArray[np.float64]) -> None:
        """Enter the points (n, 3) of a map: a cell with an obstacle is taken; one with floor alone is free."""
        if not len(points):
            return
        self._cover(points[:, :2].min(axis=0) - 0.5, points[:, :2].max(axis=0) + 0.5)
        columns, rows = (np.floor(points[:, :2] / self.resolution).astype(np.int64) - self.corner).T
        floor = np.abs(heights) < LOWEST_OBSTACLE
        obstacle = (heights > LOWEST_OBSTACLE) & (heights < HIGHEST_OBSTACLE)
        for drow in (-1, 0, 1):  # the floor of a map is thinner than one point a cell
            for dcolumn in (-1, 0, 1):
                self.cells.looks[rows[floor] + drow, columns[floor] + dcolumn] = MEMORY
        self.cells.looks[rows[obstacle], columns[obstacle]] = MEMORY
        self.cells.mean[rows[obstacle], columns[obstacle]] = 1.0

    def percent(self) -> npt.NDArray[np.int8]:
        """Return the grid (rows, columns): -1 unknown, 0 free to 100 occupied."""
        share = np.rint(100.0 * self.cells.mean)
        return np.where(self.cells.looks > 0, share, -1.0).astype(np.int8)

    def _cover(self, low: npt.NDArray[Any], high: npt.NDArray[Any]) -> None:
        """Grow the grid until it holds the rectangle low (2,) to high (2,), metres."""
        first = np.floor(np.asarray(low, np.float64) / self.resolution).astype(np.int64)
        last = np.floor(np.asarray(high, np.float64) / self.resolution).astype(np.int64) + 1
        rows, columns = self.cells.mean.shape
        old_last = self.corner + np.array([columns, rows])
        if rows and (first >= self.corner).all() and (last <= old_last).all():
            return
        first, last = first - MARGIN, last + MARGIN
        if rows:
            first, last = np.minimum(first, self.corner), np.maximum(last, old_last)
        shape = (int(last[1] - first[1]), int(last[0] - first[0]))
        column, row = self.corner - first
        larger: list[Any] = []
        for old in self.cells:
            new = np.zeros(shape, old.dtype)
            new[row : row + rows, column : column + columns] = old
            larger.append(new)
        self.cells, self.corner = Cells(*larger), first
