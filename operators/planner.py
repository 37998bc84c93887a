"""Drive to the goal: plan on the map and on what is seen, choose velocities ten times a second.

planner:
  run: operators.planner:Planner
  inputs: {goal: simulator/goal, map: localizer/occupancy, obstacles: triage/planning, people: triage/people,
    tracks: tracker/tracks, things: tracker/things, pose: localizer/pose}
  config: {people: predict}

Where people are predicted and frames are classified, it wants `tracks` and `people`: whose echoes return is not near.
Where the tracker has a second sensor, it goes by the tracks alone, and `things` are what that sensor sees beside the
robot that is nobody: they are in the way like `obstacles`.
"""

from __future__ import annotations

from collections import deque
from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from graph.contract import Operator
from graph.geometry import Matrix, interpolate, planar, transform
from graph.messages import Drive, Goal, OccupancyGrid, Plan, PointCloud, Pose, Tracks
from operators.navigation.footprint import Footprint
from operators.navigation.navigator import Navigator
from operators.navigation.people import NOBODY, Walkers, apart
from operators.navigation.presence import BLIND, Presence
from operators.navigation.window import Limits
from operators.pointmap.rehearsal import room_scan

HISTORY = 50  # poses kept, to find where a frame was taken
WAITING = 10  # frames kept until the pose of their time is known
THEIRS = 0.32  # metres from the middle of a person, as a tracker says it, within which all that is seen is theirs
JUST_NOW = 0.25  # seconds: whoever was seen since


