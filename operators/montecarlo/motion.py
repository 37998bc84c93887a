"""Odometry motion models: where particles go, given where wheels and gyro say the robot went."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import wrap

Doubles = npt.NDArray[np.float64]

STANDING = 0.01  # metres; below, the heading of a movement is noise, and the robot turned on the spot


class Alphas(NamedTuple):
    """Noise of a differential drive, as amcl of ROS names it: shares of squared motions."""

    alpha1: float = 0.05  # of turning, by turning
    alpha2: float = 0.1  # of turning, by driving (rad^2/m^2)
    alpha3: float = 0.1  # of driving, by driving
    alpha4: float = 0.05  # of driving, by turning (m^2/rad^2)


class Spread(NamedTuple):
    """Noise of the odometry, as gmapping names it: standard deviation a metre or radian."""

    srr: float = 0.1  # of driving, by driving
    srt: float = 0.2  # of turning, by driving (rad/m)
    str: float = 0.1  # of driving, by turning (m/rad)
    stt: float = 0.2  # of turning, by turning


def difference(before: Doubles, now: Doubles) -> Doubles:
    """Return the motion (3,) from one pose (x, y, heading) to another, in the axes of the first."""
    dx, dy = now[0] - before[0], now[1] - before[1]
    cosine, sine = math.cos(before[2]), math.sin(before[2])
    return np.array([cosine * dx + sine * dy, cosine * dy - sine * dx, float(wrap(now[2] - before[2]))])


def compose(poses: Doubles, motions: Doubles) -> Doubles:
    """Return the poses (n, 3) moved on by motions (n, 3) or (3,) in their own axes."""
    motions = np.broadcast_to(motions, poses.shape)
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cosine * motions[:, 0] - sine * motions[:, 1]
    y = poses[:, 1] + sine * motions[:, 0] + cosine * motions[:, 1]
    return np.stack([x, y, wrap(poses[:, 2] + motions[:, 2])], axis=1)


def move(poses: Doubles, motion: Doubles, alphas: Alphas, rng: np.random.Generator) -> Doubles:
    """Draw where particles (n, 3) are after a motion (3,): turn, drive, turn (Thrun, Burgard, Fox 2005, table 5.6).

    A robot that drives backwards turns no more than one that drives ahead: noise is of the smaller angle.
    """
    drive = math.hypot(motion[0], motion[1])
    first = 0.0 if drive < STANDING else math.atan2(motion[1], motion[0])
    second = float(wrap(motion[2] - first))
    a1, a2, a3, a4 = alphas
    turns = [min(abs(turn), abs(math.pi - abs(turn))) ** 2 for turn in (first, second)]
    scales = (
        math.sqrt(a1 * turns[0] + a2 * drive**2),
        math.sqrt(a3 * drive**2 + a4 * (turns[0] + turns[1])),
        math.sqrt(a1 * turns[1] + a2 * drive**2),
    )
    noisy = np.array([first, drive, second]) - rng.standard_normal((len(poses), 3)) * scales
    heading = poses[:, 2] + noisy[:, 0]
    x = poses[:, 0] + noisy[:, 1] * np.cos(heading)
    y = poses[:, 1] + noisy[:, 1] * np.sin(heading)
    return np.stack([x, y, wrap(heading + noisy[:, 2])], axis=1)


def shake(poses: Doubles, motion: Doubles, spread: Spread, rng: np.random.Generator) -> Doubles:
    """Draw where particles (n, 3) are after a motion (3,), each axis with its own noise, as gmapping does."""
    dx, dy, turn = (abs(value) for value in motion.tolist())
    across = 0.3 * spread.srr  # what of driving along one axis goes into the other
    scales = (
        spread.srr * dx + spread.str * turn + across * dy,
        spread.srr * dy + spread.str * turn + across * dx,
        spread.stt * turn + spread.srt * math.hypot(dx, dy),
    )
    return compose(poses, motion + rng.standard_normal((len(poses), 3)) * scales)
