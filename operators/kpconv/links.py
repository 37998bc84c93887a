"""The sparse matrices of kernel point convolutions: which neighbour reaches which kernel point, and how strongly.

A KPConv is linear in its features: row (point, kernel point) of a sparse matrix sums the neighbours' features with
their influence on that kernel point (Thomas et al. 2019, eq. 1 to 3); a dense matrix then mixes kernel points and
channels. A neighbour reaches 1.7 of 15 kernel points on average, so the sparse form saves nine tenths of the work, and
it needs neither a limit on neighbours nor shadow points.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.kpconv.disposition import kernel_points
from operators.kpconv.grid import Floats, Grid, Ints, run_of

Bytes = npt.NDArray[np.uint8]

ENTRIES = 40  # guess of entries a point; the arrays grow where it is too small
NEIGHBOURS = 20
BOXES = 16  # boxes an edge of the table of candidates


class Kernel(NamedTuple):
    """A kernel in units of its radius, with a table that says which kernel points a place may reach."""

    points: Floats  # (k, 3)
    extent: float  # distance at which the influence ends
    box_starts: Ints  # (BOXES^3 + 1,) first candidate of each box of [-1, 1]^3
    candidates: Bytes  # kernel points


class Links(NamedTuple):
    """A sparse matrix of (points, kernel points) rows, grouped by point, and each point's list of neighbours."""

    starts: Ints  # (q + 1,) first entry of each point
    columns: Ints  # (entries,) neighbour
    places: Bytes  # (entries,) kernel point
    weights: Floats  # (entries,) influence, in (0, 1]
    neighbour_starts: Ints  # (q + 1,) first neighbour of each point; empty where no neighbours were asked for
    neighbours: Ints  # (pairs,) all points within the radius
    sources: int  # number of points that may be neighbours


@functools.cache
def kernel_of(count: int, extent: float) -> Kernel:
    """Return the kernel of `count` points; extent: of the influence, in radii of the kernel."""
    points = kernel_points(count)
    edge = 2.0 / BOXES
    low = np.stack(np.meshgrid(*[np.arange(BOXES) * edge - 1.0] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
    gaps = np.maximum(np.maximum(low - points, points - low - edge), 0.0)
    reached = (gaps**2).sum(-1) < (extent + 1e-3) ** 2  # (boxes, k); the margin covers rounding at a box's edge
    box_starts = np.concatenate([[0], np.cumsum(reached.sum(1))]).astype(np.int32)
    return Kernel(points.astype(np.float32), extent, box_starts, np.nonzero(reached)[1].astype(np.uint8))


@njit(cache=True, nogil=True, error_model="numpy")
def connect(
    grid: Grid,
    queries: Floats,
    radius: float,
    kernel: Kernel,
    begin: int,
    starts: Ints,
    columns: Ints,
    places: Bytes,
    weights: Floats,
    neighbour_starts: Ints,
    neighbours: Ints,
) -> int:
    """Link queries (q, 3) from `begin` on until they end or the room for entries or neighbours does.

    radius: metres, at most a cell. The other arrays are those of Links, written from the entries that starts[begin] and
    neighbour_starts[begin] name; no list of neighbours is kept where `neighbour_starts` is empty. Returns the first
    query that is not done.
    """
    listed = len(neighbour_starts) > 0
    size, cloud = grid.cell_size, grid.points
    first, after = np.empty(9, np.int64), np.empty(9, np.int64)
    near = np.empty(len(cloud), np.int32)  # neighbours of the query at hand
    offsets = np.empty((len(cloud), 3), np.float32)  # in radii
    limit, scale = np.float32(radius * radius), np.float32(1.0 / radius)
    reach, per_extent = np.float32(kernel.extent * kernel.extent), np.float32(1.0 / kernel.extent)
    half, most = np.float32(BOXES / 2), BOXES - 1
    runs, last_i, last_j, last_k = 0, 0, 0, 0
    known = False
    entries = starts[begin]
    pairs = neighbour_starts[begin] if listed else 0
    for q in range(begin, len(queries)):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        i, j, k = math.floor(x / size), math.floor(y / size), math.floor(z / size)
        if not known or i != last_i or j != last_j or k != last_k:
            known, last_i, last_j, last_k, runs = True, i, j, k, 0
            for code in range(9):
                a, b = run_of(grid, i + code // 3 - 1, j + code % 3 - 1, k - 1, k + 1)
                if a < b:
                    first[runs], after[runs] = a, b
                    runs += 1
        own = 0
        for run in range(runs):
            for n in range(first[run], after[run]):
                dx, dy, dz = cloud[n, 0] - x, cloud[n, 1] - y, cloud[n, 2] - z
                near[own] = n
                offsets[own, 0], offsets[own, 1], offsets[own, 2] = dx * scale, dy * scale, dz * scale
                own += 1 if dx * dx + dy * dy + dz * dz <= limit else 0
        if entries + own * len(kernel.points) > len(columns) or (listed and pairs + own > len(neighbours)):
            return q
        for n in range(own):
            dx, dy, dz = offsets[n, 0], offsets[n, 1], offsets[n, 2]
            u = min(int((dx + np.float32(1.0)) * half), most)
            v = min(int((dy + np.float32(1.0)) * half), most)
            w = min(int((dz + np.float32(1.0)) * half), most)
            box = (u * BOXES + v) * BOXES + w
            for c in range(kernel.box_starts[box], kernel.box_starts[box + 1]):
                p = kernel.candidates[c]
                ex, ey, ez = dx - kernel.points[p, 0], dy - kernel.points[p, 1], dz - kernel.points[p, 2]
                square = ex * ex + ey * ey + ez * ez
                columns[entries], places[entries] = near[n], p
                weights[entries] = np.float32(1.0) - np.sqrt(square) * per_extent
                entries += 1 if square < reach else 0
        starts[q + 1] = entries
        if listed:
            for n in range(own):
                neighbours[pairs + n] = near[n]
            pairs += own
            neighbour_starts[q + 1] = pairs
    return len(queries)


def link(grid: Grid, queries: Floats, *, radius: float, kernel: Kernel, listed: bool = False) -> Links:
    """Build the sparse matrix of a KPConv from grid points to queries (q, 3), which lie in the grid's frame.

    radius: of the kernel, metres, at most the grid's cell. listed: keep the lists of neighbours, for max pooling.
    Raises ValueError for a radius that the cells do not cover.
    """
    if radius > grid.cell_size:
        raise ValueError(f"a radius of {radius:g} m was wanted; the grid's cells cover {grid.cell_size:g} m")
    count, spare = len(queries), len(kernel.points) * len(grid.points)  # with the spare room at least one query fits
    starts = np.zeros(count + 1, np.int32)
    neighbour_starts = np.zeros(count + 1 if listed else 0, np.int32)
    room, pair_room = ENTRIES * count + spare, NEIGHBOURS * count + spare if listed else 0
    columns, places, weights = np.empty(room, np.int32), np.empty(room, np.uint8), np.empty(room, np.float32)
    neighbours = np.empty(pair_room, np.int32)
    done = 0
    while True:
        done = connect(
            grid, queries, radius, kernel, done, starts, columns, places, weights, neighbour_starts, neighbours
        )
        if done == count:
            break
        columns, places, weights = (np.concatenate([array, array]) for array in (columns, places, weights))
        neighbours = np.concatenate([neighbours, neighbours])
    entries, pairs = int(starts[-1]), int(neighbour_starts[-1]) if listed else 0
    return Links(
        starts, columns[:entries], places[:entries], weights[:entries], neighbour_starts, neighbours[:pairs],
        len(grid.points),
    )  # fmt: skip