class Planner(Operator):
    """Plan and drive at each pose, with the latest goal, map and obstacles."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """What the robot is and how it shall drive."""

        max_speed: float = 1.3  # m/s
        max_reverse: float = 0.2  # m/s
        max_turn: float = 1.0  # rad/s
        acceleration: float = 1.0  # m/s^2
        turn_acceleration: float = 2.5  # rad/s^2
        braking: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0  # m/s^2, towards rest
        length: float = 0.42  # metres, of the footprint
        width: float = 0.31  # metres
        padding: float = 0.05  # metres kept free around it
        inflation: float = 0.8  # metres: the way keeps farther from things where it can
        window: float = 4.0  # metres, side of the square in which velocities are judged
        horizon: float = 3.0  # seconds that they are followed
        latency: float = 0.1  # seconds from a measurement to the effect of the command that answers it
        people: Literal["ignore", "predict"] = (
            "ignore"  # those whom a tracker follows: trust them to step aside, or not
        )

    class Outputs(msgspec.Struct):
        """What to do and what for."""

        drive: Drive | None = None
        plan: Plan | None = None

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c: Planner.Config = self.config
        self.navigator = Navigator(
            Footprint(c.length, c.width),
            Limits(c.max_speed, c.max_reverse, c.max_turn, c.acceleration, c.turn_acceleration, c.braking),
            padding=c.padding,
            inflation=c.inflation,
            side=c.window,
            horizon=c.horizon,
            latency=c.latency,
        )
        self._poses: deque[tuple[int, Matrix]] = deque(maxlen=HISTORY)
        self._frames: deque[PointCloud] = deque(maxlen=WAITING)
        self._people: deque[PointCloud] = deque(maxlen=WAITING)
        self._things: deque[PointCloud] = deque(maxlen=WAITING)
        self._tracks: Tracks | None = None
        self._presence = Presence()

    @classmethod
    def warm_up(cls) -> None:
        """Plan twice in a made-up room."""
        rehearsed = cls(cls.Config(people="predict"))
        mount = planar(0.0, 0.0, 0.0, 0.64)
        cells = np.zeros((160, 160), np.int8)
        rehearsed.on_goal(Goal(measured_at=0, target=np.array([2.0, 1.0]), index=0, count=1))
        rehearsed.on_map(OccupancyGrid(measured_at=0, cells=cells, origin=np.array([-4.0, -4.0]), resolution=0.05))
        for stamp in (0, 100_000_000):
            rehearsed.on_obstacles(PointCloud(measured_at=stamp, points=room_scan(), base_from_lidar=mount))
            walker = np.array([[1.0, 0.5]])
            rehearsed.on_tracks(
                Tracks(
                    measured_at=stamp,
                    identity=np.ones(1, np.int32),
                    position=walker,
                    velocity=-walker,
                    unseen=np.zeros(1, np.float32),
                )
            )
            rehearsed.on_things(PointCloud(measured_at=stamp, points=room_scan(), base_from_lidar=mount))
            rehearsed.on_pose(Pose(measured_at=stamp, world_from_base=np.eye(4)))

    @classmethod
    def missing(cls, config: Config, wired: frozenset[str]) -> str:
        """Warn where people cannot be predicted (`tracks`), or not where the lidar is blind (`people`)."""
        wanted = [port for port in ("tracks", "people") if port not in wired]
        if config.people == "ignore" or not wanted:
            return ""
        return f"people: predict wants {' and '.join(wanted)} wired; without, people may go unseen"

    def on_goal(self, goal: Goal) -> None:
        self.navigator.set_goal(float(goal.target[0]), float(goal.target[1]))

    def on_map(self, grid: OccupancyGrid) -> None:
        self.navigator.set_map(grid.cells, grid.origin, grid.resolution)

    def on_obstacles(self, frame: PointCloud) -> None:
        self._frames.append(frame)

    def on_people(self, people: PointCloud | None) -> None:
        assert people is not None
        self._people.append(people)

    def on_things(self, things: PointCloud | None) -> None:
        assert things is not None
        self._things.append(things)

    def on_tracks(self, tracks: Tracks | None) -> None:
        self._tracks = tracks

    def on_pose(self, pose: Pose) -> Outputs:
        self._poses.append((pose.measured_at, pose.world_from_base))
        while self._frames and self._frames[0].measured_at <= pose.measured_at:
            frame = self._frames.popleft()
            where = self._pose_at(frame.measured_at)
            if where is not None:
                points = frame.points
                if self._tracks is not None and self.config.people == "predict":
                    points = self._nobodys(frame, where @ frame.base_from_lidar, self._tracks)
                self.navigator.observe(points, where, frame.base_from_lidar)
                if self.config.people == "predict" and (self._tracks is None or self._tracks.blind > 0.0):
                    things = self.navigator.costmap.standing(float(where[0, 3]), float(where[1, 3]), BLIND)
                    people = [other.points for other in self._people if other.measured_at == frame.measured_at]
                    if people or frame.label is None:  # else nobody knows which rays people gave back
                        points = np.concatenate([frame.points, *people])
                        self._presence.observe(points, where @ frame.base_from_lidar, things)
        while self._things and self._things[0].measured_at <= pose.measured_at:
            beside = self._things.popleft()
            where = self._pose_at(beside.measured_at)
            if where is not None:
                self.navigator.stand(beside.points, where @ beside.base_from_lidar)
        if self.config.people == "predict":
            self.navigator.meet(self._walkers(pose.measured_at))
        decision = self.navigator.step(pose.measured_at, pose.world_from_base, valid=pose.valid)
        drive = Drive(measured_at=pose.measured_at, linear=decision.twist.linear, angular=decision.twist.angular)
        plan = Plan(
            measured_at=pose.measured_at,
            path=decision.path,
            trajectory=decision.trajectory,
            status=decision.status,
        )
        return self.Outputs(drive=drive, plan=plan)

    def _nobodys(self, frame: PointCloud, world_from_lidar: Matrix, tracks: Tracks) -> npt.NDArray[np.float32]:
        """Return the points (m, 3; lidar frame) but those at people: parts of them pass for things now and then."""
        seconds = (frame.measured_at - tracks.measured_at) * 1e-9
        places = (tracks.position + seconds * tracks.velocity)[tracks.unseen < JUST_NOW]
        floor = transform(world_from_lidar, frame.points.astype(np.float64))[:, :2]
        return frame.points[apart(floor, places, THEIRS)]

    def _walkers(self, time: int) -> Walkers:
        """Return the people (k, 4) that are followed, at the moment when the command for a pose takes effect."""
        if self._tracks is None:
            return NOBODY
        seconds = (time - self._tracks.measured_at) * 1e-9 + self.config.latency
        places = self._tracks.position + seconds * self._tracks.velocity
        walkers = np.concatenate([places, self._tracks.velocity], axis=1)
        if self._tracks.blind == 0.0:
            return walkers
        return self._presence.company(self._tracks.identity, walkers, self._tracks.unseen)

    def _pose_at(self, time: int) -> Matrix | None:
        """Return world_from_base at a time within the history, between its neighbours; None before its first."""
        later: tuple[int, Matrix] | None = None
        for when, world_from_base in reversed(self._poses):
            if when == time:
                return world_from_base
            if when < time:
                return (
                    None if later is None else interpolate(world_from_base, later[1], (time - when) / (later[0] - when))
                )
            later = when, world_from_base
        return None
