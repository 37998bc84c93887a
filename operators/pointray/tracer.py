"""PointRay: which points of a map can move, by looking through them (paper section III-B)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import Matrix, inverse
from operators.pointmap.angles import spherical
from operators.pointmap.frame import separate
from operators.pointmap.voxel_map import VoxelMap
from operators.pointray.frustums import frustum_grid
from operators.pointray.looks import FREE, LOOKS, look
from operators.pointray.occupied import blocks_of_points, carried, with_neighbours

Floats = npt.NDArray[np.float32]

UNKNOWN = 0.5  # movable probability of a point that was hardly looked at


class RaySettings(NamedTuple):
    """The size of the frustums and how many looks are enough."""

    height: float = math.radians(1.33)  # the lidar's vertical resolution
    width: float = math.radians(0.1)
    least_looks: int = 10
    level: float = (
        0.5  # |z| of a normal above which any incidence counts: table tops are always seen at a grazing angle
    )


class PointRay:
    """Count, for every point of a voxel map, how often frames looked at it and how often they saw through it.

    Frames are added one by one, in any order; the map may grow between them. Only the map points within the reach of a
    frame are touched.
    """

    def __init__(self, voxels: VoxelMap, settings: RaySettings | None = None) -> None:
        self.voxels = voxels
        self.settings = RaySettings() if settings is None else settings
        self.frames = 0
        self.counts = np.zeros((0, 2), np.int32)

    def add(self, points: npt.NDArray[Any], world_from_lidar: Matrix) -> int:
        """Take in one frame (n, 3) in the sensor's frame, at its pose. Returns how many map points were tried."""
        self._grow()
        x, y, z, _ = separate(np.ascontiguousarray(points, np.float32))
        if not len(x) or not len(self.voxels):
            return 0
        rho, theta, phi = spherical(x, y, z)
        frustums = frustum_grid(rho, theta, phi, self.settings.height, self.settings.width)
        world = carried(np.ascontiguousarray(world_from_lidar, np.float64), x, y, z)
        size = self.voxels.voxel_size
        occupied = with_neighbours(blocks_of_points(world, size))
        box = np.stack([world.min(axis=0), world.max(axis=0)])
        self.frames += 1
        lidar_from_world = inverse(world_from_lidar)
        return int(
            look(self.voxels.store, self.counts, frustums, occupied, lidar_from_world, box, size, self.settings.level)
        )

    def looks(self) -> npt.NDArray[np.int32]:
        """Return how often each point of the map was looked at (n,)."""
        self._grow()
        return self.counts[: len(self.voxels), LOOKS].copy()

    def movable(self) -> Floats:
        """Return the movable probability of each point of the map (n,): 0.5 where fewer than `least_looks` looked."""
        self._grow()
        counts = self.counts[: len(self.voxels)]
        enough = counts[:, LOOKS] >= self.settings.least_looks
        share = counts[:, FREE] / np.maximum(1, counts[:, LOOKS])
        return np.where(enough, share, UNKNOWN).astype(np.float32)

    def _grow(self) -> None:
        if len(self.counts) < len(self.voxels):
            larger = np.zeros((max(len(self.voxels), 2 * len(self.counts)), 2), np.int32)
            larger[: len(self.counts)] = self.counts
            self.counts = larger
