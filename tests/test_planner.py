"""The planner in a synthetic building: boxes, a ray-cast lidar, and a robot that moves as it is told, 100 ms later."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import njit

from graph.contract import ports_of
from graph.geometry import inverse, planar, transform
from graph.messages import Goal, OccupancyGrid, PointCloud, Pose, Tracks
from operators.navigation.footprint import Footprint
from operators.navigation.navigator import Navigator
from operators.planner import Planner

PERIOD = 100_000_000  # nanoseconds
LIDAR_HEIGHT = 0.64
BASE_FROM_LIDAR = planar(0.0, 0.0, 0.0, LIDAR_HEIGHT)
ELEVATION, AZIMUTH = np.meshgrid(np.radians(np.linspace(-30, 10, 16)), np.linspace(-np.pi, np.pi, 500, endpoint=False))
RAYS = np.stack(
    [np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)], axis=-1
).reshape(-1, 3)


def wall(x0, y0, x1, y1):
    return [x0, y0, 0.0, x1, y1, 2.5]


def two_rooms(door=(3.6, 4.5)):
    """8 x 8 m, a wall at x = 4 with a door 0.9 m wide."""
    return [
        wall(-0.15, -0.15, 0.0, 8.15),
        wall(8.0, -0.15, 8.15, 8.15),
        wall(0.0, -0.15, 8.0, 0.0),
        wall(0.0, 8.0, 8.0, 8.15),
        wall(3.925, 0.0, 4.075, door[0]),
        wall(3.925, door[1], 4.075, 8.0),
    ]


ROOM = two_rooms()[:4]


@njit(cache=True)
def cast(rays, origin, boxes):
    """Return the distance along each ray (n, 3) to the floor or the nearest box (b, 6)."""
    reach = np.empty(len(rays))
    for i in range(len(rays)):
        reach[i] = -origin[2] / rays[i, 2] if rays[i, 2] < 0.0 else np.inf
        for j in range(len(boxes)):
            enter, leave = 0.0, reach[i]
            for axis in range(3):
                slope = rays[i, axis] if abs(rays[i, axis]) > 1e-12 else 1e-12
                a, b = (boxes[j, axis] - origin[axis]) / slope, (boxes[j, axis + 3] - origin[axis]) / slope
                enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
            if 0.0 < enter <= leave:
                reach[i] = enter
    return reach


class Building:
    """Boxes (x0, y0, z0, x1, y1, z1) and a robot among them."""

    def __init__(self, boxes, pose):
        self.boxes = np.array(boxes, np.float64).reshape(-1, 6)
        self.pose = np.array(pose, np.float64)
        self.footprint = Footprint()
        self.least_room = math.inf

    def scan(self):
        """Cast the rays at the boxes and the floor; nothing nearer than 0.9 m echoes."""
        yaw = self.pose[2]
        turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1.0]])
        reach = cast(RAYS @ turn.T, np.array([self.pose[0], self.pose[1], LIDAR_HEIGHT]), self.boxes)
        seen = (reach > 0.9) & (reach < 30.0)
        return (RAYS[seen] * reach[seen, None]).astype(np.float32)

    def move(self, linear, angular):
        for _ in range(10):
            middle = self.pose[2] + 0.005 * angular
            self.pose += 0.01 * np.array([linear * math.cos(middle), linear * math.sin(middle), angular])
            self.least_room = min(self.least_room, self.room())

    def room(self):
        """Distance from the outline to the nearest box, 0 when touching."""
        outline = self.footprint.outline(0.01)
        cosine, sine = math.cos(self.pose[2]), math.sin(self.pose[2])
        points = outline @ np.array([[cosine, sine], [-sine, cosine]]) + self.pose[:2]
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 3:5]
        outside = np.maximum(np.maximum(low - points, points - high), 0.0)
        return float(np.hypot(outside[..., 0], outside[..., 1]).min()) if len(self.boxes) else math.inf


class Tour:
    """Drive a planner through a building, as graph.yaml wires it."""

    def __init__(self, building, targets, *, config=None, grid=None, noise=0.0, valid=True):
        self.building, self.targets = building, [np.array(target, np.float64) for target in targets]
        self.planner = Planner(config or Planner.Config())
        if grid is not None:
            self.planner.on_map(grid)
        self.random = np.random.default_rng(0)
        self.noise, self.valid = noise, valid
        self.reached, self.period = 0, 0
        self.drive = None
        self.poses, self.drives, self.statuses, self.outputs = [], [], [], []

    def step(self):
        stamp = self.period * PERIOD
        if self.drive is not None:
            self.building.move(self.drive.linear, self.drive.angular)
        while (
            self.reached < len(self.targets) and np.hypot(*(self.building.pose[:2] - self.targets[self.reached])) < 0.9
        ):
            self.reached += 1
        if self.reached < len(self.targets):
            self.planner.on_goal(
                Goal(measured_at=stamp, target=self.targets[self.reached], index=self.reached, count=len(self.targets))
            )
        self.planner.on_obstacles(
            PointCloud(measured_at=stamp, points=self.building.scan(), base_from_lidar=BASE_FROM_LIDAR)
        )
        x, y, yaw = self.building.pose + self.random.normal(0.0, 1.0, 3) * np.array([1.0, 1.0, 0.2]) * self.noise
        outputs = self.planner.on_pose(Pose(measured_at=stamp, world_from_base=planar(x, y, yaw), valid=self.valid))
        self.drive = outputs.drive
        self.outputs.append(outputs)
        self.poses.append(self.building.pose.copy())
        self.drives.append((outputs.drive.linear, outputs.drive.angular))
        self.statuses.append(outputs.plan.status)
        self.period += 1

    def run(self, seconds):
        while self.period * PERIOD < seconds * 1e9 and self.reached < len(self.targets):
            self.step()
        return self


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
