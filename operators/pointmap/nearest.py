"""The nearest point of a voxel map."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.prefetch import prefetch
from operators.pointmap.store import (
    BLOCK_BITS,
    BLOCK_VOXELS,
    CELL_BITS,
    CELL_BLOCKS,
    FARTHEST,
    KEY,
    LAYER,
    MASK,
    NONE,
    SIZE,
    START,
    Floats,
    Ints,
    Longs,
    Store,
    find,
    local_of,
    ones_below,
    voxel_of,
)
from operators.pointmap.voxels import pack, spread, unpack

Doubles = npt.NDArray[np.float64]

FETCHED = 300  # points whose blocks are brought into the cache together: 100 KB


@njit(cache=True, inline="always")
def gap(place: int, size: float, x: float) -> float:
    """Return the distance along one axis from x to the interval [place, place + 1] * size."""
    below, above = place * size - x, x - (place + 1) * size
    return below if below > 0.0 else (above if above > 0.0 else 0.0)


@njit(cache=True, error_model="numpy")
def search_voxels(
    table: Longs, pool: Floats, voxel: float, x: float, y: float, z: float, reach: float
) -> tuple[int, float]:
    """Return the place in the pool of the nearest point and its squared distance, from the 27 voxels around (x, y, z).

    table, pool: of the store, one by one, for to hand over all of it costs more than the search. voxel: metres. The
    place is -1 if nothing is nearer than `reach`. Along each axis the voxel itself comes first, then the nearer and
    then the farther neighbour, so that what cannot beat the nearest so far ends a loop.
    """
    place, square = NONE, np.float32(reach * reach)
    px, py, pz = np.float32(x), np.float32(y), np.float32(z)
    i, j, k = voxel_of(x, y, z, voxel)
    left, front, below = x - i * voxel, y - j * voxel, z - k * voxel  # distances to the walls of the voxel
    sa = -1 if 2.0 * left < voxel else 1
    sb = -1 if 2.0 * front < voxel else 1
    sc = -1 if 2.0 * below < voxel else 1
    last_key, slot, mask = np.int64(-2), 0, np.int64(0)
    for a in range(3):
        u = i if a == 0 else (i + sa if a == 1 else i - sa)
        ga = 0.0 if u == i else (left if u < i else voxel - left)
        if ga * ga >= square:
            break
        for b in range(3):
            v = j if b == 0 else (j + sb if b == 1 else j - sb)
            gb = 0.0 if v == j else (front if v < j else voxel - front)
            if ga * ga + gb * gb >= square:
                break
            for c in range(3):
                w = k if c == 0 else (k + sc if c == 1 else k - sc)
                gc = 0.0 if w == k else (below if w < k else voxel - below)
                if ga * ga + gb * gb + gc * gc >= square:
                    break
                key = pack(u >> BLOCK_BITS, v >> BLOCK_BITS, w >> BLOCK_BITS)
                if key != last_key:
                    last_key = key
                    slot = find(table, key)
                    mask = table[slot, MASK] if table[slot, KEY] != NONE else np.int64(0)
                local = local_of(u, v, w)
                if (mask >> local) & 1:
                    candidate = table[slot, START] + ones_below(mask, local)
                    dx, dy, dz = pool[candidate, 0] - px, pool[candidate, 1] - py, pool[candidate, 2] - pz
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 < square:
                        place, square = candidate, d2
    return place, float(square)


@njit(cache=True, error_model="numpy")
def search_blocks(
    table: Longs, pool: Floats, edge: float, x: float, y: float, z: float, place: int, square: float
) -> tuple[int, float]:
    """Return place and squared distance of the nearest so far, after the 27 blocks (of `edge` metres) around."""
    least = np.float32(square)
    px, py, pz = np.float32(x), np.float32(y), np.float32(z)
    i, j, k = voxel_of(x, y, z, edge)
    left, front, below = x - i * edge, y - j * edge, z - k * edge
    for a in range(-1, 2):
        ga = left if a < 0 else (edge - left if a > 0 else 0.0)
        if ga * ga >= least:
            continue
        for b in range(-1, 2):
            gb = front if b < 0 else (edge - front if b > 0 else 0.0)
            if ga * ga + gb * gb >= least:
                continue
            for c in range(-1, 2):
                gc = below if c < 0 else (edge - below if c > 0 else 0.0)
                if ga * ga + gb * gb + gc * gc >= least:
                    continue
                slot = find(table, pack(i + a, j + b, k + c))
                if table[slot, KEY] == NONE:
                    continue
                for candidate in range(table[slot, START], table[slot, START] + table[slot, SIZE]):
                    dx, dy, dz = pool[candidate, 0] - px, pool[candidate, 1] - py, pool[candidate, 2] - pz
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 < least:
                        place, least = candidate, d2
    return place, float(least)


@njit(cache=True, error_model="numpy")
def search_cell(
    store: Store, cell: int, edge: float, x: float, y: float, z: float, place: int, square: float
) -> tuple[int, float]:
    """Return place and squared distance of the nearest so far, after the blocks (of `edge` metres) of a cell's slot."""
    i, j, k = unpack(store.cells[cell, KEY])
    i, j, k = i << CELL_BITS, j << CELL_BITS, k << CELL_BITS
    for c in range(CELL_BLOCKS):
        layer = store.cells[cell, LAYER + c]
        dz = gap(k + c, edge, z)
        if layer == 0 or dz * dz >= square:
            continue
        for b in range(CELL_BLOCKS):
            row = (layer >> (CELL_BLOCKS * b)) & 255
            dy = gap(j + b, edge, y)
            if row == 0 or dy * dy + dz * dz >= square:
                continue
            for a in range(CELL_BLOCKS):
                dx = gap(i + a, edge, x)
                if (row >> a) & 1 == 0 or dx * dx + dy * dy + dz * dz >= square:
                    continue
                slot = find(store.table, pack(i + a, j + b, k + c))
                for candidate in range(store.table[slot, START], store.table[slot, START] + store.table[slot, SIZE]):
                    ex, ey, ez = (
                        store.pool[candidate, 0] - x,
                        store.pool[candidate, 1] - y,
                        store.pool[candidate, 2] - z,
                    )
                    d2 = ex * ex + ey * ey + ez * ez
                    if d2 < square:
                        place, square = candidate, d2
    return place, square


