"""The way of a sensor during one scan, from a few poses along it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graph.geometry import logarithm

Array = npt.NDArray[np.float64]


def along(knots: Array, share: Array) -> Array:
    """Return the poses (n, 4, 4) at shares (n,) of the time between evenly spaced poses (k, 4, 4).

    Between two poses the sensor goes straight and turns steadily.
    """
    last = len(knots) - 1
    place = np.clip(share, 0.0, 1.0) * last
    index = np.minimum(place.astype(np.int64), last - 1)
    fraction = place - index
    result = np.broadcast_to(np.eye(4), (len(share), 4, 4)).copy()
    for k in range(last):
        here = index == k
        a, b = knots[k], knots[k + 1]
        vector = logarithm(a[:3, :3].T @ b[:3, :3])
        angle = float(np.linalg.norm(vector))
        x, y, z = vector / max(angle, 1e-12)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = (fraction[here] * angle)[:, None, None]
        spin = np.eye(3) + np.sin(turn) * cross + (1.0 - np.cos(turn)) * (cross @ cross)
        result[here, :3, :3] = a[:3, :3] @ spin
        result[here, :3, 3] = a[:3, 3] + fraction[here, None] * (b[:3, 3] - a[:3, 3])
    return result
