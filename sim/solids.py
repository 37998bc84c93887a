"""Boxes and prisms, of which all that stands still is made: the triangles that rays hit are those that collide."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Triangles = npt.NDArray[np.float64]  # (m, 3, 3)

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = np.array(
    [
        [[0, 1, 3], [0, 3, 2]],
        [[4, 6, 7], [4, 7, 5]],
        [[0, 4, 5], [0, 5, 1]],
        [[2, 3, 7], [2, 7, 6]],
        [[0, 2, 6], [0, 6, 4]],
        [[1, 5, 7], [1, 7, 3]],
    ]
).reshape(-1, 3)


class Box(NamedTuple):
    """An upright box: centre and full sizes in metres, heading of its x side in radians."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float
    yaw: float = 0.0

    def triangles(self) -> Triangles:
        """Return its twelve triangles (12, 3, 3), normals outward."""
        corners = _CORNERS * (self.dx, self.dy, self.dz)
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        turned = np.stack(
            [corners[:, 0] * cosine - corners[:, 1] * sine, corners[:, 0] * sine + corners[:, 1] * cosine], 1
        )
        placed = np.column_stack([turned, corners[:, 2]]) + np.array([self.x, self.y, self.z])
        return placed[_FACES]

    def moved(self, x: float, y: float, yaw: float) -> Box:
        """Place the box, given in a body's frame, with that body at (x, y, yaw) in the world."""
        cosine, sine = math.cos(yaw), math.sin(yaw)
        return Box(
            x + cosine * self.x - sine * self.y,
            y + sine * self.x + cosine * self.y,
            *self[2:6],
            self.yaw + yaw,
        )

    def footprint(self) -> npt.NDArray[np.float64]:
        """Return the corners of its ground rectangle (4, 2), counter-clockwise."""
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * (self.dx, self.dy)
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        return corners @ np.array([[cosine, sine], [-sine, cosine]]) + (self.x, self.y)


class Prism(NamedTuple):
    """An upright column with a regular polygon as ground plan: a round table top or leg. Metres."""

    x: float
    y: float
    z: float  # centre
    radius: float
    dz: float
    sides: int = 16
    yaw: float = 0.0

    def triangles(self) -> Triangles:
        """Return its triangles (4 sides - 4, 3, 3), normals outward."""
        angles = self.yaw + np.arange(self.sides) * (2 * np.pi / self.sides)
        ring = np.stack([self.x + self.radius * np.cos(angles), self.y + self.radius * np.sin(angles)], 1)
        low = np.concatenate([ring, np.full((self.sides, 1), self.z - self.dz / 2)], 1)
        high = np.concatenate([ring, np.full((self.sides, 1), self.z + self.dz / 2)], 1)
        i, j = np.arange(self.sides), (np.arange(self.sides) + 1) % self.sides
        fan = np.arange(1, self.sides - 1)
        return np.concatenate(
            [
                np.stack([low[i], low[j], high[j]], 1),
                np.stack([low[i], high[j], high[i]], 1),
                np.stack([np.broadcast_to(high[0], (len(fan), 3)), high[fan], high[fan + 1]], 1),
                np.stack([np.broadcast_to(low[0], (len(fan), 3)), low[fan + 1], low[fan]], 1),
            ]
        )

    def moved(self, x: float, y: float, yaw: float) -> Prism:
        """Place the prism, given in a body's frame, with that body at (x, y, yaw) in the world."""
        cosine, sine = math.cos(yaw), math.sin(yaw)
        return Prism(
            x + cosine * self.x - sine * self.y,
            y + sine * self.x + cosine * self.y,
            *self[2:6],
            self.yaw + yaw,
        )

    def footprint(self) -> npt.NDArray[np.float64]:
        """Return the corners of its ground polygon (sides, 2), counter-clockwise."""
        angles = self.yaw + np.arange(self.sides) * (2 * np.pi / self.sides)
        return np.stack([self.x + self.radius * np.cos(angles), self.y + self.radius * np.sin(angles)], 1)


Solid = Box | Prism


class Truth:
    """Classes of what a ray hit; the numbers are those of the recordings."""

    UNKNOWN, GROUND, WALL, DOOR, TABLE, CHAIR, MOVING_PERSON, STILL_PERSON = range(8)


class Body(NamedTuple):
    """A thing that stands still for a session: its parts, its class and what to call it."""

    name: str
    truth: int
    parts: tuple[Solid, ...]


def triangles_of(bodies: list[Body]) -> tuple[Triangles, npt.NDArray[np.int32]]:
    """Return the triangles (m, 3, 3) of all bodies and the index of the body of each (m,)."""
    pieces = [(part.triangles(), index) for index, body in enumerate(bodies) for part in body.parts]
    owner = np.concatenate([np.full(len(piece), index, np.int32) for piece, index in pieces])
    return np.concatenate([piece for piece, _ in pieces]), owner
