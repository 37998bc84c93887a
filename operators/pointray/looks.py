"""What one frame says about the points of a map: there, or seen through."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.angles import fill_spherical
from operators.pointmap.prefetch import prefetch
from operators.pointmap.store import (
    BLOCK_VOXELS,
    CELL_BITS,
    CELL_BLOCKS,
    KEY,
    LAYER,
    MASK,
    NONE,
    NORMAL,
    SIZE,
    START,
    Store,
    find,
    ones_below,
)
from operators.pointmap.voxels import pack, spread, unpack
from operators.pointray.frustums import Frustums, behind, hidden
from operators.pointray.occupied import EMPTY, Blocks, slot_of

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Longs = npt.NDArray[np.int64]
Masks = npt.NDArray[np.uint64]
Counts = npt.NDArray[np.int32]  # (n, 2): LOOKS, FREE

LOOKS, FREE = 0, 1
LEAST_RANGE = 0.06  # metres; nearer there is only the robot
GRAZING_COSINE = math.cos(5.0 * math.pi / 12.0)  # a surface says nothing beyond 75 degrees of incidence
BESIDE = 4.0  # voxels; more than from a point to the far corner of a voxel next to its own
MOST_BLOCKS = CELL_BLOCKS**3
MOST_POINTS = MOST_BLOCKS * BLOCK_VOXELS**3


@njit(cache=True, error_model="numpy")
def cells_within(store: Store, low: Doubles, high: Doubles, edge: float) -> Longs:
    """Return the slots of the cells (of `edge` metres) that reach into the box from low (3,) to high (3,), metres.

    Looks up every place in the box, or reads the whole table where that is less.
    """
    i0, j0, k0 = math.floor(low[0] / edge), math.floor(low[1] / edge), math.floor(low[2] / edge)
    i1, j1, k1 = math.floor(high[0] / edge), math.floor(high[1] / edge), math.floor(high[2] / edge)
    cells = store.cells
    found = np.empty(store.counts[3], np.int64)
    count = 0
    if float(i1 - i0 + 1) * float(j1 - j0 + 1) * float(k1 - k0 + 1) > len(cells):
        for cell in range(len(cells)):
            if cells[cell, KEY] == NONE:
                continue
            i, j, k = unpack(cells[cell, KEY])
            if i0 <= i <= i1 and j0 <= j <= j1 and k0 <= k <= k1:
                found[count] = cell
                count += 1
        return found[:count]
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                cell = find(cells, pack(i, j, k))
                if cells[cell, KEY] != NONE:
                    found[count] = cell
                    count += 1
    return found[:count]


@njit(cache=True)
def ones(mask: int) -> int:
    """Count the bits of a mask of 64 (not all of them set)."""
    return ones_below(np.int64(mask), 63) + np.int64(mask >> np.uint64(63))


@njit(cache=True, error_model="numpy")
def list_blocks(
    cells: Longs,
    cell: int,
    edge: float,
    lidar_from_world: Doubles,
    occupied: Blocks,
    keys: Longs,
    x: Floats,
    y: Floats,
    z: Floats,
) -> int:
    """Write the keys of the blocks (of `edge` metres) of a cell and their centres in the sensor's frame; how many."""
    last = len(occupied.keys) - 1
    m = lidar_from_world
    i, j, k = unpack(cells[cell, KEY])
    count = 0
    for c in range(CELL_BLOCKS):
        layer = np.uint64(cells[cell, LAYER + c])
        while layer != EMPTY:
            low = layer & (~layer + np.uint64(1))
            layer ^= low
            local = ones(low - np.uint64(1))
            a, b = (i << CELL_BITS) + (local & 7), (j << CELL_BITS) + (local >> 3)
            px, py, pz = (a + 0.5) * edge, (b + 0.5) * edge, ((k << CELL_BITS) + c + 0.5) * edge
            keys[count] = pack(a, b, (k << CELL_BITS) + c)
            prefetch(occupied.keys, spread(keys[count], last))
            x[count] = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y[count] = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            z[count] = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def select_blocks(
    blocks: int,
    keys: Longs,
    x: Floats,
    y: Floats,
    rho: Floats,
    theta: Floats,
    phi: Floats,
    radius: float,
    occupied: Blocks,
    frustums: Frustums,
    taken: Masks,
    table: Longs,
) -> int:
    """Keep the first of `keys` that this frame says something about, with their occupied voxels in `taken`; how many.

    taken: (MOST_BLOCKS,) gets all bits for a block that lies behind what was measured and has occupied voxels, in two
    entries: see `see_cell`.
    """
    count = 0
    for n in range(blocks):
        slot = slot_of(occupied.keys, keys[n])
        mask = occupied.masks[slot] if occupied.keys[slot] != NONE else EMPTY
        level = math.sqrt(x[n] * x[n] + y[n] * y[n])
        back = behind(frustums, rho[n], theta[n], phi[n], level, radius)
        if back and mask == EMPTY:
            continue
        prefetch(table, spread(keys[n], len(table) - 1))
        keys[count], taken[2 * count], taken[2 * count + 1] = keys[n], mask, (~EMPTY if back else mask)
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def see_occupied(
    store: Store,
    counts: Counts,
    blocks: int,
    keys: Longs,
    taken: Masks,
    lidar_from_world: Doubles,
    x: Floats,
    y: Floats,
    z: Floats,
    places: Longs,
) -> int:
    """Look once at the occupied points of a cell's blocks; collect the others that may be seen through. How many.

    Of the collected points x, y, z are in the sensor's frame, places in the pool.
    """
    m, table, pool = lidar_from_world, store.table, store.pool
    for n in range(blocks):
        keys[n] = find(table, keys[n])
        prefetch(pool, table[keys[n], START])
        prefetch(pool, table[keys[n], START] + 4)
    count = 0
    for n in range(blocks):
        slot = keys[n]
        start, mask = table[slot, START], np.uint64(table[slot, MASK])
        bits = mask & taken[2 * n]
        while bits != EMPTY:
            low = bits & (~bits + np.uint64(1))
            bits ^= low
            counts[store.pool_number[start + ones(mask & (low - np.uint64(1))), 3], LOOKS] += 1
        others = mask & ~taken[2 * n + 1]
        if others == EMPTY:
            continue
        local = mask
        for place in range(start, start + table[slot, SIZE]):
            low = local & (~local + np.uint64(1))
            local ^= low
            px, py, pz = float(pool[place, 0]), float(pool[place, 1]), float(pool[place, 2])
            x[count] = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y[count] = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            z[count] = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            places[count] = place
            count += 1 if others & low else 0  # else the next one is written over it
    return count


