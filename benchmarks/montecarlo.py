"""AMCL beside PyPI's amcl (a port of Nav2's) on one recording, and the speed of Gmapping.

python -m benchmarks.montecarlo

Records tour A of the hard scenario once (build/montecarlo.mcap), with the truth in the loop. Both get the same scans of
the whole cloud, the same map, odometry and parameters; times are CPU times of one thread, of scans that are used. The
peer weighs by Nav2's beam model (it has no other), ours by the likelihood field, which is the default of both systems.
"""

from __future__ import annotations

import functools
import json
import math
import multiprocessing
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graph.check import require
from graph.codec import decode
from graph.geometry import yaw
from graph.launcher import launch
from graph.messages import Odometry, PointCloud
from graph.recording import Recording
from operators.montecarlo import Amcl, Gmapping, GridMap, Parameters, Settings, flatten, load_map
from operators.montecarlo.scan import ANGLE_INCREMENT, MAX_RANGE

RECORDING, MAP = Path("build/montecarlo.mcap"), Path("recordings/maps/default.yaml")
PARTICLES, BINS = 2000, math.ceil(2.0 * math.pi / ANGLE_INCREMENT)
WARM_UP = 5  # updates
FRAMES = 120  # of the tour, for both; the peer casts a ray for every beam and particle, and would take minutes
PATIENCE = 300.0  # seconds that the peer may take
PEER = "PyPI amcl (Nav2's)"


class Drive(NamedTuple):
    """A tour as 2-D localizers see it."""

    odometry: np.ndarray  # (n, 3)
    true: np.ndarray  # (n, 3)
    ends: list[np.ndarray]  # (m, 2) each, base frame
    sensor: np.ndarray  # (2,)
    seconds: float


class Result(NamedTuple):
    """How fast and how exact."""

    milliseconds: list[float]  # of each update
    errors: list[float]  # metres; of AMCL where the scan is used


@functools.cache
def drive() -> Drive:
    """Read the recording, after driving it where it is not there yet."""
    if not RECORDING.exists():
        RECORDING.parent.mkdir(exist_ok=True)
        swaps = ("localizer=operators.localizer:TrueLocalizer",)
        launch(require("graph.yaml", ("simulator.scenario=hard",), swaps), record=RECORDING, quiet=True)
    rows: dict[int, list[Any]] = {}
    recording = Recording(RECORDING)
    sensor = np.zeros(2)
    for entry in recording.messages("simulator/odometry", "simulator/frame"):
        if entry.port == "odometry":
            odometry = decode(entry.payload, Odometry)
            assert odometry.true_world_from_base is not None
            poses = (odometry.odom_from_base, odometry.true_world_from_base)
            rows.setdefault(entry.stamp, []).insert(0, [(p[0, 3], p[1, 3], yaw(p)) for p in poses])
        else:
            cloud = decode(entry.payload, PointCloud)
            scan = flatten(cloud.points, cloud.base_from_lidar)
            sensor = scan.sensor
            rows.setdefault(entry.stamp, []).append(scan.returns())
    both = np.array([row[0] for row in rows.values()])
    return Drive(both[:, 0], both[:, 1], [row[1] for row in rows.values()], sensor, recording.verdict.end / 1e9)


def ours(grid: GridMap, known: Drive) -> Result:
    """Localize by our AMCL with a fixed number of particles."""
    parameters = Parameters(min_particles=PARTICLES, max_particles=PARTICLES)
    amcl = Amcl(grid, parameters, start=tuple(known.odometry[0].tolist()))
    times, errors = [], []
    for odometry, true, ends in zip(known.odometry, known.true, known.ends, strict=True):
        begun = time.process_time()
        belief = amcl.step(odometry, ends)
        if belief.updated:
            times.append(1e3 * (time.process_time() - begun))
            errors.append(float(np.hypot(*(belief.pose - true)[:2])))
    return Result(times[WARM_UP:], errors)


