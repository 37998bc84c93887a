"""Which voxels around a frame are occupied: those of its points and their 26 neighbours, as bits of blocks.

Blocks of 4 x 4 x 4 voxels as in the map's store, a mask of 64 bits each, in a hash table that stays in the cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
    used: Longs  # (1,) how many slots


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
def take(blocks: Blocks, key: int, mask: Any) -> None:
    """Add taken voxels to a block. The table must have room."""
    slot = slot_of(blocks.keys, key)
    if blocks.keys[slot] == NONE:
        blocks.keys[slot] = key
        blocks.masks[slot] = mask
        blocks.used[0] += 1
    else:
        blocks.masks[slot] |= mask


@njit(cache=True)
def larger(blocks: Blocks) -> Blocks:
    """Return a table with twice the slots and the same blocks. Not called for every block: handing one back costs."""
    result = empty_blocks(2 * len(blocks.keys))
    for slot in range(len(blocks.keys)):
        if blocks.keys[slot] != NONE:
            take(result, blocks.keys[slot], blocks.masks[slot])
    return result


@njit(cache=True, inline="always")
def neighbours(mask: Any, axis: int, side: int) -> Any:
    """Return the voxels next to those of a mask along an axis: of the block itself (side 0) or of the block beside it.

    For side 0 the voxels themselves are among them.
    """
    if side < 0:
        return (mask & FIRST_LAYER[axis]) << (THREE * STRIDE[axis])
    if side > 0:
        return (mask & LAST_LAYER[axis]) >> (THREE * STRIDE[axis])
    return mask | ((mask & ~LAST_LAYER[axis]) << STRIDE[axis]) | ((mask & ~FIRST_LAYER[axis]) >> STRIDE[axis])


@njit(cache=True, error_model="numpy")
def carried(pose: Doubles, x: Floats, y: Floats, z: Floats) -> Doubles:
    """Return points, given by their coordinates (n,), moved by a pose (4, 4), as (n, 3) in double precision."""
    moved = np.empty((len(x), 3))
    for n in range(len(x)):
        for axis in range(3):
            moved[n, axis] = pose[axis, 0] * x[n] + pose[axis, 1] * y[n] + pose[axis, 2] * z[n] + pose[axis, 3]
    return moved


@njit(cache=True, error_model="numpy")
def blocks_of_points(points: Doubles, size: float) -> Blocks:
    """Return the blocks with the voxels, of `size` metres, that hold the points (n, 3)."""
    blocks = empty_blocks(1 << 14)
    last, mask = np.int64(NONE), EMPTY  # a mask is uint64 throughout: signed bits would spread
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (abs(x) < FARTHEST * size and abs(y) < FARTHEST * size and abs(z) < FARTHEST * size):
            continue
        i, j, k = voxel_of(x, y, z, size)
        key = pack(i >> BLOCK_BITS, j >> BLOCK_BITS, k >> BLOCK_BITS)
        if key != last:  # neighbours in a scan mostly share their block
            if last != NONE:
                if 2 * (blocks.used[0] + 1) > len(blocks.keys):
                    blocks = larger(blocks)
                take(blocks, last, mask)
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
        if 2 * (wide.used[0] + 27) > len(wide.keys):
            wide = larger(wide)
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
