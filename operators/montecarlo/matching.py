"""Scan matching on a grid of mean end points: the score, the hill climb and the likelihood of gmapping."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.montecarlo.patches import BITS, HITS, OFTEN, SIDE, Store, X, Y

Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

BACK = math.sqrt(2.0)  # cells before an end point that should be free
NO_HIT = -0.5  # log-likelihood of a beam whose end meets nothing
MOVES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
FAR = 1e9


@njit(cache=True, error_model="numpy")
def judge(
    directory: Ints,
    store: Store,
    pose: Doubles,
    ends: Doubles,
    sensor: Doubles,
    resolution: float,
    kernel: int,
    sigma: float,
    logarithmic: bool,
) -> float:
    """Return the score of a scan, sum of exp(-d^2 / sigma), or its log-likelihood, sum of -d^2 / sigma.

    pose: (3,) relative to the corner of the map. ends: (n, 2) and sensor (2,) in the base frame. directory: the
    (rows, columns) of one map.
    """
    scale, back = 1.0 / resolution, BACK * resolution
    met, state = store.ends, store.state
    height, width = directory.shape[0] << BITS, directory.shape[1] << BITS
    cosine, sine = math.cos(pose[2]) * scale, math.sin(pose[2]) * scale
    px, py = pose[0] * scale, pose[1] * scale
    reach = kernel + 2  # cells around an end point that are looked at
    total = 0.0
    for beam in range(len(ends)):
        bx, by = ends[beam, 0], ends[beam, 1]
        ex, ey = px + cosine * bx - sine * by, py + sine * bx + cosine * by
        rx, ry = bx - sensor[0], by - sensor[1]
        step = back / math.sqrt(rx * rx + ry * ry)
        cx, cy = np.int64(math.floor(ex)), np.int64(math.floor(ey))
        gap = FAR
        if reach <= cx < width - reach and reach <= cy < height - reach:
            fx = np.int64(ex - step * (cosine * rx - sine * ry)) - cx  # to the cell that the beam passed before
            fy = np.int64(ey - step * (sine * rx + cosine * ry)) - cy
            for y in range(cy - kernel, cy + kernel + 1):
                for x in range(cx - kernel, cx + kernel + 1):
                    patch = directory[y >> BITS, x >> BITS]
                    place = ((y & (SIDE - 1)) << BITS) | (x & (SIDE - 1))
                    if state[patch, place] != OFTEN:
                        continue
                    v, u = y + fy, x + fx
                    if state[directory[v >> BITS, u >> BITS], ((v & (SIDE - 1)) << BITS) | (u & (SIDE - 1))] == OFTEN:
                        continue
                    hits = met[patch, place, HITS]
                    dx = (ex - x) * resolution - met[patch, place, X] / hits
                    dy = (ey - y) * resolution - met[patch, place, Y] / hits
                    gap = min(gap, dx * dx + dy * dy)
        if logarithmic:
            total += -gap / sigma if gap < FAR else NO_HIT
        elif gap < FAR:
            total += math.exp(-gap / sigma)
    return total


@njit(cache=True, error_model="numpy")
def climb(
    directory: Ints,
    store: Store,
    start: Doubles,
    ends: Doubles,
    sensor: Doubles,
    resolution: float,
    kernel: int,
    sigma: float,
    lstep: float,
    astep: float,
    iterations: int,
) -> tuple[Doubles, float]:
    """Climb from a pose (3,) to the best nearby, halving the steps (metres, radians) so many times; with its score."""
    pose = start.copy()
    score = judge(directory, store, pose, ends, sensor, resolution, kernel, sigma, False)
    halved = 0
    while True:
        best, best_score = pose, score
        for move in range(len(MOVES)):
            tried = pose.copy()
            tried[0] += MOVES[move, 0] * lstep
            tried[1] += MOVES[move, 1] * lstep
            tried[2] += MOVES[move, 2] * astep
            found = judge(directory, store, tried, ends, sensor, resolution, kernel, sigma, False)
            if found > best_score:
                best, best_score = tried, found
        if best_score > score:
            pose, score = best, best_score
            continue
        if halved == iterations:
            return pose, score
        halved += 1
        lstep *= 0.5
        astep *= 0.5
