"""A map of points with normals, at most one point a voxel."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.nearest import nearest
from operators.pointmap.store import (
    BLOCK_BITS,
    BLOCK_VOXELS,
    CELL_BITS,
    CELL_BLOCKS,
    FARTHEST,
    NONE,
    NORMAL,
    SCORE,
    empty_store,
    insert,
    voxel_of,
    with_room,
)

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]

CHUNK = 16_384  # points inserted at once
INITIAL = -1  # frame number of the points of an initial map


class MapPoints(NamedTuple):
    """The points of a map, as they are kept in files and handed around; all arrays have n entries."""

    points: Floats  # (n, 3) metres, world
    normals: Floats  # (n, 3) unit
    scores: Floats  # trust in the normals
    movable: Floats | None = None  # movable probability
    label: npt.NDArray[np.uint8] | None = None  # 0 uncertain, 1 ground, 2 permanent, 3 longT, 4 shortT

    def kept(self, chosen: npt.NDArray[Any]) -> MapPoints:
        """Return the chosen points, by mask or by index."""
        movable = None if self.movable is None else self.movable[chosen]
        label = None if self.label is None else self.label[chosen]
        return MapPoints(self.points[chosen], self.normals[chosen], self.scores[chosen], movable, label)


@njit(cache=True, error_model="numpy")
def places(points: Floats, voxel: float) -> npt.NDArray[np.int64]:
    """Return a number (n,) for each point (n, 3) that rises with its cell, and in it with its block, along x, y, z.

    voxel: metres. Points without a place, which no map takes, come last.
    """
    result = np.full(len(points), np.iinfo(np.int64).max, np.int64)
    half, blocks = FARTHEST >> (BLOCK_BITS + CELL_BITS), CELL_BLOCKS - 1
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (abs(x) < FARTHEST * voxel and abs(y) < FARTHEST * voxel and abs(z) < FARTHEST * voxel):
            continue
        i, j, k = voxel_of(x, y, z, BLOCK_VOXELS * voxel)
        cell = (((i >> CELL_BITS) + half) * 2 * half + (j >> CELL_BITS) + half) * 2 * half + (k >> CELL_BITS) + half
        result[n] = ((cell * CELL_BLOCKS + (i & blocks)) * CELL_BLOCKS + (j & blocks)) * CELL_BLOCKS + (k & blocks)
    return result


class VoxelMap:
    """A growing map: the first point of a voxel stays for ever, its normal is replaced by a better scored one."""

    def __init__(self, voxel_size: float = 0.03) -> None:
        if not voxel_size > 0.0:
            raise ValueError(f"the map's voxel size must be above 0 m; it is {voxel_size}")
        self.voxel_size = voxel_size
        self.store = empty_store()

    def __len__(self) -> int:
        return int(self.store.counts[0])

    @property
    def points(self) -> Floats:
        """Return the points (n, 3), metres, world; a view, older points first."""
        return self.store.rows[: len(self), :3]

    @property
    def normals(self) -> Floats:
        """Return the normals (n, 3); a view."""
        return self.store.rows[: len(self), NORMAL : NORMAL + 3]

    @property
    def scores(self) -> Floats:
        """Return the scores of the normals (n,); a view."""
        return self.store.rows[: len(self), SCORE]

    @property
    def created(self) -> Ints:
        """Return the number (n,) of the frame that brought each point, -1 for the initial map; a view."""
        return self.store.created[: len(self)]

    def insert(self, points: Floats, normals: Floats, scores: Floats, frame: int) -> int:
        """Add points (n, 3) in world coordinates with normals (n, 3) and scores (n,); returns how many are new."""
        before = len(self)
        for first in range(0, len(points), CHUNK):  # room is made for the worst case: small steps keep that small
            part = slice(first, first + CHUNK)
            self.store = with_room(self.store, len(points[part]))
            insert(self.store, points[part], normals[part], scores[part], frame, self.voxel_size)
        return len(self) - before

    def insert_map(self, cloud: MapPoints) -> npt.NDArray[np.int64]:
        """Add the points of an initial map, neighbours in space as neighbours in memory.

        Returns which points of the cloud were kept (k,), in the order of their new numbers: the first of each voxel.
        """
        order = np.argsort(places(np.ascontiguousarray(cloud.points, np.float32), self.voxel_size), kind="stable")
        before = len(self)
        self.insert(cloud.points[order], cloud.normals[order], cloud.scores[order], INITIAL)
        if len(self) - before == len(order):
            return order
        found, _ = self.nearest(cloud.points[order], 1e-3 * self.voxel_size)
        _, first = np.unique(np.where(found >= before, found, NONE), return_index=True)
        return order[first[-(len(self) - before) :]] if len(self) > before else order[:0]

    def nearest(self, points: Floats, reach: float = 2.0) -> tuple[Ints, npt.NDArray[np.float64]]:
        """Return the map point nearest each of the points (n, 3), -1 beyond `reach` metres, and its distance (n,)."""
        found, squares = nearest(self.store, self.voxel_size, np.ascontiguousarray(points, np.float32), reach)
        return found, np.sqrt(squares)

    def cloud(self, **more: Any) -> MapPoints:
        """Copy the map; `more` may give `movable` and `label`."""
        return MapPoints(self.points.copy(), self.normals.copy(), self.scores.copy(), **more)
