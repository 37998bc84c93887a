"""Eigenvalues of symmetric 3x3 matrices and the direction of the smallest, in closed form.

Without a branch: called in a loop over arrays, eight matrices are solved at once.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, error_model="numpy", inline="always")
def cosine_of_third(cosine: float) -> float:
    """Return cos(acos(c) / 3) for c in [-1, 1], in [0.5, 1]; c beyond is taken as the bound. Exact to about 1e-12.

    The largest root x of 4 x^3 - 3 x = c, by Newton's method from above: a third of the time of the C library's
    functions, and the same bits on every machine. Next to c = -1 two roots meet, and a square root starts near them.
    """
    c = min(1.0, max(-1.0, cosine))
    x = 0.5 + math.sqrt((c + 1.0) * (1.0 / 6.0)) * (1.0 - 0.1340 * math.sqrt(0.5 * (c + 1.0)))
    for _ in range(4):
        slope = 12.0 * x * x - 3.0
        step = ((4.0 * x * x - 3.0) * x - c) / max(slope, 1e-7)
        x -= step if slope > 1e-7 else 0.0
    return min(1.0, max(0.5, x))


@njit(cache=True, error_model="numpy", inline="always")
def longest(
    ux: float, uy: float, uz: float, vx: float, vy: float, vz: float, wx: float, wy: float, wz: float
) -> tuple[float, float, float, float]:
    """Return the longest of three vectors and the square of its length."""
    uu, vv, ww = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    second = vv > uu
    ux, uy, uz, uu = vx if second else ux, vy if second else uy, vz if second else uz, vv if second else uu
    third = ww > uu
    return wx if third else ux, wy if third else uy, wz if third else uz, ww if third else uu


@njit(cache=True, error_model="numpy", inline="always")
def smallest_direction(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Return the eigenvalues in rising order and the unit eigenvector of the smallest.

    The matrix is [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]. Where the smallest eigenvalue is double the vector is any
    unit vector orthogonal to the others, and (0, 0, 1) where all are equal. Eigenvalues are exact to about 1e-8 of the
    largest.
    """
    mean = (xx + yy + zz) * (1.0 / 3.0)
    off = xy * xy + xz * xz + yz * yz
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    scale = math.sqrt((dx * dx + dy * dy + dz * dz + 2.0 * off) * (1.0 / 6.0))
    round_ = not scale > max(1e-60, 1e-14 * abs(mean))  # below, squares of areas leave the range of numbers
    scale = 1.0 if round_ else scale
    determinant = dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz)
    third = cosine_of_third(0.5 * determinant / (scale * scale * scale))
    high = mean + 2.0 * scale * third
    low = mean - scale * (third + math.sqrt(max(0.0, 3.0 * (1.0 - third * third))))
    largest, smallest = mean if round_ else high, mean if round_ else low
    middle = 3.0 * mean - largest - smallest

    # The direction is orthogonal to every row of (matrix - smallest): of the three cross products the longest is exact.
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    ux, uy, uz, uu = longest(
        xy * yz - xz * b,
        xz * xy - a * yz,
        a * b - xy * xy,
        xy * c - xz * yz,
        xz * xz - a * c,
        a * yz - xy * xz,
        b * c - yz * yz,
        yz * xz - xy * c,
        xy * yz - b * xz,
    )
    # A double smallest eigenvalue: any direction across the largest, which is the direction of every row. Shorter than
    # this the cross products are right to less than 1e-6, what is left of products of 1e-16.
    double = uu <= 1e-20 * scale * scale * scale * scale
    rx, ry, rz, _ = longest(a, xy, xz, xy, b, yz, xz, yz, c)
    flat = abs(rx) < abs(rz)
    tx, ty, tz = 0.0 if flat else ry, rz if flat else -rx, -ry if flat else 0.0
    ux, uy, uz = tx if double else ux, ty if double else uy, tz if double else uz
    ux, uy, uz = 0.0 if round_ else ux, 0.0 if round_ else uy, 1.0 if round_ else uz
    inverse = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
    return smallest, middle, largest, ux * inverse, uy * inverse, uz * inverse
