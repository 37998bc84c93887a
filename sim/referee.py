"""The referee of a tour: targets reached, the error of the robot's belief, and when the robot is stuck or lost.

The rules are the paper's: a target counts when the robot believes to be within 0.9 m of it, and is within 1.5 m; a tour
is over when the mean speed over 15 s falls below 0.03 m/s, or when the error exceeds 2 m.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

BELIEVED = 0.9  # metres between the robot's own estimate and a target that it reaches
TRUE = 1.5  # metres that it may be away in truth
SLOW = 0.03  # m/s, mean over
SLOW_TIME = 15.0  # seconds
LOST = 2.0  # metres
FREE_SPEED = 0.8  # m/s at which a free way is driven


class Referee:
    """Watches one tour. targets: (n, 2) metres; way: (m, 2) through all of them."""

    def __init__(self, targets: Array, way: Array, *, patience: float) -> None:
        self.targets = targets
        self.free_length = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
        self.limit = patience * self.free_length / FREE_SPEED
        self.index = 0  # of the next target
        self.reached = 0
        self.errors: list[float] = []
        self.believed: Array | None = None  # (2,) where the robot last said it was
        self.track: deque[tuple[float, float, float]] = deque()  # time, x, y of the last SLOW_TIME
        self.driven = 0.0
        self.time = 0.0
        self.ending = "under way"

    def judge(self, time: float, believed: Array, true: Array) -> None:
        """Take the robot's estimate of a pose, and the true one of the same moment; both world_from_base (4, 4)."""
        self.believed = np.asarray(believed[:2, 3])
        self.errors.append(float(np.linalg.norm(believed[:2, 3] - true[:2, 3])))

    def watch(self, time: float, true: Array) -> str:
        """Look at the robot's true pose; return why the tour is over, or nothing."""
        place = np.asarray(true[:2, 3])
        if self.track:
            self.driven += math.hypot(place[0] - self.track[-1][1], place[1] - self.track[-1][2])
        self.time = time
        self.track.append((time, float(place[0]), float(place[1])))
        believed = place if self.believed is None else self.believed
        target = self.targets[self.index]
        if np.linalg.norm(believed - target) < BELIEVED and np.linalg.norm(place - target) < TRUE:
            self.reached += 1
            self.index += 1
        self.ending = self._ending(time)
        return self.ending

    def _ending(self, time: float) -> str:
        if self.index == len(self.targets):
            return "tour finished"
        if self.errors and self.errors[-1] > LOST:
            return "lost"
        if time > self.limit:
            return "time is up"
        while self.track[-1][0] - self.track[0][0] > SLOW_TIME:
            self.track.popleft()
        if time >= SLOW_TIME:
            steps = np.diff(np.array(self.track)[:, 1:], axis=0)
            if np.linalg.norm(steps, axis=1).sum() / SLOW_TIME < SLOW:
                return "stuck"
        return ""

    def summary(self) -> dict[str, Any]:
        """Return targets, reached, the error's quantiles in metres, metres driven and mean speed."""
        errors = np.array(self.errors) if self.errors else np.zeros(1)
        return {
            "targets": len(self.targets),
            "reached": self.reached,
            "ending": self.ending or "stopped",
            "localization_error_m": {
                "median": float(np.median(errors)),
                "p95": float(np.percentile(errors, 95)),
                "max": float(errors.max()),
            },
            "driven_m": self.driven,
            "mean_speed": self.driven / self.time if self.time > 0 else 0.0,
        }
