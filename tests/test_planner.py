"""The planner in a synthetic building."""

from __future__ import annotations

import numpy as np
import pytest

from graph.contract import ports_of
from graph.geometry import inverse, planar, transform
from graph.messages import Goal, OccupancyGrid, PointCloud, Pose
from operators.navigation.navigator import Navigator
from operators.planner import Planner
from tests.planner_tour import (
    BASE_FROM_LIDAR,
    PERIOD,
    ROOM,
    Building,
    Tour,
    two_rooms,
    wall,
)


def drive_limits_hold(tour):
    config = tour.planner.config
    drives = np.array([(0.0, 0.0), *tour.drives])
    change = np.abs(np.diff(drives, axis=0)).max(axis=0)
    return (
        drives[:, 0].max() <= config.max_speed
        and drives[:, 0].min() >= -config.max_reverse
        and np.abs(drives[:, 1]).max() <= config.max_turn
        and change[0] <= config.acceleration * 0.1 + 1e-9
        and change[1] <= config.turn_acceleration * 0.1 + 1e-9
    )


def test_ports_come_in_the_order_of_the_graph():
    assert list(ports_of(Planner).inputs) == ["goal", "map", "obstacles", "people", "things", "tracks", "pose"]
    assert list(ports_of(Planner).outputs) == ["drive", "plan"]


def test_without_a_goal_it_waits():
    outputs = Planner().on_pose(Pose(measured_at=0, world_from_base=planar(1.0, 2.0, 0.5)))
    assert (outputs.drive.linear, outputs.drive.angular) == (0.0, 0.0)
    assert outputs.plan.status == "wait"
    assert outputs.plan.path.shape == (0, 2)
    assert outputs.plan.trajectory.shape == (1, 3)


def test_tour_through_a_door_touches_nothing():
    """Three targets, a door 0.9 m wide twice, poses with 1 cm of noise, no map."""
    tour = Tour(Building(two_rooms(), (1.0, 1.0, 3.0)), [(7.0, 7.0), (1.0, 7.0), (6.0, 1.0)], noise=0.01).run(60)
    assert tour.reached == 3
    assert tour.building.least_room > 0.05
    assert drive_limits_hold(tour)
    way = np.hypot(*np.diff(np.array(tour.poses)[:, :2], axis=0).T).sum()
    assert way / (tour.period * 0.1) > 0.8


def test_two_runs_say_the_same():
    def run():
        tour = Tour(Building(two_rooms(), (1.0, 1.0, 0.0)), [(7.0, 7.0)], noise=0.01).run(8)
        return [
            (o.drive.linear, o.drive.angular, o.plan.path.tobytes(), o.plan.trajectory.tobytes()) for o in tour.outputs
        ]

    assert run() == run()


def test_box_that_appears_is_driven_around():
    tour = Tour(Building(ROOM, (1.0, 4.0, 0.0)), [(7.0, 4.0)]).run(2.0)
    ahead = tour.building.pose[0] + 1.3
    tour.building.boxes = np.vstack([tour.building.boxes, [[ahead, 3.4, 0.0, ahead + 0.4, 4.5, 0.7]]])
    tour.run(30)
    assert tour.reached == 1
    assert tour.building.least_room > 0.02


def test_low_box_is_remembered_in_the_blind_ring():
    """0.3 m high: from 1 m on the lidar looks over it."""
    boxes = [*ROOM, [3.0, 2.5, 0.0, 3.4, 5.5, 0.3]]
    tour = Tour(Building(boxes, (1.5, 4.0, 0.0)), [(7.0, 4.0)]).run(30)
    assert tour.reached == 1
    assert tour.building.least_room > 0.02


@pytest.mark.parametrize("room", [0.022, 0.03])
def test_robot_pushed_against_a_wall_gets_loose(room):
    """Beside a wall the room varies by a centimetre from cell to cell: without any slack no motion would be left."""
    tour = Tour(Building([*ROOM, wall(1.0, 5.0, 6.0, 5.5)], (1.5, 3.0, 0.0)), [(7.0, 3.0)]).run(2)
    tour.building.pose = np.array([3.2, 5.0 - 0.5 * tour.building.footprint.width - room, 0.0])
    tour.run(25)
    assert "recover" in tour.statuses
    assert tour.reached == 1


@pytest.mark.parametrize(("turn", "seconds"), [(0.0, 3.0), (0.3, 6.0)])
def test_robot_that_stays_in_one_place_is_stuck_even_if_it_turns(turn, seconds):
    navigator = Navigator()
    periods = 0
    while not navigator._stuck((0.01 * (periods % 3), 0.0, turn * 0.1 * periods)):
        periods += 1
        assert periods < 100
    assert periods + 1 == round(10 * seconds)
    creeping = Navigator()
    assert not any(creeping._stuck((0.03 * step, 0.0, 0.0)) for step in range(100))


def test_person_in_the_door_is_waited_for():
    boxes = [*two_rooms(), [3.8, 3.6, 0.0, 4.2, 4.5, 1.7]]
    tour = Tour(Building(boxes, (1.5, 4.0, 0.0)), [(7.0, 4.0)]).run(8)
    assert tour.reached == 0
    tour.building.boxes = tour.building.boxes[:-1]
    tour.run(30)
    assert tour.reached == 1
    assert tour.building.least_room > 0.02


