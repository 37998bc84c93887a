"""Walkers: people who wander, and people who step into the robot's way. How they walk stands in steering.py."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sim.clearance import Clearance
from sim.figure import walking
from sim.steering import FOOT, ROBOT, STAND, STAND_SHARE, walk

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

STEP = 0.05  # seconds of one update, about
FRONT = (1.0, 1.25)  # metres in front of the robot at which a follower aims
ASIDE = 1.0  # radians by which that point may be off the robot's heading
KEPT = 5.0  # seconds, on average, until a follower chooses another such point
TURN_RATE = 4.0  # rad/s at which a body turns to where it goes
MOVES = 0.1  # m/s above which a body counts as moving
FIRST_STEP = 0.4  # metres after which who starts to walk takes full strides
SETTLING = 0.3  # seconds in which the feet of who stops come together


class Crowd:
    """All walkers of a session as arrays; deterministic by its generator.

    spots: (n, 2) where they begin, metres. following: (n,) who is a follower. attentive: share that minds the robot.
    """

    def __init__(self, spots: Array, following: Flags, attentive: float, rng: np.random.Generator) -> None:
        count = len(spots)
        self.rng = rng
        self.position = spots.astype(np.float64).copy()
        self.heading = rng.uniform(-np.pi, np.pi, count)  # where they want to go
        self.facing = self.heading.copy()  # where their body points
        self.following = following
        self.attentive = rng.random(count) < attentive
        self.pace = np.clip(rng.normal(0.92, 0.06, count), 0.75, 1.0)  # m/s
        self.height, self.build = stature(count, rng)
        self.kept = ROBOT + FOOT * self.height  # metres from the robot's middle
        self.velocity = np.zeros((count, 2))
        self.swing = np.zeros(count)  # share of a full stride that they have come to
        self.walked = rng.uniform(0.0, 2.0, count)  # metres, so that not all feet are in step
        self.standing = np.where(rng.random(count) < STAND_SHARE, rng.uniform(*STAND, count), 0.0) * ~following
        self.offset = self._offsets()

    def advance(
        self, seconds: float, free: Clearance, robot: tuple[float, float, float], near: Flags | None = None
    ) -> None:
        """Walk for a while. robot: x, y (metres), heading (radians). near: (n,) who could follow; by default all.

        A follower that does not see the robot wanders.
        """
        count = len(self.position)
        anew = self.rng.random(count) < seconds / KEPT
        self.offset = np.where(anew[:, None], self._offsets(), self.offset)
        low = np.array([free.x, free.y])
        place = np.array(robot[:2])
        bearing = robot[2] + self.offset[:, 1]
        aim = place + self.offset[:, :1] * np.stack([np.cos(bearing), np.sin(bearing)], 1)
        follows = self.following if near is None else self.following & near
        steps = max(1, round(seconds / STEP))
        step = seconds / steps
        for _ in range(steps):
            draws = np.stack([self.rng.standard_normal(count), self.rng.random(count), self.rng.uniform(*STAND, count)])
            walk(
                self.position, self.velocity, self.heading, self.standing, follows, self.attentive,
                self.pace, aim, draws, place, self.kept, free.distance, low, free.resolution, step,
            )  # fmt: skip
            pace = np.hypot(*self.velocity.T)
            self.walked += pace * step
            slower = np.maximum(0.0, self.swing - step / SETTLING)
            self.swing = np.where(pace > MOVES, np.minimum(1.0, self.swing + pace * step / FIRST_STEP), slower)
            went = np.arctan2(self.velocity[:, 1], self.velocity[:, 0])
            turn = np.where(pace > 0.15, went - self.facing, 0.0)
            self.facing += np.clip((turn + np.pi) % (2 * np.pi) - np.pi, -TURN_RATE * step, TURN_RATE * step)

    def _offsets(self) -> Array:
        """Draw the places in front of the robot, as distance and bearing (n, 2)."""
        count = len(self.position)
        return np.stack([self.rng.uniform(*FRONT, count), self.rng.uniform(-ASIDE, ASIDE, count)], 1)

    def moving(self) -> Flags:
        """Say who moves right now."""
        return np.asarray(np.hypot(*self.velocity.T) > MOVES)

    def stride_share(self) -> Array:
        """Return how much of the walking pose each shows: 1 at full pace, 0 standing."""
        return np.asarray(np.clip(np.hypot(*self.velocity.T) / 0.6, 0.0, self.swing))

    def phase(self) -> Array:
        """Return the gait's phase: the distance walked over the length of a stride."""
        return np.asarray(self.walked / (walking().stride * self.height))


def stature(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw height (metres) and build (1: average) of adults."""
    height = np.clip(rng.normal(1.71, 0.09, count), 1.50, 1.95)
    return height, np.clip(rng.normal(1.0, 0.08, count), 0.85, 1.25)


def spots(free: Clearance, box: Array, count: int, taken: Array, rng: np.random.Generator) -> Array:
    """Draw up to (count, 2) places on the free floor of a box (x0, y0, x1, y1), off things and off the places taken.

    taken: (m, 3) x, y and the distance to keep. Places are 0.4 m off things and 0.8 m off each other, and nearer where
    that does not fit.
    """
    found: list[Array] = []
    for tries in range(400 * count):
        if len(found) == count:
            break
        ease = 1.0 - 0.5 * tries / (400 * count)
        spot = rng.uniform(box[:2], box[2:])
        if free.at(spot[None])[0] < max(0.4 * ease, 0.27):
            continue
        if len(taken) and (np.hypot(*(taken[:, :2] - spot).T) < taken[:, 2]).any():
            continue
        if found and np.hypot(*(np.array(found) - spot).T).min() < 0.8 * ease:
            continue
        found.append(spot)
    return np.array(found).reshape(-1, 2)
