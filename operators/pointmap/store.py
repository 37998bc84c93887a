"""The memory of a voxel map: points chained by block of 4 x 4 x 4 voxels, blocks by cell of 8 x 8 x 8 blocks.

A block answers 'is this voxel taken?' with one bit of a 64-bit mask, so that one look-up in a hash table serves 64
voxels; a cell lets a search step over a cubic metre of emptiness at once. All is plain arrays, for numba.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.voxels import pack, spread

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

NONE = -1
BLOCK_BITS, CELL_BITS = 2, 3  # a block has 4 voxels an edge, a cell 8 blocks
BLOCK_VOXELS, CELL_BLOCKS = 1 << BLOCK_BITS, 1 << CELL_BITS
FARTHEST = 1 << 20  # voxel coordinates that fit the packed keys


class Store(NamedTuple):
    """The arrays of a voxel map; capacities are longer than the counts in `counts`."""

    points: Floats  # (capacity, 3) metres
    normals: Floats  # (capacity, 3)
    scores: Floats  # (capacity,) of the normals
    created: Ints  # (capacity,) frame that brought the point, -1 from the initial map
    local: npt.NDArray[np.uint8]  # (capacity,) number of its voxel within the block
    next_point: Ints  # (capacity,) next point of the same block
    block_mask: npt.NDArray[np.uint64]  # (blocks,) taken voxels
    block_head: Ints  # (blocks,) first point
    block_place: Ints  # (blocks, 3) block coordinates
    next_block: Ints  # (blocks,) next block of the same cell
    block_keys: Longs  # open addressing: key, or -1
    block_values: Ints
    cell_head: Ints  # (cells,) first block
    cell_keys: Longs
    cell_values: Ints
    counts: Longs  # (3,) points, blocks, cells


@njit(cache=True)
def find(keys: Longs, values: Ints, key: int) -> int:
    """Return the value of a key, or -1."""
    mask = len(keys) - 1
    slot = spread(key, mask)
    while keys[slot] != key:
        if keys[slot] == NONE:
            return NONE
        slot = (slot + 1) & mask
    return int(values[slot])


@njit(cache=True)
def put(keys: Longs, values: Ints, key: int, value: int) -> None:
    """Enter a key that is not there yet."""
    mask = len(keys) - 1
    slot = spread(key, mask)
    while keys[slot] != NONE:
        slot = (slot + 1) & mask
    keys[slot] = key
    values[slot] = value


@njit(cache=True)
def rehash(keys: Longs, values: Ints, slots: int) -> tuple[Longs, Ints]:
    """Return a larger table (slots: a power of two) with the same entries."""
    new_keys = np.full(slots, NONE, np.int64)
    new_values = np.empty(slots, np.int32)
    for slot in range(len(keys)):
        if keys[slot] != NONE:
            put(new_keys, new_values, keys[slot], values[slot])
    return new_keys, new_values


@njit(cache=True)
def make_block(store: Store, i: int, j: int, k: int) -> int:
    """Open the block at block coordinates (i, j, k), and its cell if that is new. Returns its number."""
    block = store.counts[1]
    store.counts[1] += 1
    put(store.block_keys, store.block_values, pack(i, j, k), block)
    store.block_mask[block] = np.uint64(0)
    store.block_head[block] = NONE
    store.block_place[block, 0], store.block_place[block, 1], store.block_place[block, 2] = i, j, k
    key = pack(i >> CELL_BITS, j >> CELL_BITS, k >> CELL_BITS)
    cell = find(store.cell_keys, store.cell_values, key)
    if cell == NONE:
        cell = store.counts[2]
        store.counts[2] += 1
        put(store.cell_keys, store.cell_values, key, cell)
        store.cell_head[cell] = NONE
    store.next_block[block] = store.cell_head[cell]
    store.cell_head[cell] = block
    return block


@njit(cache=True, error_model="numpy")
def insert(store: Store, points: Floats, normals: Floats, scores: Floats, created: int, size: float) -> int:
    """Add points (n, 3) in world coordinates: the first point of a voxel stays, the best-scored normal replaces.

    size: of a voxel, metres. The store must have room. Returns how many points are new. Points that are not finite or
    too far from the origin are passed over.
    """
    before = store.counts[0]
    for n in range(len(points)):
        u, v, w = points[n, 0] / size, points[n, 1] / size, points[n, 2] / size
        if not (abs(u) < FARTHEST and abs(v) < FARTHEST and abs(w) < FARTHEST):
            continue
        i, j, k = math.floor(u), math.floor(v), math.floor(w)
        bi, bj, bk = i >> BLOCK_BITS, j >> BLOCK_BITS, k >> BLOCK_BITS
        local = (i & 3) | ((j & 3) << 2) | ((k & 3) << 4)
        bit = np.uint64(1) << np.uint64(local)
        block = find(store.block_keys, store.block_values, pack(bi, bj, bk))
        if block == NONE:
            block = make_block(store, bi, bj, bk)
        if store.block_mask[block] & bit:
            point = store.block_head[block]
            while store.local[point] != local:
                point = store.next_point[point]
            if scores[n] > store.scores[point]:
                for axis in range(3):
                    store.normals[point, axis] = normals[n, axis]
                store.scores[point] = scores[n]
            continue
        point = store.counts[0]
        store.counts[0] += 1
        for axis in range(3):
            store.points[point, axis] = points[n, axis]
            store.normals[point, axis] = normals[n, axis]
        store.scores[point] = scores[n]
        store.created[point] = created
        store.local[point] = local
        store.next_point[point] = store.block_head[block]
        store.block_head[block] = point
        store.block_mask[block] |= bit
    return store.counts[0] - before


def grown(array: npt.NDArray[Any], length: int) -> npt.NDArray[Any]:
    """Return the array with at least `length` rows, doubling; old rows are kept."""
    if len(array) >= length:
        return array
    larger = np.empty((max(length, 2 * len(array)), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def empty_store() -> Store:
    """Return a store without points."""
    slots = 1 << 10
    return Store(
        points=np.empty((slots, 3), np.float32),
        normals=np.empty((slots, 3), np.float32),
        scores=np.empty(slots, np.float32),
        created=np.empty(slots, np.int32),
        local=np.empty(slots, np.uint8),
        next_point=np.empty(slots, np.int32),
        block_mask=np.empty(slots, np.uint64),
        block_head=np.empty(slots, np.int32),
        block_place=np.empty((slots, 3), np.int32),
        next_block=np.empty(slots, np.int32),
        block_keys=np.full(slots, NONE, np.int64),
        block_values=np.empty(slots, np.int32),
        cell_head=np.empty(slots, np.int32),
        cell_keys=np.full(slots, NONE, np.int64),
        cell_values=np.empty(slots, np.int32),
        counts=np.zeros(3, np.int64),
    )


def with_room(store: Store, more: int) -> Store:
    """Return the store with room for so many more points, each perhaps in a new block and cell."""
    points, blocks, cells = (int(count) + more for count in store.counts)
    changes: dict[str, Any] = {name: grown(getattr(store, name), points) for name in Store._fields[:6]}
    changes |= {name: grown(getattr(store, name), blocks) for name in Store._fields[6:10]}
    changes["cell_head"] = grown(store.cell_head, cells)
    for kind, wanted in (("block", blocks), ("cell", cells)):
        keys, values = getattr(store, f"{kind}_keys"), getattr(store, f"{kind}_values")
        if 2 * wanted > len(keys):
            slots = 1 << (2 * wanted - 1).bit_length()
            changes[f"{kind}_keys"], changes[f"{kind}_values"] = rehash(keys, values, max(slots, 2 * len(keys)))
    return store._replace(**changes)
