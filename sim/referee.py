"""The referee of a tour: targets reached, the error of the robot's belief, and when the robot is stuck or lost.

The rules are the paper's: a target counts when the robot believes to be within 0.9 m of it, and is within 1.5 m; a tour
is over when the mean speed over 15 s falls below 0.03 m/s, or when the error exceeds 2 m. A target that the robot calls
unreachable is skipped, and counts as not reached.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

TRUE = 1.5  # metres that the robot may be away from a target that it believes to reach
SLOW = 0.03  # m/s, mean over
SLOW_TIME = 15.0  # seconds
LOST = 2.0  # metres
FREE_SPEED = 0.8  # m/s at which a free way is driven

FINISHED, STUCK, LOST_WAY, TIME_UP = "tour finished", "stuck", "lost", "time is up"
ENDINGS = (FINISHED, STUCK, LOST_WAY, TIME_UP)


class Referee:
    """Watches one tour.

    targets: (n, 2) metres. length: of the way through all of them, metres. patience: the tour ends after so many times
    its free driving time. radius: metres between the robot's own estimate and a target that it reaches.
    """

    def __init__(self, targets: Array, length: float, *, patience: float = 5.0, radius: float = 0.9) -> None:
        self.targets = targets
        self.limit = patience * length / FREE_SPEED
        self.radius = radius
        self.index = 0  # of the next target
        self.skipped = 0  # targets that the robot gave up
        self.errors: list[float] = []
        self.believed: Array | None = None  # (2,) where the robot last said it was
        self.track: deque[tuple[float, float]] = deque()  # time, and metres driven until then, of the last SLOW_TIME
        self.place: Array | None = None
        self.driven = 0.0
        self.time = 0.0
        self.ending = ""

    def judge(self, believed: Array, true: Array) -> None:
        """Take the robot's estimate of a pose, and the true one of the same moment; both world_from_base (4, 4)."""
        self.believed = np.array(believed[:2, 3])
        self.errors.append(float(np.hypot(*(believed[:2, 3] - true[:2, 3]))))

    def skip(self) -> None:
        """Go on with the next target: the robot calls this one unreachable."""
        if self.index < len(self.targets):
            self.index += 1
            self.skipped += 1

    def watch(self, time: float, true: Array) -> str:
        """Look at the robot's true pose at a time in seconds; return why the tour is over, or nothing.

        As long as the robot has never said where it is, its true place counts.
        """
        place = np.array(true[:2, 3])
        if self.place is not None:
            self.driven += math.hypot(place[0] - self.place[0], place[1] - self.place[1])
        self.place, self.time = place, time
        believed = place if self.believed is None else self.believed
        if self.index < len(self.targets):
            target = self.targets[self.index]
            if np.hypot(*(believed - target)) < self.radius and np.hypot(*(place - target)) < TRUE:
                self.index += 1
        self.track.append((time, self.driven))
        self.ending = self._ending(time)
        return self.ending

    def _ending(self, time: float) -> str:
        if self.index == len(self.targets):
            return FINISHED
        if self.errors and self.errors[-1] > LOST:
            return LOST_WAY
        if time > self.limit:
            return TIME_UP
        while self.track[0][0] < time - SLOW_TIME:
            self.track.popleft()
        began, driven = self.track[0]
        if time - began > SLOW_TIME - 0.05 and (self.driven - driven) / SLOW_TIME < SLOW:
            return STUCK
        return ""

    def summary(self) -> dict[str, Any]:
        """Return targets, reached, skipped, the error's quantiles, metres, seconds and ending, all as numbers."""
        errors = np.array(self.errors) if self.errors else np.zeros(1)
        return {
            "targets": len(self.targets),
            "reached": self.index - self.skipped,
            "skipped": self.skipped,
            "localization_error_m": {
                "median": float(np.median(errors)),
                "p95": float(np.percentile(errors, 95)),
                "max": float(errors.max()),
            },
            "driven_m": self.driven,
            "time_s": self.time,
            "mean_speed": self.driven / self.time if self.time > 0 else 0.0,
            "ending": {ending.replace(" ", "_"): int(ending == self.ending) for ending in ENDINGS},
        }
