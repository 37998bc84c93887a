"""A grid of the free floor: how far the nearest obstacle is, and the shortest way between two points."""

from __future__ import annotations

import heapq
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import distance_transform_edt

from sim.solids import Body

Grid = npt.NDArray[np.float64]
Bounds = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max

HEADROOM = 1.9  # metres: what hangs higher is in nobody's way


class Clearance(NamedTuple):
    """Metres to the nearest obstacle, 0 inside; cell [row, column] lies at (x, y) + resolution * (column, row)."""

    distance: Grid
    x: float
    y: float
    resolution: float

    def at(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the clearance of points (n, 2), that of the nearest cell; 0 outside the grid."""
        cells = np.rint((points - (self.x, self.y)) / self.resolution).astype(np.int64)
        rows, columns = self.distance.shape
        inside = (cells[:, 0] >= 0) & (cells[:, 0] < columns) & (cells[:, 1] >= 0) & (cells[:, 1] < rows)
        result = np.zeros(len(points))
        result[inside] = self.distance[cells[inside, 1], cells[inside, 0]]
        return result


def clearance(bodies: list[Body], bounds: Bounds, resolution: float) -> Clearance:
    """Rasterize what stands on the floor below head height and measure the distance to it."""
    columns = math.ceil((bounds[2] - bounds[0]) / resolution) + 1
    rows = math.ceil((bounds[3] - bounds[1]) / resolution) + 1
    free = np.ones((rows, columns), np.bool_)
    for body in bodies:
        for part in body.parts:
            if part.z - part.dz / 2 < HEADROOM:
                carve(free, part.footprint() - (bounds[0], bounds[1]), resolution)
    free[[0, -1]] = False
    free[:, [0, -1]] = False
    return Clearance(distance_transform_edt(free) * resolution, bounds[0], bounds[1], resolution)


def carve(free: npt.NDArray[np.bool_], corners: Grid, resolution: float) -> None:
    """Mark the cells whose centre lies in a convex polygon, or within half a cell of it, as taken."""
    low = np.maximum(np.floor(corners.min(0) / resolution).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(0) / resolution).astype(int), np.array(free.shape[::-1]) - 1)
    if (high < low).any():
        return
    x = np.arange(low[0], high[0] + 1) * resolution
    y = np.arange(low[1], high[1] + 1)[:, None] * resolution
    inside = np.ones((len(y), len(x)), np.bool_)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        outward = ((x - ax) * (by - ay) - (y - ay) * (bx - ax)) / max(math.hypot(bx - ax, by - ay), 1e-9)
        inside &= outward <= resolution / 2
    free[low[1] : high[1] + 1, low[0] : high[0] + 1] &= ~inside


@njit(cache=True)
def _astar(
    distance: Grid, resolution: float, start: int, goal: int, radius: float, wide: float
) -> npt.NDArray[np.int64]:
    """Return the cells of the cheapest 8-connected way, goal first; empty if there is none.

    A step costs its length, up to three times as much the nearer to an obstacle within `wide` metres.
    """
    rows, columns = distance.shape
    cost = np.full(rows * columns, np.inf)
    parent = np.full(rows * columns, -1, np.int64)
    goal_row, goal_column = goal // columns, goal % columns
    cost[start] = 0.0
    queue = [(0.0, start)]
    while len(queue) > 0:
        bound, cell = heapq.heappop(queue)
        if cell == goal:
            break
        row, column = cell // columns, cell % columns
        base = cost[cell]
        if bound > base + resolution * math.hypot(float(row - goal_row), float(column - goal_column)) + 1e-9:
            continue  # a cheaper way to this cell has been followed already
        for down in range(-1, 2):
            for right in range(-1, 2):
                r, c = row + down, column + right
                if (down == 0 and right == 0) or r < 0 or c < 0 or r >= rows or c >= columns:
                    continue
                if distance[r, c] < radius:
                    continue
                length = resolution * math.sqrt(float(down * down + right * right))
                near = max(0.0, 1.0 - (distance[r, c] - radius) / (wide - radius))
                total = base + length * (1.0 + 2.0 * near)
                following = r * columns + c
                if total < cost[following]:
                    cost[following] = total
                    parent[following] = cell
                    ahead = resolution * math.hypot(float(r - goal_row), float(c - goal_column))
                    heapq.heappush(queue, (total + ahead, following))
    found = [goal]
    if parent[goal] < 0 and goal != start:
        return np.zeros(0, np.int64)
    while found[-1] != start:
        found.append(parent[found[-1]])
    return np.array(found)


def route(free: Clearance, start: npt.ArrayLike, goal: npt.ArrayLike, *, radius: float) -> Grid | None:
    """Return the way (n, 2) of a disc from start to goal, which keeps to the middle of the free floor; None if none.

    The ends may be nearer to an obstacle than `radius` (metres).
    """
    ends = np.array([start, goal], np.float64)
    rows, columns = free.distance.shape
    cells = np.rint((ends - (free.x, free.y)) / free.resolution).astype(np.int64)
    if (cells < 0).any() or (cells >= (columns, rows)).any():
        return None
    first, last = cells[:, 1] * columns + cells[:, 0]
    cells_found = _astar(free.distance, free.resolution, int(first), int(last), radius, radius + 0.6)
    if len(cells_found) == 0:
        return None
    column, row = cells_found[::-1] % columns, cells_found[::-1] // columns
    way = np.stack([free.x + column * free.resolution, free.y + row * free.resolution], 1)
    way[0], way[-1] = ends
    return way


def length_of(way: Grid) -> float:
    """Return the length in metres of a way (n, 2), smoothed over half a metre so that grid steps do not count."""
    window = 5
    if len(way) > 2 * window:
        padded = np.concatenate([np.repeat(way[:1], window, 0), way, np.repeat(way[-1:], window, 0)])
        sums = np.cumsum(padded, axis=0)
        way = np.concatenate([way[:1], (sums[2 * window :] - sums[: -2 * window]) / (2 * window), way[-1:]])
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
