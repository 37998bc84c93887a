"""The tracker: where people are and where they go, from the points that move by themselves.

tracker:
  run: operators.tracker:Tracker
  inputs: {people: triage/people, pose: localizer/pose}
"""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np

from graph.contract import Operator, Summary
from graph.geometry import planar, transform
from graph.messages import PointCloud, Pose, Tracks
from operators.pointmap.rehearsal import room_scan
from operators.tracking.tracker import Habits
from operators.tracking.tracker import Tracker as Tracking

SECOND = 1_000_000_000  # nanoseconds
WAITING = 10  # frames kept until their pose is known
LOWEST, HIGHEST = 0.1, 2.1  # metres above the floor between which people are


class Tracker(Operator):
    """Follow people by the points that move by themselves; say where they are at each pose."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """How far and how long."""

        reach: float = 10.0  # metres
        forgotten: float = 0.7  # seconds without being seen
        blind_for: float = 3.0  # seconds that somebody is remembered in the lidar's blind ring

    class Outputs(msgspec.Struct):
        """People."""

        tracks: Tracks | None = None

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c: Tracker.Config = self.config
        self.tracking = Tracking(Habits(reach=c.reach, forgotten=c.forgotten, blind_for=c.blind_for))
        self._frames: deque[PointCloud] = deque(maxlen=WAITING)
        self._last: int | None = None
        self.frames, self.followed = 0, 0

    @classmethod
    def warm_up(cls) -> None:
        """Follow a made-up crowd."""
        rehearsed = cls()
        for stamp in (0, SECOND // 10):
            cloud = PointCloud(measured_at=stamp, points=room_scan(), base_from_lidar=planar(0.0, 0.0, 0.0, 0.64))
            rehearsed.on_people(cloud)
            rehearsed.on_pose(Pose(measured_at=stamp, world_from_base=np.eye(4)))

    def on_people(self, cloud: PointCloud) -> None:
        """Keep a frame until it is known where it was taken."""
        self._frames.append(cloud)

    def on_pose(self, pose: Pose) -> Outputs | None:
        """Look at the frame of this pose. Frames whose pose never comes are left out."""
        while self._frames and self._frames[0].measured_at < pose.measured_at:
            self._frames.popleft()
        if not self._frames or self._frames[0].measured_at > pose.measured_at:
            return None
        cloud = self._frames.popleft()
        world_from_lidar = pose.world_from_base @ cloud.base_from_lidar
        points = transform(world_from_lidar, cloud.points.astype(np.float64))
        above = points[:, 2] - pose.world_from_base[2, 3]
        points = points[(above > LOWEST) & (above < HIGHEST)]
        seconds = 0.0 if self._last is None else (pose.measured_at - self._last) / SECOND
        self._last = pose.measured_at
        eye = float(world_from_lidar[0, 3]), float(world_from_lidar[1, 3])
        people = self.tracking.observe(points, eye, seconds)
        self.frames += 1
        self.followed += len(people.identity)
        return self.Outputs(
            Tracks(
                measured_at=pose.measured_at,
                identity=people.identity,
                position=people.place,
                velocity=people.velocity,
                unseen=people.unseen.astype(np.float32),
            )
        )

    def on_end(self) -> Summary:
        """Tell how many people were met, and how many were followed at once."""
        return Summary(people_met=self.tracking.met, people_followed=self.followed / max(1, self.frames))
