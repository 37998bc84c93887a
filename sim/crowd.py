"""Walkers: people who wander, and people who step into the robot's way.

The behaviours are those of the paper's simulation: a wanderer's heading is a random walk; a follower aims at a point
1 to 1.25 m in front of the robot. All of them are pushed off walls, things, each other and, if they are attentive, the
robot, by 1/d^2 within a margin.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sim.clearance import Clearance
from sim.figure import walking

Array = npt.NDArray[np.float64]

MARGIN = 0.5  # metres: people and obstacles push within it
BODY = 0.22  # metres: half the breadth of a person
ROBOT = 0.27  # metres: half the diagonal of the robot
STEP = 0.05  # seconds of one update
TURNING = 0.6  # rad/sqrt(s), of a wanderer's heading
STAND_SHARE = 0.2  # of its time that a wanderer stands
STAND = (2.0, 20.0)  # seconds at once
FRONT = (1.0, 1.25)  # metres in front of the robot at which a follower aims
ARRIVED = 0.25  # metres from its aim at which a follower stops
RESPONSE = 0.4  # seconds in which velocity follows intent


class Crowd:
    """All walkers of a session as arrays; deterministic by its generator.

    spots: (n, 2) where they begin, metres. following: (n,) who is a follower.
    """

    def __init__(
        self, spots: Array, following: npt.NDArray[np.bool_], attentive: float, rng: np.random.Generator
    ) -> None:
        count = len(spots)
        self.rng = rng
        self.position = spots.astype(np.float64).copy()
        self.heading = rng.uniform(-np.pi, np.pi, count)
        self.following = following
        self.attentive = rng.random(count) < attentive
        self.pace = np.clip(rng.normal(0.92, 0.06, count), 0.75, 1.0)  # m/s
        self.height = np.clip(rng.normal(1.71, 0.09, count), 1.50, 1.95)  # metres
        self.build = np.clip(rng.normal(1.0, 0.08, count), 0.85, 1.25)
        self.velocity = np.zeros((count, 2))
        self.walked = rng.uniform(0.0, 2.0, count)  # metres, so that not all feet are in step
        self.standing = np.where(rng.random(count) < STAND_SHARE, rng.uniform(*STAND, count), 0.0)  # seconds left
        self.offset = np.stack([rng.uniform(*FRONT, count), rng.uniform(-1.0, 1.0, count)], 1)
        self.facing = self.heading.copy()

    def advance(self, seconds: float, free: Clearance, robot: tuple[float, float, float]) -> None:
        """Walk for a while. robot: x, y (metres) and heading (radians)."""
        for _ in range(round(seconds / STEP)):
            self._step(free, robot)

    def moving(self) -> npt.NDArray[np.bool_]:
        """Say who moves right now (faster than 0.1 m/s)."""
        return np.hypot(*self.velocity.T) > 0.1

    def stride_share(self) -> Array:
        """Return how much of the walking pose each shows: 1 at full pace, 0 standing."""
        return np.clip(np.hypot(*self.velocity.T) / 0.6, 0.0, 1.0)

    def phase(self) -> Array:
        """Return the gait's phase: the distance walked over the length of a stride."""
        return self.walked / (walking().stride * self.height)

    def _step(self, free: Clearance, robot: tuple[float, float, float]) -> None:
        count = len(self.position)
        if not count:
            return
        self.heading += self.rng.normal(0.0, TURNING * np.sqrt(STEP), count)
        self._pause(count)
        intent = np.stack([np.cos(self.heading), np.sin(self.heading)], 1)
        speed = np.where(self.standing > 0, 0.0, self.pace)
        self._follow(intent, speed, robot)
        push = self._walls(free) + self._others()
        away = self.position - robot[:2]
        distance = np.maximum(np.hypot(*away.T), 0.05)
        gap = np.maximum(distance - ROBOT - BODY, 0.05)
        shy = (gap < MARGIN) & self.attentive & ~self.following
        push[shy] += (away[shy] / distance[shy, None]) * np.minimum(0.15 / gap[shy, None] ** 2, 3.0)
        wish = intent * speed[:, None]
        pressed = np.hypot(*push.T)
        wish += push * np.where(speed > 0, 1.0, 0.6)[:, None]
        size = np.maximum(np.hypot(*wish.T), 1e-9)
        wish *= np.minimum(1.0, np.where((speed > 0) | (pressed > 0.3), self.pace, 0.0) / size)[:, None]
        self.velocity += (wish - self.velocity) * min(1.0, STEP / RESPONSE)
        before = self.position
        self.position = self._blocked(before + self.velocity * STEP, free, robot)
        self.velocity = (self.position - before) / STEP
        pace = np.hypot(*self.velocity.T)
        self.walked += pace * STEP
        turn = np.where(pace > 0.15, np.arctan2(self.velocity[:, 1], self.velocity[:, 0]), self.facing)
        wander = ~self.following & (pressed > 0.2) & (pace > 0.05)
        self.heading[wander] += (
            _wrap(turn - self.heading)[wander] * 0.3
        )  # deflected people go on where they were pushed
        self.facing += np.clip(_wrap(turn - self.facing), -STEP * 4.0, STEP * 4.0)

    def _pause(self, count: int) -> None:
        """Let wanderers stand for a fifth of their time."""
        draws, lengths = self.rng.random(count), self.rng.uniform(*STAND, count)
        rate = STEP * STAND_SHARE / (1.0 - STAND_SHARE) / np.mean(STAND)
        begin = (self.standing <= 0) & (draws < rate) & ~self.following
        self.standing = np.maximum(np.where(begin, lengths, self.standing - STEP), 0.0)

    def _follow(self, intent: Array, speed: Array, robot: tuple[float, float, float]) -> None:
        """Turn the followers towards their places in front of the robot."""
        who = self.following
        if not who.any():
            return
        bearing = robot[2] + self.offset[who, 1]
        aim = np.array(robot[:2]) + self.offset[who, :1] * np.stack([np.cos(bearing), np.sin(bearing)], 1)
        way = aim - self.position[who]
        left = np.hypot(*way.T)
        intent[who] = way / np.maximum(left, 1e-9)[:, None]
        speed[who] = np.where(left < ARRIVED, 0.0, self.pace[who] * np.minimum(1.0, left / 0.5))

    def _walls(self, free: Clearance) -> Array:
        """Push off walls and things by the gradient of the clearance."""
        step = free.resolution
        x, y = np.array([step, 0.0]), np.array([0.0, step])
        at = self.position
        slope = np.stack([free.at(at + x) - free.at(at - x), free.at(at + y) - free.at(at - y)], 1)
        slope /= np.maximum(np.hypot(*slope.T), 1e-9)[:, None]
        gap = np.maximum(free.at(at) - BODY, 0.05)
        return slope * np.where(gap < MARGIN, np.minimum(0.05 / gap**2, 3.0), 0.0)[:, None]

    def _others(self) -> Array:
        """Push off each other."""
        away = self.position[:, None] - self.position[None]
        distance = np.hypot(away[..., 0], away[..., 1])
        np.fill_diagonal(distance, np.inf)
        gap = np.maximum(distance - 2 * BODY, 0.05)
        strength = np.where(gap < MARGIN, np.minimum(0.04 / gap**2, 2.0), 0.0) / np.maximum(distance, 0.05)
        return (away * strength[..., None]).sum(1)

    def _blocked(self, wanted: Array, free: Clearance, robot: tuple[float, float, float]) -> Array:
        """Stop those who would walk into a wall, a thing, or further into the robot; first try each axis alone."""
        result = self.position.copy()
        here = free.at(self.position)
        for axes in (slice(0, 2), slice(0, 1), slice(1, 2)):
            trial = result.copy()
            trial[:, axes] = wanted[:, axes]
            there = free.at(trial)
            fine = (there >= BODY) | (there > here)
            near = np.hypot(*(trial - robot[:2]).T)
            fine &= (near > ROBOT + BODY - 0.12) | (near > np.hypot(*(self.position - robot[:2]).T))
            still = (result == self.position).all(1)
            result[fine & still] = trial[fine & still]
        return result


def _wrap(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def spots(free: Clearance, rooms: list[Array], count: int, keep: Array, rng: np.random.Generator) -> Array:
    """Draw (count, 2) places on the free floor of some rooms: 0.4 m off things, 0.7 m off each other, 1.5 m off `keep`.

    rooms: polygons' bounding boxes (x0, y0, x1, y1). Returns fewer where there is no room for all.
    """
    found: list[Array] = []
    areas = np.array([(box[2] - box[0]) * (box[3] - box[1]) for box in rooms])
    for _ in range(60 * count):
        if len(found) == count:
            break
        box = rooms[int(rng.choice(len(rooms), p=areas / areas.sum()))]
        spot = rng.uniform(box[:2], box[2:])
        if free.at(spot[None])[0] < 0.4 or np.linalg.norm(spot - keep) < 1.5:
            continue
        if found and np.linalg.norm(np.array(found) - spot, axis=1).min() < 0.7:
            continue
        found.append(spot)
    return np.array(found).reshape(-1, 2)
