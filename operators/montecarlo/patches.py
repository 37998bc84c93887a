"""Grid maps of many particles in one store of patches: what two maps have in common is there once (copy on write)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]

BITS = 5
SIDE = 1 << BITS  # cells along a patch
FULL = 0.1  # share of hits from which a cell counts as occupied when scans are matched
HITS, X, Y = 0, 1, 2  # of a cell: end points in it, and the sums of their offsets (metres)
NEVER, SELDOM, OFTEN = 0, 1, 2  # how many of the beams that met a cell ended there


class Store(NamedTuple):
    """The arrays of all maps; patch 0 is the empty one, never written."""

    ends: Floats  # (patches, SIDE * SIDE, 3)
    visits: Floats  # (patches, SIDE * SIDE) beams that met the cell; apart, as rays touch little else
    state: npt.NDArray[np.uint8]  # (patches, SIDE * SIDE) NEVER, SELDOM or OFTEN
    users: Ints  # (patches,) maps that show the patch
    free: Ints  # (patches,) stack of unused patches
    top: Ints  # (1,) height of the stack


class Patches:
    """As many maps as particles, (rows, columns) of patches each, growing with what is seen.

    resolution: metres a cell. Cell (0, 0) of the world begins at its origin.
    """

    def __init__(self, maps: int, resolution: float) -> None:
        self.resolution = resolution
        self.corner = np.zeros(2, np.int64)  # column and row, in patches, of directory entry [0, 0]
        self.directory = np.zeros((maps, 0, 0), np.int32)
        self.store = _store(256)

    def cover(self, low: Doubles, high: Doubles) -> None:
        """Let all maps reach from low (2,) to high (2,), metres in the world."""
        size = SIDE * self.resolution
        first = np.floor(np.asarray(low) / size).astype(np.int64)
        last = np.floor(np.asarray(high) / size).astype(np.int64) + 1
        maps, rows, columns = self.directory.shape
        end = self.corner + np.array([columns, rows])
        if rows and (first >= self.corner).all() and (last <= end).all():
            return
        first, last = first - 4, last + 4  # seldom again
        if rows:
            first, last = np.minimum(first, self.corner), np.maximum(last, end)
        larger = np.zeros((maps, int(last[1] - first[1]), int(last[0] - first[0])), np.int32)
        column, row = self.corner - first
        larger[:, row : row + rows, column : column + columns] = self.directory
        self.directory, self.corner = larger, first

    def choose(self, parents: npt.NDArray[np.int64]) -> None:
        """Let each map become that of its parent (n,); nothing is copied but the directory."""
        self.directory = self.directory[parents]
        _count(self.directory, self.store)

    def reserve(self, patches: int) -> None:
        """Have so many unused patches at hand."""
        store = self.store
        missing = patches - int(store.top[0])
        if missing <= 0:
            return
        count = len(store.users)
        larger = _store(count + max(missing, count // 2))
        larger.ends[:count], larger.visits[:count] = store.ends, store.visits
        larger.state[:count], larger.users[:count] = store.state, store.users
        added = np.arange(len(larger.users) - 1, count - 1, -1, dtype=np.int32)
        top = int(store.top[0])
        larger.free[: len(added)] = added
        larger.free[len(added) : len(added) + top] = store.free[:top]
        larger.top[0] = len(added) + top
        self.store = larger

    @property
    def origin(self) -> Doubles:
        """Return the world coordinates (2,) of the maps' corner, metres."""
        return np.asarray(self.corner * (SIDE * self.resolution), np.float64)

    def enter(self, index: int, sensor: Doubles, ends: Doubles, hits: npt.NDArray[np.bool_]) -> None:
        """Enter a scan into a map: beams from sensor (2,) to ends (n, 2) in the world, which hit something or not."""
        if not len(ends):
            return
        both = np.concatenate([ends, sensor[None]])
        low, high = both.min(axis=0), both.max(axis=0)
        self.cover(low, high)
        spread = np.floor((high - low) / (SIDE * self.resolution)) + 2
        self.reserve(int(spread[0] * spread[1]))
        _enter(self.directory[index], self.store, sensor - self.origin, ends - self.origin, hits, self.resolution)

    def dense(self, index: int) -> tuple[Floats, Floats]:
        """Return how many beams ended in each cell of one map and how many met it, each (rows, columns)."""
        _, rows, columns = self.directory.shape
        places = self.directory[index]
        both = []
        for values in (self.store.ends[places, :, HITS], self.store.visits[places]):
            tiles = values.reshape(rows, columns, SIDE, SIDE).transpose(0, 2, 1, 3)
            both.append(np.ascontiguousarray(tiles).reshape(rows * SIDE, columns * SIDE))
        return both[0], both[1]

    def in_use(self) -> int:
        """Return how many patches all maps need together."""
        return len(self.store.users) - 1 - int(self.store.top[0])


