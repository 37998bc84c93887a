"""Eigenvalues of symmetric 3x3 matrices and the direction of the smallest, in closed form."""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, error_model="numpy")
def cosine_of_third(cosine: float) -> float:
    """Return cos(acos(c) / 3) for c in [-1, 1], in [0.5, 1]; c beyond is taken as the bound. Exact to about 1e-12.

    The largest root x of 4 x^3 - 3 x = c, by Newton's method from above: a third of the time of the C library's
    functions, and the same bits on every machine. Next to c = -1 two roots meet, and a square root starts near them.
    """
    c = min(1.0, max(-1.0, cosine))
    x = 0.5 + math.sqrt((c + 1.0) * (1.0 / 6.0)) * (1.0 - 0.1340 * math.sqrt(0.5 * (c + 1.0)))
    for _ in range(4):
        slope = 12.0 * x * x - 3.0
        if slope > 1e-7:
            x -= ((4.0 * x * x - 3.0) * x - c) / slope
    return min(1.0, max(0.5, x))


@njit(cache=True, error_model="numpy")
def smallest_direction(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Return the eigenvalues in rising order and the unit eigenvector of the smallest.

    The matrix is [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]. Where the smallest eigenvalue is double the vector is any
    unit vector orthogonal to the others, and (0, 0, 1) where all are equal. Eigenvalues are exact to about 1e-8 of the
    largest.
    """
    mean = (xx + yy + zz) / 3.0
    off = xy * xy + xz * xz + yz * yz
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    scale = math.sqrt((dx * dx + dy * dy + dz * dz + 2.0 * off) / 6.0)
    if scale <= 1e-14 * abs(mean) or scale == 0.0:
        return mean, mean, mean, 0.0, 0.0, 1.0
    determinant = dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz)
    third = cosine_of_third(0.5 * determinant / (scale * scale * scale))
    largest = mean + 2.0 * scale * third
    smallest = mean - scale * (third + math.sqrt(max(0.0, 3.0 * (1.0 - third * third))))
    middle = 3.0 * mean - largest - smallest

    # The direction is orthogonal to every row of (matrix - smallest): of the three cross products the longest is exact.
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    ux, uy, uz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    vx, vy, vz = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    wx, wy, wz = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    uu, vv, ww = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    if vv > uu:
        ux, uy, uz, uu = vx, vy, vz, vv
    if ww > uu:
        ux, uy, uz, uu = wx, wy, wz, ww
    if uu <= 1e-28 * scale * scale * scale * scale:  # a double smallest eigenvalue: any direction across the largest
        rx, ry, rz = a, xy, xz
        if xy * xy + b * b + yz * yz > rx * rx + ry * ry + rz * rz:
            rx, ry, rz = xy, b, yz
        if xz * xz + yz * yz + c * c > rx * rx + ry * ry + rz * rz:
            rx, ry, rz = xz, yz, c
        if abs(rx) < abs(rz):
            ux, uy, uz = 0.0, rz, -ry
        else:
            ux, uy, uz = ry, -rx, 0.0
        uu = ux * ux + uy * uy + uz * uz
    length = math.sqrt(uu)
    return smallest, middle, largest, ux / length, uy / length, uz / length
