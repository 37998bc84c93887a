"""Flat upright pieces of a map: leaves of doors, fronts of cupboards, panels, walls from corner to corner."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from operators.annotation.session import Floats

Doubles = npt.NDArray[np.float64]
Longs = npt.NDArray[np.int64]

NOWHERE = -1  # piece of a point that is not upright
EDGE = 0.06  # metres of the cubes that are joined: two voxels
UPRIGHT = 0.3  # |z| of a normal, at most
ALIKE = math.cos(math.radians(11.0))  # between the normals of neighbouring cubes
THICKNESS = 0.015  # metres of one cube's middle from the plane of its neighbour
SECTORS = 4  # of half a turn: what faces other ways in one cube, as in a corner, is kept apart
AROUND = [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1) if (a, b, c) >= (0, 0, 0)]


def flat_pieces(points: Floats, normals: Floats) -> Longs:
    """Number the flat upright pieces of a cloud (n, 3) with normals (n, 3); -1 for points that belong to none.

    Cubes of 0.06 m are joined where they touch, face alike and lie on each other's plane. A wall ends at its corners,
    the leaf of a door at its hinges, unless it is shut flush with the wall.
    """
    pieces = np.full(len(points), NOWHERE, np.int64)
    upright = np.flatnonzero(np.abs(normals[:, 2]) < UPRIGHT)
    if not len(upright):
        return pieces
    cells = np.floor(points[upright] / EDGE).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    _, depth, height = (cells.max(axis=0) + 2).tolist()
    facing = np.arctan2(normals[upright, 1], normals[upright, 0]).astype(np.float64) % math.pi
    sector = np.floor(facing / math.pi * SECTORS + 0.5).astype(np.int64) % SECTORS
    place = (cells[:, 0] * depth + cells[:, 1]) * height + cells[:, 2]
    keys, cube = np.unique(place * SECTORS + sector, return_inverse=True)
    count = np.bincount(cube)
    middle = np.stack([np.bincount(cube, points[upright, axis]) / count for axis in range(2)], axis=1)
    doubled = np.bincount(cube, np.sin(2.0 * facing)), np.bincount(cube, np.cos(2.0 * facing))
    facing = 0.5 * np.arctan2(*doubled)  # the mean of directions whose sense does not matter
    normal = np.stack([np.cos(facing), np.sin(facing)], axis=1)
    pairs = [
        continued(keys, ((a * depth + b) * height + c) * SECTORS, sector, middle, normal)
        for a, b, c in AROUND
        for sector in range(SECTORS)
    ]
    one, other = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(one), np.bool_), (one, other)), shape=(len(keys), len(keys)))
    pieces[upright] = connected_components(graph, directed=False)[1][cube]
    return pieces


def continued(keys: Longs, step: int, sector: int, middle: Doubles, normal: Doubles) -> Longs:
    """Return the pairs (2, k) of cubes, each once, that are `step` apart, the second facing `sector`, on one plane.

    keys: (n,) rising. middle, normal: (n, 2) on the floor plan.
    """
    wanted = keys // SECTORS * SECTORS + step + sector
    found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    one = np.flatnonzero((keys[found] == wanted) & (found > np.arange(len(keys))))
    other = found[one]
    way = middle[other] - middle[one]
    flat = np.abs((normal[one] * normal[other]).sum(axis=1)) > ALIKE
    for side in (one, other):
        flat &= np.abs((way * normal[side]).sum(axis=1)) < THICKNESS
    return np.stack([one[flat], other[flat]])


def share_of_piece(pieces: Longs, chosen: npt.NDArray[np.bool_]) -> Doubles:
    """Return for each point (n,) what share of its piece is chosen (n,); 0 for points without a piece."""
    inside = pieces != NOWHERE
    size = np.bincount(pieces[inside], minlength=1)
    taken = np.bincount(pieces[inside], chosen[inside], minlength=1)
    return np.where(inside, (taken / np.maximum(size, 1))[pieces], 0.0)


def length_of_piece(pieces: Longs, points: Floats) -> Doubles:
    """Return for each point (n, 3) the larger side of its piece's box on the floor plan, metres; 0 without a piece."""
    lengths = np.zeros(len(pieces))
    inside = np.flatnonzero(pieces != NOWHERE)
    if not len(inside):
        return lengths
    order = inside[np.argsort(pieces[inside], kind="stable")]
    first = np.flatnonzero(np.diff(pieces[order], prepend=NOWHERE))
    spread = np.maximum.reduceat(points[order, :2], first) - np.minimum.reduceat(points[order, :2], first)
    lengths[order] = np.repeat(spread.max(axis=1), np.diff(first, append=len(order)))
    return lengths
