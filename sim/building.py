"""A building as data: walls, doors, pillars, rooms, table positions and tours.

Lengths in metres, angles in degrees. Walls, rooms and doors are given by the centre lines of the walls.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from sim.solids import Box

Point = tuple[float, float]
Pose2 = tuple[float, float, float]  # x, y in metres, heading in degrees

LEAF_THICKNESS = 0.04  # metres


class BuildingError(ValueError):
    """A building that cannot be used: every mistake by name and place, one a line."""


class WallStyle(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Measures of every wall that has none of its own."""

    thickness: float = 0.15
    height: float = 2.5


class Wall(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A wall with measures of its own; one without is written as the bare line."""

    line: list[Point]
    thickness: float | None = None
    height: float | None = None


class Segment(NamedTuple):
    """One straight piece of a wall, along its centre line."""

    wall: int  # index of the wall in the file
    start: Point
    end: Point
    thickness: float
    height: float


class Door(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A door in a wall: opening from the hinge along `heading`; the leaf opens to the left or right of that."""

    hinge: Point
    heading: float
    name: str = ""
    width: float = 0.9
    lintel: float = 2.0  # height of the opening
    swing: Literal["left", "right"] = "left"
    angle: float | Literal["closed"] | None = None  # None: drawn for each session

    def end(self) -> Point:
        """Return the point of the opening opposite to the hinge."""
        turn = math.radians(self.heading)
        return self.hinge[0] + self.width * math.cos(turn), self.hinge[1] + self.width * math.sin(turn)

    def leaf(self, angle: float, thickness: float) -> Box:
        """Return the leaf, opened by `angle` radians (0: closed), at the swing side's face of a wall so thick."""
        turn, side = math.radians(self.heading), 1.0 if self.swing == "left" else -1.0
        offset = side * (thickness - LEAF_THICKNESS) / 2
        x, y = self.hinge[0] - offset * math.sin(turn), self.hinge[1] + offset * math.cos(turn)
        turn += side * angle
        length = self.width - 0.01  # a gap, so that the leaf does not cut into the jamb
        return Box(
            x + length / 2 * math.cos(turn),
            y + length / 2 * math.sin(turn),
            self.lintel / 2,
            length,
            LEAF_THICKNESS,
            self.lintel - 0.01,
            turn,
        )


class Passage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"start": "from", "end": "to"}):
    """An opening in a wall without a door, up to the lintel or to the top of the wall."""

    start: Point
    end: Point
    lintel: float | None = None


class Pillar(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A column as high as the walls."""

    at: Point
    size: Point = (0.4, 0.4)
    heading: float = 0.0


class Block(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A box of wall, as imported buildings have them: two corners, then turned by `heading` about the middle."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    heading: float = 0.0
    part_of: str = ""  # blocks of one name are one body


class Room(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A room by the centre lines of its walls, or by a rectangle; people live in populated ones."""

    name: str
    polygon: list[Point] = []
    rectangle: tuple[float, float, float, float] | None = None  # x_min, y_min, x_max, y_max
    populated: bool = False

    def __post_init__(self) -> None:
        if self.rectangle is not None and not self.polygon:
            x0, y0, x1, y1 = self.rectangle
            msgspec.structs.force_setattr(self, "polygon", [(x0, y0), (x1, y0), (x1, y1), (x0, y1)])

    def contains(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Say which of the points (n, 2) lie inside the polygon."""
        inside = np.zeros(len(points), np.bool_)
        x, y = points[:, 0], points[:, 1]
        for (x0, y0), (x1, y1) in zip(self.polygon, self.polygon[1:] + self.polygon[:1], strict=True):
            if y0 == y1:
                continue
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        return inside

    def area(self, wall: WallStyle) -> float:
        """Return the floor area in square metres: the polygon's, less half of the walls around it."""
        ring = np.array(self.polygon)
        following = np.roll(ring, -1, axis=0)
        area = abs(float(np.sum(ring[:, 0] * following[:, 1] - following[:, 0] * ring[:, 1]))) / 2
        return area - float(np.linalg.norm(following - ring, axis=1).sum()) * wall.thickness / 2 + wall.thickness**2


class TablePosition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A place where a table may stand, and the models that may stand there (none named: all)."""

    at: Point
    heading: float = 0.0
    models: list[str] = []


class Tour(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Targets in their order, and where the robot starts (absent: the building's start)."""

    targets: list[Point]
    start: Pose2 | None = None


class Building(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A building; see sim/buildings/default.yaml for an example of the file."""

    name: str = "building"
    wall: WallStyle = WallStyle()
    start: Pose2 | None = None
    boxes: str | None = None  # an ASCII PLY of boxes beside the file, raised to walls
    map: str | None = None  # a ROS map beside the file, its occupied cells raised to walls
    walls: list[list[Point] | Wall] = []
    blocks: list[Block] = []
    passages: list[Passage] = []
    pillars: list[Pillar] = []
    doors: list[Door] = []
    rooms: list[Room] = []
    tables: list[TablePosition] = []
    tours: dict[str, Tour] = {}

    def segments(self) -> list[Segment]:
        """Return the straight pieces of all walls."""
        found = []
        for index, entry in enumerate(self.walls):
            wall = entry if isinstance(entry, Wall) else Wall(entry)
            thickness = self.wall.thickness if wall.thickness is None else wall.thickness
            height = self.wall.height if wall.height is None else wall.height
            pairs = zip(wall.line, wall.line[1:], strict=False)
            found += [Segment(index, a, b, thickness, height) for a, b in pairs]
        return found

    def bounds(self) -> tuple[float, float, float, float]:
        """Return x_min, y_min, x_max, y_max of all walls and blocks. Raises BuildingError if there are none."""
        segments = self.segments()
        points = [point for segment in segments for point in (segment.start, segment.end)]
        for block in self.blocks:
            middle, reach = np.add(block.low, block.high)[:2] / 2, np.subtract(block.high, block.low)[:2] / 2
            if block.heading % 180.0:
                reach = np.full(2, math.hypot(*reach))
            points += [tuple(middle - reach), tuple(middle + reach)]
        if not points:
            raise BuildingError(f"building {self.name}: no walls; give walls, or boxes, or a map")
        ring, half = np.array(points), max([segment.thickness for segment in segments], default=0.0) / 2
        low, high = ring.min(0) - half, ring.max(0) + half
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def start_pose(self, tour: str) -> tuple[float, float, float]:
        """Return x, y (metres) and heading (radians) at which a tour starts. Raises BuildingError."""
        if tour not in self.tours:
            raise BuildingError(f"building {self.name} has no tour {tour!r}; it has {', '.join(self.tours) or 'none'}")
        start = self.tours[tour].start or self.start
        if start is None:
            raise BuildingError(f"building {self.name}: tour {tour} has no start, and the building has none")
        return start[0], start[1], math.radians(start[2])

    def room_of(self, point: Point) -> int:
        """Return the index of the first room that holds the point, or -1."""
        for index, room in enumerate(self.rooms):
            if room.contains(np.array([point]))[0]:
                return index
        return -1

    def populated_area(self) -> float:
        """Return the floor area of the populated rooms in square metres."""
        return sum(room.area(self.wall) for room in self.rooms if room.populated)
