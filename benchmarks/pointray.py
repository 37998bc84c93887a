"""What PointRay costs a frame against the size of the map, and what it finds, beside plain numpy and dufomap.

python -m benchmarks.pointray

Times are CPU times: all run on one thread. Maps are nested: of the whole building the points nearest to the drive.
Both detectors get true poses. Ours maps the session, traces it by its own frames and labels every point by the nearest
point of that map, with the ground found by RANSAC; dufomap is asked for its labels of the same frames.
"""

from __future__ import annotations

import json
import math
import time
from typing import Any, NamedTuple

import numpy as np

from benchmarks.pointmap import Drive, drive, row, whole_map
from graph.geometry import Matrix, inverse, transform
from operators.pointmap import MapPoints, PointMap, VoxelMap, find_ground, height_above
from operators.pointray import PointRay, RaySettings

SIZES = (250_000, 500_000, 1_000_000, 2_000_000)  # points of the map
FRAMES, WARM_UP = 40, 4
SESSION, SCENARIO, SEED = 300, "medium", 31
MOVING, STATIC = (6,), (1, 2, 3, 4, 5, 7)  # truth classes: a moving person; everything that stands still
SHORT_TERM = 0.7  # movable probability
GROUND = 0.05  # metres above the plane
REACH = 0.2  # metres to the map point that answers for a point


def numpy_trace(cloud: MapPoints, points: np.ndarray, pose: Matrix, settings: RaySettings) -> np.ndarray:
    """Do what PointRay does to every point of a map, by its definition. Returns looks and free looks (n, 2)."""
    size = 0.03
    world = transform(pose, points.astype(np.float64))

    def keys(voxels: np.ndarray) -> np.ndarray:
        return ((voxels[:, 0] + 65536) << 34) | ((voxels[:, 1] + 65536) << 17) | (voxels[:, 2] + 65536)

    taken = np.unique(np.floor(world / size).astype(np.int64), axis=0)
    steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    taken = np.unique(keys((taken[:, None] + steps).reshape(-1, 3)))
    occupied = np.isin(keys(np.floor(cloud.points / np.float64(size)).astype(np.int64)), taken)
    rho = np.linalg.norm(points, axis=1)
    theta = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    phi = np.arctan2(points[:, 1], points[:, 0])
    columns, low = round(2 * np.pi / settings.width), float(theta.min()) - settings.height / 2
    depth = np.full((int((theta.max() - low) / settings.height) + 1, columns), np.inf)
    row_, column = ((theta - low) / settings.height).astype(int), ((phi + np.pi) / (2 * np.pi) * columns).astype(int)
    np.minimum.at(depth, (np.minimum(row_, len(depth) - 1), np.minimum(column, columns - 1)), rho)
    depth[np.isinf(depth)] = 0.0
    depth -= np.maximum(0.03, depth * settings.height / 2)
    local = transform(inverse(pose), cloud.points)
    rho = np.linalg.norm(local, axis=1)
    theta = np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1]))
    row_ = np.floor((theta - low) / settings.height).astype(int)
    column = ((np.arctan2(local[:, 1], local[:, 0]) + np.pi) / (2 * np.pi) * columns).astype(int)
    inside = (row_ >= 0) & (row_ < len(depth))
    limit = np.where(inside, depth[np.clip(row_, 0, len(depth) - 1), np.minimum(column, columns - 1)], 0.0)
    box = ((cloud.points >= world.min(axis=0)) & (cloud.points <= world.max(axis=0))).all(axis=1)
    along = np.abs((local * (cloud.normals @ pose[:3, :3])).sum(axis=1))
    facing = (np.abs(cloud.normals[:, 2]) > settings.level) | (along > math.cos(math.radians(75)) * rho)
    free = ~occupied & box & (rho > 0.06) & (rho < limit) & facing
    return np.stack([occupied | free, free], axis=1)


