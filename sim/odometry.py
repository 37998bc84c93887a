"""Wheel-and-gyro odometry with the errors of a real robot of this size."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import numpy.typing as npt

from sim.physics import WHEEL_RADIUS, Motion

Array = npt.NDArray[np.float64]


class OdometryNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sizes of the errors, each a standard deviation.

    Scale of the wheels: 1 %, what UMBmark tests find of unequal and worn wheels (Borenstein, Feng 1996). Gyro: the data
    sheet of a common MEMS sensor (InvenSense MPU-9250), and a bias of 0.05 deg/s left after calibration at rest.
    """

    wheel_scale: float = 0.01  # drawn once a session, for both wheels together
    wheel_slip: float = 0.02  # of the distance of each interval
    gyro_bias: float = math.radians(0.05)  # rad/s, drawn once a session
    gyro_scale: float = 0.005  # drawn once a session
    gyro_noise: float = math.radians(0.01)  # rad/s/sqrt(Hz)


class Odometer:
    """Integrates wheels and gyro from a known start pose; deterministic by its generator."""

    def __init__(self, start: tuple[float, float, float], noise: OdometryNoise, rng: np.random.Generator) -> None:
        self.x, self.y, self.yaw = start
        self.noise, self.rng = noise, rng
        self.scale = 1.0 + noise.wheel_scale * float(rng.standard_normal())
        self.bias = noise.gyro_bias * float(rng.standard_normal())
        self.gyro = 1.0 + noise.gyro_scale * float(rng.standard_normal())
        self.wheels: tuple[float, float] | None = None
        self.linear = self.angular = 0.0

    def advance(self, motion: Motion, turned: float, seconds: float) -> None:
        """Take in one interval. turned: radians that the base really turned in it."""
        slip, noise = self.rng.standard_normal(2)
        if self.wheels is None:
            self.wheels = motion.wheels
            return
        left, right = (now - then for now, then in zip(motion.wheels, self.wheels, strict=True))
        self.wheels = motion.wheels
        moved = (left + right) / 2 * WHEEL_RADIUS * self.scale
        moved += abs(moved) * self.noise.wheel_slip * float(slip)
        turn = turned * self.gyro + self.bias * seconds + self.noise.gyro_noise * math.sqrt(seconds) * float(noise)
        self.x += moved * math.cos(self.yaw + turn / 2)
        self.y += moved * math.sin(self.yaw + turn / 2)
        self.yaw += turn
        self.linear, self.angular = moved / seconds, turn / seconds
