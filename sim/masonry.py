"""Walls of a building as bodies: cut by doors and passages, closed at the corners."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sim.building import Building, Point, Segment
from sim.solids import Body, Box, Truth

ON_WALL = 0.01  # metres: a door this near to a wall's centre line belongs to the wall


def wall_bodies(building: Building) -> list[Body]:
    """Return walls, pillars and blocks as bodies; blocks that are parts of one thing make one body."""
    bodies = [_wall(building, index, segment) for index, segment in enumerate(building.segments())]
    height = building.wall.height
    for index, pillar in enumerate(building.pillars):
        box = Box(*pillar.at, height / 2, *pillar.size, height, math.radians(pillar.heading))
        bodies.append(Body(f"pillar {index}", Truth.WALL, (box,)))
    things: dict[str, list[Box]] = {}
    for index, block in enumerate(building.blocks):
        low, high = np.array(block.low), np.array(block.high)
        x, y, z = ((low + high) / 2).tolist()
        dx, dy, dz = (high - low).tolist()
        box = Box(x, y, z, dx, dy, dz, math.radians(block.heading))
        things.setdefault(block.part_of or f"block {index}", []).append(box)
    return bodies + [Body(name, Truth.WALL, tuple(parts)) for name, parts in things.items()]


def door_leaf(building: Building, index: int, angle: float) -> Body:
    """Return the leaf of a door, opened by an angle in radians."""
    door = building.doors[index]
    thickness = next(
        (segment.thickness for segment in building.segments() if lies_on(door.hinge, segment)), building.wall.thickness
    )
    return Body(f"door {door.name or index}", Truth.DOOR, (door.leaf(angle, thickness),))


def place_on(point: Point, segment: Segment) -> tuple[float, float]:
    """Return where a point lies along a wall from its start, and how far to the left of it, in metres."""
    direction, _ = _direction(segment)
    x, y = point[0] - segment.start[0], point[1] - segment.start[1]
    return float(x * direction[0] + y * direction[1]), float(y * direction[0] - x * direction[1])


def openings(building: Building, segment: Segment) -> list[tuple[float, float, float]]:
    """Return (from, to, lintel) of the doors and passages in a wall, as metres along it, in order."""
    gaps = [(door.hinge, door.end(), door.lintel) for door in building.doors]
    for gap in building.passages:
        gaps.append((gap.start, gap.end, segment.height if gap.lintel is None else gap.lintel))
    found = []
    for first, second, lintel in gaps:
        if lies_on(first, segment) and lies_on(second, segment):
            along = place_on(first, segment)[0], place_on(second, segment)[0]
            found.append((min(along), max(along), lintel))
    return sorted(found)


def lies_on(point: Point, segment: Segment) -> bool:
    """Say whether a point lies on a wall's centre line."""
    along, across = place_on(point, segment)
    return abs(across) < ON_WALL and -ON_WALL < along < _direction(segment)[1] + ON_WALL


def _direction(segment: Segment) -> tuple[npt.NDArray[np.float64], float]:
    reach = np.subtract(segment.end, segment.start)
    length = float(np.hypot(*reach))
    return reach / max(length, 1e-9), length


def _wall(building: Building, index: int, segment: Segment) -> Body:
    direction, length = _direction(segment)
    start, thickness, height = np.array(segment.start, np.float64), segment.thickness, segment.height
    turn = math.atan2(direction[1], direction[0])

    def piece(first: float, last: float, low: float) -> Box:
        x, y = start + direction * (first + last) / 2
        return Box(float(x), float(y), (low + height) / 2, last - first, thickness, height - low, turn)

    parts: list[Box] = []
    beyond = thickness / 2 - 0.002  # metres past the ends, which closes corners; short of the other wall's face, so
    reached = -beyond  # that every point of a face belongs to one wall
    for first, last, lintel in openings(building, segment):
        if first > reached:
            parts.append(piece(reached, first, 0.0))
        if lintel < height:
            parts.append(piece(first, last, lintel))
        reached = max(reached, last)
    if length + beyond > reached:
        parts.append(piece(reached, length + beyond, 0.0))
    return Body(f"wall {index}", Truth.WALL, tuple(parts))
