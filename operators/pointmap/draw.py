"""Seeded random numbers and weighted sampling without replacement."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
State = npt.NDArray[np.uint64]  # (1,)

TRIES = 20  # draws a wanted sample before a lopsided distribution is given up


def generator(seed: int, number: int) -> State:
    """Return the state of a generator (1,) for one frame: the same for the same seed and frame number."""
    return np.random.SeedSequence([seed, number]).generate_state(1, np.uint64).astype(np.uint64, copy=False)


@njit(cache=True)
def uniform(state: State) -> float:
    """Return the next number in [0, 1) of splitmix64 (Steele, Lea, Flood 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    mixed = state[0]
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed = mixed ^ (mixed >> np.uint64(31))
    return (mixed >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, error_model="numpy")
def alias_table(weights: npt.NDArray[Any]) -> tuple[Doubles, Ints]:
    """Return (share, other), each (n,), from which `sample` draws an index by weight in constant time (Vose 1991).

    weights: (n,) not negative, with a positive sum.
    """
    count = len(weights)
    total = 0.0
    for i in range(count):
        total += weights[i]
    share = np.empty(count, np.float64)
    other = np.empty(count, np.int32)
    pending = np.empty(count, np.int32)  # the poor from the left, the rich from the right
    poor, rich = 0, count
    for i in range(count):
        share[i] = weights[i] * count / total
        other[i] = i
        if share[i] < 1.0:
            pending[poor] = i
            poor += 1
        else:
            rich -= 1
            pending[rich] = i
    while poor > 0 and rich < count:
        poor -= 1
        small, large = pending[poor], pending[rich]
        other[small] = large
        share[large] -= 1.0 - share[small]
        if share[large] < 1.0:
            rich += 1
            pending[poor] = large
            poor += 1
    while poor > 0:  # rounding leaves a few that are full
        poor -= 1
        share[pending[poor]] = 1.0
    while rich < count:
        share[pending[rich]] = 1.0
        rich += 1
    return share, other


@njit(cache=True, error_model="numpy")
def sample(share: Doubles, other: Ints, drawn: Ints, stamp: int, wanted: int, state: State, chosen: Ints) -> int:
    """Draw so many different indices by weight into `chosen`; returns how many were found.

    share, other: from `alias_table`. drawn: (n,) scratch that remembers the stamp at which an index was last drawn;
    stamps must differ between calls. If no more are wanted than there are, all are taken in order. A distribution with
    too little weight on too many indices may give fewer.
    """
    count = len(share)
    if count <= wanted:
        for i in range(count):
            chosen[i] = i
        return count
    found = 0
    for _ in range(TRIES * wanted):
        position = uniform(state) * count
        i = min(count - 1, int(position))
        if position - i >= share[i]:
            i = other[i]
        if drawn[i] != stamp:
            drawn[i] = stamp
            chosen[found] = i
            found += 1
            if found == wanted:
                break
    return found
