"""How a differential drive moves: arcs, and the pose at which the next command will find the robot."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from numba import njit

from graph.geometry import wrap

Planar = tuple[float, float, float]  # x, y in metres, yaw in radians

WATCHED = 3  # periods over which poses are held against commands
SLOWED, TURNED = 0.35, 0.8  # m/s less than commanded, and rad/s off it, from which a robot is held or turned


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


@njit(cache=True)
def paced(now: float, wanted: float, faster: float, slower: float) -> float:
    """Change a speed towards another, by at most `faster` away from rest and `slower` towards it; all in m/s."""
    least = now - faster if now <= 0.0 else (now - slower if now >= slower else min(now - faster, 0.0))
    most = now + faster if now >= 0.0 else (now + slower if now <= -slower else max(now + faster, 0.0))
    return min(max(wanted, least), most)


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


class Progress:
    """What becomes of the commands: whether the robot gets on as they say, or pushes against something."""

    def __init__(self, turn: float) -> None:
        """Take the fastest turn of the drive in rad/s."""
        self._turn = turn
        self._poses: deque[tuple[int, float, float, float]] = deque(maxlen=WATCHED + 1)

    def hindered(self, commands: Commands, measured_at: int, x: float, y: float, yaw: float) -> Twist | None:
        """Return the velocity that the robot has had of late if the commands say another; None while all is well.

        measured_at in nanoseconds; x, y in metres and yaw in radians, as measured then. To be asked at every pose.
        """
        self._poses.append((measured_at, x, y, yaw))
        since, x_then, y_then, yaw_then = self._poses[0]
        seconds = (measured_at - since) * 1e-9
        if len(self._poses) <= WATCHED or seconds <= 0.0:
            return None
        turned = float(wrap(yaw - yaw_then))
        middle = yaw_then + 0.5 * turned
        linear = ((x - x_then) * math.cos(middle) + (y - y_then) * math.sin(middle)) / seconds
        angular = turned / seconds
        given = [commands.at(pose[0]) for pose in list(self._poses)[:-1]]
        wanted = sum(command.linear for command in given) / WATCHED
        forth = math.copysign(1.0, wanted)
        slowed = forth * (wanted - linear) > SLOWED
        if not slowed and abs(angular - sum(command.angular for command in given) / WATCHED) < TURNED:
            return None
        slower = min(max(forth * linear, 0.0), abs(wanted))
        return Twist(forth * slower, min(max(angular, -self._turn), self._turn))
