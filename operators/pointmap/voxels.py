"""Voxel subsampling of a frame: in each voxel the real point nearest its centre."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float32]

OFFSET = 1 << 20  # voxel coordinates are packed into three fields of 21 bits


@njit(cache=True)
def pack(i: int, j: int, k: int) -> int:
    """Pack voxel coordinates, each in [-2^20, 2^20), into one key of 63 bits."""
    return ((i + OFFSET) << 42) | ((j + OFFSET) << 21) | (k + OFFSET)


@njit(cache=True)
def unpack(key: int) -> tuple[int, int, int]:
    """Return the voxel coordinates of a key."""
    field = (1 << 21) - 1
    return (key >> 42) - OFFSET, ((key >> 21) & field) - OFFSET, (key & field) - OFFSET


@njit(cache=True)
def spread(key: int, mask: int) -> int:
    """Return the home slot of a key in an open addressing table of mask + 1 (a power of two) slots."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)  # Fibonacci hashing: the high bits are the good ones
    return int(mixed >> np.uint64(32)) & mask


@njit(cache=True, error_model="numpy")
def voxel_keys(x: Floats, y: Floats, z: Floats, size: float, keys: npt.NDArray[np.int64], offsets: Floats) -> None:
    """Write the key of each point's voxel, and its squared distance in voxels from the centre, both (n,)."""
    per = 1.0 / size
    for i in range(len(x)):
        u, v, w = x[i] * per, y[i] * per, z[i] * per
        fu, fv, fw = math.floor(u), math.floor(v), math.floor(w)
        keys[i] = pack(int(fu), int(fv), int(fw))
        du, dv, dw = u - fu - 0.5, v - fv - 0.5, w - fw - 0.5
        offsets[i] = du * du + dv * dv + dw * dw


@njit(cache=True, error_model="numpy")
def first_visits(keys: npt.NDArray[np.int64], offsets: Floats) -> npt.NDArray[np.int32]:
    """Return, for each different key by first visit, the index of its smallest offset; of two equal ones the first."""
    table = np.full(1 << 12, -1, np.int32)  # slot to position in `chosen`; small tables stay in the cache
    mask = len(table) - 1
    chosen = np.empty(len(keys), np.int32)
    found, place = 0, 0
    last_key = np.int64(-1)
    for i in range(len(keys)):
        key = keys[i]
        if key != last_key:  # neighbours in a scan mostly share their voxel
            last_key = key
            slot = spread(key, mask)
            while table[slot] != -1 and keys[chosen[table[slot]]] != key:
                slot = (slot + 1) & mask
            if table[slot] == -1:
                place = found
                table[slot] = place
                chosen[place] = i
                found += 1
                if 2 * found > mask:
                    table = np.full(4 * len(table), -1, np.int32)
                    mask = len(table) - 1
                    for old in range(found):
                        slot = spread(keys[chosen[old]], mask)
                        while table[slot] != -1:
                            slot = (slot + 1) & mask
                        table[slot] = old
                continue
            place = table[slot]
        if offsets[i] < offsets[chosen[place]]:
            chosen[place] = i
    return chosen[:found].copy()


def central_points(x: Floats, y: Floats, z: Floats, size: float) -> npt.NDArray[np.int32]:
    """Return the indices (m,) of the point nearest the centre of each voxel of `size` metres, by first visit.

    Of two points equally near the first stays.
    """
    keys, offsets = np.empty(len(x), np.int64), np.empty(len(x), np.float32)
    voxel_keys(x, y, z, size, keys, offsets)
    return first_visits(keys, offsets)
