"""The memory of a voxel map: voxels in blocks of 4 x 4 x 4, blocks in cells of 8 x 8 x 8.

One look-up in a hash table finds a block and with it 64 voxels: a mask of 64 bits says which are taken, and the points
of a block lie side by side in a pool, in the order of their voxels, so that the mask also says where. A cell has a
bit for each of its blocks, so that a search steps over a cubic metre of emptiness at once. A search waits for memory
and hardly ever computes: so what is read together lies together, in rows.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.prefetch import prefetch
from operators.pointmap.voxels import pack, spread

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

NONE = -1
BLOCK_BITS, CELL_BITS = 2, 3  # a block has 4 voxels an edge, a cell 8 blocks
BLOCK_VOXELS, CELL_BLOCKS = 1 << BLOCK_BITS, 1 << CELL_BITS
FETCHED = 512  # points whose rows are brought into the cache together: 100 KB
LEAST_ROOM = 8  # points for which a new block has room in the pool
FARTHEST = 1 << 20  # voxel coordinates that fit the packed keys

KEY, START, SIZE, MASK = 0, 1, 2, 3  # columns of the table of blocks: START, SIZE of the points in the pool
LAYER = 1  # first of 8 columns of the table of cells: the taken blocks of one layer, 8 x 8 bits
NORMAL, SCORE = 3, 6  # first columns of `rows` after the coordinates


class Store(NamedTuple):
    """The arrays of a voxel map; all are longer than what is in them, which `counts` tells."""

    rows: Floats  # (points, 8) x y z, nx ny nz, score of the normal, unused
    created: Ints  # (points,) frame that brought the point, -1 from the initial map
    pool: Floats  # (places, 4) x y z once more, block by block, voxel by voxel
    pool_number: Ints  # (places, 4) the same memory as `pool`; column 3 is the number of the point
    table: Longs  # (slots, 4) open addressing: KEY of a block or -1, START, SIZE, MASK of the taken voxels
    cells: Longs  # (slots, 9) open addressing: KEY of a cell or -1, LAYER from below
    counts: Longs  # (4,) points, places, blocks, cells


@njit(cache=True)
def find(table: Longs, key: int) -> int:
    """Return the slot of a key in an open addressing table (slots, k), or the free slot where it belongs."""
    mask = len(table) - 1
    slot = spread(key, mask)
    while table[slot, KEY] != key and table[slot, KEY] != NONE:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True)
def rehash(table: Longs, slots: int) -> Longs:
    """Return a larger table (slots: a power of two) with the same entries."""
    larger = np.full((slots, table.shape[1]), NONE, np.int64)
    for old in range(len(table)):
        if table[old, KEY] != NONE:
            new = find(larger, table[old, KEY])
            for column in range(table.shape[1]):
                larger[new, column] = table[old, column]
    return larger


@njit(cache=True)
def open_block(store: Store, slot: int, i: int, j: int, k: int) -> None:
    """Open the block at block coordinates (i, j, k) in its free slot, and its cell if that is new."""
    store.counts[2] += 1
    store.table[slot, KEY] = pack(i, j, k)
    store.table[slot, START] = 0
    store.table[slot, SIZE] = 0
    store.table[slot, MASK] = 0
    key = pack(i >> CELL_BITS, j >> CELL_BITS, k >> CELL_BITS)
    cell = find(store.cells, key)
    if store.cells[cell, KEY] == NONE:
        store.counts[3] += 1
        store.cells[cell, KEY] = key
        for layer in range(CELL_BLOCKS):
            store.cells[cell, LAYER + layer] = 0
    store.cells[cell, LAYER + (k & 7)] |= 1 << ((i & 7) | ((j & 7) << 3))


@njit(cache=True)
def make_room(store: Store, slot: int) -> None:
    """Give a block that is full twice its room, at the end of the pool: for 8, 16, 32, 64 points."""
    size = store.table[slot, SIZE]
    if size != 0 and (size < LEAST_ROOM or size & (size - 1) != 0):
        return
    old, new = store.table[slot, START], store.counts[1]
    store.counts[1] += max(LEAST_ROOM, 2 * size)
    store.table[slot, START] = new
    for n in range(size):
        for column in range(4):  # as integers: a number may look like a NaN that a register would change
            store.pool_number[new + n, column] = store.pool_number[old + n, column]


@njit(cache=True)
def voxel_of(x: float, y: float, z: float, size: float) -> tuple[int, int, int]:
    """Return the coordinates of the voxel of `size` metres that holds a point."""
    return math.floor(x / size), math.floor(y / size), math.floor(z / size)


@njit(cache=True)
def ones_below(mask: int, local: int) -> int:
    """Count the bits set below bit `local` of a mask of 64; compiles to one instruction."""
    bits = np.uint64(mask) & ((np.uint64(1) << np.uint64(local)) - np.uint64(1))
    bits = bits - ((bits >> np.uint64(1)) & np.uint64(0x5555555555555555))
    bits = (bits & np.uint64(0x3333333333333333)) + ((bits >> np.uint64(2)) & np.uint64(0x3333333333333333))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((bits * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)
def local_of(i: int, j: int, k: int) -> int:
    """Return the number of voxel (i, j, k) within its block."""
    return (i & 3) | ((j & 3) << 2) | ((k & 3) << 4)


@njit(cache=True)
def place_in(store: Store, slot: int, place: int, x: float, y: float, z: float, point: int) -> None:
    """Put a point into the pool of a block at a place; what is there and behind moves up by one."""
    last = store.table[slot, START] + store.table[slot, SIZE]
    for n in range(last, place, -1):
        for column in range(4):
            store.pool_number[n, column] = store.pool_number[n - 1, column]
    store.pool[place, 0], store.pool[place, 1], store.pool[place, 2] = x, y, z
    store.pool_number[place, 3] = point
    store.table[slot, SIZE] += 1


@njit(cache=True, error_model="numpy")
def fetch_rows(store: Store, points: Floats, size: float) -> None:
    """Bring what `insert` will read for the points (n, 3) into the cache; size: of a voxel, metres."""
    table, mask = store.table, len(store.table) - 1
    keys, locals_ = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    count = 0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (abs(x) < FARTHEST * size and abs(y) < FARTHEST * size and abs(z) < FARTHEST * size):
            continue
        i, j, k = voxel_of(x, y, z, size)
        keys[count] = pack(i >> BLOCK_BITS, j >> BLOCK_BITS, k >> BLOCK_BITS)
        locals_[count] = local_of(i, j, k)
        prefetch(table, spread(keys[count], mask))
        count += 1
    for n in range(count):  # from now on the places in the pool
        slot = find(table, keys[n])
        taken = table[slot, KEY] != NONE and (table[slot, MASK] >> locals_[n]) & 1
        keys[n] = table[slot, START] + ones_below(table[slot, MASK], locals_[n]) if taken else NONE
        prefetch(store.pool, keys[n])
    for n in range(count):
        if keys[n] != NONE:
            prefetch(store.rows, store.pool_number[keys[n], 3])


@njit(cache=True, error_model="numpy")
def insert(store: Store, points: Floats, normals: Floats, scores: Floats, created: int, size: float) -> int:
    """Add points (n, 3) in world coordinates: the first point of a voxel stays, the best-scored normal replaces.

    size: of a voxel, metres. The store must have room. Returns how many points are new. Points that are not finite or
    too far from the origin are passed over.
    """
    before = store.counts[0]
    for n in range(len(points)):
        if n % FETCHED == 0:
            fetch_rows(store, points[n : n + FETCHED], size)
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (abs(x) < FARTHEST * size and abs(y) < FARTHEST * size and abs(z) < FARTHEST * size):
            continue
        i, j, k = voxel_of(x, y, z, size)
        a, b, c = i >> BLOCK_BITS, j >> BLOCK_BITS, k >> BLOCK_BITS
        slot = find(store.table, pack(a, b, c))
        if store.table[slot, KEY] == NONE:
            open_block(store, slot, a, b, c)
        local = local_of(i, j, k)
        taken = (store.table[slot, MASK] >> local) & 1
        if not taken:
            make_room(store, slot)
        place = store.table[slot, START] + ones_below(store.table[slot, MASK], local)
        if taken:
            point = int(store.pool_number[place, 3])
            if not scores[n] > store.rows[point, SCORE]:
                continue
        else:
            point = int(store.counts[0])
            store.counts[0] += 1
            place_in(store, slot, place, x, y, z, point)
            store.table[slot, MASK] |= 1 << local
            store.rows[point, 0], store.rows[point, 1], store.rows[point, 2] = x, y, z
            store.created[point] = created
        for axis in range(3):
            store.rows[point, NORMAL + axis] = normals[n, axis]
        store.rows[point, SCORE] = scores[n]
    return store.counts[0] - before


def empty_store() -> Store:
    """Return a store without points."""
    pool = np.empty((1024, 4), np.float32)
    return Store(
        rows=np.empty((1024, 8), np.float32),
        created=np.empty(1024, np.int32),
        pool=pool,
        pool_number=pool.view(np.int32),
        table=np.full((1024, 4), NONE, np.int64),
        cells=np.full((1024, 1 + CELL_BLOCKS), NONE, np.int64),
        counts=np.zeros(4, np.int64),
    )


def grown(array: npt.NDArray[Any], length: int) -> npt.NDArray[Any]:
    """Return the array with at least `length` rows, doubling; old rows are kept."""
    if len(array) >= length:
        return array
    larger = np.zeros((max(length, 2 * len(array)), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def roomier(table: Longs, entries: int) -> Longs:
    """Return an open addressing table that so many entries fill by half at most."""
    return table if 2 * entries <= len(table) else rehash(table, 1 << (2 * entries - 1).bit_length())


def with_room(store: Store, more: int) -> Store:
    """Return the store with room for so many more points, wherever they fall."""
    points, places, blocks, cells = (int(count) + more for count in store.counts)
    # One point may open a block (8 places); to move a block of 8, 16 or 32 it takes as many points as it had.
    pool = grown(store.pool, places + (LEAST_ROOM - 1) * more)
    return Store(
        rows=grown(store.rows, points),
        created=grown(store.created, points),
        pool=pool,
        pool_number=pool.view(np.int32),
        table=roomier(store.table, blocks),
        cells=roomier(store.cells, cells),
        counts=store.counts,
    )
