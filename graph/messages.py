"""The vocabulary of the robot: every message that operators exchange.

Frames: `world` is the building's (x, y on the floor, z up), `odom` starts where the robot starts, `base` is the robot's
centre on the floor (x forward, y left), `lidar` the sensor. Times are integer nanoseconds of logical time.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from graph.arrays import Array, array, unit

Nanoseconds = Annotated[int, unit("ns")]
Pose44 = array("float64", 4, 4, unit="m", about="homogeneous matrix")


class Message(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A message about the world: what was measured, and when."""

    measured_at: Nanoseconds


class Tick(Message, frozen=True, kw_only=True, eq=False):
    """A beat of a timer; `measured_at` is its own stamp."""

    index: int


class PointCloud(Message, frozen=True, kw_only=True, eq=False):
    """One scan, or a part of it, in the sensor's frame at `measured_at`.

    Optional arrays have one entry a point. Classes of `label`: 0 uncertain, 1 ground, 2 permanent, 3 longT, 4 shortT.
    Classes of `truth`: 0 unknown, 1 ground, 2 wall, 3 door, 4 table, 5 chair, 6 moving person, 7 still person.
    """

    points: Annotated[Array, array("float32", "n", 3, unit="m", frame="lidar")]
    base_from_lidar: Annotated[Array, Pose44]
    ring: Annotated[Array, array("uint8", "n", about="beam, lowest first")] | None = None
    time_offset: Annotated[Array, array("float32", "n", unit="s", about="after measured_at")] | None = None
    label: Annotated[Array, array("uint8", "n")] | None = None
    scores: Annotated[Array, array("float32", "n", 4, about="probability of labels 1 to 4")] | None = None
    truth: Annotated[Array, array("uint8", "n")] | None = None
    moving: Annotated[Array, array("bool", "n", about="its body moves right now")] | None = None
    instance: Annotated[Array, array("int32", "n", about="body number, unique within the session")] | None = None


class LaserScan(Message, frozen=True, kw_only=True, eq=False):
    """Ranges at even bearings, the fields of ROS's message of this name; bearing 0 is the base's x axis."""

    ranges: Annotated[Array, array("float32", "n", unit="m", about="inf where nothing was met")]
    angle_min: Annotated[float, unit("rad", about="bearing of the first range")]
    angle_increment: Annotated[float, unit("rad")]
    range_max: Annotated[float, unit("m")]
    sensor: Annotated[Array, array("float64", 2, unit="m", frame="base", about="where beams begin")]


class Odometry(Message, frozen=True, kw_only=True, eq=False):
    """Where wheels and gyro say the robot is; a simulator adds the truth."""

    odom_from_base: Annotated[Array, Pose44]
    linear: Annotated[float, unit("m/s", frame="base")]
    angular: Annotated[float, unit("rad/s", frame="base")]
    true_world_from_base: Annotated[Array, Pose44] | None = None


class Pose(Message, frozen=True, kw_only=True, eq=False):
    """Where a localizer says the robot is."""

    world_from_base: Annotated[Array, Pose44]
    valid: bool = True
    reason: str = ""  # why it is not valid
    inliers: float = 1.0  # share of the sampled points that found their plane in the map


class Drive(Message, frozen=True, kw_only=True, eq=False):
    """A velocity command to a differential drive."""

    linear: Annotated[float, unit("m/s", frame="base")]
    angular: Annotated[float, unit("rad/s", frame="base")]


class Goal(Message, frozen=True, kw_only=True, eq=False):
    """The target that the robot shall reach next."""

    target: Annotated[Array, array("float64", 2, unit="m", frame="world")]
    index: int  # of the target in its tour, from 0
    count: int  # targets of the tour


class OccupancyGrid(Message, frozen=True, kw_only=True, eq=False):
    """A 2-D map; `cells[row, column]` covers origin + resolution * (column .. column + 1, row .. row + 1)."""

    cells: Annotated[Array, array("int8", "rows", "columns", about="-1 unknown, 0 free to 100 occupied")]
    origin: Annotated[Array, array("float64", 2, unit="m", frame="world")]
    resolution: Annotated[float, unit("m")]


class MapCloud(Message, frozen=True, kw_only=True, eq=False):
    """Points of a map, or those added since the last message of this kind when `incremental`."""

    points: Annotated[Array, array("float32", "n", 3, unit="m", frame="world")]
    normals: Annotated[Array, array("float32", "n", 3)] | None = None
    score: Annotated[Array, array("float32", "n")] | None = None
    movable: Annotated[Array, array("float32", "n", about="movable probability")] | None = None
    label: Annotated[Array, array("uint8", "n")] | None = None
    incremental: bool = False


class Plan(Message, frozen=True, kw_only=True, eq=False):
    """What the planner intends: a path to the goal and the next seconds of motion."""

    path: Annotated[Array, array("float64", "n", 2, unit="m", frame="world")]
    trajectory: Annotated[Array, array("float64", "k", 3, unit="m, rad", frame="world", about="x, y, yaw")]
    status: str = "follow"  # follow, recover, unreachable, arrived, wait


class Tracks(Message, frozen=True, kw_only=True, eq=False):
    """People that are followed, in the order in which they were met."""

    identity: Annotated[Array, array("int32", "k", about="from 1, never given twice")]
    position: Annotated[Array, array("float64", "k", 2, unit="m", frame="world")]
    velocity: Annotated[Array, array("float64", "k", 2, unit="m/s", frame="world")]
    unseen: Annotated[Array, array("float32", "k", unit="s", about="since the last sighting")]
    blind: float = 1.15  # metres from the lidar: nearer, people may go unseen


class Truth(Message, frozen=True, kw_only=True, eq=False):
    """What a simulator knows: the true pose of the robot and of the people, and what it touches."""

    world_from_base: Annotated[Array, Pose44]
    people: Annotated[Array, array("float64", "p", 3, unit="m, m, rad", frame="world", about="x, y, heading")]
    people_moving: Annotated[Array, array("bool", "p")]
    people_instance: Annotated[Array, array("int32", "p")]
    contacts: Annotated[Array, array("int32", "c", about="instances in touch with the robot")]


class Text(Message, frozen=True, kw_only=True, eq=False):
    """A line for people to read."""

    text: str
    level: str = "info"  # debug, info, warning, error
