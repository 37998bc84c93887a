"""The planner among people, and beside what only a second lidar sees."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graph.geometry import inverse, planar, transform
from graph.messages import Goal, PointCloud, Pose, Tracks
from operators.planner import Planner
from tests.planner_tour import (
    BASE_FROM_LIDAR,
    LIDAR_HEIGHT,
    PERIOD,
    RAYS,
    ROOM,
    Building,
    Tour,
    cast,
    wall,
)


def beside_a_leaf(*, told):
    """Turn towards a goal behind, a door's leaf beside the robot that no frame has shown; return the least room."""
    leaf = wall(3.6, 4.225, 4.4, 4.265)
    tour = Tour(Building([*ROOM, leaf], [4.0, 4.0, 0.0]), [[2.0, 4.5]])
    xs = np.linspace(3.6, 4.4, 60)
    seen = np.stack([xs, np.full(60, 4.23), np.full(60, 0.5)], axis=1)
    for _ in range(80):
        if told:
            x, y, yaw = tour.building.pose
            points = transform(inverse(planar(x, y, yaw) @ BASE_FROM_LIDAR), seen).astype(np.float32)
            stamp = tour.period * PERIOD
            tour.planner.on_things(PointCloud(measured_at=stamp, points=points, base_from_lidar=BASE_FROM_LIDAR))
        tour.step()
    return tour.building.least_room


def test_what_stands_beside_the_robot_is_not_turned_into():
    assert beside_a_leaf(told=False) == 0.0
    assert beside_a_leaf(told=True) > 0.04


@pytest.mark.parametrize(("mode", "unseen", "struck"), [("predict", 0.0, 1), ("predict", 0.5, 2), ("ignore", 0.0, 2)])
def test_what_is_seen_at_somebody_is_theirs(mode, unseen, struck):
    """Two posts, one where a tracker has just seen somebody, who walks: it is their leg, labelled as a thing."""
    planner = Planner(Planner.Config(people=mode))
    planner.on_goal(Goal(measured_at=0, target=np.array([6.0, 0.0]), index=0, count=1))
    planner.on_tracks(
        Tracks(
            measured_at=0,
            identity=np.ones(1, np.int32),
            position=np.array([[2.0, 1.0]]),
            velocity=np.array([[0.0, 1.0]]),
            unseen=np.array([unseen], np.float32),
            blind=0.0,
        )
    )
    points = np.array([[2.02, 1.33, -0.2], [2.02, -1.2, -0.2]], np.float32)
    planner.on_pose(Pose(measured_at=0, world_from_base=planar(0.0, 0.0, 0.0)))
    planner.on_obstacles(PointCloud(measured_at=PERIOD, points=points, base_from_lidar=BASE_FROM_LIDAR))
    planner.on_pose(Pose(measured_at=PERIOD, world_from_base=planar(0.0, 0.0, 0.0)))
    assert planner.navigator.costmap.obstacles.filled.sum() == struck


def test_robot_hemmed_in_from_behind_gets_out_ahead():
    """People beside and behind who do not move, nobody before it: it cannot turn towards its goal where it stands."""
    around = [(0.45, 104.0), (0.68, -144.0), (0.86, 157.0), (0.95, 75.0), (1.0, -66.0), (1.05, -22.0), (0.8, -110.0)]
    people = np.array([[4.0 + r * math.cos(math.radians(b)), 4.0 + r * math.sin(math.radians(b))] for r, b in around])
    tour = Tour(Building(ROOM, [4.0, 4.0, 0.0]), [[2.0, 2.0]], config=Planner.Config(people="predict", braking=2.5))
    for _ in range(150):
        stamp = tour.period * PERIOD
        tour.planner.on_tracks(
            Tracks(
                measured_at=stamp,
                identity=np.arange(len(people), dtype=np.int32),
                position=people,
                velocity=np.zeros_like(people),
                unseen=np.zeros(len(people), np.float32),
                blind=0.0,
            )
        )
        tour.step()
        away = np.hypot(*(people - tour.building.pose[:2]).T)
        assert away.min() > 0.4
    assert max(math.dist(pose[:2], (4.0, 4.0)) for pose in tour.poses) > 0.3


def hidden_after(people_reach, *, told=True, blind=1.15):
    """Show a planner a person at a distance, its echoes kept only beyond the ring; return whom it keeps clear of."""
    planner = Planner(Planner.Config(people="predict"))
    origin = np.array([2.0, 2.0, LIDAR_HEIGHT])
    person = [2.0 + people_reach - 0.1, 1.85, 0.0, 2.0 + people_reach + 0.1, 2.15, 1.8]
    reach, clear = cast(RAYS, origin, np.array([*ROOM, person])), cast(RAYS, origin, np.array(ROOM))
    hit, seen = reach < clear, (reach >= 0.9) & (RAYS[:, 2] * reach + LIDAR_HEIGHT > 0.05)
    cloud = (RAYS * reach[:, None]).astype(np.float32)
    base = planar(2.0, 2.0, 0.0)
    planner.on_goal(Goal(measured_at=0, target=np.array([6.0, 6.0]), index=0, count=1))
    for frame in range(4):
        stamp = frame * PERIOD

        def part(keep, stamp=stamp):
            label = np.full(keep.sum(), 2, np.uint8)
            return PointCloud(measured_at=stamp, points=cloud[keep], base_from_lidar=BASE_FROM_LIDAR, label=label)

        planner.on_obstacles(part(seen & ~hit))
        if told:
            planner.on_people(part(seen & hit))
        nobody = np.zeros((0, 2))
        planner.on_tracks(
            Tracks(
                measured_at=stamp,
                identity=np.zeros(0, np.int32),
                position=nobody,
                velocity=nobody,
                unseen=np.zeros(0, np.float32),
                blind=blind,
            )
        )
        planner.on_pose(Pose(measured_at=stamp, world_from_base=base))
    return len(planner.navigator._walkers)


def test_who_gives_rays_back_is_seen_and_who_swallows_them_is_near():
    assert hidden_after(1.6) == 0
    assert hidden_after(0.6) == 1
    assert hidden_after(1.6, told=False) == 0  # whose rays come back nobody said


def test_nobody_is_suspected_where_the_tracker_sees_all():
    assert hidden_after(0.6, blind=0.0) == 0
