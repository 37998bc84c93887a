"""The ground of a frame or a map: the lowest near-horizontal plane."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Doubles = npt.NDArray[np.float64]

DRAWS = 100
LARGEST_TILT = math.radians(10.0)
LEAST_INLIERS = 30
LOWER_SHARE = 0.1  # a lower plane wins over a larger one above it from this share of its inliers on
POLISHES = 2


@njit(cache=True, error_model="numpy")
def largest_plane(
    x: Doubles, y: Doubles, z: Doubles, draws: npt.NDArray[np.int64], steepest: float, tolerance: float
) -> tuple[float, float, float, int]:
    """Return the plane z = a x + b y + c with most points within the tolerance (metres), and their number.

    x, y, z: (n,). draws: (k, 3) indices of the corners of the candidates. steepest: largest slope (tangent).
    """
    best_a, best_b, best_c, most = 0.0, 0.0, 0.0, 0
    for k in range(len(draws)):
        i, j, m = draws[k, 0], draws[k, 1], draws[k, 2]
        ux, uy, uz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
        vx, vy, vz = x[m] - x[i], y[m] - y[i], z[m] - z[i]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        if not math.sqrt(nx * nx + ny * ny) < steepest * abs(nz):
            continue
        a, b = -nx / nz, -ny / nz
        c = z[i] - a * x[i] - b * y[i]
        found = 0
        for n in range(len(x)):
            found += 1 if abs(z[n] - a * x[n] - b * y[n] - c) < tolerance else 0
        if found > most:
            best_a, best_b, best_c, most = a, b, c, found
    return best_a, best_b, best_c, most


def polished(x: Doubles, y: Doubles, z: Doubles, plane: Doubles, tolerance: float) -> Doubles:
    """Fit the plane again to its inliers, by least squares."""
    for _ in range(POLISHES):
        near = np.abs(z - plane[0] * x - plane[1] * y - plane[2]) < tolerance
        u, v, w = x[near] - x[near].mean(), y[near] - y[near].mean(), z[near] - z[near].mean()
        uu, uv, vv, uw, vw = ((p * q).sum() for p, q in ((u, u), (u, v), (v, v), (u, w), (v, w)))
        determinant = uu * vv - uv * uv
        if not determinant > 1e-9 * (uu + vv) ** 2:
            break
        a, b = (uw * vv - vw * uv) / determinant, (vw * uu - uw * uv) / determinant
        if math.hypot(a, b) > math.tan(LARGEST_TILT):
            break
        plane = np.array([a, b, z[near].mean() - a * x[near].mean() - b * y[near].mean()])
    return plane


def find_ground(
    points: npt.NDArray[Any], normals: npt.NDArray[Any], *, tolerance: float = 0.10, seed: int = 0
) -> Doubles | None:
    """Find the ground z = a x + b y + c by RANSAC among the points whose normals are within 10 degrees of vertical.

    points, normals: (n, 3) with z up. tolerance: of an inlier, metres. Returns (a, b, c), or None if fewer than 30
    points agree. A table top does not win: below a plane that was found the search goes on, and a lower plane is taken
    if it has a tenth of the inliers.
    """
    level = np.abs(normals[:, 2]) > math.cos(LARGEST_TILT)
    x, y, z = np.ascontiguousarray(points[level].astype(np.float64).T)
    ground, needed = None, LEAST_INLIERS
    while len(x) >= LEAST_INLIERS:
        draws = np.random.default_rng([seed, len(x)]).integers(0, len(x), (DRAWS, 3))
        a, b, c, found = largest_plane(x, y, z, draws, math.tan(LARGEST_TILT), tolerance)
        if found < needed:
            break
        ground = polished(x, y, z, np.array([a, b, c]), tolerance)
        needed = max(LEAST_INLIERS, int(LOWER_SHARE * found))
        below = z - ground[0] * x - ground[1] * y - ground[2] < -2.0 * tolerance
        x, y, z = x[below], y[below], z[below]
    return ground


def height_above(plane: npt.NDArray[Any], points: npt.NDArray[Any]) -> Doubles:
    """Return the heights (n,) of points (n, 3) above the plane (a, b, c), metres, measured along z."""
    x, y, z = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64), points[:, 2].astype(np.float64)
    return z - plane[0] * x - plane[1] * y - plane[2]
