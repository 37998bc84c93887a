"""The input of a network: a cloud at several resolutions, and the sparse matrices between them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from operators.kpconv.crew import side_by_side
from operators.kpconv.grid import Floats, Grid, Ints, nearest, subsample
from operators.kpconv.links import Links, kernel_of, link


class Geometry(NamedTuple):
    """What decides a pyramid; lengths are in voxels of the level."""

    voxel: float  # metres, of the finest level
    levels: int = 5
    kernel_points: int = 15
    radius: float = 2.5
    extent: float = 1.2


class Pyramid(NamedTuple):
    """Levels from fine to coarse; level l has voxels of 2^l times the finest."""

    points: tuple[Floats, ...]  # (m_l, 3) metres
    convolutions: tuple[Links, ...]  # from each level to itself
    pools: tuple[Links, ...]  # from level l to l + 1, with neighbour lists
    parents: tuple[Ints, ...]  # (m_l,) nearest point of level l + 1


def build(grid: Grid, geometry: Geometry, threads: int = 1) -> Pyramid:
    """Build the pyramid on a grid of voxels of `geometry.voxel` metres, on so many threads."""
    kernel = kernel_of(geometry.kernel_points, geometry.extent / geometry.radius)
    sizes = [geometry.voxel * 2**level for level in range(geometry.levels)]
    grids, ranks = [grid], []
    for size in sizes[1:]:
        coarser, rank = subsample(grids[-1].points, size)
        grids.append(coarser)
        ranks.append(rank)
    convolutions: list[Callable[[], Any]] = []
    pools: list[Callable[[], Any]] = []
    parents: list[Callable[[], Any]] = []
    for level, (own, size) in enumerate(zip(grids, sizes, strict=True)):
        linked = functools.partial(link, own, radius=geometry.radius * size, kernel=kernel)
        convolutions.append(functools.partial(linked, own.points))
        if level + 1 < geometry.levels:
            pools.append(functools.partial(linked, grids[level + 1].points, listed=True))
            parents.append(functools.partial(nearest, grids[level + 1], own.points, ranks[level]))
    done = side_by_side([*convolutions, *pools, *parents], threads)
    count = geometry.levels
    return Pyramid(
        tuple(own.points for own in grids),
        tuple(done[:count]),
        tuple(done[count : 2 * count - 1]),
        tuple(done[2 * count - 1 :]),
    )


def offset(parts: Sequence[npt.NDArray[Any]], first: npt.NDArray[np.int64], *, head: bool = False) -> Ints:
    """Join arrays of positions, each moved by its first; head: they are bounds, whose zero is kept once."""
    pieces: list[npt.NDArray[Any]] = [np.zeros(1, np.int32)] if head else []
    pieces += [part[int(head) :] + start for part, start in zip(parts, first[:-1], strict=True)]
    return np.concatenate(pieces, dtype=np.int32, casting="same_kind")


def stacked_links(parts: Sequence[Links]) -> Links:
    """Put sparse matrices on the diagonal of one."""
    entries = np.cumsum([0, *(len(part.columns) for part in parts)])
    sources = np.cumsum([0, *(part.sources for part in parts)])
    pairs = np.cumsum([0, *(len(part.neighbours) for part in parts)])
    listed = all(len(part.neighbour_starts) for part in parts)
    return Links(
        starts=offset([part.starts for part in parts], entries, head=True),
        columns=offset([part.columns for part in parts], sources),
        places=np.concatenate([part.places for part in parts]),
        weights=np.concatenate([part.weights for part in parts]),
        neighbour_starts=offset([part.neighbour_starts for part in parts], pairs, head=True)
        if listed
        else np.zeros(0, np.int32),
        neighbours=offset([part.neighbours for part in parts], sources),
        sources=int(sources[-1]),
    )


def stacked(parts: Sequence[Pyramid]) -> Pyramid:
    """Make one pyramid of several, which do not see each other: a batch."""
    levels = range(len(parts[0].points))
    parents = []
    for level in levels[:-1]:
        above = np.cumsum([0, *(len(part.points[level + 1]) for part in parts)])
        parents.append(offset([part.parents[level] for part in parts], above))
    return Pyramid(
        points=tuple(np.concatenate([part.points[level] for part in parts]) for level in levels),
        convolutions=tuple(stacked_links([part.convolutions[level] for part in parts]) for level in levels),
        pools=tuple(stacked_links([part.pools[level] for part in parts]) for level in levels[:-1]),
        parents=tuple(parents),
    )
