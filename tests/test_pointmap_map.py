"""The voxel map: what enters, what stays, what is nearest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from operators.pointmap import MapPoints, VoxelMap

RANDOM = np.random.default_rng(5)


def cloud(count, spread, seed=0):
    random = np.random.default_rng(seed)
    points = (random.normal(size=(count, 3)) * spread).astype(np.float32)
    normals = random.normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    return points, normals, random.uniform(0.01, 1, count).astype(np.float32)


def twin_of_insert(batches, size):
    voxels = {}
    for frame, (points, normals, scores) in enumerate(batches):
        for point, normal, score in zip(points, normals, scores, strict=True):
            key = tuple(np.floor(point.astype(np.float64) / size).astype(int))
            if key not in voxels:
                voxels[key] = [point, normal, score, frame]
            elif score > voxels[key][2]:
                voxels[key][1:3] = normal, score
    return list(voxels.values())


def test_the_first_point_of_a_voxel_stays_and_the_best_normal_replaces():
    batches = [cloud(2500, 0.4, seed) for seed in range(4)]
    voxels = VoxelMap(0.1)
    added = [voxels.insert(*batch, frame) for frame, batch in enumerate(batches)]
    wanted = twin_of_insert(batches, 0.1)
    assert sum(added) == len(voxels) == len(wanted)
    assert added[0] > added[3] > 0
    assert np.array_equal(voxels.points, [entry[0] for entry in wanted])
    assert np.array_equal(voxels.normals, [entry[1] for entry in wanted])
    assert np.array_equal(voxels.scores, [entry[2] for entry in wanted])
    assert voxels.created.tolist() == [entry[3] for entry in wanted]


def test_what_has_no_place_is_passed_over():
    voxels = VoxelMap(0.03)
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0], [1, 1, 1]], np.float32)
    assert voxels.insert(points, points, np.ones(4, np.float32), 0) == 1


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10_000),
    st.sampled_from([0.02, 0.1, 1.0, 5.0]),
    st.integers(1, 600),
    st.sampled_from([0.05, 0.5, 2.0]),
)
def test_the_nearest_point_is_the_nearest(seed, spread, count, reach):
    voxels = VoxelMap(0.03)
    voxels.insert(*cloud(count, spread, seed), 0)
    queries = cloud(200, 1.3 * spread, seed + 1)[0]
    found, distance = voxels.nearest(queries, reach)
    wanted, _ = cKDTree(voxels.points.astype(np.float64)).query(queries.astype(np.float64))
    near = wanted < reach
    assert np.array_equal(found >= 0, near)
    assert np.allclose(distance[near], wanted[near], rtol=1e-6, atol=1e-7)
    assert np.isinf(distance[~near]).all()
    there = np.linalg.norm(voxels.points[found[near]] - queries[near], axis=1)
    assert np.allclose(there, wanted[near], atol=1e-5)


def test_far_from_the_origin_and_below_zero_too():
    for shift in (np.array([-20_000.0, 0.0, 500.0]), np.array([-3.0, -3.0, -3.0])):
        points, normals, scores = cloud(500, 0.3, 7)
        points = (points + shift).astype(np.float32)
        voxels = VoxelMap(0.03)
        voxels.insert(points, normals, scores, 0)
        found, distance = voxels.nearest(voxels.points)
        assert found.tolist() == list(range(len(voxels)))
        assert (distance == 0).all()


def test_an_empty_map_and_an_empty_query_find_nothing():
    found, distance = VoxelMap(0.03).nearest(np.zeros((3, 3), np.float32))
    assert found.tolist() == [-1, -1, -1]
    assert np.isinf(distance).all()
    assert len(VoxelMap(0.03).nearest(np.empty((0, 3), np.float32))[0]) == 0
    assert VoxelMap(0.03).nearest(np.full((1, 3), np.nan, np.float32))[0].tolist() == [-1]


def test_growing_keeps_every_entry():
    voxels, batches = VoxelMap(0.05), [cloud(n, 2.0, n) for n in (1, 10, 3000, 40_000)]
    for frame, batch in enumerate(batches):
        voxels.insert(*batch, frame)
    assert voxels.nearest(np.concatenate([b[0] for b in batches]), 0.1)[0].min() >= 0


def test_an_initial_map_comes_before_all_frames_and_keeps_its_points():
    points, normals, scores = cloud(3000, 0.2, 11)
    voxels = VoxelMap(0.03)
    kept = voxels.insert_map(MapPoints(points, normals, scores))
    assert np.array_equal(points[kept], voxels.points)
    assert len(kept) < 3000
    assert (voxels.created == -1).all()
    again = VoxelMap(0.03)
    assert sorted(again.insert_map(voxels.cloud())) == list(range(len(voxels)))
    assert len(again.insert_map(voxels.cloud())) == 0
    assert sorted(map(tuple, again.points)) == sorted(map(tuple, voxels.points))


def test_the_points_of_an_initial_map_lie_in_memory_as_in_space():
    points, normals, scores = cloud(4000, 1.5, 3)
    points[::50] = np.nan
    points[1::50] = 1e9
    voxels = VoxelMap(0.03)
    voxels.insert_map(MapPoints(points, normals, scores))
    blocks = np.floor(voxels.points.astype(np.float64) / 0.12).astype(int)
    wanted = np.lexsort((*blocks.T[::-1], *(blocks // 8).T[::-1]))
    assert wanted.tolist() == list(range(len(voxels)))
    assert 3500 < len(voxels) <= 3840


def test_a_voxel_has_a_size():
    with pytest.raises(ValueError, match="above 0"):
        VoxelMap(0.0)
