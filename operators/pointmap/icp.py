"""Point-to-plane ICP of a frame on a voxel map."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.pointmap.draw import State, alias_table, sample
from operators.pointmap.frame import Frame
from operators.pointmap.nearest import nearest
from operators.pointmap.prefetch import prefetch
from operators.pointmap.store import NONE, NORMAL, SCORE, Store

Doubles = npt.NDArray[np.float64]

DAMPING = 1e-6  # of the mean diagonal: keeps a direction that nothing constrains from running away


class Criteria(NamedTuple):
    """The settings of the alignment; defaults are the authors' (table I and their code)."""

    samples: int = 600  # drawn at each iteration
    reach: float = 2.0  # metres; pairs farther apart are rejected
    plane_reach: float = 0.30  # metres from the plane; from `plane_from` on
    plane_from: int = 3  # iteration, from 0
    final_reach: float = 0.08  # metres from the plane, in the last iterations
    window: int = 5  # iterations of the moving averages, and of the final mean
    translation: float = 0.01  # metres; convergence of the average step
    rotation: float = math.radians(0.1)
    iterations: int = 100
    least_pairs: int = 60
    tail: float = 2.0  # Cauchy weights of this many times the last residual, from `plane_from` on; inf as the authors
    least_tail: float = 0.002  # metres; the weights' width never falls below


class Alignment(NamedTuple):
    """What the alignment found."""

    world_from_lidar: Doubles  # (4, 4)
    converged: bool
    iterations: int
    inliers: float  # share of the samples of the last iteration within `final_reach` of their plane
    residual: float  # metres, weighted root mean square distance of these from their planes


