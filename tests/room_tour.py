"""A recorded drive through a room of boxes, with truth; tests of the annotation make their sessions of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.contract import End, Source
from graph.geometry import planar, transform
from graph.graphfile import Clock, Graph, OperatorEntry
from graph.inprocess import launch_in_process
from graph.messages import Goal, Odometry, PointCloud, Pose
from tests.test_pointmap_room import BASE_FROM_LIDAR, BOXES, rays, scan

PERIOD = 100_000_000  # ns
CUPBOARD = (np.array([4.5, 3.0, 0.0]), np.array([5.3, 3.8, 1.6]))  # stands in the mapping session, then is gone
CHAIR = (np.array([-1.5, -2.2, 0.0]), np.array([-1.0, -1.7, 0.9]))
GROUND, WALL, CHAIR_TRUTH, WALKER = 1, 2, 5, 6
DIRECTIONS = rays(columns=512)


def place(step: int, shift: float = 0.0) -> np.ndarray:
    """Where the robot is at a step: on its way through the room and back."""
    angle = 2.0 * np.pi * step / 40.0 + shift
    return planar(0.2 + 2.0 * np.cos(angle), -0.8 + 0.6 * np.sin(angle), angle)


def walker(step: int) -> tuple[np.ndarray, np.ndarray]:
    """The box of somebody who walks along the room."""
    low = np.array([-2.5 + 0.12 * step, 3.0, 0.0])
    return low, low + np.array([0.35, 0.35, 1.7])


def inside(points: np.ndarray, box: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return ((points > box[0] - 0.05) & (points < box[1] + 0.05)).all(axis=1)


class RoomTour(Source):
    """Drive around, and give frames, odometry, goals and poses."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        steps: int = 40
        cupboard: bool = False
        chair: bool = False
        walks: bool = False
        poses: bool = True
        goals: int = 2
        reach: int = 2  # goals that lie on the way
        shift: float = 0.0  # metres that the poses are wrong, sideways
        invalid: int = 0  # poses
        skipped: int = 0  # frames without a pose
        seed: int = 0
        frame_points: int = -1  # -1: all

    class Outputs(msgspec.Struct):
        frame: PointCloud | None = None
        odometry: Odometry | None = None
        pose: Pose | None = None
        goal: Goal | None = None

    config: Config

    def stream(self) -> Iterator[tuple[int, Any]]:
        for step in range(self.config.steps):
            outputs = self.outputs(step)
            yield step * PERIOD, outputs if step < self.config.steps - 1 else [outputs, End("done")]

    def outputs(self, step: int) -> Outputs:
        c = self.config
        base = place(step)
        things = [(CHAIR, CHAIR_TRUTH)] * c.chair + [(walker(step), WALKER)] * c.walks + [(CUPBOARD, 4)] * c.cupboard
        boxes = (*BOXES, *(box for box, _ in things))
        points = scan(base @ BASE_FROM_LIDAR, DIRECTIONS, boxes, noise=0.005, seed=1000 * c.seed + step)
        if c.frame_points >= 0:
            points = points[: c.frame_points]
        world = transform(base @ BASE_FROM_LIDAR, points.astype(np.float64))
        truth = np.where(world[:, 2] < 0.05, GROUND, WALL).astype(np.uint8)
        for box, kind in things:
            truth[inside(world, box) & (world[:, 2] > 0.05)] = kind
        stamp = step * PERIOD
        goal_steps = [min(c.steps - 1, (n + 1) * c.steps // c.goals) for n in range(c.goals)]
        index = min(sum(step > s for s in goal_steps), c.goals - 1)
        on_way = index < c.reach
        target = place(goal_steps[index])[:2, 3] if on_way else np.array([30.0, 30.0])
        said = base.copy()
        said[1, 3] += c.shift
        pose = Pose(measured_at=stamp, world_from_base=said, valid=step >= c.invalid, inliers=0.98)
        return self.Outputs(
            PointCloud(
                measured_at=stamp,
                points=points,
                base_from_lidar=BASE_FROM_LIDAR,
                truth=truth,
                moving=truth == WALKER,
                instance=truth.astype(np.int32),
            ),
            Odometry(measured_at=stamp, odom_from_base=base, linear=0.5, angular=0.5),
            pose if c.poses and step >= c.skipped else None,
            Goal(measured_at=stamp, target=target, index=index, count=c.goals),
        )


def record(path: Path, **config: Any) -> Path:
    """Record a drive; config as in RoomTour.Config."""
    entry = OperatorEntry(run="tests.room_tour:RoomTour", config=config)
    root = str(Path(__file__).parents[1])
    graph = Graph(clock=Clock(end="sensor"), operators={"sensor": entry}, name="tour", root=root)
    launch_in_process(graph, record=path)
    return path
