"""Where the points of a convolution kernel sit: charges that repel each other, drawn to the centre by springs."""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

Doubles = npt.NDArray[np.float64]

STARTS = 8  # random starts; 15 points have one best disposition, which most starts find
MEAN_RADIUS = 0.66  # of the outer points, in radii of the kernel (Thomas et al. 2019, supplementary material)


def energy(points: Doubles, spring: float) -> tuple[float, Doubles]:
    """Return the energy of points (k, 3) and its gradient: sum of 1 / distance, plus spring times squared radius.

    (Thomas et al. 2019, eq. 4 to 6; there spring = 1 and the result is scaled, which changes the spring alone.)
    """
    apart = points[:, None] - points[None]
    squares = (apart**2).sum(-1)
    np.fill_diagonal(squares, np.inf)
    repulsion = 0.5 * (1.0 / np.sqrt(squares)).sum()
    gradient = -(apart / squares[..., None] ** 1.5).sum(1) + 2.0 * spring * points
    return float(repulsion + spring * (points**2).sum()), gradient


def spring_of(points: Doubles) -> float:
    """Return the spring for which the scale of these points has the least energy (d E / d scale = 0)."""
    repulsion = energy(points, 0.0)[0]
    return float(repulsion / (2.0 * (points**2).sum()))


@functools.cache
def kernel_points(count: int) -> Doubles:
    """Return the disposition (count, 3) for a kernel of radius 1: one point in the centre, the others around it.

    The outer points' mean radius is 0.66. The axis of the disposition points along z. Raises ValueError below 5 points.
    """
    if count < 5:
        raise ValueError(f"a kernel of {count} points was wanted; at least 5 span space")
    generator = np.random.default_rng(0)
    best, least = np.zeros((count, 3)), np.inf

    def outer(flat: Doubles) -> tuple[float, Doubles]:
        value, gradient = energy(np.vstack([np.zeros(3), flat.reshape(-1, 3)]), 1.0)
        return value, gradient[1:].ravel()

    for _ in range(STARTS):
        found = minimize(outer, generator.normal(size=3 * (count - 1)), jac=True, method="BFGS", options={"gtol": 1e-9})
        if found.fun < least - 1e-9:
            best, least = np.vstack([np.zeros(3), found.x.reshape(-1, 3)]), found.fun
    best = upright(best)
    best *= MEAN_RADIUS / np.linalg.norm(best[1:], axis=1).mean()
    best.flags.writeable = False
    return best


def upright(points: Doubles) -> Doubles:
    """Turn points so that the axis of the odd moment of inertia is z, and the farthest point from it has y = 0."""
    moments, axes = np.linalg.eigh(points.T @ points)
    odd = 0 if moments[1] - moments[0] > moments[2] - moments[1] else 2
    turned = points @ np.roll(axes, 2 - odd, axis=1)
    far = int(np.argmax(np.round(np.hypot(turned[:, 0], turned[:, 1]), 6)))
    yaw = np.arctan2(turned[far, 1], turned[far, 0])
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return turned @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
