"""Adaptive Monte Carlo localization on a known map, with the parameters of amcl in ROS and Nav2.

amcl = Amcl(load_map(Path("map.yaml")), Parameters(), start=(1.0, 2.0, 0.0))
belief = amcl.step(odometry, scan.returns())
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import wrap
from operators.montecarlo.likelihood import free_places, likelihood_field, weigh
from operators.montecarlo.map_file import GridMap, MapError
from operators.montecarlo.motion import Alphas, compose, difference, move
from operators.montecarlo.resampling import heaviest_cluster, mean_pose, resample
from operators.montecarlo.scan import Band

Doubles = npt.NDArray[np.float64]

ANYWHERE = 200_000  # poses tried when the robot may be anywhere
ELSEWHERE = 5_000  # poses tried at each update, in case that it is not where it is believed to be
COARSE = 10  # every so many-th beam judges them
RIVALS, STARTS = 32, 1000  # how many of the best are looked at closely
CLOSER = ((0.3, 0.15), (0.1, 0.05), (0.04, 0.02))  # metres, radians: around them, ever nearer
TRIES = 16  # poses each time
MOST_RIVALS = 0.2  # share of the particles that a better pose elsewhere gets at once
SHARPNESS = 4.0  # power of the likelihood by which they become particles


class Parameters(Band):
    """The parameters of amcl, by their names in ROS; lengths in metres, angles in radians."""

    min_particles: int = 500
    max_particles: int = 2000
    kld_err: float = 0.01
    kld_z: float = 0.99
    odom_alpha1: float = 0.05
    odom_alpha2: float = 0.1
    odom_alpha3: float = 0.1
    odom_alpha4: float = 0.05
    laser_z_hit: float = 0.5
    laser_z_rand: float = 0.5
    laser_sigma_hit: float = 0.2
    laser_likelihood_max_dist: float = 2.0
    laser_max_beams: int = 629
    update_min_d: float = 0.1
    update_min_a: float = 0.2
    resample_interval: int = 1
    recovery_alpha_slow: float = 0.0  # as in ROS: no recovery; 0.001 and 0.1 are what its authors advise
    recovery_alpha_fast: float = 0.0
    initial_cov_xx: float = 0.05**2  # m^2
    initial_cov_yy: float = 0.05**2
    initial_cov_aa: float = 0.05**2  # rad^2
    seed: int = 0


class Belief(NamedTuple):
    """Where the robot is believed to be."""

    pose: Doubles  # (3,) x, y (metres), heading (radians)
    covariance: Doubles  # (3, 3) at the last update
    particles: int
    updated: bool  # whether the scan was used
    recovering: float  # chance with which particles are drawn anew


class Amcl:
    """A particle filter on a map; start: x, y, heading, or None if the robot may be anywhere (global localization).

    Raises MapError for a map without free or without occupied cells, ValueError for parameters that fit nothing.
    """

    def __init__(
        self, grid: GridMap, parameters: Parameters | None = None, *, start: tuple[float, float, float] | None = None
    ) -> None:
        self.parameters = p = Parameters() if parameters is None else parameters
        if not 0 < p.min_particles <= p.max_particles:
            raise ValueError(
                f"amcl wants 0 < min_particles <= max_particles; given are {p.min_particles}, {p.max_particles}"
            )
        if min(p.laser_sigma_hit, p.kld_err, p.range_max) <= 0.0 or min(p.resample_interval, p.laser_max_beams) < 1:
            raise ValueError(
                "amcl wants laser_sigma_hit, kld_err, range_max, resample_interval and laser_max_beams above 0"
            )
        self.places = free_places(grid)
        self.cell = grid.resolution
        self.low, self.high = grid.origin, grid.origin + grid.resolution * np.array(grid.cells.shape[::-1])
        self.field = likelihood_field(
            grid,
            z_hit=p.laser_z_hit,
            z_rand=p.laser_z_rand,
            sigma_hit=p.laser_sigma_hit,
            max_dist=p.laser_likelihood_max_dist,
            range_max=p.range_max,
        )
        self.alphas = Alphas(p.odom_alpha1, p.odom_alpha2, p.odom_alpha3, p.odom_alpha4)
        self.rng = np.random.default_rng(p.seed)
        self.slow = self.fast = 0.0  # running means of the likelihood a beam
        self.updates = 0
        self.odometry: Doubles | None = None  # at the last update
        self.poses, self.weights = np.zeros((0, 3)), np.zeros(0)
        self.mean, self.covariance, self.chance = np.zeros(3), np.zeros((3, 3)), 0.0
        if start is not None:
            self.put(start)

    def put(self, pose: tuple[float, float, float]) -> None:
        """Say where the robot is, with the initial covariance. Raises MapError for a place beyond the map."""
        p = self.parameters
        if not ((self.low <= pose[:2]) & (pose[:2] <= self.high)).all():
            raise MapError(
                f"the robot begins at ({pose[0]:g}, {pose[1]:g}), which is beyond the map: x from {self.low[0]:g} to "
                f"{self.high[0]:g} and y from {self.low[1]:g} to {self.high[1]:g} m; are its origin, its resolution "
                f"({self.cell:g} m) and the pose right?"
            )
        scales = np.sqrt([p.initial_cov_xx, p.initial_cov_yy, p.initial_cov_aa])
        poses = np.array(pose) + self.rng.standard_normal((p.max_particles, 3)) * scales
        poses[:, 2] = wrap(poses[:, 2])
        self._take(poses, np.array(pose, np.float64))

    def scatter(self, ends: Doubles) -> None:
        """Say that the robot may be anywhere: draw particles where the scan's end points (n, 2) fit the map."""
        poses, scores = self.candidates(ends, ANYWHERE, STARTS)
        self._take(self.drawn(poses, scores, self.parameters.max_particles), None)

    def _take(self, poses: Doubles, mean: Doubles | None) -> None:
        self.poses, self.weights = poses, np.full(len(poses), 1.0 / len(poses))
        self.mean = mean_pose(poses, self.weights)[0] if mean is None else mean
        self.slow = self.fast = self.chance = 0.0
        self.odometry = None

    def candidates(self, ends: Doubles, tried: int, kept: int) -> tuple[Doubles, Doubles]:
        """Find the poses (kept, 3) on free floor that fit the scan best, and their likelihood a beam (kept,).

        Tries poses drawn at random and looks around the best of them (after sensor resetting, Lenser and Veloso 2000).
        """
        rng, few = self.rng, np.ascontiguousarray(ends[::COARSE])
        poses = np.empty((tried, 3))
        poses[:, :2] = self.places[rng.integers(len(self.places), size=tried)]
        poses[:, :2] += (rng.random((tried, 2)) - 0.5) * self.cell
        poses[:, 2] = rng.random(tried) * 2.0 * math.pi - math.pi
        poses = poses[np.argsort(-weigh(poses, few, self.field), kind="stable")[:kept]]
        for reach, turn in CLOSER:
            near = np.repeat(poses[:, None], TRIES, axis=1)
            near[:, 1:] += rng.standard_normal((len(poses), TRIES - 1, 3)) * (reach, reach, turn)
            scores = weigh(near.reshape(-1, 3), few, self.field).reshape(near.shape[:2])
            poses = np.ascontiguousarray(near[np.arange(len(poses)), scores.argmax(axis=1)])
        return poses, weigh(poses, ends, self.field) / len(ends)

    def drawn(self, poses: Doubles, scores: Doubles, count: int) -> Doubles:
        """Draw particles (count, 3) at poses (n, 3) by their likelihood (n,), each a little beside its pose."""
        chances = np.cumsum((scores / scores.max()) ** SHARPNESS)
        place = np.searchsorted(chances, self.rng.random(count) * chances[-1], side="right")
        reach, turn = CLOSER[-1]
        beside = self.rng.standard_normal((count, 3)) * (reach, reach, turn)
        return np.asarray(poses[np.minimum(place, len(poses) - 1)] + beside)

    def step(self, odometry: Doubles, ends: Doubles) -> Belief:
        """Take in odometry (3,), x, y and heading in whatever frame, and a scan's end points (n, 2) in the base frame.

        The scan is used where the robot has moved by update_min_d or turned by update_min_a since the last one, and has
        returns.
        """
        p = self.parameters
        if not len(self.poses):
            if not len(ends):
                return Belief(self.mean, self.covariance, 0, False, 0.0)
            self.scatter(ends)
        if self.odometry is None:
            self.odometry, first = odometry.copy(), True
        else:
            first = False
        motion = difference(self.odometry, odometry)
        moved = math.hypot(motion[0], motion[1]) >= p.update_min_d or abs(motion[2]) >= p.update_min_a
        if not (first or moved) or not len(ends):
            return self._belief(motion, False)
        if moved:
            self.poses = move(self.poses, motion, self.alphas, self.rng)
        self.odometry = odometry.copy()
        self._correct(ends)
        return self._belief(np.zeros(3), True)

    def _correct(self, ends: Doubles) -> None:
        p = self.parameters
        used = np.ascontiguousarray(ends[:: max(1, math.ceil(len(ends) / p.laser_max_beams))])
        fits = weigh(self.poses, used, self.field)
        self.weights = self.weights * fits
        total = float(self.weights.sum())
        self.weights /= total
        self.updates += 1
        random_poses = self._recover(used, total / len(used), float(fits.max()) / len(used))
        if self.updates % p.resample_interval == 0:
            self.poses = resample(
                self.poses,
                self.weights,
                random_poses,
                self.chance,
                self.rng,
                least=p.min_particles,
                most=p.max_particles,
                kld_err=p.kld_err,
                kld_z=p.kld_z,
            )
            self.weights = np.full(len(self.poses), 1.0 / len(self.poses))
        cluster = heaviest_cluster(self.poses, self.weights)
        self.mean, self.covariance = mean_pose(self.poses[cluster], self.weights[cluster])

    def _recover(self, ends: Doubles, average: float, best: float) -> Doubles:
        """Set the chance of drawing particles anew, and return poses for them (max_particles, 3), or (0, 3).

        average, best: likelihood a beam of the particles, so that neither the number of beams nor that of particles
        makes the robot lost. Lost it is where the average falls (augmented MCL), or where a pose elsewhere fits better
        than any of them.
        """
        p = self.parameters
        self.chance = 0.0
        if p.recovery_alpha_slow <= 0.0:
            return np.zeros((0, 3))
        self.slow = average if self.slow == 0.0 else self.slow + p.recovery_alpha_slow * (average - self.slow)
        self.fast = average if self.fast == 0.0 else self.fast + p.recovery_alpha_fast * (average - self.fast)
        fallen = 1.0 - self.fast / self.slow
        if fallen > 0.0:
            self.slow = self.fast = 0.0  # as in amcl: else all would end in randomness
        poses, scores = self.candidates(ends, ELSEWHERE, RIVALS)
        self.chance = max(0.0, fallen, min(MOST_RIVALS, 1.0 - best / float(scores.max())))
        return self.drawn(poses, scores, p.max_particles) if self.chance > 0.0 else np.zeros((0, 3))

    def _belief(self, motion: Doubles, updated: bool) -> Belief:
        pose = compose(self.mean[None], motion)[0]
        return Belief(pose, self.covariance, len(self.poses), updated, self.chance)
