"""The nearest point of a voxel map."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.store import BLOCK_VOXELS, CELL_BLOCKS, NONE, Store, find
from operators.pointmap.voxels import pack

Floats = npt.NDArray[np.float32]


@njit(cache=True)
def gap(place: int, size: float, x: float) -> float:
    """Return the distance along one axis from x to the interval [place, place + 1] * size."""
    below, above = place * size - x, x - (place + 1) * size
    return below if below > 0.0 else (above if above > 0.0 else 0.0)


@njit(cache=True, error_model="numpy")
def search_block(
    store: Store, block: int, x: float, y: float, z: float, point: int, square: float
) -> tuple[int, float]:
    """Return the nearest point so far and its squared distance, after all points of a block."""
    candidate = int(store.block_head[block])
    while candidate != NONE:
        dx, dy, dz = store.points[candidate, 0] - x, store.points[candidate, 1] - y, store.points[candidate, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < square:
            point, square = candidate, d2
        candidate = int(store.next_point[candidate])
    return point, square


@njit(cache=True, error_model="numpy")
def search_cell(
    store: Store, cell: int, size: float, x: float, y: float, z: float, point: int, square: float
) -> tuple[int, float]:
    """Return the nearest point so far and its squared distance, after all blocks (of `size` metres) of a cell."""
    block = int(store.cell_head[cell])
    while block != NONE:
        dx = gap(store.block_place[block, 0], size, x)
        dy = gap(store.block_place[block, 1], size, y)
        dz = gap(store.block_place[block, 2], size, z)
        if dx * dx + dy * dy + dz * dz < square:
            point, square = search_block(store, block, x, y, z, point, square)
        block = int(store.next_block[block])
    return point, square


@njit(cache=True, error_model="numpy")
def nearest(store: Store, voxel: float, x: float, y: float, z: float, reach: float) -> tuple[int, float]:
    """Return the number of the map point nearest (x, y, z) and its squared distance; -1 if none is within `reach`.

    voxel, reach: metres. First the block of the point and its 26 neighbours, as far as they can beat what is found;
    only if they leave it open, the cells within reach, from the inside out.
    """
    point, square = NONE, reach * reach
    size = BLOCK_VOXELS * voxel
    bi, bj, bk = math.floor(x / size), math.floor(y / size), math.floor(z / size)
    block = find(store.block_keys, store.block_values, pack(bi, bj, bk))
    if block != NONE:
        point, square = search_block(store, block, x, y, z, point, square)
    for i in range(bi - 1, bi + 2):
        dx = gap(i, size, x)
        if dx * dx >= square:
            continue
        for j in range(bj - 1, bj + 2):
            dy = gap(j, size, y)
            if dx * dx + dy * dy >= square:
                continue
            for k in range(bk - 1, bk + 2):
                dz = gap(k, size, z)
                if dx * dx + dy * dy + dz * dz >= square or (i == bi and j == bj and k == bk):
                    continue
                block = find(store.block_keys, store.block_values, pack(i, j, k))
                if block != NONE:
                    point, square = search_block(store, block, x, y, z, point, square)
    if square <= size * size:  # the 27 blocks reach at least one block's size in every direction
        return point, square
    return nearest_by_cell(store, size, x, y, z, point, square)


@njit(cache=True, error_model="numpy")
def nearest_by_cell(
    store: Store, size: float, x: float, y: float, z: float, point: int, square: float
) -> tuple[int, float]:
    """Go on with the search of `nearest` (blocks of `size` metres), shell by shell of cells."""
    edge = CELL_BLOCKS * size
    ci, cj, ck = math.floor(x / edge), math.floor(y / edge), math.floor(z / edge)
    for shell in range(int(math.sqrt(square) / edge) + 2):
        inner = (shell - 1) * edge  # every cell of the shell is farther than this
        if shell > 0 and inner * inner >= square:
            break
        for i in range(ci - shell, ci + shell + 1):
            dx = gap(i, edge, x)
            for j in range(cj - shell, cj + shell + 1):
                dy = gap(j, edge, y)
                if dx * dx + dy * dy >= square:
                    continue
                whole = abs(i - ci) == shell or abs(j - cj) == shell
                for k in range(ck - shell, ck + shell + 1, 1 if whole or shell == 0 else 2 * shell):
                    dz = gap(k, edge, z)
                    if dx * dx + dy * dy + dz * dz >= square:
                        continue
                    cell = find(store.cell_keys, store.cell_values, pack(i, j, k))
                    if cell != NONE:
                        point, square = search_cell(store, cell, size, x, y, z, point, square)
    return point, square


@njit(cache=True, error_model="numpy")
def nearest_all(
    store: Store, voxel: float, points: Floats, reach: float
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """Return, for each of the points (n, 3), the nearest map point (-1 beyond reach) and its squared distance (n,)."""
    found = np.empty(len(points), np.int32)
    squares = np.empty(len(points), np.float64)
    for n in range(len(points)):
        x, y, z = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
        if not (abs(x) < np.inf and abs(y) < np.inf and abs(z) < np.inf):
            found[n], squares[n] = NONE, np.inf
            continue
        found[n], squares[n] = nearest(store, voxel, x, y, z, reach)
    return found, squares
