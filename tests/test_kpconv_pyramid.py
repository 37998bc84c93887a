"""Grid subsampling, neighbours, kernels: against plain numpy, and whatever the order of the points."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from operators.kpconv.disposition import energy, kernel_points, spring_of
from operators.kpconv.grid import nearest, subsample
from operators.kpconv.links import kernel_of, link
from operators.kpconv.pyramid import Geometry, Pyramid, build, stacked

VOXEL = 0.25


def cloud(count: int, seed: int = 0, spread: float = 2.0) -> np.ndarray:
    """Draw points on a floor, a wall and in the air."""
    points = np.random.default_rng(seed).uniform(-spread, spread, (count, 3)).astype(np.float32)
    points[: count // 3, 2] = 0.0
    points[count // 3 : count // 2, 0] = spread
    return points


def arrays_of(pyramid: Pyramid) -> list[np.ndarray]:
    """List every array of a pyramid."""
    links = [array for part in (*pyramid.convolutions, *pyramid.pools) for array in part[:-1]]
    return [*pyramid.points, *pyramid.parents, *links]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 400), st.sampled_from([0.1, 0.25, 0.7]), st.integers(0, 1000))
def test_a_voxel_has_the_mean_of_its_points(count: int, size: float, seed: int) -> None:
    points = cloud(count, seed)
    grid, rows = subsample(points, size)
    voxels = np.floor(points.astype(np.float64) / size).astype(int)
    _, first, twin = np.unique(voxels, axis=0, return_index=True, return_inverse=True)
    assert len(grid.points) == len(first)
    twin = twin.reshape(-1)
    sums = np.stack([np.bincount(twin, points[:, axis].astype(np.float64), len(first)) for axis in range(3)], 1)
    means = sums / np.bincount(twin, minlength=len(first))[:, None]
    np.testing.assert_allclose(grid.points[rows], means[twin], atol=2e-6)


def test_points_that_are_nowhere_are_left_out() -> None:
    points = np.array([[0.1, 0.1, 0.1], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0], [1e9, 0.0, 0.0]], np.float32)
    grid, rows = subsample(points, VOXEL)
    assert rows.tolist() == [0, -1, -1, -1]
    assert nearest(grid, points, rows).tolist() == [0, -1, -1, -1]
    np.testing.assert_allclose(grid.points, points[:1], atol=1e-6)


def test_the_order_of_the_points_changes_no_bit() -> None:
    points = cloud(500)
    order = np.random.default_rng(1).permutation(len(points))
    one, other = (subsample(given, VOXEL) for given in (points, points[order]))
    np.testing.assert_array_equal(one[1][order], other[1])
    pairs = (arrays_of(build(grid, Geometry(VOXEL, 3))) for grid in (one[0], other[0]))
    for mine, theirs in zip(*pairs, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@settings(deadline=None, max_examples=10)
@given(st.integers(1, 300), st.integers(0, 1000))
def test_neighbours_and_influences_are_those_of_a_search_over_all(count: int, seed: int) -> None:
    grid, _ = subsample(cloud(count, seed), VOXEL)
    queries, _ = subsample(grid.points, 2 * VOXEL)
    radius, kernel = 2.5 * VOXEL, kernel_of(15, 1.2 / 2.5)
    links = link(grid, queries.points, radius=radius, kernel=kernel, listed=True)
    offsets = (grid.points[None] - queries.points[:, None]).astype(np.float64)
    near = np.linalg.norm(offsets, axis=2) <= radius
    apart = np.linalg.norm(offsets[:, :, None] - radius * kernel.points[None, None], axis=3)
    wanted = np.maximum(1.0 - apart / (1.2 * VOXEL), 0.0) * near[..., None]  # (q, m, k)
    found = np.zeros_like(wanted)
    owners = np.repeat(np.arange(len(queries.points)), np.diff(links.starts))
    np.add.at(found, (owners, links.columns, links.places), links.weights)
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    owners = np.repeat(np.arange(len(queries.points)), np.diff(links.neighbour_starts))
    listed = np.zeros_like(near)
    listed[owners, links.neighbours] = True
    np.testing.assert_array_equal(listed, near)


def test_many_neighbours_find_room() -> None:
    points = np.stack(np.meshgrid(*[np.arange(12) * VOXEL + 0.1] * 3), -1).reshape(-1, 3).astype(np.float32)
    grid, _ = subsample(points, VOXEL)
    links = link(grid, grid.points, radius=2.5 * VOXEL, kernel=kernel_of(15, 0.48), listed=True)
    assert len(links.columns) == links.starts[-1] > 40 * len(points)
    pairs = cKDTree(grid.points).query_ball_point(grid.points, 2.5 * VOXEL, return_length=True)
    np.testing.assert_array_equal(np.diff(links.neighbour_starts), pairs)


def test_a_radius_that_cells_do_not_cover_is_refused() -> None:
    grid, _ = subsample(cloud(10), VOXEL)
    with pytest.raises(ValueError, match="cells cover"):
        link(grid, grid.points, radius=3.5 * VOXEL, kernel=kernel_of(15, 0.48))


@settings(deadline=None, max_examples=10)
@given(st.integers(1, 600), st.integers(0, 1000))
def test_the_nearest_is_that_of_a_tree(count: int, seed: int) -> None:
    points = cloud(count, seed)
    grid, rows = subsample(points, VOXEL)
    found = nearest(grid, points, rows)
    least, _ = cKDTree(grid.points.astype(np.float64)).query(points.astype(np.float64))
    np.testing.assert_allclose(np.linalg.norm(grid.points[found] - points, axis=1), least, atol=1e-6)


def test_a_batch_is_its_parts_side_by_side() -> None:
    geometry = Geometry(VOXEL, 3)
    parts = [build(subsample(cloud(count, count), VOXEL)[0], geometry) for count in (50, 7, 300)]
    whole = stacked(parts)
    for level in range(3):
        sizes = np.cumsum([0, *(len(part.points[level]) for part in parts)])
        np.testing.assert_array_equal(whole.points[level], np.concatenate([part.points[level] for part in parts]))
        starts = whole.convolutions[level].starts
        for number, part in enumerate(parts):
            mine = part.convolutions[level]
            entries = slice(starts[sizes[number]], starts[sizes[number + 1]])
            np.testing.assert_array_equal(whole.convolutions[level].columns[entries] - sizes[number], mine.columns)
            np.testing.assert_array_equal(whole.convolutions[level].weights[entries], mine.weights)
            if level < 2:
                above = sum(len(before.points[level + 1]) for before in parts[:number])
                parents = whole.parents[level][sizes[number] : sizes[number + 1]]
                np.testing.assert_array_equal(parents - above, part.parents[level])


def test_no_point_makes_an_empty_pyramid() -> None:
    pyramid = build(subsample(np.zeros((0, 3), np.float32), VOXEL)[0], Geometry(VOXEL))
    assert all(len(points) == 0 for points in pyramid.points)


@pytest.mark.parametrize("count", [5, 9, 15])
def test_a_disposition_is_a_minimum_of_its_energy(count: int) -> None:
    points = kernel_points(count)
    spring = spring_of(points)
    value, gradient = energy(points, spring)
    np.testing.assert_allclose(gradient[1:], 0.0, atol=1e-4 * value)
    generator = np.random.default_rng(0)
    for _ in range(50):
        step = generator.normal(size=points.shape) * 0.02
        step[0] = 0.0
        assert energy(points + step, spring)[0] > value - 1e-9
    assert np.linalg.norm(points[0]) == 0.0
    assert np.linalg.norm(points[1:], axis=1).mean() == pytest.approx(0.66)


def test_the_energy_has_the_gradient_that_it_says() -> None:
    points = np.random.default_rng(0).normal(size=(6, 3))
    _, gradient = energy(points, 0.7)
    for index in itertools.product(range(6), range(3)):
        step = np.zeros_like(points)
        step[index] = 1e-6
        slope = (energy(points + step, 0.7)[0] - energy(points - step, 0.7)[0]) / 2e-6
        assert slope == pytest.approx(gradient[index], rel=1e-5, abs=1e-6)
