"""Grid maps of many particles in one store of patches: what two maps have in common is there once (copy on write)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int32]

BITS = 5
SIDE = 1 << BITS  # cells along a patch
FULL = 0.1  # share of hits from which a cell counts as occupied when scans are matched
HITS, X, Y = 0, 1, 2  # of a cell: end points in it, and the means of their offsets (metres)
LAST = SIDE - 1
WHOLE = slice(None)


class Store(NamedTuple):
    """The arrays of all maps; patch 0 is the empty one, never written."""

    ends: Floats  # (patches, SIDE * SIDE, 3)
    visits: npt.NDArray[np.uint32]  # (patches, SIDE * SIDE) twice the beams that met a cell, odd once one ended there
    often: npt.NDArray[np.uint32]  # (patches, SIDE) a bit for each cell of a row that counts as occupied
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
        larger.often[:count], larger.users[:count] = store.often, store.users
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

    def enter(self, index: int, sensor: Doubles, ends: Doubles, hits: Flags) -> None:
        """Enter a scan into a map: beams from sensor (2,) to ends (n, 2) in the world, which hit something or not."""
        if len(ends):
            self.reserve(self._room(*np.concatenate([ends, sensor[None]]).T))
            _enter(self.directory[index], self.store, sensor - self.origin, ends - self.origin, hits, self.resolution)

    def enter_each(self, poses: Doubles, sensor: Doubles, ends: Doubles, hits: Flags) -> None:
        """Enter a scan into each map at its own pose (maps, 3); sensor (2,) and ends (n, 2) are in the base frame."""
        if not len(ends):
            return
        x, y = np.concatenate([ends, sensor[None]]).T
        cosine, sine = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        wanted = self._room(poses[:, :1] + cosine * x - sine * y, poses[:, 1:2] + sine * x + cosine * y)
        local, size = poses - np.append(self.origin, 0.0), self.resolution
        entered = 0
        while entered < len(poses):
            self.reserve(wanted)
            entered = _enter_each(self.directory, self.store, local, sensor, ends, hits, size, entered, wanted)

    def _room(self, x: Doubles, y: Doubles) -> int:
        """Let all maps reach over points, and a cell more; returns how many patches one map may touch at most."""
        low, high = (np.array([bound(x), bound(y)]) for bound in (np.min, np.max))
        self.cover(low - self.resolution, high + self.resolution)
        spread = np.floor((high - low) / (SIDE * self.resolution)) + 3
        return int(spread[0] * spread[1])

    def seen(self, index: int) -> tuple[slice, slice]:
        """Return the rows and columns, in patches, within which one map holds anything."""
        held = self.directory[index] != 0
        if not held.any():
            return slice(0, 0), slice(0, 0)
        rows, columns = (np.nonzero(held.any(axis=axis))[0] for axis in (1, 0))
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    def dense(self, index: int, rows: slice = WHOLE, columns: slice = WHOLE) -> tuple[Floats, Floats]:
        """Return how many beams ended in each cell of one map and how many met it, each (rows, columns).

        rows, columns: of patches, for a part of the map.
        """
        places = self.directory[index, rows, columns]
        both = []
        for values in (self.store.ends[places, :, HITS], (self.store.visits[places] >> 1).astype(np.float32)):
            tiles = values.reshape(*places.shape, SIDE, SIDE).transpose(0, 2, 1, 3)
            both.append(np.ascontiguousarray(tiles).reshape(places.shape[0] * SIDE, places.shape[1] * SIDE))
        return both[0], both[1]

    def in_use(self) -> int:
        """Return how many patches all maps need together."""
        return len(self.store.users) - 1 - int(self.store.top[0])


def _store(count: int) -> Store:
    store = Store(
        np.zeros((count, SIDE * SIDE, 3), np.float32),
        np.zeros((count, SIDE * SIDE), np.uint32),
        np.zeros((count, SIDE), np.uint32),
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
    """Give a map a patch of its own at a place of its directory (rows, columns): a new one, or a copy; returns it."""
    patch = directory[row, column]
    store.top[0] -= 1
    own = store.free[store.top[0]]
    for place in range(SIDE * SIDE):
        store.visits[own, place] = store.visits[patch, place]
        for value in range(3):
            store.ends[own, place, value] = store.ends[patch, place, value]
    for line in range(SIDE):
        store.often[own, line] = store.often[patch, line]
    if patch != 0:
        store.users[patch] -= 1
    store.users[own] = 1
    directory[row, column] = own
    return own


@njit(cache=True, error_model="numpy")
def _enter_each(
    directories: Ints,
    store: Store,
    poses: Doubles,
    sensor: Doubles,
    ends: Doubles,
    hits: Flags,
    resolution: float,
    first: int,
    wanted: int,
) -> int:
    """Enter a scan at each pose from the first on; returns the one for which fewer than `wanted` patches are left."""
    here, there = np.empty(2), np.empty_like(ends)
    for index in range(first, len(poses)):
        if store.top[0] < wanted:
            return index
        x, y, cosine, sine = poses[index, 0], poses[index, 1], math.cos(poses[index, 2]), math.sin(poses[index, 2])
        here[0], here[1] = x + cosine * sensor[0] - sine * sensor[1], y + sine * sensor[0] + cosine * sensor[1]
        for beam in range(len(ends)):
            there[beam, 0] = x + cosine * ends[beam, 0] - sine * ends[beam, 1]
            there[beam, 1] = y + sine * ends[beam, 0] + cosine * ends[beam, 1]
        _enter(directories[index], store, here, there, hits, resolution)
    return len(poses)


@njit(cache=True, error_model="numpy")
def _enter(directory: Ints, store: Store, sensor: Doubles, ends: Doubles, hits: Flags, resolution: float) -> None:
    """Count a visit of each cell along each beam (Bresenham 1965), and the hit at its end.

    x and y count within a patch, row and column are the patch's; a step out of it carries over.
    """
    scale, met, often, users = 1.0 / resolution, store.ends, store.often, store.users
    visits = store.visits.reshape(-1)  # by unsigned places, which numba takes without asking whether they are negative
    x0, y0 = np.int64(math.floor(sensor[0] * scale)), np.int64(math.floor(sensor[1] * scale))
    for beam in range(len(ends)):
        ex, ey = ends[beam, 0] * scale, ends[beam, 1] * scale
        x1, y1 = np.int64(math.floor(ex)), np.int64(math.floor(ey))
        dx, dy = abs(x1 - x0), abs(y1 - y0)
        sx = 1 if x0 < x1 else -1
        sy = 1 if y0 < y1 else -1
        steep = dy > dx
        longer, shorter = (dy, dx) if steep else (dx, dy)
        along_x, along_y = (0, sy) if steep else (sx, 0)  # each step
        aside_x, aside_y = (sx, 0) if steep else (0, sy)  # now and then
        error = longer >> 1
        row, column, patch = np.int64(0), np.int64(0), np.int64(0)
        x, y = x0, y0
        for step in range(longer + 1):
            if (x | y) & ~LAST or not step:
                row, column = row + (y >> BITS), column + (x >> BITS)
                x, y = x & LAST, y & LAST
                patch = np.int64(directory[row, column])
                if patch == 0 or users[patch] != 1:
                    patch = np.int64(_own(directory, store, row, column))
            place = (y << BITS) | x
            beams = visits[np.uint64((patch << (2 * BITS)) | place)] + np.uint32(2)
            if step == longer and hits[beam]:
                beams |= np.uint32(1)
                met[patch, place, HITS] += np.float32(1.0)
                share = np.float32(1.0) / met[patch, place, HITS]
                met[patch, place, X] += share * (np.float32((ex - x1) * resolution) - met[patch, place, X])
                met[patch, place, Y] += share * (np.float32((ey - y1) * resolution) - met[patch, place, Y])
            visits[np.uint64((patch << (2 * BITS)) | place)] = beams
            if beams & np.uint32(1):
                bit = np.uint32(1) << np.uint32(x)
                if met[patch, place, HITS] > FULL * (beams >> np.uint32(1)):
                    often[patch, y] |= bit
                else:
                    often[patch, y] &= ~bit
            error -= shorter
            turn = error >> 63  # all bits where the error is negative, else none
            error += longer & turn
            x += along_x + (aside_x & turn)
            y += along_y + (aside_y & turn)