def _store(count: int) -> Store:
    store = Store(
        np.zeros((count, SIDE * SIDE, 3), np.float32),
        np.zeros((count, SIDE * SIDE), np.float32),
        np.zeros((count, SIDE * SIDE), np.uint8),
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
        np.array([count - 1], np.int32),
    )
    store.free[: count - 1] = np.arange(count - 1, 0, -1)
    return store


@njit(cache=True)
def _count(directory: Ints, store: Store) -> None:
    """Count who shows which patch, and put on the stack what nobody shows any more."""
    before = store.users.copy()
    store.users[:] = 0
    for index in range(directory.shape[0]):
        for row in range(directory.shape[1]):
            for column in range(directory.shape[2]):
                store.users[directory[index, row, column]] += 1
    for patch in range(1, len(before)):
        if before[patch] > 0 and store.users[patch] == 0:
            store.free[store.top[0]] = patch
            store.top[0] += 1


@njit(cache=True)
def _own(directory: Ints, store: Store, row: int, column: int) -> int:
    """Return the patch that a map may write at a place of its directory (rows, columns): a new one, a copy, its own."""
    patch = directory[row, column]
    if patch != 0 and store.users[patch] == 1:
        return patch
    store.top[0] -= 1
    own = store.free[store.top[0]]
    for place in range(SIDE * SIDE):
        store.state[own, place] = store.state[patch, place]
        store.visits[own, place] = store.visits[patch, place]
        for value in range(3):
            store.ends[own, place, value] = store.ends[patch, place, value]
    if patch != 0:
        store.users[patch] -= 1
    store.users[own] = 1
    directory[row, column] = own
    return own


@njit(cache=True, error_model="numpy")
def _enter(
    directory: Ints, store: Store, sensor: Doubles, ends: Doubles, hits: npt.NDArray[np.bool_], resolution: float
) -> None:
    """Count a visit of each cell along each beam (Bresenham 1965), and the hit at its end."""
    scale, met, visits, state = 1.0 / resolution, store.ends, store.visits, store.state
    x0, y0 = math.floor(sensor[0] * scale), math.floor(sensor[1] * scale)
    for beam in range(len(ends)):
        ex, ey = ends[beam, 0] * scale, ends[beam, 1] * scale
        x1, y1 = math.floor(ex), math.floor(ey)
        dx, dy = abs(x1 - x0), abs(y1 - y0)
        sx = 1 if x0 < x1 else -1
        sy = 1 if y0 < y1 else -1
        error = dx - dy
        x, y = x0, y0
        last_row = last_column = -1
        patch = 0
        for _ in range(max(dx, dy) + 1):
            row, column = y >> BITS, x >> BITS
            if row != last_row or column != last_column:
                patch = _own(directory, store, row, column)
                last_row, last_column = row, column
            place = ((y & (SIDE - 1)) << BITS) | (x & (SIDE - 1))
            visits[patch, place] += np.float32(1.0)
            if x == x1 and y == y1 and hits[beam]:
                met[patch, place, HITS] += np.float32(1.0)
                met[patch, place, X] += np.float32((ex - x1) * resolution)
                met[patch, place, Y] += np.float32((ey - y1) * resolution)
                state[patch, place] = SELDOM
            if state[patch, place] != NEVER:
                often = met[patch, place, HITS] > FULL * visits[patch, place]
                state[patch, place] = OFTEN if often else SELDOM
            twice = 2 * error
            if twice > -dy:
                error -= dy
                x += sx
            if twice < dx:
                error += dx
                y += sy