def test_enclosed_goal_is_given_up_and_taken_up_again():
    around = [wall(4.9, 4.9, 7.1, 5.0), wall(4.9, 7.0, 7.1, 7.1), wall(4.9, 5.0, 5.0, 7.0), wall(7.0, 5.0, 7.1, 7.0)]
    tour = Tour(Building([*ROOM, *around], (1.5, 2.0, 1.0)), [(6.0, 6.0)]).run(30)
    assert tour.reached == 0
    assert tour.statuses[-1] == "unreachable"
    assert tour.drives[-1] == (0.0, 0.0)
    assert tour.building.least_room > 0.02
    tour.building.boxes = tour.building.boxes[:-4]
    tour.run(60)
    assert tour.reached == 1


def test_blocked_target_is_approached():
    """A chair stands on the target: half a metre beside it the goal's radius is reached."""
    tour = Tour(Building([*ROOM, [5.7, 3.7, 0.0, 6.3, 4.3, 0.8]], (2.0, 4.0, 2.0)), [(6.0, 4.0)]).run(20)
    assert tour.reached == 1


def test_target_is_stopped_at():
    tour = Tour(Building(ROOM, (2.0, 2.0, 0.0)), [(6.0, 4.0)])
    tour.reached = -1  # a simulator that never says that it is reached
    tour.targets = [tour.targets[0]] * 2
    for _ in range(120):
        tour.reached = 0
        tour.step()
    assert tour.statuses[-1] == "arrived"
    assert np.hypot(*(tour.building.pose[:2] - tour.targets[0])) < 0.4


def test_uncertain_pose_slows_down():
    tour = Tour(Building(ROOM, (1.5, 4.0, 0.0)), [(7.0, 4.0)], valid=False).run(3)
    assert 0.2 < max(speed for speed, _ in tour.drives) <= 0.4 + 1e-9


def test_robot_that_is_held_plans_from_the_speed_that_it_has():
    """It does not push on at full speed, but gathers speed anew until it notices again that it does not get on."""
    building = Building(ROOM, (1.5, 4.0, 0.0))
    tour = Tour(building, [(7.0, 4.0)]).run(1.5)
    before = tour.drives[-1][0]
    held = building.pose.copy()
    pushing = []
    for _ in range(12):
        building.pose = held.copy()
        tour.step()
        pushing.append(tour.drives[-1][0])
    assert before > 1.0
    assert min(pushing) < 0.2
    assert max(pushing[2:]) < 0.8
    tour.run(10)
    assert tour.reached == 1


def test_map_leads_around_what_the_lidar_cannot_see():
    """The door of the wall ahead is known from the map before the lidar has seen anything."""
    cells = np.zeros((160, 160), np.int8)
    cells[0], cells[-1], cells[:, 0], cells[:, -1], cells[:, 80] = [100] * 5
    cells[130:148, 80] = 0
    grid = OccupancyGrid(measured_at=0, cells=cells, origin=np.zeros(2), resolution=0.05)
    planner = Planner()
    planner.on_goal(Goal(measured_at=0, target=np.array([7.0, 1.0]), index=0, count=1))
    planner.on_map(grid)
    path = planner.on_pose(Pose(measured_at=0, world_from_base=planar(1.0, 1.0, 0.0))).plan.path
    crossing = path[np.abs(path[:, 0] - 4.025).argmin()]
    assert 6.6 < crossing[1] < 7.3
    assert np.hypot(*(path[-1] - [7.0, 1.0])) < 0.1


@pytest.mark.parametrize("late", [0, 1, 3])
def test_frames_are_placed_where_they_were_taken(late):
    """A frame that comes some periods after its pose, while the robot turns, still hits the wall's cells."""
    planner = Planner()
    planner.on_goal(Goal(measured_at=0, target=np.array([30.0, 0.0]), index=0, count=1))
    wall_points = np.stack([np.full(200, 3.0), np.linspace(-2.0, 2.0, 200), np.full(200, 0.6)], axis=1)
    for period in range(8):
        world_from_base = planar(0.1 * period, 0.0, 0.2 * period)
        if period >= late:
            taken = period - late
            world_from_lidar = planar(0.1 * taken, 0.0, 0.2 * taken) @ BASE_FROM_LIDAR
            points = transform(inverse(world_from_lidar), wall_points).astype(np.float32)
            points.flags.writeable = False
            planner.on_obstacles(PointCloud(measured_at=taken * PERIOD, points=points, base_from_lidar=BASE_FROM_LIDAR))
        planner.on_pose(Pose(measured_at=period * PERIOD, world_from_base=world_from_base))
    costmap = planner.navigator.costmap
    x, _ = costmap.lattice.centre(*np.nonzero(costmap.obstacles.filled))
    assert len(x) >= 75
    assert np.abs(x - 3.0).max() < 0.051


def test_frame_before_its_pose_waits_for_it():
    planner = Planner()
    planner.on_pose(Pose(measured_at=0, world_from_base=planar(0.0, 0.0, 0.0)))
    points = np.array([[2.0, 0.0, 0.0]], np.float32)
    planner.on_obstacles(PointCloud(measured_at=2 * PERIOD, points=points, base_from_lidar=BASE_FROM_LIDAR))
    planner.on_pose(Pose(measured_at=PERIOD, world_from_base=planar(0.5, 0.0, 0.0)))
    assert not planner.navigator.costmap.obstacles.filled.any()
    planner.on_pose(Pose(measured_at=2 * PERIOD, world_from_base=planar(1.0, 0.0, 0.0)))
    costmap = planner.navigator.costmap
    x, _ = costmap.lattice.centre(*np.nonzero(costmap.obstacles.filled))
    assert np.abs(x - 3.0).max() < 0.05
