"""Normals of a lidar frame: neighbourhoods in spherical space, PCA, and how far to trust the result."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.eigen import smallest_direction

Floats = npt.NDArray[np.float32]

RANGE_SCALE = 8.0  # log range over 8: a ball of 2 degrees reaches +-31 % in range
AZIMUTH_SCALE = 2.0  # the ball is half as wide as it is high
GRAZING = 5.0 * math.pi / 12.0  # incidence above which the sensor does not face the surface
IDEAL_RANGE = 2.0  # metres
LEAST_NEIGHBOURS = 4


class Bins(NamedTuple):
    """The points of a frame, sorted by elevation row and azimuth column."""

    first: npt.NDArray[np.int32]  # (rows * columns + 1,) start of each bin in `order`
    order: npt.NDArray[np.int32]  # (n,)
    rows: int
    columns: int
    lowest: float  # elevation of the lower edge of row 0
    height: float  # of a row, radians
    width: float  # of a column, radians; columns go once around


@njit(cache=True, error_model="numpy")
def bin_directions(theta: Floats, phi: Floats, radius: float) -> Bins:
    """Sort points (n,) by direction into rows of half the radius and columns of an eighth of it. Keeps their order."""
    count = len(theta)
    height = 0.5 * radius
    columns = max(8, int(2.0 * math.pi / (0.125 * radius)))
    width = 2.0 * math.pi / columns
    lowest, highest = 4.0, -4.0
    for i in range(count):
        lowest = min(lowest, theta[i])
        highest = max(highest, theta[i])
    rows = max(1, int((highest - lowest) / height) + 1)
    first = np.zeros(rows * columns + 1, np.int32)
    bins = np.empty(count, np.int32)
    for i in range(count):
        row = min(rows - 1, int((theta[i] - lowest) / height))
        column = min(columns - 1, int((phi[i] + math.pi) / width))
        bins[i] = row * columns + column
        first[bins[i] + 1] += 1
    for i in range(rows * columns):
        first[i + 1] += first[i]
    order = np.empty(count, np.int32)
    fill = first[:-1].copy()
    for i in range(count):
        order[fill[bins[i]]] = i
        fill[bins[i]] += 1
    return Bins(first, order, rows, columns, lowest, height, width)


@njit(cache=True, error_model="numpy")
def trust(planarity: float, cosine: float, rho: float) -> float:
    """Return the score of a normal in [0, 1]: planarity times how well the sensor faced the surface from how near.

    planarity: 1 - smallest / largest eigenvalue. cosine: of the incidence angle. rho: range in metres.
    """
    if cosine < math.cos(GRAZING):
        facing = 0.2 * math.asin(cosine) / (0.5 * math.pi - GRAZING)
    else:
        facing = 0.2 + 0.8 * math.exp(-0.01 * (rho - IDEAL_RANGE) ** 2)
    return min(1.0, planarity * facing)


@njit(cache=True, error_model="numpy")
def estimate_normals(
    x: Floats,
    y: Floats,
    z: Floats,
    rho: Floats,
    theta: Floats,
    phi: Floats,
    chosen: npt.NDArray[np.int32],
    radius: float,
) -> tuple[Floats, Floats, Floats]:
    """Return normals (m, 3) towards the sensor, their scores (m,) and planarities (m,) at the chosen points.

    x, y, z, rho, theta, phi: all points of the frame (n,), in the sensor's frame. chosen: indices (m,) among them.
    radius: of the ball in (log rho / 8, theta, 2 phi), radians. Azimuth wraps around. The score is 0 where fewer than
    4 points are near.
    """
    bins = bin_directions(theta, phi, radius)
    normals = np.zeros((len(chosen), 3), np.float32)
    scores = np.zeros(len(chosen), np.float32)
    planarities = np.zeros(len(chosen), np.float32)
    count = len(bins.order)
    sx, sy, sz = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    srho, stheta, sphi = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    for i in range(count):  # neighbours in space become neighbours in memory
        j = bins.order[i]
        sx[i], sy[i], sz[i] = x[j], y[j], z[j]
        srho[i], stheta[i], sphi[i] = rho[j], theta[j], phi[j]
    reach = radius / AZIMUTH_SCALE
    spread = min(int(reach / bins.width) + 1, (bins.columns - 1) // 2)
    for k in range(len(chosen)):
        i = chosen[k]
        px, py, pz = float(x[i]), float(y[i]), float(z[i])
        r, t, f = float(rho[i]), float(theta[i]), float(phi[i])
        low = max(0, int((t - radius - bins.lowest) / bins.height))
        high = min(bins.rows - 1, int((t + radius - bins.lowest) / bins.height))
        centre = min(bins.columns - 1, int((f + math.pi) / bins.width))
        left, right = centre - spread, centre + spread
        near = 0
        mx, my, mz = 0.0, 0.0, 0.0
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for row in range(low, high + 1):
            # Columns beyond the seam of the azimuth are read at its other side, one turn away.
            for part in range(2 if left < 0 or right >= bins.columns else 1):
                a, b, g = max(0, left), min(bins.columns - 1, right), f
                if part == 1 and left < 0:
                    a, b, g = left + bins.columns, bins.columns - 1, f + 2.0 * math.pi
                elif part == 1:
                    a, b, g = 0, right - bins.columns, f - 2.0 * math.pi
                for j in range(bins.first[row * bins.columns + a], bins.first[row * bins.columns + b + 1]):
                    dt = stheta[j] - t
                    df = AZIMUTH_SCALE * (sphi[j] - g)
                    flat = radius * radius - dt * dt - df * df
                    if flat <= 0.0:
                        continue
                    u = (srho[j] - r) / (srho[j] + r)  # log(a / b) = 2 atanh((a - b) / (a + b))
                    dr = 2.0 * u * (1.0 + u * u * (1.0 / 3.0 + 0.2 * u * u)) / RANGE_SCALE
                    if dr * dr >= flat:
                        continue
                    dx, dy, dz = sx[j] - px, sy[j] - py, sz[j] - pz
                    near += 1
                    mx, my, mz = mx + dx, my + dy, mz + dz
                    xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
                    yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
        if near < LEAST_NEIGHBOURS:
            continue
        mx, my, mz = mx / near, my / near, mz / near
        l0, _, l2, nx, ny, nz = smallest_direction(
            xx / near - mx * mx,
            xy / near - mx * my,
            xz / near - mx * mz,
            yy / near - my * my,
            yz / near - my * mz,
            zz / near - mz * mz,
        )
        if not l2 > 0.0:
            continue
        cosine = (nx * px + ny * py + nz * pz) / r
        sign = -1.0 if cosine > 0.0 else 1.0
        normals[k, 0], normals[k, 1], normals[k, 2] = sign * nx, sign * ny, sign * nz
        planarities[k] = 1.0 - max(0.0, l0) / l2
        scores[k] = trust(planarities[k], min(1.0, abs(cosine)), r)
    return normals, scores, planarities
