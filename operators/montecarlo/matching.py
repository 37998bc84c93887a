"""Scan matching on a grid of mean end points: the score, the hill climb and the likelihood of gmapping."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.montecarlo.patches import BITS, LAST, SIDE, Store, X, Y

Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

BACK = math.sqrt(2.0)  # cells before an end point that should be free
NO_HIT = -0.5  # log-likelihood of a beam whose end meets nothing
MOVES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)  # each, and back
FAR = 1e9
MOST_KERNEL = 3  # the cells around an end point are bits of one number
DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)  # times 2^n has another number in its upper six bits for each n
PLACES = np.zeros(64, np.int64)  # n, by that number
PLACES[[(int(DE_BRUIJN) << n & 0xFFFFFFFFFFFFFFFF) >> 58 for n in range(64)]] = np.arange(64)


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
    (rows, columns) of one map. d is the distance from an end point to the mean of a cell within `kernel` cells of its
    own that is OFTEN hit, and before which, on the way to the sensor, lies one that is not.
    """
    before = _before(ends, sensor, resolution)
    return _judge(directory, store, pose, ends, before, resolution, kernel, sigma, logarithmic)


@njit(cache=True, error_model="numpy")
def _before(ends: Doubles, sensor: Doubles, resolution: float) -> Doubles:
    """Return the points (n, 2) a little before the end points, base frame, where beams should have been free."""
    before = np.empty_like(ends)
    for beam in range(len(ends)):
        rx, ry = ends[beam, 0] - sensor[0], ends[beam, 1] - sensor[1]
        step = BACK * resolution / math.sqrt(rx * rx + ry * ry)
        before[beam, 0], before[beam, 1] = ends[beam, 0] - step * rx, ends[beam, 1] - step * ry
    return before


@njit(cache=True, error_model="numpy")
def _judge(
    directory: Ints,
    store: Store,
    pose: Doubles,
    ends: Doubles,
    before: Doubles,
    resolution: float,
    kernel: int,
    sigma: float,
    logarithmic: bool,
) -> float:
    scale, met, often = 1.0 / resolution, store.ends, store.often
    height, width = directory.shape[0] << BITS, directory.shape[1] << BITS
    cosine, sine = math.cos(pose[2]) * scale, math.sin(pose[2]) * scale
    px, py = pose[0] * scale, pose[1] * scale
    reach, across = kernel + 2, 2 * kernel + 1  # cells around an end point that are looked at
    mask = (np.int64(1) << across) - 1
    total = 0.0
    for beam in range(len(ends)):
        bx, by, ax, ay = ends[beam, 0], ends[beam, 1], before[beam, 0], before[beam, 1]
        ex, ey = px + cosine * bx - sine * by, py + sine * bx + cosine * by
        cx, cy = np.int64(math.floor(ex)), np.int64(math.floor(ey))
        gap = FAR
        if reach <= cx < width - reach and reach <= cy < height - reach:
            fx = np.int64(px + cosine * ax - sine * ay) - cx  # to the cell that the beam passed before
            fy = np.int64(py + sine * ax + cosine * ay) - cy
            x0, y0 = cx - kernel, cy - kernel
            u0, v0 = x0 + fx, y0 + fy
            found = np.int64(0)  # eight bits a row of cells around: hit often, and the one before them not
            for row in range(across):
                y, v = y0 + row, v0 + row
                bits = np.int64(often[directory[y >> BITS, x0 >> BITS], y & LAST]) >> (x0 & LAST)
                if (x0 & LAST) + across > SIDE:  # the cells lie in two patches
                    bits |= np.int64(often[directory[y >> BITS, (x0 >> BITS) + 1], y & LAST]) << (SIDE - (x0 & LAST))
                free = np.int64(often[directory[v >> BITS, u0 >> BITS], v & LAST]) >> (u0 & LAST)
                if (u0 & LAST) + across > SIDE:
                    free |= np.int64(often[directory[v >> BITS, (u0 >> BITS) + 1], v & LAST]) << (SIDE - (u0 & LAST))
                found |= (bits & ~free & mask) << (row << 3)
            while found:
                lowest = found & -found
                found ^= lowest
                nth = PLACES[(np.uint64(lowest) * DE_BRUIJN) >> np.uint64(58)]
                y, x = y0 + (nth >> 3), x0 + (nth & 7)
                patch = directory[y >> BITS, x >> BITS]
                place = ((y & LAST) << BITS) | (x & LAST)
                dx = (ex - x) * resolution - met[patch, place, X]
                dy = (ey - y) * resolution - met[patch, place, Y]
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
    pose, before = start.copy(), _before(ends, sensor, resolution)
    score = _judge(directory, store, pose, ends, before, resolution, kernel, sigma, False)
    halved, last = 0, -1
    while True:
        best, best_score, back = pose, score, last ^ 1
        for move in range(len(MOVES)):
            if move == back:  # that pose scored less
                continue
            tried = pose.copy()
            tried[0] += MOVES[move, 0] * lstep
            tried[1] += MOVES[move, 1] * lstep
            tried[2] += MOVES[move, 2] * astep
            found = _judge(directory, store, tried, ends, before, resolution, kernel, sigma, False)
            if found > best_score:
                best, best_score, last = tried, found, move
        if best_score > score:
            pose, score = best, best_score
            continue
        if halved == iterations:
            return pose, score
        halved, last = halved + 1, -1
        lstep *= 0.5
        astep *= 0.5


@njit(cache=True, error_model="numpy")
def match(
    directories: Ints,
    store: Store,
    poses: Doubles,
    ends: Doubles,
    sensor: Doubles,
    resolution: float,
    kernel: int,
    sigma: float,
    lstep: float,
    astep: float,
    iterations: int,
    least: float,
    lsigma: float,
) -> Doubles:
    """Move each pose (n, 3) to where the scan fits its map best, unless it scores `least` or less there.

    Returns the log-likelihood (n,) of the scan at each pose then. directories: (n, rows, columns).
    """
    before = _before(ends, sensor, resolution)
    likelihoods = np.empty(len(poses))
    for index in range(len(poses)):
        directory = directories[index]
        matched, score = climb(
            directory, store, poses[index], ends, sensor, resolution, kernel, sigma, lstep, astep, iterations
        )
        if score > least:
            poses[index] = matched
        likelihoods[index] = _judge(directory, store, poses[index], ends, before, resolution, kernel, lsigma, True)
    return likelihoods
