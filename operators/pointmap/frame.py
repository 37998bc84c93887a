"""A lidar frame made ready for alignment: subsampled, with normals, their scores and sampling weights."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from graph.geometry import Matrix
from operators.pointmap.angles import spherical
from operators.pointmap.normals import decay, estimate_normals
from operators.pointmap.voxels import central_points

Floats = npt.NDArray[np.float32]

LEAST_SCORE = 0.01  # normals trusted less are dropped
LEAST_RANGE = 0.05  # metres; some drivers report a lost echo as a point at the sensor
LARGEST_RANGE = 1000.0  # metres; anything farther is garbage


class Frame(NamedTuple):
    """The subsampled points of one frame, in the sensor's frame; all arrays have m entries."""

    points: Floats  # (m, 3) metres
    normals: Floats  # (m, 3) unit, towards the sensor
    scores: Floats  # trust in the normal, (0, 1]
    weights: Floats  # of the random sampling
    indices: npt.NDArray[np.int32]  # of these points in the full frame

    def moved(self, world_from_lidar: Matrix) -> tuple[Floats, Floats]:
        """Return points and normals, each (m, 3), in the world."""
        return carried(np.ascontiguousarray(world_from_lidar, np.float64), self.points, self.normals)


@njit(cache=True, error_model="numpy")
def carried(pose: npt.NDArray[np.float64], points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Return points moved and normals turned by a pose (4, 4), each (m, 3)."""
    moved, turned = np.empty_like(points), np.empty_like(normals)
    for n in range(len(points)):
        x, y, z = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
        u, v, w = float(normals[n, 0]), float(normals[n, 1]), float(normals[n, 2])
        for axis in range(3):
            moved[n, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
            turned[n, axis] = pose[axis, 0] * u + pose[axis, 1] * v + pose[axis, 2] * w
    return moved, turned


@njit(cache=True, error_model="numpy")
def separate(points: Floats) -> tuple[Floats, Floats, Floats, npt.NDArray[np.int32]]:
    """Return x, y, z of the usable points (finite, in range) of (n, 3), and their indices."""
    count = len(points)
    x, y, z = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    kept = np.empty(count, np.int32)
    found = 0
    for i in range(count):
        px, py, pz = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        square = px * px + py * py + pz * pz
        if LEAST_RANGE * LEAST_RANGE < square < LARGEST_RANGE * LARGEST_RANGE:  # false for NaN too
            x[found], y[found], z[found], kept[found] = points[i, 0], points[i, 1], points[i, 2], i
            found += 1
    return x[:found], y[:found], z[:found], kept[:found]


@njit(cache=True, error_model="numpy")
def sampling_weight(planarity: float, rho: float) -> float:
    """Return the weight of a point in the random sampling: planar and far points first."""
    return planarity * (1.5 - decay(rho * rho / 25.0))


@njit(cache=True, error_model="numpy")
def gather(
    x: Floats,
    y: Floats,
    z: Floats,
    rho: Floats,
    kept: npt.NDArray[np.int32],
    chosen: npt.NDArray[np.int32],
    normals: Floats,
    scores: Floats,
    planarities: Floats,
) -> tuple[Floats, Floats, Floats, Floats, npt.NDArray[np.int32]]:
    """Collect what is trusted of the chosen points, in their order, into the fields of a Frame. normals: (3, m)."""
    most = len(chosen)
    points, turned = np.empty((most, 3), np.float32), np.empty((most, 3), np.float32)
    trusted, weights = np.empty(most, np.float32), np.empty(most, np.float32)
    indices = np.empty(most, np.int32)
    found = 0
    for k in range(most):
        if scores[k] < LEAST_SCORE:
            continue
        i = chosen[k]
        points[found, 0], points[found, 1], points[found, 2] = x[i], y[i], z[i]
        turned[found, 0], turned[found, 1], turned[found, 2] = normals[0, k], normals[1, k], normals[2, k]
        trusted[found] = scores[k]
        weights[found] = sampling_weight(float(planarities[k]), float(rho[i]))
        indices[found] = kept[i]
        found += 1
    return points[:found], turned[:found], trusted[:found], weights[:found], indices[:found]


def prepare(points: npt.NDArray[Any], *, voxel_size: float, angular_radius: float) -> Frame:
    """Subsample a frame and estimate its normals.

    points: (n, 3) metres in the sensor's frame; NaN, infinite and zero points are dropped. voxel_size: metres.
    angular_radius: of the spherical neighbourhoods, radians. Paper section III-A, with the scores of the authors' code.
    """
    x, y, z, kept = separate(np.ascontiguousarray(points, np.float32))
    rho, theta, phi = spherical(x, y, z)
    chosen = central_points(x, y, z, voxel_size)
    normals, scores, planarities = estimate_normals(x, y, z, rho, theta, phi, chosen, angular_radius)
    return Frame(*gather(x, y, z, rho, kept, chosen, normals, scores, planarities))