@njit(cache=True, error_model="numpy")
def search_cells(
    store: Store, edge: float, x: float, y: float, z: float, place: int, square: float
) -> tuple[int, float]:
    """Return place and squared distance of the nearest so far, after all cells within it, shell by shell."""
    width = CELL_BLOCKS * edge
    ci, cj, ck = voxel_of(x, y, z, width)
    for shell in range(int(math.sqrt(square) / width) + 2):
        inner = (shell - 1) * width  # every cell of the shell is farther than this
        if shell > 0 and inner * inner >= square:
            break
        for i in range(ci - shell, ci + shell + 1):
            dx = gap(i, width, x)
            for j in range(cj - shell, cj + shell + 1):
                dy = gap(j, width, y)
                if dx * dx + dy * dy >= square:
                    continue
                whole = abs(i - ci) == shell or abs(j - cj) == shell
                for k in range(ck - shell, ck + shell + 1, 1 if whole or shell == 0 else 2 * shell):
                    dz = gap(k, width, z)
                    if dx * dx + dy * dy + dz * dz >= square:
                        continue
                    cell = find(store.cells, pack(i, j, k))
                    if store.cells[cell, KEY] != NONE:
                        place, square = search_cell(store, cell, edge, x, y, z, place, square)
    return place, square


@njit(cache=True, error_model="numpy", inline="always")
def beside(place: float) -> int:
    """Return on which side a point at `place` of its block, in [0, 1), is within half a voxel of the next block."""
    return -1 if place < 0.5 / BLOCK_VOXELS else (1 if place > 1.0 - 0.5 / BLOCK_VOXELS else 0)


@njit(cache=True, error_model="numpy")
def fetch_blocks(store: Store, edge: float, points: Floats | Doubles) -> None:
    """Bring the blocks (of `edge` metres) that `search_voxels` will read for the points (n, 3) into the cache."""
    table, pool = store.table, store.pool
    mask, per_edge = len(table) - 1, 1.0 / edge
    keys = np.empty(4 * len(points), np.int64)
    count = 0
    for n in range(len(points)):
        x, y, z = points[n, 0] * per_edge, points[n, 1] * per_edge, points[n, 2] * per_edge
        if not (abs(x) < FARTHEST and abs(y) < FARTHEST and abs(z) < FARTHEST):
            continue
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        a, b, c = beside(x - i), beside(y - j), beside(z - k)
        for axis in range(4):
            if axis == 0 or (axis == 1 and a != 0) or (axis == 2 and b != 0) or (axis == 3 and c != 0):
                key = pack(i + (a if axis == 1 else 0), j + (b if axis == 2 else 0), k + (c if axis == 3 else 0))
                prefetch(table, spread(key, mask))
                keys[count] = key
                count += 1
    for n in range(count):
        slot = find(table, keys[n])
        if table[slot, KEY] != NONE:
            for line in range(3):  # of 4 points; most blocks have fewer than 12
                prefetch(pool, table[slot, START] + 4 * line)


@njit(cache=True, error_model="numpy")
def nearest(store: Store, voxel: float, points: Floats | Doubles, reach: float) -> tuple[Ints, Doubles]:
    """Return, for each of the points (n, 3), the nearest map point (-1 beyond reach) and its squared distance (n,).

    voxel, reach: metres. First the 27 voxels around the point; if they leave it open the 27 blocks; then the cells
    within reach, from the inside out. Points that are not finite have no neighbour.
    """
    edge = BLOCK_VOXELS * voxel
    table, pool = store.table, store.pool
    found = np.full(len(points), NONE, np.int32)
    squares = np.full(len(points), np.inf)
    for n in range(len(points)):
        if n % FETCHED == 0:
            fetch_blocks(store, edge, points[n : n + FETCHED])
        x, y, z = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
        if not (abs(x) < np.inf and abs(y) < np.inf and abs(z) < np.inf):
            continue
        place, square = search_voxels(table, pool, voxel, x, y, z, reach)
        if square > voxel * voxel:  # else the 27 voxels, which reach so far in every direction, have settled it
            place, square = search_blocks(table, pool, edge, x, y, z, place, square)
            if square > edge * edge:
                place, square = search_cells(store, edge, x, y, z, place, square)
        if place != NONE:
            found[n], squares[n] = store.pool_number[place, 3], square
    return found, squares
