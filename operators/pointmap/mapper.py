"""What a localizer does to each frame: align it, and enter it into the map and the occupancy grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from graph.geometry import Matrix, inverse
from operators.pointmap.ground import find_ground, height_above
from operators.pointmap.occupancy import Occupancy
from operators.pointmap.slam import PointMap, Settings, Track
from operators.pointmap.voxel_map import MapPoints

OCCUPANCY_EVERY = 3  # frames: at 10 Hz and 1 m/s the robot moves 0.3 m between them


class Mapper:
    """A PointMap and an occupancy grid that grow together."""

    def __init__(
        self, settings: Settings | None = None, *, initial: MapPoints | None = None, cell: float = 0.05
    ) -> None:
        self.pointmap = PointMap(settings, initial=initial)
        self.occupancy = Occupancy(cell)
        self.handed = 0  # points of the map that `news` has given
        if initial is not None:
            ground = find_ground(initial.points, initial.normals)
            level = np.zeros(3) if ground is None else ground
            self.occupancy.add_map(initial.points, height_above(level, initial.points))

    def look(
        self,
        points: npt.NDArray[Any],
        world_from_base: Matrix,
        base_from_lidar: Matrix,
        *,
        level: bool = False,
        known: bool = False,
    ) -> Track:
        """Align a frame (n, 3) in the sensor's frame and enter it, unless it is refused.

        world_from_base: (4, 4) the guess; the pose itself if it is `known`. level: the robot drives on one level floor
        at height 0. Every third frame enters the grid, which takes heights from the ground of the frame, or from the
        floor under the base where the frame shows none.
        """
        frame = self.pointmap.prepare(points)
        guess = world_from_base @ base_from_lidar
        if known:
            track = self.pointmap.enter(frame, guess)
        else:
            track = self.pointmap.track_frame(frame, guess, base_from_lidar if level else None)
        if track.valid and len(frame.points) and self.pointmap.frames % OCCUPANCY_EVERY == 1:
            world, normals = frame.moved(track.world_from_lidar)
            ground = find_ground(world, normals)
            floor = (track.world_from_lidar @ inverse(base_from_lidar))[2, 3]
            heights = height_above(np.array([0.0, 0.0, floor]) if ground is None else ground, world)
            self.occupancy.add(world, heights, track.world_from_lidar[:2, 3])
        return track

    def news(self) -> MapPoints:
        """Return the points that came to the map since the last call."""
        voxels = self.pointmap.map
        fresh = slice(self.handed, len(voxels))
        self.handed = len(voxels)
        return MapPoints(voxels.points[fresh].copy(), voxels.normals[fresh].copy(), voxels.scores[fresh].copy())
