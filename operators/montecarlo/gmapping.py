"""Grid mapping with Rao-Blackwellized particles, after Grisetti, Stachniss and Burgard (2007), as gmapping does it.

gmapping = Gmapping(Settings(), start=(1.0, 2.0, 0.0))
slam = gmapping.step(odometry, scan.returns(), scan.sensor)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import wrap
from operators.montecarlo.map_file import FREE, OCCUPIED, UNKNOWN, GridMap
from operators.montecarlo.matching import MOST_KERNEL, match
from operators.montecarlo.motion import Spread, compose, difference, shake
from operators.montecarlo.patches import SIDE, Patches
from operators.montecarlo.resampling import effective, systematic
from operators.montecarlo.scan import Band

Doubles = npt.NDArray[np.float64]


class Settings(Band):
    """The parameters of gmapping, by their names in ROS; lengths in metres, angles in radians."""

    particles: int = 30
    delta: float = 0.05  # of a cell
    maxUrange: float = 30.0  # beams are used up to here
    sigma: float = 0.05
    kernelSize: int = 1  # cells around an end point in which it may find its match
    lstep: float = 0.05
    astep: float = 0.05
    iterations: int = 5
    lsigma: float = 0.075
    ogain: float = 3.0
    lskip: int = 2  # beams left out between two that are matched
    minimumScore: float = 0.0  # below, a match is not believed and odometry stands
    srr: float = 0.1
    srt: float = 0.2
    str: float = 0.1
    stt: float = 0.2
    linearUpdate: float = 0.1
    angularUpdate: float = 0.05
    resampleThreshold: float = 0.5  # share of effective particles below which they are drawn anew
    occ_thresh: float = 0.25  # share of hits from which a cell of the map that goes out is occupied
    seed: int = 0


class Slam(NamedTuple):
    """Where the robot is believed to be, by the particle that has explained all scans best."""

    pose: Doubles  # (3,) x, y (metres), heading (radians)
    updated: bool  # whether the scan was used
    effective: float  # number of effective particles at the last update
    resampled: bool


class Gmapping:
    """Particles, each with a pose and a map; start: x, y, heading of the robot at the first scan.

    Raises ValueError for settings that fit nothing.
    """

    def __init__(
        self, settings: Settings | None = None, *, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        self.settings = s = Settings() if settings is None else settings
        if s.particles < 1 or s.iterations < 0 or s.lskip < 0 or not 0 <= s.kernelSize <= MOST_KERNEL:
            raise ValueError(
                f"gmapping wants at least one particle, no negative iterations or lskip, and a kernelSize of 0 to "
                f"{MOST_KERNEL}; given are {s.particles}, {s.iterations}, {s.lskip} and {s.kernelSize}"
            )
        if not min(s.delta, s.sigma, s.lsigma, s.ogain, s.lstep, s.astep, s.maxUrange) > 0.0:
            raise ValueError("gmapping wants delta, sigma, lsigma, ogain, lstep, astep and maxUrange above 0")
        self.rng = np.random.default_rng(s.seed)
        self.spread = Spread(s.srr, s.srt, s.str, s.stt)
        self.patches = Patches(s.particles, s.delta)
        self.poses = np.tile(np.array(start, np.float64), (s.particles, 1))
        self.logs = np.zeros(s.particles)  # log-weights since the last resampling
        self.sums = np.zeros(s.particles)  # of all log-likelihoods along a particle's past
        self.odometry: Doubles | None = None  # at the last update
        self.scans = self.resamplings = 0
        self.effective = float(s.particles)

    @property
    def best(self) -> int:
        """Return which particle has explained all scans best."""
        return int(np.argmax(self.sums))

    def step(self, odometry: Doubles, ends: Doubles, sensor: Doubles) -> Slam:
        """Take in odometry (3,) in whatever frame, and a scan: end points (n, 2) and sensor (2,) in the base frame.

        The scan is used where the robot has moved by linearUpdate or turned by angularUpdate since the last one, and
        has returns.
        """
        s = self.settings
        ends = ends[np.hypot(*(ends - sensor).T) < s.maxUrange] if len(ends) else ends
        if self.odometry is None:
            if len(ends):
                self.odometry = odometry.copy()
                self._register(ends, sensor)
            return Slam(self.poses[self.best], bool(len(ends)), self.effective, False)
        motion = difference(self.odometry, odometry)
        moved = math.hypot(motion[0], motion[1]) >= s.linearUpdate or abs(motion[2]) >= s.angularUpdate
        if not moved or not len(ends):
            return Slam(compose(self.poses[self.best][None], motion)[0], False, self.effective, False)
        self.odometry = odometry.copy()
        self.poses = shake(self.poses, motion, self.spread, self.rng)
        self._match(np.ascontiguousarray(ends[:: s.lskip + 1]), sensor)
        resampled = self._resample()
        self._register(ends, sensor)
        return Slam(self.poses[self.best], True, self.effective, resampled)

    def _match(self, ends: Doubles, sensor: Doubles) -> None:
        """Move each particle to where the scan fits its map best, and weigh it by how well it fits there."""
        s, corner = self.settings, np.append(self.patches.origin, 0.0)
        poses = self.poses - corner
        likelihoods = match(
            *(self.patches.directory, self.patches.store, poses, ends, sensor, s.delta, s.kernelSize),
            *(s.sigma, s.lstep, s.astep, s.iterations, s.minimumScore, s.lsigma),
        )
        self.poses = poses + corner
        self.logs += likelihoods
        self.sums += likelihoods
        self.poses[:, 2] = wrap(self.poses[:, 2])

    def _resample(self) -> bool:
        """Draw particles anew where too few bear the weight (selective resampling, section III-B)."""
        s = self.settings
        weights = np.exp((self.logs - self.logs.max()) / (s.ogain * s.particles))
        weights /= weights.sum()
        self.effective = effective(weights)
        if self.effective >= s.resampleThreshold * s.particles:
            return False
        parents = systematic(weights, float(self.rng.random()))
        self.patches.choose(parents)
        self.poses, self.sums = self.poses[parents], self.sums[parents]
        self.logs = np.zeros(s.particles)
        self.resamplings += 1
        return True

    def _register(self, ends: Doubles, sensor: Doubles) -> None:
        """Enter the scan into the map of each particle, at its pose."""
        self.patches.enter_each(self.poses, sensor, ends, np.ones(len(ends), np.bool_))
        self.scans += 1

    def grid(self, index: int | None = None) -> GridMap:
        """Return the map of a particle, by default of the best: 100 where enough beams ended, 0 where they passed.

        It reaches as far as the particle has seen, and has no cells before the first scan.
        """
        particle, patches = self.best if index is None else index, self.patches
        rows, columns = patches.seen(particle)
        hits, visits = patches.dense(particle, rows, columns)
        seen = np.where(hits > self.settings.occ_thresh * visits, OCCUPIED, FREE)
        corner = patches.origin + SIDE * self.settings.delta * np.array([columns.start, rows.start])
        return GridMap(np.where(visits > 0, seen, UNKNOWN).astype(np.int8), corner, self.settings.delta)
