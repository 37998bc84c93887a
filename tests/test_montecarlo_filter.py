"""Monte Carlo localization: likelihood field, motion, resampling, and the filter as a whole."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from operators.montecarlo import Amcl, GridMap, MapError, Parameters, flatten, load_map, save_map
from operators.montecarlo.likelihood import free_places, likelihood_field, weigh
from operators.montecarlo.localizers_command import SLIPPING
from operators.montecarlo.motion import Alphas, compose, difference, move
from operators.montecarlo.resampling import (
    effective,
    heaviest_cluster,
    kld_limit,
    mean_pose,
    resample,
    systematic,
)

RESOLUTION = 0.05
angles = st.floats(-3.0, 3.0)
places = st.floats(-10.0, 10.0)
poses = st.tuples(places, places, angles)


def room() -> GridMap:
    """A room of 10 x 6 m from (0, 0), with a pillar and a niche so that no pose looks like another."""
    cells = np.zeros((140, 220), np.int8)
    cells[:10], cells[-10:], cells[:, :10], cells[:, -10:] = 100, 100, 100, 100
    cells[40:60, 60:66] = 100
    cells[100:130, 180:210] = 100
    return GridMap(cells, np.array([-0.5, -0.5]), RESOLUTION)


def scan_from(pose, grid=None, beams=180) -> np.ndarray:
    """Cast rays by small steps: end points (n, 2) in the base frame."""
    grid = room() if grid is None else grid
    bearings = np.linspace(-math.pi, math.pi, beams, endpoint=False)
    ranges = np.zeros(beams)
    steps = np.arange(0.0, 14.0, 0.01)
    x = pose[0] + np.cos(pose[2] + bearings)[:, None] * steps
    y = pose[1] + np.sin(pose[2] + bearings)[:, None] * steps
    columns, rows = (np.floor((v - o) / RESOLUTION).astype(int) for v, o in ((x, grid.origin[0]), (y, grid.origin[1])))
    hit = grid.cells[np.clip(rows, 0, 139), np.clip(columns, 0, 219)] > 50
    ranges = steps[hit.argmax(axis=1)]
    return np.stack([np.cos(bearings), np.sin(bearings)], axis=1) * ranges[:, None]


@given(poses, poses)
def test_difference_undoes_compose(a, b):
    motion = difference(np.array(a), np.array(b))
    back = compose(np.array([a]), motion)[0]
    assert np.allclose(back[:2], b[:2], atol=1e-9)
    assert math.isclose(math.cos(back[2] - b[2]), 1.0, abs_tol=1e-12)


@given(poses, st.tuples(st.floats(-1, 1), st.floats(-0.1, 0.1), angles))
def test_without_noise_particles_go_where_odometry_goes(pose, motion):
    moved = move(np.array([pose]), np.array(motion), Alphas(0, 0, 0, 0), np.random.default_rng(0))[0]
    if math.hypot(motion[0], motion[1]) >= 0.01:
        assert np.allclose(moved[:2], compose(np.array([pose]), np.array(motion))[0][:2], atol=1e-9)
    assert math.isclose(math.cos(moved[2] - pose[2] - motion[2]), 1.0, abs_tol=1e-9)


def test_noise_grows_with_the_motion_and_driving_back_turns_no_more_than_driving_ahead():
    start = np.zeros((4000, 3))
    spreads = [
        move(start, np.array([d, 0.0, 0.0]), Alphas(), np.random.default_rng(1)).std(axis=0) for d in (0.1, 0.5, -0.5)
    ]
    assert (spreads[1] > 3 * spreads[0]).all()
    assert np.allclose(spreads[1], spreads[2], rtol=0.1)


def test_the_field_is_highest_on_walls_and_its_weights_are_those_of_plain_numpy():
    field = likelihood_field(room())
    assert np.isclose(field.cubed.max(), (0.5 + 0.5 / 30.0) ** 3)
    assert (field.cubed[room().cells == 100] == field.cubed.max()).all()
    rng = np.random.default_rng(2)
    particles = np.column_stack([rng.random(20) * 12 - 1, rng.random(20) * 8 - 1, rng.random(20) * 6 - 3])
    ends = rng.random((30, 2)) * 8 - 4
    expected = []
    for x, y, turn in particles:
        c, s = math.cos(turn), math.sin(turn)
        cells = np.floor((ends @ np.array([[c, s], [-s, c]]) + (x, y) - field.origin) / RESOLUTION).astype(int)
        inside = (cells >= 0).all(1) & (cells[:, 0] < 220) & (cells[:, 1] < 140)
        values = np.full(len(ends), field.outside)
        values[inside] = field.cubed[cells[inside, 1], cells[inside, 0]]
        expected.append(1.0 + values.sum())
    assert np.allclose(weigh(particles, ends, field), expected, rtol=1e-6)


def test_the_true_pose_weighs_most():
    pose = np.array([4.0, 3.0, 0.5])
    rng = np.random.default_rng(0)
    others = np.column_stack([rng.random(500) * 10, rng.random(500) * 6, rng.random(500) * 6 - 3])
    others = others[np.hypot(*(others - pose)[:, :2].T) > 0.3]
    weights = weigh(np.concatenate([pose[None], others]), scan_from(pose), likelihood_field(room()))
    assert weights.argmax() == 0


def test_kld_asks_for_more_particles_where_they_are_spread():
    limits = [kld_limit(bins, 0.01, 0.99, 10**9) for bins in (2, 10, 100, 1000)]
    assert limits == sorted(limits)
    assert kld_limit(1, 0.01, 0.99, 700) == 700
    b = 2.0 / (9.0 * 99)
    assert limits[2] == math.ceil(99 / 0.02 * (1.0 - b + math.sqrt(b) * 0.99) ** 3)


def test_resampling_draws_by_weight_and_few_where_all_are_together():
    rng = np.random.default_rng(0)
    particles = np.array([[0.1, 0.1, 0.05], [5.1, 5.1, 1.05]])
    drawn = resample(
        particles, np.array([0.25, 0.75]), np.zeros((0, 3)), 0.0, rng, least=100, most=5000, kld_err=0.01, kld_z=0.99
    )
    assert 100 <= len(drawn) < 300
    assert 0.6 < (drawn[:, 0] > 1).mean() < 0.9
    fresh = np.full((5000, 3), 9.0)
    half = resample(particles, np.array([0.5, 0.5]), fresh, 0.5, rng, least=2000, most=5000, kld_err=0.01, kld_z=0.99)
    assert 0.4 < (half[:, 0] == 9.0).mean() < 0.6


@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=40), st.floats(0, 0.999))
def test_systematic_resampling_keeps_each_share_within_one(weights, uniform):
    shares = np.array(weights) / np.sum(weights)
    counts = np.bincount(systematic(shares, uniform), minlength=len(shares))
    assert (np.abs(counts - shares * len(shares)) < 1.0 + 1e-6).all()
    assert 1.0 - 1e-9 <= effective(shares) <= len(shares) + 1e-6


def test_clusters_hold_together_over_the_turn_of_headings_and_the_heavier_one_wins():
    particles = np.array([[1.0, 1.0, 3.1], [1.1, 1.0, -3.1], [8.0, 1.0, 0.0], [1.2, 1.1, 3.13]])
    cluster = heaviest_cluster(particles, np.array([0.2, 0.2, 0.4, 0.2]))
    assert cluster.tolist() == [True, True, False, True]
    mean, covariance = mean_pose(particles[cluster], np.ones(3))
    assert abs(abs(mean[2]) - math.pi) < 0.05
    assert covariance[2, 2] < 0.01


START = (1.2, 1.0, 0.15)


@functools.cache
def seen(n: int):
    """Return the n-th pose of an arc, and the scan there."""
    pose = np.array([START])
    for _ in range(n):
        pose = compose(pose, np.array([0.12, 0.0, 0.004]))
    return pose[0], scan_from(pose[0])


def drive(amcl: Amcl, start=0, steps=40):
    """Drive an arc and return the errors in metres and all beliefs; odometry drives and turns a little too much."""
    errors, told, odometry = [], [], np.zeros(3)
    for n in range(start, start + steps):
        pose, ends = seen(n)
        if n > start:
            odometry = compose(odometry[None], np.array([0.124, 0.0, 0.0044]))[0]
        belief = amcl.step(odometry, ends)
        errors.append(float(np.hypot(*(belief.pose - pose)[:2])))
        told.append(belief)
    return errors, told


def test_a_drive_is_followed_and_the_same_seed_says_the_same_bits():
    first, second = (drive(Amcl(room(), Parameters(seed=3), start=START)) for _ in range(2))
    assert max(first[0]) < 0.15
    assert [b.pose.tobytes() for b in first[1]] == [b.pose.tobytes() for b in second[1]]
    other = drive(Amcl(room(), Parameters(seed=4), start=START))
    assert other[1][-1].pose.tobytes() != first[1][-1].pose.tobytes()


def spin(amcl: Amcl, updates=15):
    """Drive a bit, then turn the wheels on the spot; return the error in metres after that."""
    drive(amcl, steps=6)
    pose, ends = seen(5)
    odometry = amcl.odometry.copy()
    for _ in range(updates):
        odometry = compose(odometry[None], np.array([0.13, 0.0, 0.0]))[0]
        belief = amcl.step(odometry, ends)
    return float(np.hypot(*(belief.pose - pose)[:2]))


def test_a_robot_whose_wheels_slip_is_kept_where_its_motion_model_knows_of_that():
    slipping = [spin(Amcl(room(), Parameters(seed=seed, **SLIPPING), start=START)) for seed in range(5)]
    gripping = [spin(Amcl(room(), Parameters(seed=seed), start=START)) for seed in range(5)]
    assert max(slipping) < 1.0  # of 1.95 m for which the wheels have turned
    assert min(gripping) > 1.5


def test_a_scan_is_used_only_where_the_robot_has_moved():
    amcl = Amcl(room(), start=START)
    ends = scan_from(START)
    used = [amcl.step(np.array([x, 0.0, a]), ends).updated for x, a in ((0, 0), (0.05, 0), (0.11, 0), (0.11, 0.25))]
    assert used == [True, False, True, True]
    assert not amcl.step(np.array([1.0, 0.0, 0.0]), np.zeros((0, 2))).updated


def test_a_robot_that_may_be_anywhere_is_found_in_nine_of_ten_rooms():
    found = [drive(Amcl(room(), Parameters(seed=seed)), steps=12)[0][-1] < 0.3 for seed in range(10)]
    assert sum(found) >= 9


@pytest.mark.slow
def test_a_kidnapped_robot_is_found_within_five_metres_in_nine_of_ten_cases():
    found = []
    for seed in range(10):
        amcl = Amcl(room(), Parameters(seed=seed, recovery_alpha_slow=0.001, recovery_alpha_fast=0.1), start=START)
        drive(amcl, steps=6)
        amcl.odometry = np.zeros(3)  # somebody carries it off: odometry feels nothing
        found.append(drive(amcl, start=22, steps=40)[0][-1] < 0.3)
    assert sum(found) >= 9


def test_a_map_comes_back_as_it_was_saved(tmp_path: Path):
    grid = room()
    grid.cells[:5] = -1
    save_map(tmp_path / "map.yaml", grid)
    again = load_map(tmp_path / "map.yaml")
    assert np.array_equal(again.cells, grid.cells)
    assert np.array_equal(again.origin, grid.origin)
    assert again.resolution == grid.resolution


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("resolution: 0.05", "resolution: 0"), "above 0 metres a cell; it is 0"),
        (("resolution: 0.05", "resolution: fine"), "resolution is a number; it is 'fine'"),
        (("image: map.pgm", "image: other.pgm"), "other.pgm: the image of the map is not there"),
        (("origin:", "begin:"), "it has no origin"),
        (("mode: trinary", "mode: fuzzy"), "mode is trinary, scale or raw; it is 'fuzzy'"),
    ],
)
def test_maps_that_will_not_do_are_refused_in_a_sentence(tmp_path: Path, change, sentence: str):
    path = tmp_path / "map.yaml"
    save_map(path, room())
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(MapError, match=sentence):
        load_map(path)


def test_a_map_without_free_or_without_occupied_cells_is_refused():
    full = room()._replace(cells=np.full((20, 20), 100, np.int8))
    with pytest.raises(MapError, match="no free cell"):
        Amcl(full)
    with pytest.raises(MapError, match="no occupied cell"):
        Amcl(room()._replace(cells=np.zeros((20, 20), np.int8)))
    assert len(free_places(room())) == (room().cells == 0).sum()
    with pytest.raises(MapError, match="cells of 5 m, which is more than laser_likelihood_max_dist"):
        Amcl(room()._replace(resolution=5.0))
    with pytest.raises(
        MapError, match=r"begins at \(3, 2.5\), which is beyond the map: x from -0.5 to 3.9 and y from -0.5 to 2.3"
    ):
        Amcl(room()._replace(resolution=0.02), start=(3.0, 2.5, 0.0))


def test_a_building_becomes_a_map_of_its_walls(tmp_path: Path):
    from small_rooms import two_rooms

    from sim.rosmap import write_map

    write_map(two_rooms("closed"), tmp_path / "map.yaml")
    grid = load_map(tmp_path / "map.yaml")

    def at(x, y):
        column, row = np.floor((np.array([x, y]) - grid.origin) / grid.resolution).astype(int)
        return grid.cells[row, column]

    assert [at(2, 3), at(8, 3), at(5, 3), at(5, 1), at(0, 3), at(-0.4, 3)] == [0, 0, 0, 100, 100, -1]
    assert abs((grid.cells == 0).sum() * 0.0025 - (4.85 * 5.85 * 2 + 0.15 * 0.9)) < 0.3


def test_a_cloud_is_flattened_to_the_nearest_return_of_its_band():
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (3000, 3)).astype(np.float32)
    points[:50] = np.nan
    mount = np.eye(4)
    mount[:3, 3] = 0.1, 0.0, 0.64
    scan = flatten(points, mount)
    assert len(scan.ranges) == 629
    height = points[:, 2] + 0.64
    kept = points[(height >= 0.07) & (height <= 1.06)].astype(np.float64)
    bins = ((np.arctan2(kept[:, 1], kept[:, 0]) + math.pi) / 0.01).astype(int)
    expected = np.full(629, np.inf)
    np.minimum.at(expected, bins, np.hypot(kept[:, 0], kept[:, 1]))
    assert np.mean(np.isclose(scan.ranges, expected, atol=1e-6)) > 0.995  # a bearing on the border of two bins
    assert np.allclose(np.hypot(*(scan.returns() - scan.sensor).T), scan.ranges[np.isfinite(scan.ranges)])
    with pytest.raises(ValueError, match="min_height below max_height"):
        flatten(points, mount, min_height=2.0)
