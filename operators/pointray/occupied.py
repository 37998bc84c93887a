"""Which voxels around a frame are occupied: those of its points and their 26 neighbours, as bits of blocks.

Blocks of 4 x 4 x 4 voxels as in the map's store, a mask of 64 bits each, in a hash table that stays in the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.store import BLOCK_BITS, FARTHEST, NONE, local_of, voxel_of
from operators.pointmap.voxels import pack, spread, unpack

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Longs = npt.NDArray[np.int64]
Masks = npt.NDArray[np.uint64]

EMPTY = np.uint64(0)
# For each axis: the bits of the first and of the last layer of a block, and the distance of two layers in bits.
FIRST_LAYER = (np.uint64(0x1111111111111111), np.uint64(0x000F000F000F000F), np.uint64(0x000000000000FFFF))
LAST_LAYER = (np.uint64(0x8888888888888888), np.uint64(0xF000F000F000F000), np.uint64(0xFFFF000000000000))
STRIDE = (np.uint64(1), np.uint64(4), np.uint64(16))
THREE = np.uint64(3)


class Blocks(NamedTuple):
    """An open addressing table of blocks."""

    keys: Longs  # (slots,) or -1
    masks: Masks  # (slots,) the taken voxels
    count: Longs  # (1,)


@njit(cache=True)
def empty_blocks(slots: int) -> Blocks:
    """Return a table without blocks. slots: a power of two."""
    return Blocks(np.full(slots, NONE, np.int64), np.empty(slots, np.uint64), np.zeros(1, np.int64))


@njit(cache=True)
def slot_of(keys: Longs, key: int) -> int:
    """Return the slot of a block, or the free slot where it belongs."""
    last = len(keys) - 1
    slot = spread(key, last)
    while keys[slot] != key and keys[slot] != NONE:
        slot = (slot + 1) & last
    return slot


@njit(cache=True)
def take(blocks: Blocks, key: int, mask: int) -> None:
    """Add taken voxels to a block. The table must have room."""
    slot = slot_of(blocks.keys, key)
    if blocks.keys[slot] == NONE:
        blocks.keys[slot] = key
        blocks.masks[slot] = mask
        blocks.count[0] += 1
    else:
        blocks.masks[slot] |= mask


@njit(cache=True)
def roomy(blocks: Blocks, more: int) -> Blocks:
    """Return the table with room for so many more blocks, at most half full."""
    slots = len(blocks.keys)
    if 2 * (blocks.count[0] + more) <= slots:
        return blocks
    while 2 * (blocks.count[0] + more) > slots:
        slots *= 2
    larger = empty_blocks(slots)
    for slot in range(len(blocks.keys)):
        if blocks.keys[slot] != NONE:
            take(larger, blocks.keys[slot], blocks.masks[slot])
    return larger


@njit(cache=True, inline="always")
def neighbours(mask: int, axis: int, side: int) -> int:
    """Return the voxels next to those of a mask along an axis: of the block itself (side 0) or of the block beside it.

    For side 0 the voxels themselves are among them.
    """
    if side < 0:
        return (mask & FIRST_LAYER[axis]) << (THREE * STRIDE[axis])
    if side > 0:
        return (mask & LAST_LAYER[axis]) >> (THREE * STRIDE[axis])
    return mask | ((mask & ~LAST_LAYER[axis]) << STRIDE[axis]) | ((mask & ~FIRST_LAYER[axis]) >> STRIDE[axis])


@njit(cache=True, error_model="numpy")
def blocks_of_points(points: Doubles, size: float) -> Blocks:
    """Return the blocks with the voxels, of `size` metres, that hold the points (n, 3)."""
    blocks = empty_blocks(1 << 14)
    last, mask = np.int64(NONE), EMPTY
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (abs(x) < FARTHEST * size and abs(y) < FARTHEST * size and abs(z) < FARTHEST * size):
            continue
        i, j, k = voxel_of(x, y, z, size)
        key = pack(i >> BLOCK_BITS, j >> BLOCK_BITS, k >> BLOCK_BITS)
        if key != last:  # neighbours in a scan mostly share their block
            if last != NONE:
                take(blocks, last, mask)
                blocks = roomy(blocks, 1)
            last, mask = key, EMPTY
        mask |= np.uint64(1) << np.uint64(local_of(i, j, k))
    if last != NONE:
        take(blocks, last, mask)
    return blocks


@njit(cache=True)
def with_neighbours(blocks: Blocks) -> Blocks:
    """Return the blocks with all voxels that are taken or have a taken one among their 26 neighbours."""
    wide = empty_blocks(4 * len(blocks.keys))
    for slot in range(len(blocks.keys)):
        if blocks.keys[slot] == NONE:
            continue
        wide = roomy(wide, 27)
        i, j, k = unpack(blocks.keys[slot])
        for a in range(-1, 2):
            along_x = neighbours(blocks.masks[slot], 0, a)
            if along_x == EMPTY:
                continue
            for b in range(-1, 2):
                along_y = neighbours(along_x, 1, b)
                if along_y == EMPTY:
                    continue
                for c in range(-1, 2):
                    along_z = neighbours(along_y, 2, c)
                    if along_z != EMPTY:
                        take(wide, pack(i + a, j + b, k + c), along_z)
    return wide
