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
def central_points(x: Floats, y: Floats, z: Floats, size: float) -> npt.NDArray[np.int32]:
    """Return the indices (m,) of the point nearest the centre of each voxel of `size` metres, by first visit.

    Of two points equally near the first stays.
    """
    count = len(x)
    slots = 1 << 12
    while slots < 2 * count:
        slots *= 2
    mask = slots - 1
    keys = np.full(slots, -1, np.int64)
    places = np.empty(slots, np.int32)  # slot to position in `chosen`
    chosen = np.empty(count, np.int32)
    offsets = np.empty(count, np.float64)  # squared, in voxels
    found = 0
    last_key, place = -1, 0
    for i in range(count):
        u, v, w = x[i] / size, y[i] / size, z[i] / size
        fu, fv, fw = math.floor(u), math.floor(v), math.floor(w)
        key = pack(int(fu), int(fv), int(fw))
        du, dv, dw = u - fu - 0.5, v - fv - 0.5, w - fw - 0.5
        offset = du * du + dv * dv + dw * dw
        if key != last_key:  # neighbours in a scan mostly share their voxel
            last_key = key
            slot = spread(key, mask)
            while keys[slot] != key and keys[slot] != -1:
                slot = (slot + 1) & mask
            if keys[slot] == -1:
                keys[slot] = key
                places[slot] = found
                chosen[found] = i
                offsets[found] = offset
                place = found
                found += 1
                continue
            place = places[slot]
        if offset < offsets[place]:
            offsets[place] = offset
            chosen[place] = i
    return chosen[:found].copy()
