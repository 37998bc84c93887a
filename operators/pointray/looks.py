"""What one frame says about the points of a map: there, or seen through."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.angles import arctangent, fill_spherical
from operators.pointmap.store import (
    BLOCK_BITS,
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
    voxel_of,
)
from operators.pointmap.voxels import pack, spread, unpack
from operators.pointray.frustums import TILES, Frustums

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Longs = npt.NDArray[np.int64]
Counts = npt.NDArray[np.int32]  # (n, 4): LOOKS, FREE, STAMP of the last frame that looked, unused

LOOKS, FREE, STAMP = 0, 1, 2
LEAST_RANGE = 0.06  # metres; nearer there is only the robot
GRAZING_COSINE = math.cos(5.0 * math.pi / 12.0)  # a surface says nothing beyond 75 degrees of incidence


def masks_along(stride: int) -> Longs:
    """Return, for each set of 4 places along an axis (16,), the voxels of a block there: a mask of 64 bits."""
    places = np.arange(64) // stride % 4
    bits = [sum(1 << int(local) for local in np.flatnonzero((chosen >> places) & 1)) for chosen in range(16)]
    return np.array(bits, np.uint64).view(np.int64)


ALONG_X, ALONG_Y, ALONG_Z = masks_along(1), masks_along(4), masks_along(16)


@njit(cache=True, error_model="numpy")
def distinct_voxels(points: Doubles, size: float) -> Longs:
    """Return the keys of the voxels of `size` metres that hold points (n, 3), each once, by first visit."""
    slots = 1 << 12
    while slots < 2 * len(points):
        slots *= 2
    table = np.full(slots, NONE, np.int64)
    found = np.empty(len(points), np.int64)
    count, last = 0, NONE
    for n in range(len(points)):
        i, j, k = voxel_of(points[n, 0], points[n, 1], points[n, 2], size)
        key = pack(i, j, k)
        if key == last:
            continue
        last = key
        slot = spread(key, slots - 1)
        while table[slot] != key and table[slot] != NONE:
            slot = (slot + 1) & (slots - 1)
        if table[slot] == NONE:
            table[slot] = key
            found[count] = key
            count += 1
    return found[:count]


@njit(cache=True)
def window(local: int, side: int) -> int:
    """Return which voxels (4 bits) of the block `side` steps on are at most one from voxel `local` along an axis."""
    if side == 0:
        return ((7 << local) >> 1) & 15
    return (8 if local == 0 else 0) if side < 0 else (1 if local == 3 else 0)


@njit(cache=True)
def touch_blocks(store: Store, voxels: Longs, touched: Longs) -> Longs:
    """Set the bits of all map voxels that hold or neighbour one of the given voxels (keys, each once).

    touched: (slots of the store's table,) zeros; gets the bits of each block. Returns the slots of blocks with bits.
    """
    table = store.table
    slots = np.empty(8 * len(voxels), np.int64)
    count = 0
    for n in range(len(voxels)):
        i, j, k = unpack(voxels[n])
        for a in range(-1, 2):
            wi = window(i & 3, a)
            if wi == 0:
                continue
            for b in range(-1, 2):
                wj = window(j & 3, b)
                if wj == 0:
                    continue
                for c in range(-1, 2):
                    wk = window(k & 3, c)
                    if wk == 0:
                        continue
                    slot = find(table, pack((i >> BLOCK_BITS) + a, (j >> BLOCK_BITS) + b, (k >> BLOCK_BITS) + c))
                    if table[slot, KEY] == NONE:
                        continue
                    bits = ALONG_X[wi] & ALONG_Y[wj] & ALONG_Z[wk] & table[slot, MASK]
                    if bits != 0 and touched[slot] == 0:
                        slots[count] = slot
                        count += 1
                    touched[slot] |= bits
    return slots[:count]


@njit(cache=True)
def see_occupied(store: Store, counts: Counts, voxels: Longs, touched: Longs, frame: int) -> None:
    """Look once at every map point in the given voxels (keys, each once) or in one of their 26 neighbours: it is there.

    touched: (slots of the store's table,) zeros; left as zeros.
    """
    for slot in touch_blocks(store, voxels, touched):
        bits, place = touched[slot], store.table[slot, START]
        touched[slot] = 0
        for local in range(BLOCK_VOXELS**3):
            if (store.table[slot, MASK] >> local) & 1 == 0:
                continue
            if (bits >> local) & 1:
                point = store.pool_number[place, 3]
                counts[point, STAMP] = frame
                counts[point, LOOKS] += 1
            place += 1


@njit(cache=True, error_model="numpy")
def hidden(frustums: Frustums, x: float, y: float, z: float, radius: float) -> bool:
    """Say whether a ball around (x, y, z), in the sensor's frame, lies behind everything that was measured."""
    level = math.sqrt(x * x + y * y)
    distance = math.sqrt(level * level + z * z)
    if distance <= radius:
        return False
    lowest, highest = frustums.lowest, frustums.lowest + frustums.free.shape[0] * frustums.height
    tilt, spread_of_tilt = arctangent(z, level), math.asin(radius / distance)
    if tilt + spread_of_tilt < lowest or tilt - spread_of_tilt > highest:
        return True
    half = math.pi if level <= radius else math.asin(radius / level)
    tile = 2.0 * math.pi / TILES
    first = math.floor((arctangent(y, x) + math.pi - half) / tile)
    last = math.floor((arctangent(y, x) + math.pi + half) / tile)
    for n in range(first, min(last, first + TILES - 1) + 1):
        if frustums.farthest[n % TILES] > distance - radius:
            return False
    return True


@njit(cache=True, error_model="numpy")
def gather_cell(
    store: Store, cell: int, lidar_from_world: Doubles, x: Floats, y: Floats, z: Floats, places: Longs
) -> int:
    """Write the points of a cell (its slot) in the sensor's frame, and their places in the pool. Returns how many."""
    m, pool = lidar_from_world, store.pool
    i, j, k = unpack(store.cells[cell, KEY])
    count = 0
    for block in range(CELL_BLOCKS**3):
        if (store.cells[cell, LAYER + (block >> 6)] >> (block & 63)) & 1 == 0:
            continue
        a, b, c = block & 7, (block >> 3) & 7, block >> 6
        slot = find(store.table, pack((i << CELL_BITS) + a, (j << CELL_BITS) + b, (k << CELL_BITS) + c))
        start = store.table[slot, START]
        for n in range(store.table[slot, SIZE]):
            px, py, pz = float(pool[start + n, 0]), float(pool[start + n, 1]), float(pool[start + n, 2])
            x[count + n] = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y[count + n] = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            z[count + n] = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            places[count + n] = start + n
        count += store.table[slot, SIZE]
    return count


@njit(cache=True, error_model="numpy")
def see_through(
    store: Store,
    counts: Counts,
    frustums: Frustums,
    lidar_from_world: Doubles,
    box: Doubles,
    voxel: float,
    level: float,
    frame: int,
) -> int:
    """Look at every map point in front of what was measured in its direction: it is not there (paper eq. 2).

    box: (2, 3) low and high corner of the frame in the world. voxel: of the map, metres. level: a normal with |z| above
    it counts at any incidence. A point that this frame has found occupied stays so. Cells of 32 voxels that lie outside
    the box or behind everything are passed over. Returns how many points were tried.
    """
    m, pool, rows, cells = lidar_from_world, store.pool, store.rows, store.cells
    free, lowest = frustums.free, frustums.lowest
    per_row, per_column = 1.0 / frustums.height, 1.0 / frustums.width
    edge = CELL_BLOCKS * BLOCK_VOXELS * voxel
    most = (CELL_BLOCKS * BLOCK_VOXELS) ** 3
    x, y, z = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.float32)
    rho, theta, phi = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.float32)
    places = np.empty(most, np.int64)
    tried = 0
    for cell in range(len(cells)):
        if cells[cell, KEY] == NONE:
            continue
        i, j, k = unpack(cells[cell, KEY])
        outside = i * edge > box[1, 0] or j * edge > box[1, 1] or k * edge > box[1, 2]
        if outside or (i + 1) * edge < box[0, 0] or (j + 1) * edge < box[0, 1] or (k + 1) * edge < box[0, 2]:
            continue
        px, py, pz = (i + 0.5) * edge, (j + 0.5) * edge, (k + 0.5) * edge
        cx = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        cy = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        cz = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        if hidden(frustums, cx, cy, cz, 0.5 * math.sqrt(3.0) * edge):
            continue
        count = gather_cell(store, cell, m, x, y, z, places)
        fill_spherical(x[:count], y[:count], z[:count], rho, theta, phi)
        tried += count
        for n in range(count):
            row = math.floor((theta[n] - lowest) * per_row)
            column = min(free.shape[1] - 1, max(0, math.floor((phi[n] + math.pi) * per_column)))
            if row < 0 or row >= free.shape[0] or not LEAST_RANGE < rho[n] < free[row, column]:
                continue
            point = store.pool_number[places[n], 3]
            if counts[point, STAMP] == frame:
                continue
            px, py, pz = pool[places[n], 0], pool[places[n], 1], pool[places[n], 2]
            if px < box[0, 0] or py < box[0, 1] or pz < box[0, 2] or px > box[1, 0] or py > box[1, 1] or pz > box[1, 2]:
                continue
            nx, ny, nz = rows[point, NORMAL], rows[point, NORMAL + 1], rows[point, NORMAL + 2]
            along = x[n] * (m[0, 0] * nx + m[0, 1] * ny + m[0, 2] * nz)
            along += y[n] * (m[1, 0] * nx + m[1, 1] * ny + m[1, 2] * nz)
            along += z[n] * (m[2, 0] * nx + m[2, 1] * ny + m[2, 2] * nz)
            if abs(nz) > level or abs(along) > GRAZING_COSINE * rho[n]:
                counts[point, LOOKS] += 1
                counts[point, FREE] += 1
    return tried
