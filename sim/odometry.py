"""Wheel-and-gyro odometry with the errors of a real robot of this size."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import numpy.typing as npt

from graph.geometry import yaw
from sim.physics import WHEEL_RADIUS, Motion

Array = npt.NDArray[np.float64]


class OdometryNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sizes of the errors, each a standard deviation.

    Wheels: half a percent of the distance, which D. P. Anderson measured with wheel encoders and a gyro on his jBot, a
    robot of this size (IMU Odometry, Seattle Robotics Society Encoder, 2006); two thirds of it slip at random over ten
    metres. Gyro: the noise density of a common MEMS sensor (InvenSense MPU-9250, data sheet: 0.01 deg/s/sqrt(Hz)). What
    a calibration at rest leaves of its bias, 0.05 deg/s, and of the 3 % of its scale, 0.5 %, are estimates.
    """

    wheel_scale: float = 0.005  # drawn once a session, for both wheels together
    wheel_slip: float = 0.01  # metres/sqrt(metre)
    gyro_bias: float = math.radians(0.05)  # rad/s, drawn once a session
    gyro_scale: float = 0.005  # drawn once a session
    gyro_noise: float = math.radians(0.01)  # rad/s/sqrt(Hz)


class Odometer:
    """Integrates wheels and gyro from where the robot stands, which it knows; deterministic by its generator."""

    def __init__(self, start: Motion, noise: OdometryNoise, rng: np.random.Generator) -> None:
        pose = start.world_from_base
        self.x, self.y, self.yaw = float(pose[0, 3]), float(pose[1, 3]), yaw(pose)
        self.wheels = start.wheels
        self.noise, self.rng = noise, rng
        self.scale = 1.0 + noise.wheel_scale * float(rng.standard_normal())
        self.bias = noise.gyro_bias * float(rng.standard_normal())
        self.gyro = 1.0 + noise.gyro_scale * float(rng.standard_normal())
        self.linear = self.angular = 0.0

    def advance(self, motion: Motion, turned: float, seconds: float) -> None:
        """Take in one interval. turned: radians that the base really turned in it."""
        slip, noise = self.rng.standard_normal(2)
        left, right = (now - then for now, then in zip(motion.wheels, self.wheels, strict=True))
        self.wheels = motion.wheels
        moved = (left + right) / 2 * WHEEL_RADIUS * self.scale
        moved += self.noise.wheel_slip * math.sqrt(abs(moved)) * float(slip)
        turn = turned * self.gyro + self.bias * seconds + self.noise.gyro_noise * math.sqrt(seconds) * float(noise)
        self.x += moved * math.cos(self.yaw + turn / 2)
        self.y += moved * math.sin(self.yaw + turn / 2)
        self.yaw += turn
        self.linear, self.angular = moved / seconds, turn / seconds