def peer(grid: GridMap, known: Drive) -> Result:
    """Localize by PyPI's amcl; it is called only where our rule says that the robot has moved enough."""
    import amcl

    p = Parameters()
    motion = amcl.MotionParameters(p.odom_alpha1, p.odom_alpha2, p.odom_alpha3, p.odom_alpha4, 0.1)
    laser = amcl.LaserParameters(p.laser_z_hit, 0.05, 0.05, p.laser_z_rand, p.laser_sigma_hit, 0.1, 0.05, BINS)
    filter_ = amcl.AMCL(PARTICLES, PARTICLES, 0.0, 0.0, motion, laser, "differential")
    cells = grid.cells.tolist()
    filter_.set_map(amcl.create_occupancy_grid_from_list(cells, grid.resolution, *map(float, grid.origin)))
    x, y, heading = known.odometry[0].tolist()
    filter_.set_initial_pose(amcl.Vector3D(x, y, heading), amcl.create_diagonal_covariance(0.0025, 0.0025, 0.0025))
    filter_.set_laser_pose(amcl.Vector3D(*map(float, known.sensor), 0.0))
    times, errors, last = [], [], np.full(3, np.inf)
    for odometry, true, ends in zip(known.odometry, known.true, known.ends, strict=True):
        turn = abs((odometry[2] - last[2] + np.pi) % (2 * np.pi) - np.pi) if np.isfinite(last[2]) else np.inf
        if np.hypot(*(odometry - last)[:2]) < p.update_min_d and turn < p.update_min_a:
            continue
        last = odometry
        beams = ends - known.sensor
        scan = amcl.create_laser_scan_from_list(every_bin(beams).tolist(), MAX_RANGE)
        begun = time.process_time()
        filter_.update(scan, amcl.Vector3D(*odometry.tolist()))
        times.append(1e3 * (time.process_time() - begun))
        mean = filter_.get_pose_mean()
        errors.append(float(np.hypot(mean.x - true[0], mean.y - true[1])))
    return Result(times[WARM_UP:], errors)


def every_bin(beams: np.ndarray) -> np.ndarray:
    """Return range and bearing (629, 2) of every bin; the range of those without a return is the largest.

    The peer never comes back from a scan that has fewer beams than max_beams.
    """
    bearings = -np.pi + ANGLE_INCREMENT * (np.arange(BINS) + 0.5)
    pairs = np.column_stack([np.full(BINS, MAX_RANGE), bearings])
    found = np.arctan2(beams[:, 1], beams[:, 0])
    places = np.minimum(((found + np.pi) / ANGLE_INCREMENT).astype(int), BINS - 1)
    pairs[places] = np.column_stack([np.hypot(*beams.T), found])
    return pairs


def mapping(known: Drive) -> tuple[float, Result]:
    """Map by Gmapping; returns how many times faster than real time it was."""
    gmapping = Gmapping(Settings(), start=tuple(known.odometry[0].tolist()))
    times, errors = [], []
    for odometry, true, ends in zip(known.odometry, known.true, known.ends, strict=True):
        begun = time.process_time()
        slam = gmapping.step(odometry, ends, known.sensor)
        times.append(time.process_time() - begun)
        errors.append(float(np.hypot(*(slam.pose - true)[:2])))
    return known.seconds / sum(times[WARM_UP:]), Result([1e3 * seconds for seconds in times[WARM_UP:]], errors)


def rows() -> list[dict[str, Any]]:
    """Measure; without PyPI's amcl its columns stay empty."""
    grid, known = load_map(MAP), drive()
    begun = known._replace(odometry=known.odometry[:FRAMES], true=known.true[:FRAMES], ends=known.ends[:FRAMES])
    mine = ours(grid, begun)
    other: Result | None = None
    with multiprocessing.get_context("spawn").Pool(1) as pool:  # a process can be stopped, a call of C++ cannot
        try:
            other = pool.apply_async(peer, (grid, begun)).get(PATIENCE)
        except (ImportError, multiprocessing.TimeoutError) as error:
            print(f"{PEER} gave nothing: {type(error).__name__} {error}", file=sys.stderr)
    found = [
        _row(
            "amcl, 2000 particles, all bins, an update",
            np.median(mine.milliseconds),
            "ms",
            other and other.milliseconds,
        ),
        _row("amcl, error, median", 100 * np.median(mine.errors), "cm", other and [100 * e for e in other.errors]),
    ]
    speed, result = mapping(known)
    found.append(_row("gmapping, 30 particles, 0.05 m, whole cloud", speed, "x real", None))
    found.append(_row("gmapping, error, median", 100 * np.median(result.errors), "cm", None))
    return found


def _row(name: str, value: Any, unit: str, others: list[float] | None) -> dict[str, Any]:
    known = float(np.median(others)) if others else None
    ratio = float(value) / known if known else None
    return {"name": name, "value": float(value), "unit": unit, "peer": PEER, "peer_value": known, "ratio": ratio}


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
