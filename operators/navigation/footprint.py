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
        return Body(self.outline(), self.circumscribed, (0.5 * self.length, 0.5 * self.width))

    def outline(self, spacing: float = 0.05) -> npt.NDArray[np.float64]:
        """Return points (n, 2) on the border in the base frame, at most `spacing` metres apart, corners included."""
        along = np.linspace(-0.5, 0.5, math.ceil(self.length / spacing) + 1)
        across = np.linspace(-0.5, 0.5, math.ceil(self.width / spacing) + 1)[1:-1]
        sides = [(x * self.length, side * self.width) for side in (-0.5, 0.5) for x in along]
        ends = [(side * self.length, y * self.width) for side in (-0.5, 0.5) for y in across]
        return np.array(sides + ends)


class Surroundings(NamedTuple):
    """How near things are: distance (rows, columns) in metres from each cell's centre to the nearest occupied one's."""

    distance: npt.NDArray[np.float32]
    resolution: float  # metres
    x: float  # of the lower left corner, metres
    y: float


class Body(NamedTuple):
    """A footprint as the kernels take it."""

    outline: npt.NDArray[np.float64]  # (n, 2) metres, base frame
    circumscribed: float  # metres
    half: tuple[float, float]  # of length and width, metres


@njit(cache=True)
def _between(around: Surroundings, column: float, row: float) -> float:
    """Interpolate the distance to an occupied cell's side, at a place in cells; nothing stands beyond the border."""
    rows, columns = around.distance.shape
    low_row, low_column = math.floor(row - 0.5), math.floor(column - 0.5)
    if low_row < 0 or low_row + 1 >= rows or low_column < 0 or low_column + 1 >= columns:
        return math.inf
    down, right = row - 0.5 - low_row, column - 0.5 - low_column
    lower = (1.0 - right) * around.distance[low_row, low_column] + right * around.distance[low_row, low_column + 1]
    upper = (1.0 - right) * around.distance[low_row + 1, low_column]
    upper += right * around.distance[low_row + 1, low_column + 1]
    return (1.0 - down) * lower + down * upper - 0.5 * around.resolution


@njit(cache=True)
def room(around: Surroundings, body: Body, enough: float, x: float, y: float, yaw: float) -> float:
    """Return the metres between the outline and the nearest occupied cell's side, or a lower bound >= enough.

    Beyond the surroundings nothing is known to stand: there it is `enough`.
    """
    column, row = (x - around.x) / around.resolution, (y - around.y) / around.resolution
    least = _between(around, column, row) - body.circumscribed
    if least >= enough:
        return least
    least = enough
    cosine, sine = math.cos(yaw) / around.resolution, math.sin(yaw) / around.resolution
    for index in range(len(body.outline)):
        forward, left = body.outline[index, 0], body.outline[index, 1]
        place = _between(around, column + cosine * forward - sine * left, row + sine * forward + cosine * left)
        least = min(least, place)
    return least


def inside(
    footprint: Footprint, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], pose: tuple[float, float, float]
) -> npt.NDArray[np.bool_]:
    """Say which world positions lie within the footprint at a pose (x, y, yaw)."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    forward = cosine * (x - pose[0]) + sine * (y - pose[1])
    left = cosine * (y - pose[1]) - sine * (x - pose[0])
    return (np.abs(forward) <= 0.5 * footprint.length) & (np.abs(left) <= 0.5 * footprint.width)
