"""Grid subsampling by barycentres, and the cells in which neighbours are looked for.

All sums are integers and all orders are those of the voxels, so that the points' order changes no bit.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.voxels import spread

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

NONE = -1
CELL = 3  # voxels an edge; a cell is wider than the 2.5 voxels of a kernel's radius, so its 26 neighbours are enough
FIELD = 18  # bits of a cell coordinate in a key
HALF = 1 << (FIELD - 1)
LOCAL = 5  # bits of the voxel's number in its cell, below the cell's key
FINE = 1 << 20  # fixed-point steps a voxel edge


class Grid(NamedTuple):
    """The barycentres of the occupied voxels, sorted by cell (x, then y, then z), and a hash table of the columns."""

    points: Floats  # (m, 3) metres
    cell_heights: Ints  # (cells,) vertical coordinate of each occupied cell
    cell_starts: Ints  # (cells + 1,) first point of each cell
    column_keys: Longs  # open addressing: key of a column of cells, or -1
    column_bounds: Ints  # (slots, 2) first cell of the column and the one after its last
    cell_size: float  # metres


@njit(cache=True, nogil=True)
def cell_key(i: int, j: int, k: int) -> int:
    """Pack cell coordinates, each in [-2^17, 2^17), into one key that sorts by (i, j, k)."""
    return ((i + HALF) << (2 * FIELD)) | ((j + HALF) << FIELD) | (k + HALF)


@njit(cache=True, nogil=True, error_model="numpy")
def collect(points: Floats, size: float) -> tuple[Longs, Ints, Longs, Longs, Ints]:
    """Collect points (n, 3) in voxels of `size` metres, numbered by first visit.

    Returns the voxels' sorting keys (m,), coordinates (m, 3), sums of their points' places within them (m, 3) in
    voxels / 2^20 and numbers of points (m,), and the voxel of each point (n,), -1 where a point is not finite or too
    far away.
    """
    count = len(points)
    slots = 1 << 10
    while slots < 2 * count:
        slots *= 2
    mask = slots - 1
    table = np.full(slots, NONE, np.int64)
    numbers = np.empty(slots, np.int32)
    keys = np.empty(count, np.int64)
    places = np.empty((count, 3), np.int32)
    sums = np.zeros((count, 3), np.int64)
    sizes = np.zeros(count, np.int64)
    voxel_of = np.empty(count, np.int32)
    farthest = float(CELL * (HALF - 2))
    found, last_key, number = 0, NONE, 0
    for n in range(count):
        u, v, w = points[n, 0] / size, points[n, 1] / size, points[n, 2] / size
        if not (abs(u) < farthest and abs(v) < farthest and abs(w) < farthest):
            voxel_of[n] = NONE
            continue
        i, j, k = math.floor(u), math.floor(v), math.floor(w)
        ci, cj, ck = i // CELL, j // CELL, k // CELL
        local = ((i - ci * CELL) * CELL + (j - cj * CELL)) * CELL + (k - ck * CELL)
        key = (cell_key(ci, cj, ck) << LOCAL) | local
        if key != last_key:  # neighbours in a scan mostly share their voxel
            last_key = key
            slot = spread(key, mask)
            while table[slot] != key and table[slot] != NONE:
                slot = (slot + 1) & mask
            if table[slot] == NONE:
                table[slot] = key
                numbers[slot] = found
                keys[found] = key
                places[found, 0], places[found, 1], places[found, 2] = i, j, k
                found += 1
            number = int(numbers[slot])
        sums[number, 0] += math.floor((u - i) * FINE)
        sums[number, 1] += math.floor((v - j) * FINE)
        sums[number, 2] += math.floor((w - k) * FINE)
        sizes[number] += 1
        voxel_of[n] = number
    return keys[:found], places[:found], sums[:found], sizes[:found], voxel_of


@njit(cache=True, nogil=True, error_model="numpy")
def arrange(
    order: Longs, keys: Longs, places: Ints, sums: Longs, sizes: Longs, size: float
) -> tuple[Floats, Ints, Ints, Longs, Ints, Ints]:
    """Return barycentres (m, 3) in the given order of the voxels, the other arrays of a Grid, and each voxel's rank."""
    count = len(order)
    points = np.empty((count, 3), np.float32)
    ranks = np.empty(count, np.int32)
    slots = 1 << 6
    while slots < 2 * count:
        slots *= 2
    mask = slots - 1
    cell_heights, cell_starts = np.empty(count, np.int32), np.empty(count + 1, np.int32)
    column_keys = np.full(slots, NONE, np.int64)
    column_bounds = np.empty((slots, 2), np.int32)
    last_cell, last_column, slot, cells = NONE, NONE, 0, 0
    for rank in range(count):
        number = order[rank]
        ranks[number] = rank
        for axis in range(3):
            inner = (sums[number, axis] + 0.5 * sizes[number]) / (sizes[number] * FINE)
            points[rank, axis] = np.float32((places[number, axis] + inner) * size)
        cell = keys[number] >> LOCAL
        if cell == last_cell:
            continue
        last_cell = cell
        column = cell >> FIELD
        if column != last_column:
            last_column = column
            slot = spread(column, mask)
            while column_keys[slot] != NONE:
                slot = (slot + 1) & mask
            column_keys[slot] = column
            column_bounds[slot, 0] = cells
        cell_heights[cells] = places[number, 2] // CELL
        cell_starts[cells] = rank
        cells += 1
        column_bounds[slot, 1] = cells
    cell_starts[cells] = count
    return points, cell_heights[:cells], cell_starts[: cells + 1], column_keys, column_bounds, ranks


