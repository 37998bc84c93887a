"""A building as data: walls, doors, pillars, rooms, table positions and tours, read from a YAML file.

Lengths in metres, angles in degrees in the file. Walls, rooms and doors are given by the centre lines of the walls.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt
import yaml

from sim.solids import Body, Box, Truth

Point = tuple[float, float]
Pose2 = tuple[float, float, float]  # x, y in metres, heading in degrees

SHIPPED = Path(__file__).parent / "buildings"
LEAF_THICKNESS = 0.04  # metres
ON_WALL = 0.01  # metres: a door this near to a wall's centre line belongs to the wall


class BuildingError(ValueError):
    """A building that cannot be used: every mistake by name and place, one a line."""


class WallStyle(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Measures of every wall of the building."""

    thickness: float = 0.15
    height: float = 2.5


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

    def leaf(self, angle: float, wall: WallStyle) -> Box:
        """Return the leaf, opened by `angle` radians (0: closed), turning at the wall's face on the swing side."""
        turn, side = math.radians(self.heading), 1.0 if self.swing == "left" else -1.0
        offset = side * (wall.thickness - LEAF_THICKNESS) / 2
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
    """An axis-aligned piece of wall, as imported buildings have them."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


class Room(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A room by the centre lines of its walls; people live in populated ones."""

    name: str
    polygon: list[Point]
    populated: bool = False

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
    walls: list[list[Point]] = []
    blocks: list[Block] = []
    passages: list[Passage] = []
    pillars: list[Pillar] = []
    doors: list[Door] = []
    rooms: list[Room] = []
    tables: list[TablePosition] = []
    tours: dict[str, Tour] = {}

    def segments(self) -> list[tuple[Point, Point]]:
        """Return the centre lines of the walls, one straight piece each."""
        return [(a, b) for line in self.walls for a, b in zip(line, line[1:], strict=False)]

    def bounds(self) -> tuple[float, float, float, float]:
        """Return x_min, y_min, x_max, y_max of all walls and blocks."""
        points = [point for line in self.walls for point in line]
        points += [corner[:2] for block in self.blocks for corner in (block.low, block.high)]
        if not points:
            raise BuildingError(f"building {self.name}: no walls; give walls, or boxes, or a map")
        ring, half = np.array(points), self.wall.thickness / 2
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

    def wall_bodies(self) -> list[Body]:
        """Return walls (cut by doors and passages), pillars and blocks as bodies."""
        bodies = [self._wall(index, a, b) for index, (a, b) in enumerate(self.segments())]
        for index, pillar in enumerate(self.pillars):
            box = Box(
                *pillar.at,
                self.wall.height / 2,
                *pillar.size,
                self.wall.height,
                math.radians(pillar.heading),
            )
            bodies.append(Body(f"pillar {index}", Truth.WALL, (box,)))
        for index, block in enumerate(self.blocks):
            low, high = np.array(block.low), np.array(block.high)
            bodies.append(Body(f"block {index}", Truth.WALL, (Box(*((low + high) / 2), *(high - low)),)))
        return bodies

    def openings(self, a: Point, b: Point) -> list[tuple[float, float, float]]:
        """Return (from, to, lintel) of the doors and passages in the wall a to b, as metres along it, in order."""
        start, direction, length = _line(a, b)
        found = []
        gaps = [(door.hinge, door.end(), door.lintel) for door in self.doors]
        gaps += [(gap.start, gap.end, self.wall.height if gap.lintel is None else gap.lintel) for gap in self.passages]
        for first, second, lintel in gaps:
            along, across = zip(*(_project(point, start, direction) for point in (first, second)), strict=True)
            if (
                max(abs(offset) for offset in across) < ON_WALL
                and min(along) > -ON_WALL
                and max(along) < length + ON_WALL
            ):
                found.append((min(along), max(along), lintel))
        return sorted(found)

    def _wall(self, index: int, a: Point, b: Point) -> Body:
        start, direction, length = _line(a, b)
        turn, thickness, height = math.atan2(direction[1], direction[0]), self.wall.thickness, self.wall.height

        def piece(first: float, last: float, low: float) -> Box:
            x, y = start + direction * (first + last) / 2
            return Box(float(x), float(y), (low + height) / 2, last - first, thickness, height - low, turn)

        parts: list[Box] = []
        reached = -thickness / 2  # walls reach half a thickness beyond their ends, which closes the corners
        for first, last, lintel in self.openings(a, b):
            if first > reached:
                parts.append(piece(reached, first, 0.0))
            if lintel < height:
                parts.append(piece(first, last, lintel))
            reached = max(reached, last)
        if length + thickness / 2 > reached:
            parts.append(piece(reached, length + thickness / 2, 0.0))
        return Body(f"wall {index}", Truth.WALL, tuple(parts))


def _line(a: Point, b: Point) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]:
    start, reach = np.array(a, np.float64), np.subtract(b, a)
    length = float(np.hypot(*reach))
    return start, reach / max(length, 1e-9), length


def _project(point: Point, start: npt.NDArray[np.float64], direction: npt.NDArray[np.float64]) -> tuple[float, float]:
    x, y = point[0] - start[0], point[1] - start[1]
    return float(x * direction[0] + y * direction[1]), float(y * direction[0] - x * direction[1])


def find(path: Path | str, shipped: Path = SHIPPED) -> Path:
    """Return the file that a path means: as it is, or one that comes with the package. Raises BuildingError."""
    path = Path(path)
    for candidate in (path, shipped.parents[1] / path, shipped / path, shipped / f"{path.name}.yaml"):
        if candidate.is_file():
            return candidate
    raise BuildingError(
        f"no file {path}; shipped are {', '.join(sorted(entry.stem for entry in shipped.glob('*.yaml')))}"
    )


def load(path: Path | str) -> Building:
    """Read a building from YAML.

    Raises BuildingError with file, line or field if the file is no YAML or not of the form. Geometry is not judged
    here.
    """
    source = find(path)
    try:
        content = yaml.safe_load(source.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BuildingError(f"{source}: not YAML: {error}") from error
    try:
        return msgspec.convert(content, Building)
    except msgspec.ValidationError as error:
        raise BuildingError(f"{source}: {error}") from error
