"""How a differential drive moves: arcs, and the pose at which the next command will find the robot."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from numba import njit


class Twist(NamedTuple):
    """A velocity of the base."""

    linear: float = 0.0  # m/s, forward
    angular: float = 0.0  # rad/s, to the left


@njit(cache=True)
def advance(
    x: float, y: float, yaw: float, linear: float, angular: float, seconds: float
) -> tuple[float, float, float]:
    """Move a pose along an arc of constant velocities (midpoint rule: 0.04 % of the way too far at 0.1 rad)."""
    middle = yaw + 0.5 * angular * seconds
    return x + linear * seconds * math.cos(middle), y + linear * seconds * math.sin(middle), yaw + angular * seconds


@njit(cache=True)
def towards(now: float, wanted: float, most: float) -> float:
    """Change a velocity by at most `most`."""
    return min(max(wanted, now - most), now + most)


class Commands:
    """The commands given, each of which takes effect `latency` seconds after the measurement that it answers."""

    def __init__(self, latency: float) -> None:
        self.latency = latency
        self._given: deque[tuple[int, Twist]] = deque(maxlen=64)

    def give(self, measured_at: int, command: Twist) -> None:
        """Note a command that answers a measurement (nanoseconds)."""
        self._given.append((measured_at + round(self.latency * 1e9), command))

    @property
    def latest(self) -> Twist:
        """Return the last command given; at rest before the first."""
        return self._given[-1][1] if self._given else Twist()

    def at(self, time: int) -> Twist:
        """Return the command in effect at a time in nanoseconds; at rest before the first."""
        effective = Twist()
        for since, command in self._given:
            if since > time:
                break
            effective = command
        return effective

    def predict(self, measured_at: int, x: float, y: float, yaw: float) -> tuple[float, float, float]:
        """Carry a measured pose to the moment when the command that answers it takes effect."""
        now, end = measured_at, measured_at + round(self.latency * 1e9)
        changes = [since for since, _ in self._given if measured_at < since < end]
        for change in [*changes, end]:
            command = self.at(now)
            x, y, yaw = advance(x, y, yaw, command.linear, command.angular, (change - now) * 1e-9)
            now = change
        return x, y, yaw