def subsample(points: npt.NDArray[Any], size: float) -> tuple[Grid, Ints]:
    """Replace the points (n, 3) of each voxel of `size` metres by their barycentre.

    Returns the grid, and for each point its row in `grid.points`, or -1 where a point is not finite or too far away.
    The order of the points changes nothing but the order of these rows.
    """
    keys, places, sums, sizes, voxel_of = collect(np.ascontiguousarray(points, np.float32), size)
    order = np.argsort(keys)  # keys are unique
    barycentres, heights, starts, columns, bounds, ranks = arrange(order, keys, places, sums, sizes, size)
    rows = np.where(voxel_of == NONE, np.int32(NONE), ranks[voxel_of]) if len(ranks) else voxel_of
    return Grid(barycentres, heights, starts, columns, bounds, CELL * size), rows


@njit(cache=True, nogil=True)
def run_of(grid: Grid, i: int, j: int, lowest: int, highest: int) -> tuple[int, int]:
    """Return the first point of cells (i, j, lowest..highest) and the one after the last; equal where there is none."""
    key = ((i + HALF) << FIELD) | (j + HALF)
    mask = len(grid.column_keys) - 1
    slot = spread(key, mask)
    while grid.column_keys[slot] != key:
        if grid.column_keys[slot] == NONE:
            return 0, 0
        slot = (slot + 1) & mask
    cell, after = grid.column_bounds[slot, 0], grid.column_bounds[slot, 1]
    while cell < after and grid.cell_heights[cell] < lowest:
        cell += 1
    end = cell
    while end < after and grid.cell_heights[end] <= highest:
        end += 1
    return int(grid.cell_starts[cell]), int(grid.cell_starts[end])


@njit(cache=True, nogil=True, error_model="numpy")
def fill_nearest(grid: Grid, queries: Floats, rows: Ints, begin: int, end: int) -> None:
    """Replace for queries begin..end a near row (or -1, which stays) by that of the nearest grid point."""
    size, cloud = grid.cell_size, grid.points
    for q in range(begin, end):
        if rows[q] == NONE:
            continue
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        row = rows[q]
        dx, dy, dz = cloud[row, 0] - x, cloud[row, 1] - y, cloud[row, 2] - z
        best = dx * dx + dy * dy + dz * dz
        reach = math.sqrt(best)
        lowest, highest = math.floor((z - reach) / size), math.floor((z + reach) / size)
        # cells that the sphere through the near point touches; mostly one
        for i in range(math.floor((x - reach) / size), math.floor((x + reach) / size) + 1):
            for j in range(math.floor((y - reach) / size), math.floor((y + reach) / size) + 1):
                first, after = run_of(grid, i, j, lowest, highest)
                for p in range(first, after):
                    dx, dy, dz = cloud[p, 0] - x, cloud[p, 1] - y, cloud[p, 2] - z
                    square = dx * dx + dy * dy + dz * dz
                    if square < best or (square == best and p < row):
                        best, row = square, p
        rows[q] = row


def nearest(grid: Grid, queries: npt.NDArray[Any], near: Ints) -> Ints:
    """Return for each query (q, 3) the row of the nearest grid point.

    near: the row of some near point of the grid, such as the query's own barycentre; -1 stays -1.
    """
    rows = near.copy()
    fill_nearest(grid, np.ascontiguousarray(queries, np.float32), rows, 0, len(queries))
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def closest_members(grid: Grid, points: Floats, rows: Ints) -> Ints:
    """Return for each grid point (m,) the one of its own points (n, 3) that is nearest to it; of equal ones the first.

    rows: (n,) the grid point that each point belongs to, or -1.
    """
    source = np.full(len(grid.points), NONE, np.int32)
    least = np.full(len(grid.points), np.inf, np.float32)
    for n in range(len(points)):
        row = rows[n]
        if row == NONE:
            continue
        dx, dy = grid.points[row, 0] - points[n, 0], grid.points[row, 1] - points[n, 1]
        dz = grid.points[row, 2] - points[n, 2]
        square = np.float32(dx * dx + dy * dy + dz * dz)
        if square < least[row]:
            least[row], source[row] = square, n
    return source
