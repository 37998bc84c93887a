"""How fast and how exact PointMap localizes, beside kiss-icp and small-gicp on the same frames.

python -m benchmarks.pointmap

The peers get no odometry, and PointMap gets it: it is made for robots that have wheels. Times are CPU times: all run
on one thread.
"""

from __future__ import annotations

import functools
import json
import math
import time
from typing import Any, NamedTuple

import numpy as np

from graph.geometry import Matrix, inverse, planar, rotation_angle, wrap, yaw
from operators.pointmap import Mapper, MapPoints, PointMap

BUILDING = "sim/buildings/default.yaml"
FRAMES, WARM_UP = 600, 20
SPACING = 0.3  # metres between the scans of the map
LOOK_AHEAD = 14  # steps of 5 cm


class Drive(NamedTuple):
    """Frames of a drive, what each of their points is, and where odometry and truth say they were measured."""

    frames: list[np.ndarray]
    truth: list[np.ndarray]  # classes as in graph.messages.PointCloud
    odom_from_base: list[Matrix]
    world_from_base: list[Matrix]
    base_from_lidar: Matrix


def ways(world: Any) -> np.ndarray:
    """Return the ways (n, 2) between the targets of the tour, smoothed."""
    from sim.clearance import route  # here: the extra `sim` may be absent

    here, parts = np.array(world.start[:2]), []
    for target in world.targets:
        part = route(world.layout.free, here, target, radius=0.28)
        if part is not None:
            parts.append(part)
            here = target
    way = np.concatenate(parts)
    padded = np.concatenate([np.repeat(way[:1], 4, 0), way, np.repeat(way[-1:], 4, 0)])
    return np.stack([np.convolve(padded[:, axis], np.full(9, 1 / 9), "valid") for axis in (0, 1)], axis=1)


@functools.cache
def whole_map(seed: int) -> MapPoints:
    """Map the building from the true poses of its mapping tour."""
    from sim import World

    world = World(BUILDING, "mapping", "mapping", seed)
    pointmap = PointMap()
    last = np.full(2, np.inf)
    way = ways(world)
    for here, ahead in zip(way, np.roll(way, -LOOK_AHEAD, axis=0), strict=True):
        if math.dist(here, last) < SPACING:
            continue
        last = here
        pose = planar(*here, math.atan2(*(ahead - here)[::-1]))
        world.motion = world.motion._replace(world_from_base=pose)
        pointmap.enter(pointmap.prepare(world.scan().points), pose @ world.base_from_lidar())
    return pointmap.map.cloud()


def drive(tour: str, seed: int, count: int = FRAMES, scenario: str = "easy") -> Drive:
    """Follow a tour by its true pose and record frames at 10 Hz."""
    from sim import World

    world = World(BUILDING, scenario, tour, seed)
    way, place = ways(world), 0
    record = Drive([], [], [], [], world.base_from_lidar())
    linear, angular = 0.0, 0.0
    while len(record.frames) < count and place < len(way) - LOOK_AHEAD:
        scan = world.step(linear, angular)
        record.frames.append(scan.points)
        record.truth.append(scan.truth)
        state = world.state()
        record.odom_from_base.append(state.odom_from_base)
        record.world_from_base.append(state.world_from_base)
        here = state.world_from_base[:2, 3]
        place += int(np.linalg.norm(way[place : place + 60] - here, axis=1).argmin())
        bearing = math.atan2(*(way[min(place + LOOK_AHEAD, len(way) - 1)] - here)[::-1])
        error = float(wrap(bearing - yaw(state.world_from_base)))
        angular = min(1.0, max(-1.0, 2.2 * error))
        linear = max(0.0, 0.95 * math.cos(min(abs(error), 1.5)) - 0.25 * abs(angular))
    return record