def cost_rows() -> list[dict[str, Any]]:
    """Trace a drive against maps of several sizes."""
    whole, record = whole_map(seed=101), drive("A", seed=21, count=FRAMES)
    settings = RaySettings()
    middle = np.mean([pose[:2, 3] for pose in record.world_from_base], axis=0)
    order = np.argsort(np.linalg.norm(whole.points[:, :2] - middle, axis=1), kind="stable")
    found = []
    for size in (*SIZES, len(order)):
        cloud = whole.kept(order[:size])
        voxels = VoxelMap()
        voxels.insert_map(cloud)
        rays, seconds, tried = PointRay(voxels, settings), [], []
        for points, pose in zip(record.frames, record.world_from_base, strict=True):
            begin = time.process_time()
            tried.append(rays.add(points, pose @ record.base_from_lidar))
            seconds.append(time.process_time() - begin)
        begin = time.process_time()
        for points, pose in list(zip(record.frames, record.world_from_base, strict=True))[:2]:
            numpy_trace(cloud, points, pose @ record.base_from_lidar, settings)
        peer = (time.process_time() - begin) / 2
        name = f"pointray, map of {size / 1e6:.2f} M points"
        found.append(row(name, 1e3 * float(np.median(seconds[WARM_UP:])), "ms/frame", "numpy, all points", 1e3 * peer))
        found.append(row(f"{name}, tried", float(np.mean(tried)) / 1e3, "k points"))
    return found


class Found(NamedTuple):
    """What a detector said of a session."""

    moving: float  # share of the points of moving people that it found
    lost: float  # share of all other points that it called moving
    seconds: float  # a frame


def judge(labels: list[np.ndarray], record: Drive, seconds: float) -> Found:
    """Hold labels (True: moves) against the truth, all frames together."""
    said, truth = np.concatenate(labels), np.concatenate(record.truth)
    moving, static = np.isin(truth, MOVING), np.isin(truth, STATIC)
    return Found(float(said[moving].mean()), float(said[static].mean()), seconds / len(record.frames))


def with_pointray(record: Drive) -> Found:
    """Map, trace and label a session."""
    poses = [pose @ record.base_from_lidar for pose in record.world_from_base]
    begin = time.process_time()
    pointmap = PointMap()
    for points, pose in zip(record.frames, poses, strict=True):
        pointmap.enter(pointmap.prepare(points), pose)
    rays = PointRay(pointmap.map)
    for points, pose in zip(record.frames, poses, strict=True):
        rays.add(points, pose)
    moves = rays.movable() > SHORT_TERM
    plane = find_ground(pointmap.map.points, pointmap.map.normals)
    if plane is not None:
        moves &= np.abs(height_above(plane, pointmap.map.points)) > GROUND
    labels = []
    for points, pose in zip(record.frames, poses, strict=True):
        nearest, _ = pointmap.map.nearest(transform(pose, points), REACH)
        labels.append((nearest >= 0) & moves[nearest])
    return judge(labels, record, time.process_time() - begin)


def with_dufomap(record: Drive) -> Found:
    """Run dufomap as its authors' example does: 0.1 m voxels, d_s 0.2 m, d_p 2; on one thread."""
    from dufomap import dufomap

    poses = [pose @ record.base_from_lidar for pose in record.world_from_base]
    begin = time.process_time()
    detector = dufomap(0.1, 0.2, 2, num_threads=1)
    for points, pose in zip(record.frames, poses, strict=True):
        detector.run(points, pose, cloud_transform=True)
    detector.oncePropagateCluster(if_propagate=True, if_cluster=False)
    labels = [
        np.asarray(detector.segment(points, pose, cloud_transform=True)).ravel() != 0
        for points, pose in zip(record.frames, poses, strict=True)
    ]
    return judge(labels, record, time.process_time() - begin)


def detection_rows() -> list[dict[str, Any]]:
    """Find who moves in a session, beside dufomap."""
    record = drive("A", seed=SEED, count=SESSION, scenario=SCENARIO)
    ours, peer = with_pointray(record), with_dufomap(record)
    name = f"pointray on {len(record.frames)} frames, {SCENARIO}"
    return [
        row(f"{name}: moving people found", 100 * ours.moving, "%", "dufomap", 100 * peer.moving, more=True),
        row(f"{name}: static points lost", 100 * ours.lost, "%", "dufomap", 100 * peer.lost),
        row(f"{name}: map, trace, label", 1e3 * ours.seconds, "ms/frame", "dufomap", 1e3 * peer.seconds),
    ]


def rows() -> list[dict[str, Any]]:
    """Measure cost against map size, then detection."""
    return cost_rows() + detection_rows()


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
