"""Angles, voxel subsampling, eigenvectors and normals of a frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_pointmap_room import BASE_FROM_LIDAR, BOXES, ROOM, scan

from graph.geometry import planar, transform
from operators.pointmap.angles import logarithms, spherical
from operators.pointmap.eigen import smallest_direction
from operators.pointmap.frame import prepare
from operators.pointmap.normals import bin_directions, decay, estimate_normals, trust
from operators.pointmap.voxels import central_points

RADIUS = 1.5 * np.radians(1.33)


def columns(points):
    return tuple(np.ascontiguousarray(points[:, axis], np.float32) for axis in range(3))


def test_spherical_coordinates_agree_with_numpy_in_all_octants():
    points = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    points[:27] = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 3)
    rho, theta, phi = spherical(*columns(points))
    x, y, z = points.astype(np.float64).T
    assert np.abs(rho - np.sqrt(x**2 + y**2 + z**2)).max() < 1e-6
    assert np.abs(theta - np.arctan2(z, np.hypot(x, y))).max() < 2e-7
    assert np.abs(phi - np.arctan2(y, x)).max() < 3e-7


def test_logarithms_are_those_of_numpy():
    numbers = np.exp(np.random.default_rng(0).uniform(-3, 7, 5000)).astype(np.float32)
    numbers[:3] = 1.0, 2.0, 0.05
    assert np.abs(logarithms(numbers) - np.log(numbers.astype(np.float64))).max() < 1e-6
    assert len(logarithms(numbers[:0])) == 0


def twin_of_central_points(points, size):
    best = {}
    for i, point in enumerate(points.astype(np.float64) / size):
        voxel = tuple(np.floor(point).astype(int))
        offset = ((point - np.floor(point) - 0.5) ** 2).sum()
        if voxel not in best or offset < best[voxel][0]:
            best[voxel] = (offset, i)
    return [i for _, i in best.values()]


@pytest.mark.parametrize("size", [0.03, 0.1, 0.5])
def test_subsampling_keeps_the_point_nearest_the_centre_of_each_voxel(size):
    points = np.random.default_rng(1).normal(size=(3000, 3)).astype(np.float32)
    assert central_points(*columns(points), size).tolist() == twin_of_central_points(points, size)


def test_subsampling_nothing_gives_nothing():
    assert len(central_points(*columns(np.empty((0, 3))), 0.1)) == 0


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9), st.sampled_from([1e-3, 1.0, 1e3]))
@example([2.0**-23, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0], 1e-3)  # all but a line
def test_the_smallest_direction_is_an_eigenvector(entries, scale):
    root = scale * np.array(entries).reshape(3, 3)
    matrix = root @ root.T
    l0, l1, l2, *vector = smallest_direction(*matrix[np.triu_indices(3)])
    size = max(np.abs(matrix).max(), 1e-12)
    assert np.allclose([l0, l1, l2], np.linalg.eigvalsh(matrix), atol=3e-7 * size)
    assert np.linalg.norm(vector) == pytest.approx(1.0)
    assert np.linalg.norm(matrix @ vector - l0 * np.array(vector)) < 1e-5 * size


def test_a_flat_or_round_neighbourhood_still_gives_a_unit_direction():
    for matrix in (np.zeros((3, 3)), np.eye(3), np.diag([1.0, 0.0, 0.0]), np.diag([1.0, 1.0, 0.0])):
        vector = np.array(smallest_direction(*matrix[np.triu_indices(3)])[3:])
        assert np.linalg.norm(vector) == pytest.approx(1.0)
        assert np.linalg.norm(matrix @ vector) == pytest.approx(np.linalg.eigvalsh(matrix)[0], abs=1e-9)


def twin_of_neighbours(points, i):
    """Neighbours in (log rho / 8, theta, 2 phi), by the definition."""
    x, y, z = points.astype(np.float64).T
    rho, theta, phi = np.sqrt(x**2 + y**2 + z**2), np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)
    turn = (phi - phi[i] + np.pi) % (2 * np.pi) - np.pi
    return (np.log(rho / rho[i]) / 8) ** 2 + (theta - theta[i]) ** 2 + (2 * turn) ** 2 < RADIUS**2


def test_normals_are_those_of_all_neighbours_and_azimuth_wraps():
    points = scan(planar(0.2, 0.1, 0.4, 0.64), noise=0.008)
    x, y, z = columns(points)
    rho, theta, phi = spherical(x, y, z)
    random = np.random.default_rng(2)
    seam = np.flatnonzero(np.abs(phi) > np.pi - 0.01)
    chosen = np.concatenate([random.choice(len(points), 60), random.choice(seam, 30)]).astype(np.int32)
    normals, scores, planarities = estimate_normals(x, y, z, rho, theta, phi, chosen, RADIUS)
    for normal, score, planarity, i in zip(normals.T, scores, planarities, chosen, strict=True):
        near = points[twin_of_neighbours(points, i)].astype(np.float64)
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        wanted = vectors[:, 0] * -np.sign(vectors[:, 0] @ points[i])
        assert abs(normal @ wanted) > 1 - 1e-4 or values[1] - values[0] < 1e-3 * values[2]
        assert planarity == pytest.approx(1 - values[0] / values[2], abs=1e-4)
        cosine = abs(normal @ points[i]) / np.linalg.norm(points[i])
        assert score == pytest.approx(trust(planarity, cosine, rho[i]), rel=1e-4)
        assert normal @ points[i] <= 0


def test_bins_hold_every_point_once_in_the_order_of_directions():
    points = np.random.default_rng(3).normal(size=(4000, 3)).astype(np.float32)
    x, y, z = columns(points)
    bins = bin_directions(x, y, z, *spherical(x, y, z), RADIUS)
    assert sorted(map(tuple, bins.points[:, :3])) == sorted(map(tuple, points))
    row = (bins.points[:, 4] - bins.lowest) // bins.height
    column = (bins.points[:, 5] + np.pi) // bins.width
    number = np.repeat(np.arange(bins.rows * bins.columns), np.diff(bins.first))
    assert bins.first[-1] == 4000
    assert (row * bins.columns + column == number).mean() > 0.999  # a few lie on an edge, in single precision


def test_decay_is_the_exponential():
    for u in (0.0, 1e-6, 0.3, 1.0, 7.5, 1e4):
        assert decay(u) == pytest.approx(np.exp(-u), rel=1e-6, abs=1e-30)


def test_the_score_is_that_of_the_authors_code():
    assert trust(1.0, 1.0, 2.0) == pytest.approx(1.0)
    assert trust(1.0, 1.0, 12.0) == pytest.approx(0.2 + 0.8 * np.exp(-1.0))
    assert trust(0.5, 1.0, 2.0) == pytest.approx(0.5)
    grazing = np.radians(85)
    assert trust(1.0, np.cos(grazing), 2.0) == pytest.approx(0.2 * (np.pi / 2 - grazing) / (np.pi / 12))


def test_prepared_points_are_points_of_the_frame_with_normals_of_the_walls():
    pose = planar(-0.5, 0.2, 1.0) @ BASE_FROM_LIDAR
    points = scan(pose)
    frame = prepare(points, voxel_size=0.1, angular_radius=RADIUS)
    assert np.array_equal(points[frame.indices], frame.points)
    assert (frame.scores >= 0.01).all()
    assert (frame.scores <= 1.0).all()
    world, normals = frame.moved(pose)
    inner = (world > ROOM[0] + 0.3).all(axis=1) & (world < ROOM[1] - 0.3).all(axis=1)
    edges = np.concatenate([np.abs(world[:, None, :] - corner).min(axis=1) for corner in (np.array(BOXES)[:, 0],)])
    floor = (world[:, 2] < 1e-3) & (edges.min(axis=1) > -1) & (np.linalg.norm(frame.points[:, :2], axis=1) < 2.5)
    assert (np.abs(normals[floor, 2]) > 0.999).mean() > 0.9
    assert np.allclose(np.linalg.norm(frame.normals, axis=1), 1.0, atol=1e-5)
    assert not inner[floor].any()


def test_points_that_are_no_points_are_dropped():
    points = scan(planar(0.0, 0.0, 0.0, 0.64))
    clean = prepare(points, voxel_size=0.1, angular_radius=RADIUS)
    dirty = np.concatenate([points, np.full((3, 3), np.nan), np.full((2, 3), np.inf), np.zeros((4, 3))])
    frame = prepare(dirty, voxel_size=0.1, angular_radius=RADIUS)
    assert np.array_equal(frame.points, clean.points)
    assert np.array_equal(frame.normals, clean.normals)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((5, 3), np.nan), np.ones((1, 3))])
def test_a_frame_without_neighbours_gives_no_points(points):
    assert len(prepare(points, voxel_size=0.1, angular_radius=RADIUS).points) == 0


def test_a_frame_turned_about_the_sensor_has_turned_normals():
    points = scan(planar(0.0, 0.0, 0.0, 0.64))
    turn = planar(0.0, 0.0, np.pi)  # the voxels of a half turn are the same voxels
    frame = prepare(points, voxel_size=0.1, angular_radius=RADIUS)
    turned = prepare(transform(turn, points), voxel_size=0.1, angular_radius=RADIUS)
    same = np.isin(frame.indices, turned.indices).mean()
    assert same > 0.9
    where = {index: n for n, index in enumerate(turned.indices)}
    pairs = [(n, where[index]) for n, index in enumerate(frame.indices) if index in where]
    left, right = np.array(pairs).T
    assert np.abs(transform(turn, frame.normals[left]) - turned.normals[right]).mean() < 1e-3