@njit(cache=True, error_model="numpy")
def see_through(
    store: Store,
    counts: Counts,
    frustums: Frustums,
    lidar_from_world: Doubles,
    box: Doubles,
    level: float,
    count: int,
    x: Floats,
    y: Floats,
    z: Floats,
    rho: Floats,
    theta: Floats,
    phi: Floats,
    places: Longs,
) -> None:
    """Look at the first `count` points that lie in front of what was measured in their direction: not there (eq. 2).

    x y z, rho, theta, phi: of the points in the sensor's frame. box: (2, 3) corners of the frame in the world.
    """
    m, pool, rows, free = lidar_from_world, store.pool, store.rows, frustums.free
    per_row, per_column = 1.0 / frustums.height, 1.0 / frustums.width
    for n in range(count):
        row = math.floor((theta[n] - frustums.lowest) * per_row)
        column = min(free.shape[1] - 1, max(0, math.floor((phi[n] + math.pi) * per_column)))
        if row < 0 or row >= free.shape[0] or not LEAST_RANGE < rho[n] < free[row, column]:
            continue
        px, py, pz = pool[places[n], 0], pool[places[n], 1], pool[places[n], 2]
        if px < box[0, 0] or py < box[0, 1] or pz < box[0, 2] or px > box[1, 0] or py > box[1, 1] or pz > box[1, 2]:
            continue
        point = store.pool_number[places[n], 3]
        nx, ny, nz = rows[point, NORMAL], rows[point, NORMAL + 1], rows[point, NORMAL + 2]
        along = x[n] * (m[0, 0] * nx + m[0, 1] * ny + m[0, 2] * nz)
        along += y[n] * (m[1, 0] * nx + m[1, 1] * ny + m[1, 2] * nz)
        along += z[n] * (m[2, 0] * nx + m[2, 1] * ny + m[2, 2] * nz)
        if abs(nz) > level or abs(along) > GRAZING_COSINE * rho[n]:
            counts[point, LOOKS] += 1
            counts[point, FREE] += 1


@njit(cache=True, error_model="numpy")
def look(
    store: Store,
    counts: Counts,
    frustums: Frustums,
    occupied: Blocks,
    lidar_from_world: Doubles,
    box: Doubles,
    voxel: float,
    level: float,
) -> int:
    """Enter one frame into the counts (n, 2) of all points of a map within its reach. Returns how many were tried.

    occupied: the voxels (of `voxel` metres, as those of the map) of the frame and their neighbours; the points in them
    are there. box: (2, 3) low and high corner of the frame in the world. level: a normal with |z| above it counts at
    any incidence. Cells, and in them blocks, that lie outside the box or behind everything are passed over.
    """
    m = lidar_from_world
    edge, block = CELL_BLOCKS * BLOCK_VOXELS * voxel, BLOCK_VOXELS * voxel
    margin = BESIDE * voxel
    keys, taken = np.empty(MOST_BLOCKS, np.int64), np.empty(2 * MOST_BLOCKS, np.uint64)
    places = np.empty(MOST_POINTS + 1, np.int64)
    x, y, z = (
        np.empty(MOST_POINTS + 1, np.float32),
        np.empty(MOST_POINTS + 1, np.float32),
        np.empty(MOST_POINTS + 1, np.float32),
    )
    rho, theta, phi = (
        np.empty(MOST_POINTS + 1, np.float32),
        np.empty(MOST_POINTS + 1, np.float32),
        np.empty(MOST_POINTS + 1, np.float32),
    )
    tried = 0
    for cell in cells_within(store, box[0] - margin, box[1] + margin, edge):
        i, j, k = unpack(store.cells[cell, KEY])
        px, py, pz = (i + 0.5) * edge, (j + 0.5) * edge, (k + 0.5) * edge
        cx = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        cy = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        cz = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        if hidden(frustums, cx, cy, cz, 0.5 * math.sqrt(3.0) * edge + margin):
            continue
        blocks = list_blocks(store.cells, cell, block, m, occupied, keys, x, y, z)
        fill_spherical(x[:blocks], y[:blocks], z[:blocks], rho, theta, phi)
        radius = 0.5 * math.sqrt(3.0) * block
        blocks = select_blocks(blocks, keys, x, y, rho, theta, phi, radius, occupied, frustums, taken, store.table)
        count = see_occupied(store, counts, blocks, keys, taken, m, x, y, z, places)
        fill_spherical(x[:count], y[:count], z[:count], rho, theta, phi)
        see_through(store, counts, frustums, m, box, level, count, x, y, z, rho, theta, phi, places)
        tried += count
    return tried
