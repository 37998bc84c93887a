"""Normals of a lidar frame: neighbourhoods in spherical space, PCA, and how far to trust the result."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.angles import logarithms
from operators.pointmap.eigen import smallest_direction

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]

RANGE_SCALE = 8.0  # log range over 8: a ball of 2 degrees reaches +-31 % in range
AZIMUTH_SCALE = 2.0  # the ball is half as wide as it is high
GRAZING = 5.0 * math.pi / 12.0  # incidence above which the sensor does not face the surface
IDEAL_RANGE = 2.0  # metres
LEAST_NEIGHBOURS = 4
ROWS_PER_RADIUS, COLUMNS_PER_RADIUS = 1.5, 8.0  # a row is as high as beams are apart, where the radius is 1.5 of that

# Single precision throughout: a constant in double precision would convert every operand of the innermost loop.
ZERO, ONE = np.float32(0.0), np.float32(1.0)
TURN = np.float32(2.0 * math.pi)
ACROSS = np.float32(AZIMUTH_SCALE)


class Bins(NamedTuple):
    """The points of a frame, sorted by elevation row and azimuth column."""

    first: Ints  # (rows * columns + 1,) start of each bin among the sorted
    points: Floats  # (n, 6) sorted: x y z, depth (log range over 8), elevation, azimuth
    rows: int
    columns: int
    lowest: float  # elevation of the lower edge of row 0
    height: float  # of a row, radians
    width: float  # of a column, radians; columns go once around


@njit(cache=True, error_model="numpy")
def number_bins(
    theta: Floats, phi: Floats, lowest: float, height: float, width: float, rows: int, columns: int
) -> Ints:
    """Return the bin (n,) of each direction."""
    bins = np.empty(len(theta), np.int32)
    per_height, per_width = 1.0 / height, 1.0 / width
    for i in range(len(theta)):
        row = min(rows - 1, int((theta[i] - lowest) * per_height))
        column = min(columns - 1, int((phi[i] + math.pi) * per_width))
        bins[i] = row * columns + column
    return bins


@njit(cache=True, error_model="numpy")
def bin_directions(x: Floats, y: Floats, z: Floats, depth: Floats, theta: Floats, phi: Floats, radius: float) -> Bins:
    """Sort points (n,) by direction into rows of 2/3 of the radius and columns of an eighth of it; keeps their order.

    The lowest beam runs through the middle of its row, and so do all others of a lidar with even beams.
    """
    count = len(theta)
    height = radius / ROWS_PER_RADIUS
    columns = max(8, int(2.0 * math.pi * COLUMNS_PER_RADIUS / radius))
    width = 2.0 * math.pi / columns
    low, high = np.float32(4.0), np.float32(-4.0)
    for i in range(count):
        low, high = min(low, theta[i]), max(high, theta[i])
    lowest = float(low) - 0.5 * height
    rows = max(1, int((high - lowest) / height) + 1)
    bins = number_bins(theta, phi, lowest, height, width, rows, columns)
    first = np.zeros(rows * columns + 2, np.int32)  # two on: after the scatter below it is one on
    for i in range(count):
        first[bins[i] + 2] += 1
    for i in range(2, len(first)):
        first[i] += first[i - 1]
    points = np.empty((count, 6), np.float32)
    for i in range(count):
        place = first[bins[i] + 1]
        first[bins[i] + 1] = place + 1
        points[place, 0], points[place, 1], points[place, 2] = x[i], y[i], z[i]
        points[place, 3], points[place, 4], points[place, 5] = depth[i], theta[i], phi[i]
    return Bins(first[:-1], points, rows, columns, lowest, height, width)


@njit(cache=True, error_model="numpy")
def covariances(
    x: Floats, y: Floats, z: Floats, depth: Floats, theta: Floats, phi: Floats, chosen: Ints, radius: float
) -> Floats:
    """Return xx xy xz yy yz zz (6, m) of the neighbours of the chosen points; zeros where fewer than 4 are near.

    The innermost loop weighs by 0 or 1 instead of branching: which neighbours are near cannot be predicted.
    """
    first, points, rows, columns, lowest, height, width = bin_directions(x, y, z, depth, theta, phi, radius)
    result = np.zeros((6, len(chosen)), np.float32)
    spread = min(int(radius / AZIMUTH_SCALE / width) + 1, (columns - 1) // 2)
    per_height, per_width = 1.0 / height, 1.0 / width
    square = np.float32(radius * radius)
    reach = (1.0 - 1e-6) * radius  # three even rows of beams, not the edge of a fourth
    for k in range(len(chosen)):
        i = chosen[k]
        px, py, pz = x[i], y[i], z[i]
        d, t, f = depth[i], theta[i], phi[i]
        low = max(0, math.floor((t - reach - lowest) * per_height))
        high = min(rows - 1, math.floor((t + reach - lowest) * per_height))
        centre = min(columns - 1, int((f + math.pi) * per_width))
        left, right = centre - spread, centre + spread
        near, mx, my, mz = ZERO, ZERO, ZERO, ZERO
        xx, xy, xz, yy, yz, zz = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        for row in range(low, high + 1):
            # Columns beyond the seam of the azimuth are read at its other side, one turn away.
            for part in range(2 if left < 0 or right >= columns else 1):
                a, b, g = max(0, left), min(columns - 1, right), f
                if part == 1 and left < 0:
                    a, b, g = left + columns, columns - 1, f + TURN
                elif part == 1:
                    a, b, g = 0, right - columns, f - TURN
                for j in range(first[row * columns + a], first[row * columns + b + 1]):
                    dd, dt, df = points[j, 3] - d, points[j, 4] - t, ACROSS * (points[j, 5] - g)
                    inside = ONE if dd * dd + dt * dt + df * df < square else ZERO
                    dx, dy, dz = points[j, 0] - px, points[j, 1] - py, points[j, 2] - pz
                    wx, wy, wz = inside * dx, inside * dy, inside * dz
                    near += inside
                    mx, my, mz = mx + wx, my + wy, mz + wz
                    xx, xy, xz = xx + wx * dx, xy + wx * dy, xz + wx * dz
                    yy, yz, zz = yy + wy * dy, yz + wy * dz, zz + wz * dz
        if near < np.float32(LEAST_NEIGHBOURS):
            continue
        share = ONE / near
        mx, my, mz = mx * share, my * share, mz * share
        result[0, k], result[1, k], result[2, k] = xx * share - mx * mx, xy * share - mx * my, xz * share - mx * mz
        result[3, k], result[4, k], result[5, k] = yy * share - my * my, yz * share - my * mz, zz * share - mz * mz
    return result


@njit(cache=True, error_model="numpy", inline="always")
def decay(u: float) -> float:
    """Return exp(-u) for u >= 0, exact to about u^4 / 2e10; vectorized, and equal on every machine."""
    t = min(u, 80.0) * (1.0 / 1024.0)
    e = 1.0 - t * (1.0 - t * (0.5 - t * (1.0 / 6.0)))
    for _ in range(10):
        e = e * e
    return e


@njit(cache=True, error_model="numpy", inline="always")
def trust(planarity: float, cosine: float, rho: float) -> float:
    """Return the score of a normal in [0, 1]: planarity times how well the sensor faced the surface from how near.

    planarity: 1 - smallest / largest eigenvalue. cosine: of the incidence angle. rho: range in metres.
    """
    square = cosine * cosine
    arcsine = cosine * (1.0 + square * (1.0 / 6.0 + square * (3.0 / 40.0 + square * (15.0 / 336.0))))  # small angles
    grazing = 0.2 * arcsine / (0.5 * math.pi - GRAZING)
    facing = 0.2 + 0.8 * decay(0.01 * (rho - IDEAL_RANGE) * (rho - IDEAL_RANGE))
    return min(1.0, planarity * (grazing if cosine < math.cos(GRAZING) else facing))


@njit(cache=True, error_model="numpy")
def fill_normals(
    xx: Floats,
    xy: Floats,
    xz: Floats,
    yy: Floats,
    yz: Floats,
    zz: Floats,
    x: Floats,
    y: Floats,
    z: Floats,
    rho: Floats,
    nx: Floats,
    ny: Floats,
    nz: Floats,
    scores: Floats,
    planarities: Floats,
) -> None:
    """Write normals, scores and planarities of points from the covariances of their neighbours, all arrays (m,)."""
    for k in range(len(x)):
        l0, _, l2, ux, uy, uz = smallest_direction(
            float(xx[k]), float(xy[k]), float(xz[k]), float(yy[k]), float(yz[k]), float(zz[k])
        )
        cosine = (ux * x[k] + uy * y[k] + uz * z[k]) / rho[k]
        sign = -1.0 if cosine > 0.0 else 1.0
        planarity = 1.0 - max(0.0, l0) / l2 if l2 > 0.0 else 0.0
        nx[k], ny[k], nz[k] = sign * ux, sign * uy, sign * uz
        planarities[k] = planarity
        scores[k] = trust(planarity, min(1.0, abs(cosine)), float(rho[k]))


def estimate_normals(
    x: Floats, y: Floats, z: Floats, rho: Floats, theta: Floats, phi: Floats, chosen: Ints, radius: float
) -> tuple[Floats, Floats, Floats]:
    """Return normals (3, m) towards the sensor, their scores (m,) and planarities (m,) at the chosen points.

    x, y, z, rho, theta, phi: all points of the frame (n,), in the sensor's frame. chosen: indices (m,) among them.
    radius: of the ball in (log rho / 8, theta, 2 phi), radians. Azimuth wraps around. The score is 0 where fewer than
    4 points are near.
    """
    normals = np.empty((3, len(chosen)), np.float32)
    scores, planarities = np.empty(len(chosen), np.float32), np.empty(len(chosen), np.float32)
    depth = logarithms(rho) * np.float32(1.0 / RANGE_SCALE)
    near = covariances(x, y, z, depth, theta, phi, chosen, radius)
    fill_normals(*near, x[chosen], y[chosen], z[chosen], rho[chosen], *normals, scores, planarities)
    return normals, scores, planarities
