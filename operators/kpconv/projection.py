"""From a frame to a range image and back: each point has a pixel, each pixel its nearest point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from operators.kpconv.grid import NONE, Floats, Ints
from operators.kpconv.links import Bytes

CHANNELS = 4  # of an image: filled, log of range, height over the ground, horizontal distance
REACH_ROWS, REACH_COLUMNS = 1, 3  # pixels around a point's own among which its nearest point is looked for


class Projection(NamedTuple):
    """A frame as an image; the first row is the lowest beam."""

    image: Floats  # (CHANNELS, rows, columns)
    winners: Ints  # (rows, columns) point that the pixel shows, -1 where it is empty
    row: Ints  # (n,) of each point
    column: Ints  # (n,)


def rows_of(points: Floats, ring: Bytes | None, beams: int) -> Ints:
    """Return the row of each point (n, 3), lidar's frame: its beam, or its elevation between the lowest and highest."""
    if ring is not None:
        most = int(ring.max(initial=0)) + 1
        rows = ring.astype(np.int32)
        return rows if most <= beams else (rows * beams // most).astype(np.int32)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    low, high = float(elevation.min(initial=0.0)), float(elevation.max(initial=0.0))
    share = (elevation - low) / max(high - low, 1e-6)
    return np.clip(np.round(share * (beams - 1)), 0, beams - 1).astype(np.int32)


def project(points: Floats, heights: Floats, ring: Bytes | None, *, beams: int, columns: int) -> Projection:
    """Project points (n, 3), lidar's frame, heights (n,) in metres over the ground; a pixel shows its nearest point."""
    flat = np.hypot(points[:, 0], points[:, 1])
    distance = np.sqrt(flat**2 + points[:, 2] ** 2)
    row = rows_of(points, ring, beams)
    share = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5
    column = np.floor(share * columns).astype(np.int32) % columns
    order = np.lexsort((heights, -distance))  # of equally far points the higher: no matter which order they came in
    winners = np.full((beams, columns), NONE, np.int32)
    winners[row[order], column[order]] = order
    filled = winners != NONE
    image = np.zeros((CHANNELS, beams, columns), np.float32)
    shown = winners[filled]
    image[:, filled] = np.stack([np.ones(len(shown)), np.log1p(distance[shown]), heights[shown], 0.1 * flat[shown]])
    return Projection(image, winners, row, column.astype(np.int32))


@njit(cache=True, nogil=True, error_model="numpy")
def back_project(points: Floats, winners: Ints, row: Ints, column: Ints) -> Ints:
    """Return for each point (n, 3) the pixel, row * columns + column, of the nearest point shown around it."""
    beams, columns = winners.shape
    pixels = np.empty(len(points), np.int32)
    for n in range(len(points)):
        own = row[n] * columns + column[n]
        pixels[n] = own
        if winners[row[n], column[n]] == n:
            continue
        best = math.inf
        for i in range(max(0, row[n] - REACH_ROWS), min(beams, row[n] + REACH_ROWS + 1)):
            for turn in range(column[n] - REACH_COLUMNS, column[n] + REACH_COLUMNS + 1):
                j = turn % columns
                w = winners[i, j]
                if w == NONE:
                    continue
                dx, dy, dz = points[w, 0] - points[n, 0], points[w, 1] - points[n, 1], points[w, 2] - points[n, 2]
                square = dx * dx + dy * dy + dz * dz
                if square < best:
                    best = square
                    pixels[n] = i * columns + j
    return pixels
