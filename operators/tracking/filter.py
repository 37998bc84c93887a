"""One Kalman filter a person: place and velocity on the floor, constant velocity, both axes alike (Kalman 1960)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

ACCELERATION = 1.0  # m/s^2, standard deviation: people start, stop and turn within a second
MEASUREMENT = 0.06  # metres, standard deviation of the middle of what is seen of a person: arms and legs swing
FIRST_SPEED = 0.6  # m/s, standard deviation of the velocity of somebody just met


class Belief(NamedTuple):
    """What is believed of k people; the covariance of each axis is [[place, both], [both, velocity]]."""

    place: Floats  # (k, 2) metres
    velocity: Floats  # (k, 2) m/s
    variance: Floats  # (k, 3): place, both, velocity

    def kept(self, keep: npt.NDArray[np.bool_]) -> Belief:
        """Return some of the people."""
        return Belief(self.place[keep], self.velocity[keep], self.variance[keep])

    def joined(self, other: Belief) -> Belief:
        """Return these people, then the others."""
        return Belief(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def nobody() -> Belief:
    """Believe in nobody."""
    return Belief(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 3)))


def met(place: Floats) -> Belief:
    """Begin to believe in people at places (k, 2)."""
    variance = np.tile([MEASUREMENT**2, 0.0, FIRST_SPEED**2], (len(place), 1))
    return Belief(place.copy(), np.zeros_like(place), variance)


def predicted(belief: Belief, seconds: float) -> Belief:
    """Carry the belief on by some time."""
    place, both, velocity = belief.variance.T
    noise = ACCELERATION**2
    variance = np.stack(
        [
            place + 2.0 * seconds * both + seconds**2 * velocity + 0.25 * seconds**4 * noise,
            both + seconds * velocity + 0.5 * seconds**3 * noise,
            velocity + seconds**2 * noise,
        ],
        axis=1,
    )
    return Belief(belief.place + seconds * belief.velocity, belief.velocity, variance)


def corrected(belief: Belief, seen: Floats, deviation: Floats, where: npt.NDArray[np.bool_]) -> Belief:
    """Correct the belief of those people (k,) that were seen at places (k, 2), with standard deviations (k,)."""
    place, both, velocity = belief.variance.T
    total = place + deviation**2
    gain = np.where(where, place / total, 0.0)
    gain_velocity = np.where(where, both / total, 0.0)
    off = np.where(where[:, None], seen - belief.place, 0.0)
    variance = np.stack(
        [(1.0 - gain) * place, (1.0 - gain) * both, velocity - gain_velocity * both],
        axis=1,
    )
    return Belief(belief.place + gain[:, None] * off, belief.velocity + gain_velocity[:, None] * off, variance)