@njit(cache=True, error_model="numpy")
def solve(a: Doubles, b: Doubles) -> Doubles:
    """Solve the symmetric positive definite system a (n, n) x = b (n,) by Cholesky. NaN where a is not definite."""
    n = len(b)
    low = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            low[i, j] = math.sqrt(total) if i == j else total / low[j, j]
    x = np.empty(n)
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= low[i, k] * x[k]
        x[i] = total / low[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= low[k, i] * x[k]
        x[i] = total / low[i, i]
    return x


@njit(cache=True, error_model="numpy")
def turned(pose: Doubles, x: float, y: float, z: float) -> Doubles:
    """Return a pose (4, 4) with its rotation turned by the rotation vector (x, y, z) in radians (Rodrigues)."""
    angle = math.sqrt(x * x + y * y + z * z)
    a = math.sin(angle) / angle if angle > 1e-8 else 1.0
    b = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    result = pose.copy()
    for j in range(3):
        u, v, w = pose[0, j], pose[1, j], pose[2, j]
        result[0, j] = (1.0 - b * (y * y + z * z)) * u + (b * x * y - a * z) * v + (b * x * z + a * y) * w
        result[1, j] = (b * x * y + a * z) * u + (1.0 - b * (x * x + z * z)) * v + (b * y * z - a * x) * w
        result[2, j] = (b * x * z - a * y) * u + (b * y * z + a * x) * v + (1.0 - b * (x * x + y * y)) * w
    return result


@njit(cache=True, error_model="numpy")
def mean_pose(poses: Doubles) -> Doubles:
    """Return the mean (4, 4) of poses (n, 4, 4) that are close to each other; exact to third order in their spread."""
    count = len(poses)
    result = poses[count - 1].copy()
    x, y, z = 0.0, 0.0, 0.0
    for axis in range(3):
        result[axis, 3] = 0.0
        for n in range(count):
            result[axis, 3] += poses[n, axis, 3] / count
    for n in range(count):
        for j in range(3):  # of poses[n] against the last: half the antisymmetric part of poses[n] @ last.T
            x += 0.5 * (poses[n, 2, j] * result[1, j] - poses[n, 1, j] * result[2, j]) / count
            y += 0.5 * (poses[n, 0, j] * result[2, j] - poses[n, 2, j] * result[0, j]) / count
            z += 0.5 * (poses[n, 1, j] * result[0, j] - poses[n, 0, j] * result[1, j]) / count
    return turned(result, x, y, z)


@njit(cache=True)
def keep(poses: Doubles, place: int, pose: Doubles) -> None:
    """Write a pose (4, 4) into poses (n, 4, 4); as loops, which compile much faster than an array assignment."""
    for i in range(4):
        for j in range(4):
            poses[place, i, j] = pose[i, j]


@njit(cache=True, error_model="numpy")
def step(
    store: Store,
    voxel: float,
    points: npt.NDArray[np.float32],
    chosen: npt.NDArray[np.int32],
    count: int,
    pose: Doubles,
    reach: float,
    plane_reach: float,
    width: float,
) -> tuple[Doubles, int, float]:
    """Return the next step (6,) (translation, rotation about the sensor), its pairs and their rms distance.

    Minimizes the sum of weight * (normal . (rotation * point + translation - map point))^2 over the first `count`
    chosen points (paper table I). The weight is the map point's score (as in the authors' code) times a Cauchy weight
    of `width` metres, so that a person or a corner cannot pull.
    """
    normal_matrix = np.zeros((6, 6))
    right = np.zeros(6)
    row = np.empty(6)
    turned_points = np.empty((count, 3))  # about the sensor
    world_points = np.empty((count, 3))
    for n in range(count):
        x, y, z = float(points[chosen[n], 0]), float(points[chosen[n], 1]), float(points[chosen[n], 2])
        for axis in range(3):
            turned_points[n, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z
            world_points[n, axis] = turned_points[n, axis] + pose[axis, 3]
    matches, _ = nearest(store, voxel, world_points, reach)
    rows = store.rows
    for n in range(count):
        prefetch(rows, matches[n])
    pairs, error, total = 0, 0.0, 0.0
    for n in range(count):
        match = matches[n]
        if match == NONE:
            continue
        nx, ny, nz = float(rows[match, NORMAL]), float(rows[match, NORMAL + 1]), float(rows[match, NORMAL + 2])
        distance = nx * (world_points[n, 0] - rows[match, 0])
        distance += ny * (world_points[n, 1] - rows[match, 1])
        distance += nz * (world_points[n, 2] - rows[match, 2])
        if abs(distance) > plane_reach:
            continue
        rx, ry, rz = turned_points[n, 0], turned_points[n, 1], turned_points[n, 2]
        weight = rows[match, SCORE] / (1.0 + (distance / width) ** 2)
        row[0], row[1], row[2] = nx, ny, nz
        row[3], row[4], row[5] = ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx
        for a in range(6):
            for b in range(a + 1):
                normal_matrix[a, b] += weight * row[a] * row[b]
            right[a] -= weight * row[a] * distance
        pairs += 1
        total += weight
        error += weight * distance * distance
    trace = 0.0
    for a in range(6):
        trace += normal_matrix[a, a]
    for a in range(6):
        normal_matrix[a, a] += DAMPING * trace / 6.0
    return solve(normal_matrix, right), pairs, math.sqrt(error / total) if total > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def align(store: Store, voxel: float, frame: Frame, guess: Doubles, criteria: Criteria, state: State) -> Alignment:
    """Align a frame with the map, starting from the guess world_from_lidar (4, 4).

    voxel: size of the map's voxels, metres. state: of the random generator (advanced). Converged when the moving
    averages of the steps fall below the criteria; then so many more iterations as the window is long, and the result
    is the mean of their poses. Paper section III-A and table I; with the differences of the authors' code.
    """
    pose = guess.copy()
    share, other = alias_table(frame.weights)
    drawn = np.full(len(frame.weights), -1, np.int32)
    chosen = np.empty(criteria.samples, np.int32)
    last_poses = np.empty((criteria.window, 4, 4))
    mean_translation, mean_rotation = 0.0, 0.0
    end = criteria.iterations + criteria.window
    converged = False
    inliers, residual = 0.0, 0.0
    iteration = 0
    while iteration < end:
        final = iteration >= end - criteria.window
        plane_reach = criteria.final_reach if final else criteria.plane_reach
        if iteration < criteria.plane_from:
            plane_reach = criteria.reach
        width = math.inf if iteration < criteria.plane_from else max(criteria.least_tail, criteria.tail * residual)
        found = sample(share, other, drawn, iteration, criteria.samples, state, chosen)
        change, pairs, residual = step(
            store, voxel, frame.points, chosen, found, pose, criteria.reach, plane_reach, width
        )
        inliers = pairs / max(1, found)
        if pairs < criteria.least_pairs or not math.isfinite(change[0]):
            return Alignment(pose, False, iteration, inliers, residual)
        pose = turned(pose, change[3], change[4], change[5])
        for axis in range(3):
            pose[axis, 3] += change[axis]
        if final:
            keep(last_poses, iteration - (end - criteria.window), pose)
        translation = math.sqrt(change[0] ** 2 + change[1] ** 2 + change[2] ** 2)
        rotation = math.sqrt(change[3] ** 2 + change[4] ** 2 + change[5] ** 2)
        share_of_new = 1.0 / min(iteration + 1, criteria.window)
        mean_translation += (translation - mean_translation) * share_of_new
        mean_rotation += (rotation - mean_rotation) * share_of_new
        settled = mean_translation < criteria.translation and mean_rotation < criteria.rotation
        if not final and settled and iteration >= criteria.window:
            converged = True
            end = iteration + 1 + criteria.window
        iteration += 1
    return Alignment(mean_pose(last_poses), converged, iteration, inliers, residual)
