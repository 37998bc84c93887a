"""The tracker: where people are and where they go, from the points that move by themselves.

tracker:
  run: operators.tracker:Tracker
  inputs: {people: triage/people, near: simulator/near, obstacles: triage/planning, pose: localizer/pose}

`near`, of a second sensor for the ring in which the lidar is blind, may be left out, and `obstacles` with it. Nobody
labels its points: there, what stands where the lidar saw no obstacle before, and is not flat, is a person. What is flat
goes out as `things`: beside the robot, nobody else may have seen it. With both, points of people in a cell that is
mostly called an obstacle are left out as well.
"""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np
import numpy.typing as npt

from graph.contract import Operator, Summary
from graph.geometry import inverse, planar, transform
from graph.messages import PointCloud, Pose, Tracks
from operators.pointmap.rehearsal import room_scan
from operators.tracking.flat import flat
from operators.tracking.things import Things
from operators.tracking.tracker import Habits, looking
from operators.tracking.tracker import Tracker as Tracking

SECOND = 1_000_000_000  # nanoseconds
WAITING = 10  # frames kept until their pose is known
LOWEST, HIGHEST = 0.1, 2.1  # metres above the floor between which people are
NEAR = 1.2  # metres from the lidar: nearer, it shows but a part of somebody, and a second sensor all
THINGS = 3.0  # metres from the lidar within which obstacles are remembered
CLEAR, SOON, LATE = 1.4, 4, 1  # metres from which all of a person is seen and told from a thing, and what a sighting
# weighs there, and nearer


Frames = deque[PointCloud]
Floats = npt.NDArray[np.float64]


