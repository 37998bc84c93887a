"""A buffer that grows and is traced while the robot drives, frame by frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from operators.annotation.buffer import Buffer, Classing, classify, enter_new, known_map, pooled
from operators.annotation.refinement import Refinement, refine
from operators.annotation.session import Floats, Scan
from operators.pointmap import MapPoints, PointMap, Settings, VoxelMap
from operators.pointray import PointRay, RaySettings


class GrowingBuffer:
    """What was known, what a session saw besides, and how movable both are so far."""

    def __init__(self, known: MapPoints | None, rays: RaySettings, *, classing: Classing | None = None) -> None:
        """Start from a known map, or from nothing."""
        self.classing = Classing() if classing is None else classing
        self.pointmap = PointMap(Settings(vertical_resolution=rays.height))
        self.known = VoxelMap(self.pointmap.map.voxel_size)
        if known is not None:
            self.known.insert_map(known)
        self.known_rays, self.new_rays = PointRay(self.known, rays), PointRay(self.pointmap.map, rays)
        self.known_chosen: dict[float, npt.NDArray[np.int64]] = {}  # by grain
        self.frames = 0

    def add(self, scan: Scan, *, known_too: bool = False) -> None:
        """Take in a frame at its pose; `known_too`: look through the known points as well."""
        enter_new(self.pointmap, self.known, scan.points, scan.world_from_lidar, self.frames, self.classing.apart)
        self.new_rays.add(scan.points, scan.world_from_lidar)
        if known_too and len(self.known):
            self.known_rays.add(scan.points, scan.world_from_lidar)
        self.frames += 1

    def coarse(self, grain: float) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
        """Return one point (k, 3) of each cube of `grain` metres, its movable probability, and whether it is new.

        Known and new points have cubes of their own: those of the known, nearly all, are chosen once.
        """
        if grain not in self.known_chosen:
            self.known_chosen = {grain: one_of_each_cube(self.known.points, grain)}
        old, fresh = self.known_chosen[grain], one_of_each_cube(self.pointmap.map.points, grain)
        points = np.concatenate([self.known.points[old], self.pointmap.map.points[fresh]])
        movable = np.concatenate([self.known_rays.movable()[old], self.new_rays.movable()[fresh]])
        return points, movable, np.arange(len(points)) >= len(old)

    def classified(self, refinement: Refinement | None = None) -> Buffer:
        """Classify the new points.

        Known points that the session saw through count as new ones: with one session alone that is all there is to
        refine the map.
        """
        movable = self.known_rays.movable()
        known = self.known.cloud(movable=movable)
        refined, stays = refine(known, [movable], refinement)
        gone, new = known.kept(~stays), self.pointmap.map.cloud()
        together = MapPoints(
            np.concatenate([gone.points, new.points]),
            np.concatenate([gone.normals, new.normals]),
            np.concatenate([gone.scores, new.scores]),
            np.concatenate([movable[~stays], pooled(self.new_rays)]),
        )
        # What was known and is gone lies beside what is left: known and new are not apart.
        return classify(known_map(refined, self.classing), together, self.classing)._replace(apart=0.0)


def one_of_each_cube(points: Floats, edge: float) -> npt.NDArray[np.int64]:
    """Return the first point (k,) of each cube of `edge` metres among points (n, 3)."""
    cells = np.floor(points / edge).astype(np.int64)
    keys = (cells[:, 0] << 42) ^ ((cells[:, 1] & 0x1FFFFF) << 21) ^ (cells[:, 2] & 0x1FFFFF)
    return np.unique(keys, return_index=True)[1]
