"""The frustum grid of a frame: how far each direction is seen to be free."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.angles import arctangent

Floats = npt.NDArray[np.float32]

LEAST_MARGIN = 0.03  # metres
TILES = 360  # of a turn, for the coarse looks
SLACK = 1e-4  # radians; angles in single precision


class Frustums(NamedTuple):
    """A depth image in elevation (rows from below) and azimuth (columns from -pi); depths in metres."""

    free: Floats  # (rows, columns) smallest range less the margin; 0 where nothing was measured
    freest: Floats  # (rows, TILES) largest entry of `free` in each degree of azimuth
    farthest: Floats  # (TILES,) largest of the smallest ranges in each degree of azimuth
    lowest: float  # elevation of the lower edge of row 0, radians
    height: float  # of a row, radians
    width: float  # of a column, radians


@njit(cache=True, error_model="numpy")
def frustum_grid(rho: Floats, theta: Floats, phi: Floats, height: float, width: float) -> Frustums:
    """Keep the smallest range of each frustum and take the margin off (paper eq. 2).

    rho, theta, phi: range, elevation, azimuth of the points of a frame (n,). height, width: of a frustum, radians. Rows
    are laid so that the lowest beam runs through the middle of row 0. The margin is the half height of the frustum at
    that range: a surface seen at less than 45 degrees of incidence is never taken for free space.
    """
    columns = max(1, round(2.0 * math.pi / width))
    width = 2.0 * math.pi / columns
    low, high = np.float32(np.inf), np.float32(-np.inf)
    for i in range(len(theta)):
        low, high = min(low, theta[i]), max(high, theta[i])
    if not low <= high:
        low, high = np.float32(0.0), np.float32(0.0)
    lowest = float(low) - 0.5 * height
    rows = int((high - lowest) / height) + 1
    nearest = np.full((rows, columns), np.float32(np.inf), np.float32)
    farthest = np.zeros(TILES, np.float32)
    for i in range(len(rho)):
        row = min(rows - 1, int((theta[i] - lowest) * (1.0 / height)))
        column = min(columns - 1, max(0, int((phi[i] + math.pi) * (1.0 / width))))
        nearest[row, column] = min(nearest[row, column], rho[i])
        tile = min(TILES - 1, int((phi[i] + math.pi) * (TILES / (2.0 * math.pi))))
        farthest[tile] = max(farthest[tile], rho[i])
    freest = np.zeros((rows, TILES), np.float32)
    share, least = np.float32(0.5 * height), np.float32(LEAST_MARGIN)
    for row in range(rows):
        line = nearest[row]
        for column in range(columns):
            rho_0 = line[column] if line[column] < np.float32(np.inf) else np.float32(0.0)
            line[column] = max(np.float32(0.0), rho_0 - max(least, rho_0 * share))
    tiles = np.arange(columns) * TILES // columns  # of each column the first that it touches
    for row in range(rows):
        for column in range(columns):
            for tile in range(tiles[column], (tiles[column + 1] if column + 1 < columns else TILES - 1) + 1):
                freest[row, tile] = max(freest[row, tile], nearest[row, column])
    return Frustums(nearest, freest, farthest, lowest, height, width)


@njit(cache=True, error_model="numpy")
def hidden(frustums: Frustums, x: float, y: float, z: float, radius: float) -> bool:
    """Say whether a ball around (x, y, z), in the sensor's frame, lies behind everything that was measured."""
    level = math.sqrt(x * x + y * y)
    distance = math.sqrt(level * level + z * z)
    if distance <= radius:
        return False
    lowest, highest = frustums.lowest, frustums.lowest + frustums.free.shape[0] * frustums.height
    tilt, spread_of_tilt = arctangent(z, level), math.asin(radius / distance)
    if tilt + spread_of_tilt < lowest - SLACK or tilt - spread_of_tilt > highest + SLACK:
        return True
    half = math.pi if level <= radius else math.asin(radius / level) + SLACK
    tile = 2.0 * math.pi / TILES
    first = math.floor((arctangent(y, x) + math.pi - half) / tile)
    last = math.floor((arctangent(y, x) + math.pi + half) / tile)
    for n in range(first, min(last, first + TILES - 1) + 1):
        if frustums.farthest[n % TILES] > distance - radius:
            return False
    return True


@njit(cache=True, error_model="numpy")
def behind(frustums: Frustums, rho: float, theta: float, phi: float, level: float, radius: float) -> bool:
    """Say whether nothing is seen to be free as far as a small ball, whose centre lies in this direction.

    rho, level: metres from the sensor to the centre, in space and in the sensor's xy plane. A ball that is near for its
    radius is never behind: its angles would be too wide for a quick look.
    """
    if rho < 2.0 * radius or level < 2.0 * radius:
        return False
    nearest = rho - radius
    tall = 1.05 * radius / rho + SLACK  # above the arc sine of all that is below a half
    wide = 1.05 * radius / level + SLACK
    per_row = 1.0 / frustums.height
    low = max(0, math.floor((theta - tall - frustums.lowest) * per_row))
    high = min(frustums.free.shape[0] - 1, math.floor((theta + tall - frustums.lowest) * per_row))
    first = math.floor((phi - wide + math.pi) * (TILES / (2.0 * math.pi)))
    last = math.floor((phi + wide + math.pi) * (TILES / (2.0 * math.pi)))
    for tile in range(first, last + 1):
        column = tile + TILES if tile < 0 else (tile - TILES if tile >= TILES else tile)
        for row in range(low, high + 1):
            if frustums.freest[row, column] > nearest:
                return False
    return True
