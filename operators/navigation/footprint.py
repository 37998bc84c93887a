"""The robot's outline on the floor, and how much room there is around it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit


class Footprint(NamedTuple):
    """A rectangle around the base, x forward."""

    length: float = 0.42  # metres
    width: float = 0.31

    @property
    def inscribed(self) -> float:
        """Radius in metres that is occupied whatever the heading."""
        return 0.5 * min(self.length, self.width)

    @property
    def circumscribed(self) -> float:
        """Radius in metres outside of which nothing is touched, whatever the heading."""
        return 0.5 * math.hypot(self.length, self.width)

    def body(self) -> Body:
        """Return the footprint as the kernels take it."""
        return Body(self.outline(), self.circumscribed)

    def outline(self, spacing: float = 0.05) -> npt.NDArray[np.float64]:
        """Return points (n, 2) on the border in the base frame, at most `spacing` metres apart, corners included."""
        along = np.linspace(-0.5, 0.5, math.ceil(self.length / spacing) + 1)
        across = np.linspace(-0.5, 0.5, math.ceil(self.width / spacing) + 1)[1:-1]
        sides = [(x * self.length, side * self.width) for side in (-0.5, 0.5) for x in along]
        ends = [(side * self.length, y * self.width) for side in (-0.5, 0.5) for y in across]
        return np.array(sides + ends)


class Surroundings(NamedTuple):
    """How near things are: distance (rows, columns) in metres from each cell's centre to that of the nearest occupied cell."""

    distance: npt.NDArray[np.float32]
    resolution: float  # metres
    x: float  # of the lower left corner, metres
    y: float


class Body(NamedTuple):
    """A footprint as the kernels take it."""

    outline: npt.NDArray[np.float64]  # (n, 2) metres, base frame
    circumscribed: float  # metres


@njit(cache=True)
def room(around: Surroundings, body: Body, enough: float, x: float, y: float, yaw: float) -> float:
    """Return the distance in metres between the outline and the nearest occupied cell's centre, or a lower bound >= enough.

    Beyond the surroundings nothing is known to stand: there it is `enough`.
    """
    rows, columns = around.distance.shape
    x, y = x - around.x, y - around.y
    row, column = math.floor(y / around.resolution), math.floor(x / around.resolution)
    if row < 0 or row >= rows or column < 0 or column >= columns:
        return enough
    least = float(around.distance[row, column]) - body.circumscribed
    if least >= enough:
        return least
    least = enough
    cosine, sine = math.cos(yaw), math.sin(yaw)
    for index in range(len(body.outline)):
        forward, left = body.outline[index, 0], body.outline[index, 1]
        row = math.floor((y + sine * forward + cosine * left) / around.resolution)
        column = math.floor((x + cosine * forward - sine * left) / around.resolution)
        if 0 <= row < rows and 0 <= column < columns:
            least = min(least, float(around.distance[row, column]))
    return least


def inside(
    footprint: Footprint, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], pose: tuple[float, float, float]
) -> npt.NDArray[np.bool_]:
    """Say which world positions lie within the footprint at a pose (x, y, yaw)."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    forward = cosine * (x - pose[0]) + sine * (y - pose[1])
    left = cosine * (y - pose[1]) - sine * (x - pose[0])
    return (np.abs(forward) <= 0.5 * footprint.length) & (np.abs(left) <= 0.5 * footprint.width)
