"""Resampling: as many particles as their spread asks for (KLD), or always as many, evenly drawn."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Doubles = npt.NDArray[np.float64]
Longs = npt.NDArray[np.int64]

BIN = (0.5, 0.5, math.radians(10.0))  # metres, metres, radians: the histogram of amcl
TURN_BINS = 36
_EMPTY = np.iinfo(np.int64).min


def kld_limit(bins: int, kld_err: float, kld_z: float, most: int) -> int:
    """Return how many particles keep the error of a histogram of so many occupied bins below kld_err (Fox 2003, eq. 7).

    kld_z: the quantile of the standard normal distribution; as in amcl the number, not its probability.
    """
    return int(_limit(bins, kld_err, kld_z, most))


@njit(cache=True, error_model="numpy")
def _limit(bins: int, error: float, z: float, most: int) -> int:
    if bins <= 1:
        return most
    b = 2.0 / (9.0 * (bins - 1))
    root = 1.0 - b + math.sqrt(b) * z
    return min(most, math.ceil((bins - 1) / (2.0 * error) * root * root * root))


@njit(cache=True, error_model="numpy")
def bins_of(poses: Doubles) -> Longs:
    """Return the bin of the histogram (n,) that each pose (n, 3) falls in, as one number."""
    keys = np.empty(len(poses), np.int64)
    for i in range(len(poses)):
        column = np.int64(math.floor(poses[i, 0] / BIN[0]))
        row = np.int64(math.floor(poses[i, 1] / BIN[1]))
        turn = np.int64(math.floor(poses[i, 2] / BIN[2])) % TURN_BINS
        keys[i] = ((column + (1 << 24)) * (1 << 25) + row + (1 << 24)) * 64 + turn
    return keys


@njit(cache=True, error_model="numpy")
def _draw(
    cumulative: Doubles,
    keys: Longs,
    uniforms: Doubles,
    random_keys: Longs,
    chance: float,
    least: int,
    error: float,
    z: float,
) -> Longs:
    """Draw indices until there are as many as their bins ask for; -1 - k stands for the k-th random pose."""
    most = len(uniforms)
    chosen = np.empty(most, np.int64)
    size = 1
    while size < 2 * most:
        size *= 2
    table = np.full(size, _EMPTY, np.int64)
    bins = used = 0
    for n in range(most):
        if uniforms[n, 0] < chance:
            chosen[n], key = -1 - used, random_keys[used]
            used += 1
        else:
            chosen[n] = min(np.searchsorted(cumulative, uniforms[n, 1], side="right"), len(cumulative) - 1)
            key = keys[chosen[n]]
        slot = (key * np.int64(0x9E3779B97F4A7C1)) & (size - 1)
        while table[slot] != _EMPTY and table[slot] != key:
            slot = (slot + 1) & (size - 1)
        if table[slot] == _EMPTY:
            table[slot] = key
            bins += 1
        if n + 1 >= max(least, _limit(bins, error, z, most)):
            return chosen[: n + 1]
    return chosen


def resample(
    poses: Doubles,
    weights: Doubles,
    random_poses: Doubles,
    chance: float,
    rng: np.random.Generator,
    *,
    least: int,
    most: int,
    kld_err: float,
    kld_z: float,
) -> Doubles:
    """Draw poses (m, 3) by weights (n,) that sum to one, as many as the spread of what is drawn asks for (Fox 2003).

    chance: of taking one of the random poses (k, 3) instead, k at least `most` unless the chance is 0.
    """
    cumulative = np.cumsum(weights)
    cumulative /= cumulative[-1]
    chosen = _draw(
        cumulative, bins_of(poses), rng.random((most, 2)), bins_of(random_poses), chance, least, kld_err, kld_z
    )
    return np.ascontiguousarray(np.concatenate([poses, random_poses[::-1]])[chosen])


def systematic(weights: Doubles, uniform: float) -> Longs:
    """Draw as many indices (n,) as there are weights (n,), in order, by one number in [0, 1) (low variance)."""
    count = len(weights)
    cumulative = np.cumsum(weights)
    places = (np.arange(count) + uniform) / count * cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, places, side="right"), count - 1).astype(np.int64)


def effective(weights: Doubles) -> float:
    """Return the effective number of particles, 1 / sum w^2, of weights (n,) that sum to one."""
    return float(1.0 / np.sum(weights**2))


def heaviest_cluster(poses: Doubles, weights: Doubles) -> npt.NDArray[np.bool_]:
    """Say which particles (n,) belong to the connected bins of the histogram that bear most weight together."""
    keys, place = np.unique(bins_of(poses), return_inverse=True)
    labels = _connect(keys)[place]
    mass = np.bincount(labels, weights=weights)
    return np.asarray(labels == int(np.argmax(mass)))


@njit(cache=True, error_model="numpy")
def _connect(keys: Longs) -> Longs:
    """Label sorted bins (n,) so that bins that touch, headings in a circle, have one label."""
    parent = np.arange(len(keys))
    for i in range(len(keys)):
        turn = keys[i] % 64
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dt in range(-1, 2):
                    other = keys[i] - turn + (dx * (1 << 25) + dy) * 64 + (turn + dt) % TURN_BINS
                    place = np.searchsorted(keys, other)
                    if place < len(keys) and keys[place] == other:
                        a, b = i, place
                        while parent[a] != a:
                            a = parent[a]
                        while parent[b] != b:
                            b = parent[b]
                        parent[max(a, b)] = min(a, b)
    for i in range(len(keys)):
        parent[i] = parent[parent[i]]  # parents come before their children
    return parent


def mean_pose(poses: Doubles, weights: Doubles) -> tuple[Doubles, Doubles]:
    """Return the weighted mean (3,) of poses (n, 3), headings on the circle, and the covariance (3, 3)."""
    shares = weights / weights.sum()
    x, y = float(shares @ poses[:, 0]), float(shares @ poses[:, 1])
    cosine, sine = float(shares @ np.cos(poses[:, 2])), float(shares @ np.sin(poses[:, 2]))
    heading = math.atan2(sine, cosine)
    offsets = poses - (x, y, heading)
    offsets[:, 2] = (offsets[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    return np.array([x, y, heading]), np.asarray((offsets * shares[:, None]).T @ offsets)
