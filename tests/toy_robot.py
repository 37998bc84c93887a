"""A robot of arithmetic only, for the tests of the views: it drives on a circle through a ring of walls."""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec
import numpy as np

from graph import End, Operator, Summary
from graph.geometry import inverse, planar, transform
from graph.messages import (
    Drive,
    Goal,
    MapCloud,
    OccupancyGrid,
    Odometry,
    Plan,
    PointCloud,
    Pose,
    Text,
    Tick,
    Truth,
)

RADIUS, TURN = 3.0, 0.2  # metres, radians a tick
ERROR = 0.03  # metres that the estimated pose is off
BASE_FROM_LIDAR = planar(0.0, 0.0, 0.0, z=0.64)


class ToyRobot(Operator):
    """Say everything that a robot can say, at each tick."""

    class Config(msgspec.Struct):
        ticks: int = 12
        points: int = 4000
        seed: int = 0

    class Outputs(msgspec.Struct):
        frame: PointCloud | None = None
        odometry: Odometry | None = None
        goal: Goal | None = None
        truth: Truth | None = None
        pose: Pose | None = None
        map: MapCloud | None = None
        occupancy: OccupancyGrid | None = None
        plan: Plan | None = None
        drive: Drive | None = None
        text: Text | None = None

    def on_tick(self, tick: Tick) -> Iterator[ToyRobot.Outputs | End]:
        now, index = tick.measured_at, tick.index
        angle = TURN * index
        true = planar(RADIUS * math.cos(angle), RADIUS * math.sin(angle), angle + math.pi / 2)
        off = planar(ERROR, 0.0, 0.0) @ true
        walls, classes = ring(np.random.default_rng(self.config.seed + index), self.config.points)
        points = transform(inverse(true @ BASE_FROM_LIDAR), walls)
        cells = np.full((60, 60), -1, np.int8)
        cells[5:55, 5:55] = 0
        cells[5:8, 5:55] = 100
        path = np.array([true[:2, 3], (0.0, 0.0), (5.0, 0.0)])
        yield self.Outputs(
            frame=PointCloud(measured_at=now, points=points, base_from_lidar=BASE_FROM_LIDAR, truth=classes),
            odometry=Odometry(measured_at=now, odom_from_base=true, linear=0.6, angular=0.2, true_world_from_base=true),
            goal=Goal(measured_at=now, target=np.array([5.0, 0.0]), index=index // 6, count=2),
            truth=Truth(
                measured_at=now,
                world_from_base=true,
                people=np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]),
                people_moving=np.array([True, False]),
                people_instance=np.array([7, 8], np.int32),
                contacts=np.array([7] if index == 3 else [], np.int32),
            ),
            pose=Pose(measured_at=now, world_from_base=off, valid=index != 4, reason="lost" if index == 4 else ""),
            map=MapCloud(measured_at=now, points=walls, incremental=index > 0),
            occupancy=OccupancyGrid(measured_at=now, cells=cells, origin=np.array([-8.0, -8.0]), resolution=0.25),
            plan=Plan(measured_at=now, path=path, trajectory=np.column_stack([path, np.zeros(3)])),
            drive=Drive(measured_at=now, linear=0.5, angular=0.1),
            text=Text(measured_at=now, text=f"tick {index}"),
        )
        if index + 1 >= self.config.ticks:
            yield End("round")

    def on_end(self) -> Summary:
        return Summary(reached=2, localization_error_m={"median": ERROR})


def ring(generator: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw points (count, 3) of a round wall, a floor, a person and a table, float32, and their classes, uint8."""
    angle, reach = generator.uniform(-math.pi, math.pi, count), generator.uniform(0.0, 6.0, count)
    height = generator.uniform(0.0, 2.5, count)
    classes = np.resize(np.array([2, 2, 1, 6, 4], np.uint8), count)
    radius = np.select([classes == 2, classes == 6], [6.0, 0.25], reach)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    points[classes == 1, 2] = 0.0
    points[classes == 6] = points[classes == 6] * (1.0, 1.0, 0.7) + (1.0, 1.0, 0.0)
    points[classes == 4] = points[classes == 4] * (0.2, 0.2, 0.0) + (-1.5, -1.0, 0.75)
    return points.astype(np.float32), classes


class _OldDrive(msgspec.Struct, frozen=True, kw_only=True):
    """What a drive command might have been once: of the same name, and not to be read as one."""

    measured_at: int
    velocity: str = "fast"


_OldDrive.__module__, _OldDrive.__qualname__, _OldDrive.__name__ = Drive.__module__, Drive.__qualname__, Drive.__name__


class OldRobot(Operator):
    """Say a few drive commands of an older vocabulary."""

    class Outputs(msgspec.Struct):
        drive: _OldDrive | None = None

    def on_tick(self, tick: Tick) -> Iterator[OldRobot.Outputs | End]:
        yield self.Outputs(_OldDrive(measured_at=tick.measured_at))
        if tick.index == 3:
            yield End()


class Scanner(Operator):
    """Have two scans to give, one under a name of its own."""

    class Outputs(msgspec.Struct):
        scan: PointCloud | None = None
        classified: PointCloud | None = None

    def on_tick(self, tick: Tick) -> None: ...
