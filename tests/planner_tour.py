"""A synthetic building of boxes, a ray-cast lidar, and a robot that moves as it is told, 100 ms later."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from graph.geometry import planar
from graph.messages import Goal, PointCloud, Pose
from operators.navigation.footprint import Footprint
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