class Tracker(Operator):
    """Follow people by the points that move by themselves; say where they are at each pose."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """How far and how long."""

        reach: float = 10.0  # metres
        forgotten: float = 0.7  # seconds without being seen
        blind_for: float = 3.0  # seconds that somebody is remembered in the lidar's blind ring

    class Outputs(msgspec.Struct):
        """People, and what stands beside the robot and is nobody."""

        tracks: Tracks | None = None
        things: PointCloud | None = None

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c: Tracker.Config = self.config
        self.habits = Habits(reach=c.reach, forgotten=c.forgotten, blind_for=c.blind_for)
        self.tracking = Tracking(self.habits)
        self.things = Things()
        self._people: Frames = deque(maxlen=WAITING)
        self._near: Frames = deque(maxlen=WAITING)
        self._obstacles: Frames = deque(maxlen=WAITING)
        self._last: int | None = None
        self.frames, self.followed = 0, 0

    @classmethod
    def warm_up(cls) -> None:
        """Follow a made-up crowd."""
        rehearsed = cls()
        for stamp in (0, SECOND // 10):
            cloud = PointCloud(measured_at=stamp, points=room_scan(), base_from_lidar=planar(0.0, 0.0, 0.0, 0.64))
            for listen in (rehearsed.on_people, rehearsed.on_near, rehearsed.on_obstacles):
                listen(cloud)
            rehearsed.on_pose(Pose(measured_at=stamp, world_from_base=np.eye(4)))

    @classmethod
    def missing(cls, config: Config, wired: frozenset[str]) -> str:
        """Warn where a second sensor's points would all be people's."""
        if "near" in wired and "obstacles" not in wired:
            return "near wants obstacles wired; without, all that stands near the robot is taken for people"
        return ""

    def on_people(self, cloud: PointCloud) -> None:
        """Keep a frame until it is known where it was taken."""
        self._people.append(cloud)

    def on_near(self, cloud: PointCloud | None) -> None:
        assert cloud is not None
        self._near.append(cloud)

    def on_obstacles(self, cloud: PointCloud | None) -> None:
        assert cloud is not None
        self._obstacles.append(cloud)

    def on_pose(self, pose: Pose) -> Outputs | None:
        """Look at the frame of this pose. Frames whose pose never comes are left out."""
        cloud, near, obstacles = (_of(frames, pose) for frames in (self._people, self._near, self._obstacles))
        if cloud is None:
            return None
        eye = (pose.world_from_base @ cloud.base_from_lidar)[:2, 3]
        points = _standing(cloud, pose)
        things = None
        self.tracking.habits = self.habits
        if near is not None:
            self.tracking.habits = looking(self.habits)
            if obstacles is not None:
                self._learn(points, obstacles, pose)
            points = points[_away(points, eye) >= NEAR]
            points = points[~self.things.explain(points[:, :2], pose.measured_at / SECOND, beside=False)]
            beside, things = self._told_apart(near, pose)
            points = np.concatenate([points, beside])
        seconds = 0.0 if self._last is None else (pose.measured_at - self._last) / SECOND
        self._last = pose.measured_at
        people = self.tracking.observe(points, (float(eye[0]), float(eye[1])), seconds)
        self.frames += 1
        self.followed += len(people.identity)
        return self.Outputs(
            Tracks(
                measured_at=pose.measured_at,
                identity=people.identity,
                position=people.place,
                velocity=people.velocity,
                unseen=people.unseen.astype(np.float32),
                blind=self.tracking.habits.blind,
            ),
            things,
        )

    def _learn(self, people: Floats, obstacles: PointCloud, pose: Pose) -> None:
        """Take in where obstacles and people (n, 3; world) are around the robot."""
        seconds, here = pose.measured_at / SECOND, pose.world_from_base[:2, 3]
        places = transform(pose.world_from_base @ obstacles.base_from_lidar, obstacles.points.astype(np.float64))
        for seen, say in ((places, self.things.observe), (people, self.things.doubt)):
            away = _away(seen, here)
            say(seen[away < CLEAR, :2], seconds, LATE)
            say(seen[(away >= CLEAR) & (away < THINGS), :2], seconds, SOON)

    def _told_apart(self, near: PointCloud, pose: Pose) -> tuple[Floats, PointCloud]:
        """Return the second sensor's points (n, 3; world) at nothing that stands there, and the flat ones."""
        seconds = pose.measured_at / SECOND
        points = _standing(near, pose)
        points = points[_away(points, (pose.world_from_base @ near.base_from_lidar)[:2, 3]) < NEAR]
        upright = points[flat(np.ascontiguousarray(points[:, :2]))]
        self.things.observe(upright[:, :2], seconds)
        lidar_from_world = inverse(pose.world_from_base @ near.base_from_lidar)
        things = PointCloud(
            measured_at=near.measured_at,
            points=transform(lidar_from_world, upright).astype(np.float32),
            base_from_lidar=near.base_from_lidar,
        )
        return np.asarray(points[~self.things.explain(points[:, :2], seconds)]), things

    def on_end(self) -> Summary:
        """Tell how many people were met, and how many were followed at once."""
        return Summary(people_met=self.tracking.met, people_followed=self.followed / max(1, self.frames))


def _of(frames: Frames, pose: Pose) -> PointCloud | None:
    """Take the frame of a pose's time out of those that wait, and those before it."""
    while frames and frames[0].measured_at < pose.measured_at:
        frames.popleft()
    return frames.popleft() if frames and frames[0].measured_at == pose.measured_at else None


def _standing(cloud: PointCloud, pose: Pose) -> Floats:
    """Return the points (n, 3; world, metres) at the height of people."""
    points = transform(pose.world_from_base @ cloud.base_from_lidar, cloud.points.astype(np.float64))
    above = points[:, 2] - pose.world_from_base[2, 3]
    return np.asarray(points[(above > LOWEST) & (above < HIGHEST)])


def _away(points: Floats, eye: Floats) -> Floats:
    """Return the distances (n,) of points (n, 3) from a place (2,) on the floor, metres."""
    return np.asarray(np.hypot(points[:, 0] - eye[0], points[:, 1] - eye[1]))
