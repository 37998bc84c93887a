"""Localizers: where the robot is, and the map that it localizes on.

localizer:
  run: operators.localizer:Localizer
  inputs: {odometry: simulator/odometry, frame: simulator/frame}
  config: {map: recordings/maps/default.ply}
"""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np

from graph.contract import Operator, Summary
from graph.geometry import Matrix, inverse, planar
from graph.messages import MapCloud, OccupancyGrid, Odometry, PointCloud, Pose
from operators.pointmap import Criteria, Mapper, Settings, Track, Trail, load_map
from operators.pointmap.rehearsal import room_scan

SECOND = 1_000_000_000  # nanoseconds


class Localizer(Operator):
    """Align each frame with the map, starting from the odometry, and add it to the map."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """The map to start from and how frames are aligned; defaults are the authors'."""

        map: Path | None = None  # initial map, PLY; None starts an empty one (PointMap*)
        map_voxel: float = 0.03  # metres
        frame_voxel: float = 0.10  # metres
        vertical_resolution: float = math.radians(1.33)  # between two beams of the lidar
        samples: int = 600  # points drawn at each iteration of the alignment
        largest_jump: float = 0.5  # metres between odometry and alignment; beyond, the pose is not valid
        largest_turn: float = math.radians(15.0)
        upright: float = 0.2  # share of height and tilt given up at each frame, where odometry knows of none
        grow: bool = True  # whether aligned frames enter the map
        cell: float = 0.05  # metres, of the occupancy grid
        map_period: float = 1.0  # seconds between two messages of new map points
        occupancy_period: float = 1.0  # seconds
        seed: int = 0

    class Outputs(msgspec.Struct):
        """The pose of every frame; new points of the map and the occupancy grid now and then."""

        pose: Pose | None = None
        map: MapCloud | None = None
        occupancy: OccupancyGrid | None = None

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c: Localizer.Config = self.config
        settings = Settings(
            map_voxel=c.map_voxel,
            frame_voxel=c.frame_voxel,
            vertical_resolution=c.vertical_resolution,
            criteria=Criteria(samples=c.samples),
            largest_jump=c.largest_jump,
            largest_turn=c.largest_turn,
            upright=c.upright,
            grow=c.grow,
            seed=c.seed,
        )
        self.mapper = Mapper(settings, initial=None if c.map is None else load_map(c.map), cell=c.cell)
        self.trail = Trail()
        self.world_from_odom: Matrix = np.eye(4)
        self.map_due, self.occupancy_due = 0, 0
        self.frames, self.invalid, self.iterations = 0, 0, 0

    @classmethod
    def warm_up(cls) -> None:
        """Localize two scans of a made-up room."""
        rehearsed = cls()
        for index, turn in enumerate((0.0, 0.02)):
            stamp = index * SECOND // 10
            pose = planar(0.0, 0.0, turn)
            at = Odometry(measured_at=stamp, odom_from_base=pose, linear=0.0, angular=0.0, true_world_from_base=pose)
            mount = planar(0.0, 0.0, 0.0, 0.64)
            rehearsed.on_odometry(at)
            rehearsed.on_frame(PointCloud(measured_at=stamp, points=room_scan(turn=turn), base_from_lidar=mount))

    def on_odometry(self, odometry: Odometry) -> None:
        """Remember where wheels and gyro say the robot is."""
        self.trail.add(odometry.measured_at, odometry.odom_from_base, odometry.linear, odometry.angular)

    def on_frame(self, frame: PointCloud) -> Localizer.Outputs:
        """Say where the robot was when the frame was measured."""
        odom_from_base = self.trail.at(frame.measured_at)
        track = self.locate(frame, self.world_from_odom @ odom_from_base)
        world_from_base = track.world_from_lidar @ inverse(frame.base_from_lidar)
        if track.valid:
            self.world_from_odom = world_from_base @ inverse(odom_from_base)
        self.frames += 1
        self.invalid += not track.valid
        self.iterations += track.iterations
        pose = Pose(
            measured_at=frame.measured_at,
            world_from_base=world_from_base,
            valid=track.valid,
            reason=track.reason,
            inliers=track.inliers,
        )
        return self.Outputs(pose, self.new_points(frame.measured_at), self.grid(frame.measured_at))

    def on_end(self) -> Summary:
        """Count what was localized."""
        return Summary(
            frames=self.frames,
            invalid_poses=self.invalid,
            map_points=len(self.mapper.pointmap.map),
            mean_iterations=self.iterations / max(1, self.frames),
        )

    def locate(self, frame: PointCloud, world_from_base: Matrix) -> Track:
        """Align a frame, starting from a guess of where the base was."""
        points = self.trail.steady(frame.points, frame.time_offset, frame.base_from_lidar)
        return self.mapper.look(points, world_from_base, frame.base_from_lidar, level=self.trail.level())

    def new_points(self, stamp: int) -> MapCloud | None:
        """Return the points added since the last message, when it is time; the first message has all."""
        if stamp < self.map_due or not len(self.mapper.pointmap.map):
            return None
        self.map_due = stamp + round(self.config.map_period * SECOND)
        incremental = self.mapper.handed > 0
        points, normals, scores, _, _ = self.mapper.news()
        return MapCloud(measured_at=stamp, points=points, normals=normals, score=scores, incremental=incremental)

    def grid(self, stamp: int) -> OccupancyGrid | None:
        """Return the occupancy grid, when it is time."""
        occupancy = self.mapper.occupancy
        if stamp < self.occupancy_due or not occupancy.cells.mean.size:
            return None
        self.occupancy_due = stamp + round(self.config.occupancy_period * SECOND)
        return OccupancyGrid(
            measured_at=stamp, cells=occupancy.percent(), origin=occupancy.origin, resolution=occupancy.resolution
        )


class TrueLocalizer(Localizer):
    """Take the true pose that a simulator tells with its odometry: judges a driver alone; maps at the true pose."""

    def __init__(self, config: Localizer.Config | None = None) -> None:
        super().__init__(config)
        self.truth = Trail()

    def on_odometry(self, odometry: Odometry) -> None:
        """Remember where the robot really is. Raises ValueError where the odometry does not know."""
        super().on_odometry(odometry)
        if odometry.true_world_from_base is None:
            raise ValueError("TrueLocalizer wants odometry with true_world_from_base, which only a simulator gives")
        self.truth.add(odometry.measured_at, odometry.true_world_from_base, odometry.linear, odometry.angular)

    def locate(self, frame: PointCloud, world_from_base: Matrix) -> Track:
        """Map the frame where the base really was."""
        points = self.trail.steady(frame.points, frame.time_offset, frame.base_from_lidar)
        return self.mapper.look(points, self.truth.at(frame.measured_at), frame.base_from_lidar, known=True)
