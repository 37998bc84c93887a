"""Sampling, alignment and the whole of PointMap in a room of boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_pointmap_room import BASE_FROM_LIDAR, BOXES, scan

from graph.geometry import exponential, inverse, planar, rotation_angle, transform, yaw
from operators.pointmap import Criteria, PointMap, Settings
from operators.pointmap.draw import alias_table, generator, sample, uniform
from operators.pointmap.icp import Alignment, mean_pose, solve, turned
from operators.pointmap.slam import leveled, misfit


def error_of(world_from_lidar, truth):
    """Return metres and degrees between a pose and the true one."""
    error = inverse(truth) @ world_from_lidar
    return float(np.linalg.norm(error[:3, 3])), math.degrees(rotation_angle(error))


def drawn(weights, wanted, seed):
    share, other = alias_table(np.asarray(weights, np.float32))
    scratch, chosen = np.full(len(weights), -1, np.int32), np.empty(wanted, np.int32)
    return chosen[: sample(share, other, scratch, 0, wanted, generator(seed, 0), chosen)]


def test_uniform_numbers_are_uniform_and_repeat_with_the_seed():
    state = generator(3, 7)
    numbers = np.array([uniform(state) for _ in range(4000)])
    assert 0 <= numbers.min() < 0.01
    assert 0.99 < numbers.max() < 1
    assert abs(numbers.mean() - 0.5) < 0.02
    again = generator(3, 7)
    assert [uniform(again) for _ in range(5)] == numbers[:5].tolist()
    assert uniform(generator(3, 8)) != numbers[0]


def test_the_alias_table_holds_the_weights():
    weights = np.random.default_rng(0).uniform(0, 3, 500).astype(np.float32)
    weights[::7] = 0
    share, other = alias_table(weights)
    mass = share.copy()
    np.add.at(mass, other, 1 - share)
    assert np.allclose(mass / len(weights), weights / weights.sum(dtype=np.float64), atol=1e-12)


def test_samples_are_different_points_drawn_by_weight():
    weights = np.ones(3000)
    weights[:1000] = 4.0
    chosen = drawn(weights, 600, 1)
    assert len(set(chosen.tolist())) == 600
    assert 0.60 < (chosen < 1000).mean() < 0.72
    assert np.array_equal(chosen, drawn(weights, 600, 1))
    assert not np.array_equal(chosen, drawn(weights, 600, 2))


def test_few_points_are_all_taken_and_weightless_ones_never():
    assert drawn(np.ones(30), 600, 0).tolist() == list(range(30))
    lopsided = np.zeros(2000)
    lopsided[:100] = 1.0
    assert set(drawn(lopsided, 600, 0).tolist()) <= set(range(100))


def test_the_solver_solves():
    root = np.random.default_rng(0).normal(size=(9, 6))
    matrix, right = root.T @ root, np.arange(6.0)
    assert np.allclose(solve(matrix, right), np.linalg.solve(matrix, right))
    assert not np.isfinite(solve(np.zeros((6, 6)), right)).any()


def test_a_turned_pose_turns_by_the_rotation_vector():
    pose, vector = planar(1.0, 2.0, 0.5, 3.0), np.array([0.1, -0.2, 0.3])
    wanted = pose.copy()
    wanted[:3, :3] = exponential(vector) @ pose[:3, :3]
    assert np.allclose(turned(pose, *vector), wanted, atol=1e-15)
    assert np.allclose(turned(pose, 0.0, 0.0, 0.0), pose)


def test_the_mean_of_poses_is_in_their_middle():
    middle = planar(3.0, -1.0, 2.0, 0.6)
    vectors = np.random.default_rng(1).normal(size=(5, 3)) * 1e-3
    vectors -= vectors.mean(axis=0)
    poses = np.stack([turned(middle, *vector) for vector in vectors])
    poses[:, :3, 3] += vectors
    assert np.abs(mean_pose(poses) - middle).max() < 1e-6


@pytest.mark.parametrize("seed", range(6))
def test_a_noise_free_pair_recovers_half_a_metre_and_ten_degrees(seed):
    random = np.random.default_rng(seed)
    first = planar(random.uniform(-2, 0), random.uniform(-1, 1), random.uniform(-3, 3)) @ BASE_FROM_LIDAR
    way = random.uniform(-np.pi, np.pi)
    offset = planar(0.5 * np.cos(way), 0.5 * np.sin(way), math.radians(10) * random.choice([-1, 1]))
    second = first @ offset
    pointmap = PointMap(Settings(largest_jump=0.6, seed=seed))
    pointmap.track(scan(first), first)
    track = pointmap.track(scan(second), first)
    metres, degrees = error_of(track.world_from_lidar, second)
    assert track.valid
    assert metres < 0.001
    assert degrees < 0.01
    assert track.inliers > 0.9


def test_aligning_the_moved_frame_gives_the_moved_pose():
    pose = planar(0.1, 0.2, 0.3) @ BASE_FROM_LIDAR
    points = scan(pose)
    small = planar(0.05, -0.02, 0.01)
    pointmap = PointMap()
    pointmap.track(points, pose)
    track = pointmap.track(transform(inverse(small), points), pose)
    metres, degrees = error_of(track.world_from_lidar, pose @ small)
    assert metres < 0.001
    assert degrees < 0.01


def drive(settings=None, noise=0.008, initial=None, steps=25):
    """Return errors (steps, 2) and tracks of a drive with a drifting guess."""
    pointmap = PointMap(settings, initial=initial)
    guess_from_truth = np.eye(4)
    errors, tracks = [], []
    for n in range(steps):
        truth = planar(-2 + 0.1 * n, 0.5 * np.sin(0.2 * n), 0.1 * n) @ BASE_FROM_LIDAR
        if n > 0:
            guess_from_truth = guess_from_truth @ planar(0.01, -0.005, 0.01)
        track = pointmap.track(
            scan(truth, noise=noise, seed=n), truth @ guess_from_truth
        )  # guess = truth moved by what odometry has wrong
        if track.valid:
            guess_from_truth = inverse(truth) @ track.world_from_lidar
        errors.append(error_of(track.world_from_lidar, truth))
        tracks.append(track)
    return np.array(errors), tracks, pointmap


def test_a_drive_without_a_map_stays_where_it_is():
    errors, tracks, pointmap = drive()
    assert all(track.valid for track in tracks)
    assert np.median(errors[:, 0]) < 0.03
    assert len(pointmap.map) == sum(track.added for track in tracks)


def test_a_drive_on_its_own_map_is_exact_and_the_same_to_the_bit():
    _, _, mapped = drive(noise=0.0)
    errors, tracks, first = drive(initial=mapped.map.cloud())
    _, again, second = drive(initial=mapped.map.cloud())
    assert np.median(errors[5:, 0]) < 0.015
    assert np.median(errors[5:, 1]) < 0.2
    assert all(np.array_equal(a.world_from_lidar, b.world_from_lidar) for a, b in zip(tracks, again, strict=True))
    assert np.array_equal(first.map.points, second.map.points)
    assert np.array_equal(first.map.normals, second.map.normals)
    _, other, _ = drive(Settings(seed=1), initial=mapped.map.cloud(), steps=2)
    assert not np.array_equal(tracks[1].world_from_lidar, other[1].world_from_lidar)


def test_people_in_the_way_do_not_pull():
    pose = planar(-1.0, 0.0, 0.0) @ BASE_FROM_LIDAR
    people = tuple(
        (np.array([x, y, 0.0]), np.array([x + 0.4, y + 0.4, 1.7])) for x, y in [(0, -1), (0, 0.5), (-1, 1.5)]
    )
    pointmap = PointMap()
    pointmap.track(scan(pose), pose)
    crowd = scan(pose @ planar(0.1, 0.05, 0.05), boxes=BOXES + people, noise=0.008)
    track = pointmap.track(crowd, pose)
    metres, degrees = error_of(track.world_from_lidar, pose @ planar(0.1, 0.05, 0.05))
    assert track.valid
    assert metres < 0.01
    assert degrees < 0.1


def test_too_few_points_are_refused_and_leave_the_map_alone():
    pose = planar(0.0, 0.0, 0.0) @ BASE_FROM_LIDAR
    pointmap = PointMap()
    pointmap.track(scan(pose), pose)
    before = pointmap.map.points.copy()
    guess = pose @ planar(0.2, 0.0, 0.0)
    for points in (np.empty((0, 3)), scan(pose)[:10], np.full((40, 3), np.nan)):
        track = pointmap.track(points, guess)
        assert not track.valid
        assert "usable points" in track.reason
        assert np.array_equal(track.world_from_lidar, guess)
    assert np.array_equal(pointmap.map.points, before)


def test_a_jump_is_refused():
    pose = planar(0.0, 0.0, 0.0) @ BASE_FROM_LIDAR
    pointmap = PointMap(Settings(largest_jump=0.2))
    pointmap.track(scan(pose), pose)
    before = len(pointmap.map)
    track = pointmap.track(scan(pose @ planar(0.4, 0.0, 0.0)), pose)
    assert not track.valid
    assert "jump of 0.40 m" in track.reason
    assert np.array_equal(track.world_from_lidar, pose)
    assert len(pointmap.map) == before


def test_a_frame_of_another_place_does_not_converge_or_jumps():
    pose = planar(0.0, 0.0, 0.0) @ BASE_FROM_LIDAR
    pointmap = PointMap(Settings(criteria=Criteria(iterations=6)))
    pointmap.track(scan(pose), pose)
    track = pointmap.track(scan(pose @ planar(0.5, 0.3, 0.25)), pose)
    assert not track.valid
    assert "no convergence" in track.reason
    pointmap = PointMap(Settings(criteria=Criteria(iterations=6)))
    pointmap.track(scan(pose), pose)
    far = pose @ planar(50.0, 0.0, 0.0)
    track = pointmap.track(scan(pose), far)
    assert not track.valid
    assert track.inliers == 0


def test_a_map_that_shall_not_grow_does_not():
    pose = planar(0.0, 0.0, 0.0) @ BASE_FROM_LIDAR
    pointmap = PointMap(Settings(grow=False))
    pointmap.track(scan(pose), pose)
    before = len(pointmap.map)
    assert before > 1000
    assert pointmap.track(scan(pose @ planar(0.3, 0.0, 0.0)), pose).valid
    assert len(pointmap.map) == before


def test_a_level_robot_gives_up_height_and_tilt_but_no_place():
    pose = planar(1.0, -2.0, 0.7, 0.03)
    pose[:3, :3] = pose[:3, :3] @ exponential([0.01, 0.02, 0.0])
    pose[:3, :3] = exponential([0.0, 0.0, 0.7 - yaw(pose)]) @ pose[:3, :3]
    half = leveled(pose, 0.5)
    assert np.allclose(half[:2, 3], pose[:2, 3])
    assert half[2, 3] == pytest.approx(0.015)
    assert math.acos(half[2, 2]) == pytest.approx(0.5 * math.acos(pose[2, 2]), rel=1e-3)
    assert np.allclose(leveled(pose, 1.0), planar(1.0, -2.0, yaw(pose)))
    assert np.allclose(leveled(pose, 0.0), pose)


@pytest.mark.parametrize("slip", [0.06, 0.13, 0.2])
def test_wheels_that_slip_neither_move_the_robot_nor_spoil_the_map(slip):
    pose = planar(1.5, -1.5, 0.3) @ BASE_FROM_LIDAR
    pointmap = PointMap()
    for place in (planar(4.5, -1.5, 0.0), planar(3.0, 1.5, 0.5), planar(1.5, -1.5, 0.3)):
        pointmap.enter(pointmap.prepare(scan(place @ BASE_FROM_LIDAR)), place @ BASE_FROM_LIDAR)
    for number in range(3):
        before = len(pointmap.map)
        track = pointmap.track(scan(pose, noise=0.008, seed=number), pose @ planar(slip, 0.0, 0.0))
        assert track.valid
        assert error_of(track.world_from_lidar, pose)[0] < 0.005
        assert track.added == 0
        assert len(pointmap.map) == before
    assert pointmap.track(scan(pose), pose @ planar(0.01, 0.0, 0.0)).added > 0


def test_after_wheels_slipped_the_face_of_a_wall_that_is_near_to_odometry_is_not_trusted(monkeypatch):
    pose = planar(1.5, -1.5, 0.3) @ BASE_FROM_LIDAR
    pointmap = PointMap(Settings(watch=2))
    frame = pointmap.prepare(scan(pose))
    pointmap.enter(frame, pose)
    right, wrong = pose, pose @ planar(0.15, 0.0, 0.0)
    starts = []

    def fitted(store, voxel, frame, start, criteria, state):
        """Two faces attract a robot, each whoever starts nearer to it; the wrong one leaves some samples alone."""
        starts.append(float((inverse(pose) @ start)[0, 3]))
        off = starts[-1] > 0.075
        return Alignment(wrong if off else right, True, 5, 0.93 if off else 0.998, 0.005)

    monkeypatch.setattr("operators.pointmap.slam.align", fitted)
    slipped = [pointmap.track_frame(frame, pose @ planar(slip, 0.0, 0.0)) for slip in (0.10, 0.14, 0.14)]
    assert [error_of(track.world_from_lidar, pose)[0] for track in slipped] == [0.0, 0.0, 0.0]
    assert [track.added for track in slipped] == [0, 0, 0]
    assert starts == pytest.approx([0.10, 0.0, 0.0, 0.14, 0.0, 0.0, 0.14, 0.0, 0.0])
    starts.clear()
    for _ in range(4):
        pointmap.track_frame(frame, pose @ planar(0.01, 0.0, 0.0))
    assert starts == pytest.approx([0.01, 0.0, 0.0, 0.01, 0.0, 0.0, 0.01, 0.01])  # two frames more are doubted


def test_the_wrong_face_of_a_wall_fits_worse_however_close_its_planes_are():
    wrong = Alignment(np.eye(4), True, 11, 0.935, 0.0050)  # as both were measured when wheels slipped by 0.12 m
    right = Alignment(np.eye(4), True, 11, 0.998, 0.0052)
    assert misfit(right, 0.08) < misfit(wrong, 0.08)
    assert misfit(right._replace(inliers=1.0), 0.08) == pytest.approx(0.0052**2)
    assert misfit(right._replace(inliers=0.0), 0.08) == pytest.approx(0.08**2)
