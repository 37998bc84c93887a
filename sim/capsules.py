"""Rays against capsules, of which people are made: numba kernels that try only the rays that a capsule can cover."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]


@njit(cache=True)
def capsule_distance(
    dx: float, dy: float, dz: float, ax: float, ay: float, az: float, bx: float, by: float, bz: float, radius: float
) -> float:
    """Return where a ray from the origin along the unit direction d enters the capsule a-b, in metres; inf if nowhere.

    A ray that starts inside enters nowhere.
    """
    ux, uy, uz = bx - ax, by - ay, bz - az
    axis2 = ux * ux + uy * uy + uz * uz
    axis_d = ux * dx + uy * dy + uz * dz
    axis_o = -(ux * ax + uy * ay + uz * az)
    d_o = -(dx * ax + dy * ay + dz * az)
    o2 = ax * ax + ay * ay + az * az
    qa = axis2 - axis_d * axis_d
    qb = axis2 * d_o - axis_o * axis_d
    qc = axis2 * o2 - axis_o * axis_o - radius * radius * axis2
    if qa > 1e-12:
        root = qb * qb - qa * qc
        if root < 0.0:
            return math.inf  # past the endless cylinder is past the capsule
        distance = (-qb - math.sqrt(root)) / qa
        if 0.0 < axis_o + distance * axis_d < axis2:
            return distance if distance > 0.0 else math.inf
    best = math.inf
    for end in range(2):
        cx, cy, cz = (ax, ay, az) if end == 0 else (bx, by, bz)
        middle = dx * cx + dy * cy + dz * cz
        root = middle * middle - (cx * cx + cy * cy + cz * cz) + radius * radius
        if root >= 0.0:
            distance = middle - math.sqrt(root)
            if 0.0 < distance < best:
                best = distance
    return best


@njit(cache=True)
def _span(ax: float, ay: float, bx: float, by: float, radius: float) -> tuple[float, float, float]:
    """Return the middle bearing and the half width of a capsule as the origin sees it, and its least level distance."""
    ux, uy = bx - ax, by - ay
    length2 = ux * ux + uy * uy
    share = 0.0 if length2 < 1e-12 else min(1.0, max(0.0, -(ax * ux + ay * uy) / length2))
    nearest = math.hypot(ax + share * ux, ay + share * uy) - radius
    if nearest < 1e-3:
        return 0.0, math.pi, 0.0
    first = math.atan2(ay, ax)
    turn = (math.atan2(by, bx) - first + math.pi) % (2.0 * math.pi) - math.pi
    a_half = math.asin(min(1.0, radius / math.hypot(ax, ay)))
    b_half = math.asin(min(1.0, radius / math.hypot(bx, by)))
    low, high = min(-a_half, turn - b_half), max(a_half, turn + b_half)
    return first + (low + high) / 2.0, (high - low) / 2.0, nearest


@njit(cache=True)
def cast(
    before: Array,
    after: Array,
    radii: Array,
    owner: Integers,
    poses: Array,
    share: Array,
    elevations: Array,
    directions: Array,
    farthest: float,
    distance: Singles,
    body: Integers,
    cosine: Singles,
) -> None:
    """Shorten the rays that meet a capsule, and note its owner and the cosine of incidence.

    before, after: ends (k, 2, 3) in the world at the scan's beginning and end; radii, owner: (k,).
    poses: lidar_from_world (columns, 3, 4) of each column, share: (columns,) its time within the scan, 0 to 1.
    elevations: (beams,) ascending; directions: (beams, columns, 3) in the lidar's frame, columns evenly from -pi.
    distance, body, cosine: (beams, columns), changed in place. Metres and radians.
    """
    columns = distance.shape[1]
    step = 2.0 * math.pi / columns
    ends = np.empty((2, 2, 3))
    for k in range(len(radii)):
        radius = radii[k]
        for moment in range(2):
            column = moment * (columns - 1)
            _place(before[k], after[k], share[column], poses[column], ends[moment])
        middle, half, nearest = _span(ends[0, 0, 0], ends[0, 0, 1], ends[0, 1, 0], ends[0, 1, 1], radius)
        other, other_half, other_nearest = _span(ends[1, 0, 0], ends[1, 0, 1], ends[1, 1, 0], ends[1, 1, 1], radius)
        turn = (other - middle + math.pi) % (2.0 * math.pi) - math.pi
        low, high = min(-half, turn - other_half), max(half, turn + other_half)
        nearest = min(nearest, other_nearest)
        if nearest > farthest:
            continue
        top, bottom, reach = -math.inf, math.inf, 0.0
        for moment in range(2):
            for end in range(2):
                top = max(top, ends[moment, end, 2] + radius)
                bottom = min(bottom, ends[moment, end, 2] - radius)
                reach = max(reach, math.hypot(ends[moment, end, 0], ends[moment, end, 1]) + radius)
        near = max(nearest - 0.02, 1e-3)
        first_beam = np.searchsorted(elevations, math.atan2(bottom, reach if bottom > 0.0 else near) - 1e-3)
        last_beam = np.searchsorted(elevations, math.atan2(top, near if top > 0.0 else reach) + 1e-3)
        if first_beam >= last_beam:
            continue
        first = math.floor((middle + low + math.pi) / step) - 1
        last = math.ceil((middle + high + math.pi) / step) + 2
        if last - first > columns:
            first, last = 0, columns
        for index in range(first, last):
            column = index % columns
            _place(before[k], after[k], share[column], poses[column], ends[0])
            a, b = ends[0, 0], ends[0, 1]
            for beam in range(first_beam, last_beam):
                if distance[beam, column] < nearest:
                    continue
                d = directions[beam, column]
                t = capsule_distance(d[0], d[1], d[2], a[0], a[1], a[2], b[0], b[1], b[2], radius)
                if t < distance[beam, column]:
                    distance[beam, column] = t
                    body[beam, column] = owner[k]
                    cosine[beam, column] = _facing(d, t, a, b, radius)


@njit(cache=True)
def _place(before: Array, after: Array, share: float, pose: Array, ends: Array) -> None:
    """Write a capsule's ends (2, 3) at a time of the scan, in the lidar's frame at that time, into `ends`."""
    for end in range(2):
        x = before[end, 0] + share * (after[end, 0] - before[end, 0])
        y = before[end, 1] + share * (after[end, 1] - before[end, 1])
        z = before[end, 2] + share * (after[end, 2] - before[end, 2])
        for axis in range(3):
            ends[end, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]


@njit(cache=True)
def _facing(ray: Array, t: float, a: Array, b: Array, radius: float) -> float:
    """Return the cosine between a ray and the normal of the capsule where it enters."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    hx, hy, hz = ray[0] * t - a[0], ray[1] * t - a[1], ray[2] * t - a[2]
    length2 = ux * ux + uy * uy + uz * uz
    along = 0.0
    if length2 > 0.0:
        along = min(1.0, max(0.0, (hx * ux + hy * uy + hz * uz) / length2))
    nx, ny, nz = hx - along * ux, hy - along * uy, hz - along * uz
    return abs(nx * ray[0] + ny * ray[1] + nz * ray[2]) / radius