def errors(poses: list[Matrix], record: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances in the plane (metres) and angles (degrees) between poses of the base and the truth."""
    apart = [inverse(truth) @ pose for truth, pose in zip(record.world_from_base, poses, strict=True)]
    return np.array([math.hypot(*a[:2, 3]) for a in apart]), np.degrees([rotation_angle(a) for a in apart])


def pointmap_poses(record: Drive, initial: MapPoints | None) -> tuple[list[Matrix], float]:
    """Do what the localizer does: align, map, keep the grid. Returns poses and the median CPU seconds a frame."""
    mapper = Mapper(initial=initial)
    world_from_odom, poses, seconds = np.eye(4), [], []
    for points, odom_from_base in zip(record.frames, record.odom_from_base, strict=True):
        begin = time.process_time()
        track = mapper.look(points, world_from_odom @ odom_from_base, record.base_from_lidar, level=True)
        seconds.append(time.process_time() - begin)
        poses.append(track.world_from_lidar @ inverse(record.base_from_lidar))
        if track.valid:
            world_from_odom = poses[-1] @ inverse(odom_from_base)
    return poses, float(np.median(seconds[WARM_UP:]))


def kiss_icp_poses(record: Drive) -> tuple[list[Matrix], float]:
    """Run kiss-icp with its defaults for this range, without odometry."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = 30.0, 0.9, False
    config.registration.max_num_threads = 1
    config.mapping.voxel_size = 0.30
    odometry = KissICP(config)
    lidars, seconds = [], []
    for points in record.frames:
        begin = time.process_time()
        odometry.register_frame(points.astype(np.float64), np.zeros(len(points)))
        seconds.append(time.process_time() - begin)
        lidars.append(odometry.last_pose.copy())
    return from_start(lidars, record), float(np.median(seconds[WARM_UP:]))


def small_gicp_poses(record: Drive) -> tuple[list[Matrix], float]:
    """Run small-gicp frame against frame, with the last motion as its guess, without odometry."""
    import small_gicp

    lidars, seconds = [np.eye(4)], []
    motion, before = np.eye(4), None
    for points in record.frames:
        begin = time.process_time()
        cloud, tree = small_gicp.preprocess_points(points.astype(np.float64), downsampling_resolution=0.15)
        if before is not None:
            result = small_gicp.align(before[0], cloud, before[1], motion, max_correspondence_distance=0.5)
            motion = result.T_target_source
            lidars.append(lidars[-1] @ motion)
        before = cloud, tree
        seconds.append(time.process_time() - begin)
    return from_start(lidars, record), float(np.median(seconds[WARM_UP:]))


def from_start(start_from_lidar: list[Matrix], record: Drive) -> list[Matrix]:
    """Return poses of the base in the world from poses of the lidar in its own first frame."""
    start = record.world_from_base[0] @ record.base_from_lidar
    return [start @ pose @ inverse(record.base_from_lidar) for pose in start_from_lidar]


def row(
    name: str, value: float, unit: str, peer: str = "", peer_value: float | None = None, *, more: bool = False
) -> dict[str, Any]:
    """Make a row of the benchmark table; ratio: ours to the peer's where more is better, else the peer's to ours."""
    ratio = None
    if peer_value is not None:
        best = value / max(peer_value, 1e-9) if more or unit.endswith("/s") else peer_value / max(value, 1e-9)
        ratio = round(best, 2)
    shown = None if peer_value is None else round(peer_value, 3)
    return {"name": name, "value": round(value, 3), "unit": unit, "peer": peer, "peer_value": shown, "ratio": ratio}


def rows() -> list[dict[str, Any]]:
    """Measure speed and error with the whole building as initial map, and without a map beside the peers."""
    initial, record = whole_map(seed=101), drive("A", seed=21)
    poses, seconds = pointmap_poses(record, initial)
    metres, degrees = errors(poses, record)
    found = [
        row(f"pointmap rate, map of {len(initial.points) / 1e6:.1f} M points, one core", 1 / seconds, "frames/s"),
        row("pointmap error with map, median", 100 * float(np.median(metres)), "cm"),
        row("pointmap error with map, p95", 100 * float(np.percentile(metres, 95)), "cm"),
        row("pointmap turn error with map, median", float(np.median(degrees)), "deg"),
        row("pointmap turn error with map, p95", float(np.percentile(degrees, 95)), "deg"),
    ]
    poses, seconds = pointmap_poses(record, None)
    metres, degrees = errors(poses, record)
    for peer, task in (("kiss-icp (no odometry)", kiss_icp_poses), ("small-gicp (no odometry)", small_gicp_poses)):
        peer_poses, peer_seconds = task(record)
        peer_metres, peer_degrees = errors(peer_poses, record)
        found.append(row("pointmap rate without map", 1 / seconds, "frames/s", peer, 1 / peer_seconds))
        median, peer_median = 100 * float(np.median(metres)), 100 * float(np.median(peer_metres))
        found.append(row("pointmap error without map, median", median, "cm", peer, peer_median))
        turn, peer_turn = float(np.median(degrees)), float(np.median(peer_degrees))
        found.append(row("pointmap turn error without map, median", turn, "deg", peer, peer_turn))
    return found


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
