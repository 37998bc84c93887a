"""Ground, occupancy, de-skew and the trail of the odometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_pointmap_room import BASE_FROM_LIDAR, rays, scan

from graph.geometry import exponential, inverse, planar, transform
from operators.pointmap import Occupancy, Trail, deskew, find_ground, height_above, prepare

RADIUS = 1.5 * math.radians(1.33)


def plate(plane, count, spread, seed, noise=0.01):
    """Points and normals of a piece of the plane z = a x + b y + c."""
    random = np.random.default_rng(seed)
    points = random.uniform(-spread, spread, (count, 3))
    points[:, 2] = plane[0] * points[:, 0] + plane[1] * points[:, 1] + plane[2] + noise * random.normal(size=count)
    normal = np.array([-plane[0], -plane[1], 1.0])
    return points, np.tile(normal / np.linalg.norm(normal), (count, 1))


def walls(count, seed):
    points = np.random.default_rng(seed).uniform([-5, -5, 0], [5, 5, 2.5], (count, 3))
    return points, np.tile([1.0, 0.0, 0.0], (count, 1))


def scene(*parts):
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


@pytest.mark.parametrize("plane", [(0.0, 0.0, 0.0), (0.05, -0.1, -3.0), (-0.1, 0.02, 7.5)])
def test_a_tilted_floor_is_found(plane):
    found = find_ground(*scene(plate(plane, 1000, 5.0, 0), walls(3000, 1)))
    assert np.abs(np.array(found) - plane).max() < 0.003


def test_a_table_top_does_not_win_though_it_has_more_points():
    floor, table = plate((0.0, 0.0, 0.0), 300, 5.0, 0), plate((0.0, 0.0, 0.75), 1500, 1.0, 1)
    assert abs(find_ground(*scene(table, floor, walls(500, 2)))[2]) < 0.02


def test_a_few_reflections_below_the_floor_do_not_win():
    floor, below = plate((0.0, 0.0, 0.0), 2000, 5.0, 0), plate((0.0, 0.0, -1.0), 60, 5.0, 1)
    assert abs(find_ground(*scene(floor, below))[2]) < 0.02


def test_where_nothing_is_level_there_is_no_ground():
    assert find_ground(*walls(1000, 0)) is None
    assert find_ground(*plate((0.5, 0.0, 0.0), 1000, 5.0, 0)) is None
    assert find_ground(np.empty((0, 3)), np.empty((0, 3))) is None
    assert find_ground(*plate((0.0, 0.0, 0.0), 20, 5.0, 0)) is None


def test_the_ground_of_a_frame_is_the_floor_and_the_same_each_time():
    pose = planar(0.0, 0.5, 0.3) @ BASE_FROM_LIDAR
    frame = prepare(scan(pose, noise=0.008), voxel_size=0.1, angular_radius=RADIUS)
    ground = find_ground(*frame.moved(pose))
    assert np.abs(ground).max() < 0.01
    assert np.array_equal(ground, find_ground(*frame.moved(pose)))
    assert np.allclose(height_above(ground, np.array([[0.0, 0.0, 1.0]])), 1.0, atol=0.01)


def cell(occupancy, x, y):
    column, row = np.floor((np.array([x, y]) - occupancy.origin) / occupancy.resolution).astype(int)
    return occupancy.percent()[row, column]


def test_a_ray_through_free_space_frees_it_and_ends_in_a_hit():
    occupancy = Occupancy(0.05)
    points = np.array([[3.02, 0.02, 0.7], [0.02, -4.02, 0.0], [-2.0, -2.0, 2.0]])
    occupancy.add(points, points[:, 2], np.array([0.0, 0.0]))
    assert cell(occupancy, 3.02, 0.02) == 100
    assert cell(occupancy, 1.5, 0.012) == 0
    assert cell(occupancy, 0.012, -3.5) == 0
    assert cell(occupancy, 3.5, 0.02) == -1
    assert cell(occupancy, -1.0, -1.0) == -1  # seen above 1.2 m only: says nothing of the floor


def test_who_walked_away_is_forgotten_and_who_stays_is_not():
    occupancy = Occupancy(0.05)
    gone, stays = np.array([[2.02, 0.02, 0.7]]), np.array([[4.02, 0.02, 0.7]])
    occupancy.add(gone, gone[:, 2], np.zeros(2))
    assert cell(occupancy, 2.02, 0.02) == 100
    for _ in range(19):
        occupancy.add(stays, stays[:, 2], np.zeros(2))
    assert cell(occupancy, 2.02, 0.02) == 5
    assert cell(occupancy, 4.02, 0.02) == 100


def test_the_grid_grows_and_keeps_what_it_knows():
    occupancy = Occupancy(0.05)
    first = np.array([[1.02, 1.02, 0.5]])
    occupancy.add(first, first[:, 2], np.zeros(2))
    far = np.array([[-40.0, 30.0, 0.5]])
    occupancy.add(far, far[:, 2], np.array([-38.0, 30.0]))
    assert cell(occupancy, 1.02, 1.02) == 100
    assert cell(occupancy, -39.99, 30.01) == 100


def test_a_map_gives_walls_and_free_floor():
    occupancy = Occupancy(0.05)
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.6], [2.0, 0.0, 2.0]]) + 0.01
    occupancy.add_map(points, points[:, 2])
    assert cell(occupancy, 0.01, 0.01) == 0
    assert cell(occupancy, 1.01, 0.01) == 100
    assert cell(occupancy, 2.01, 0.01) == -1


def test_an_empty_scan_and_a_bad_resolution():
    occupancy = Occupancy(0.05)
    occupancy.add(np.empty((0, 3)), np.empty(0), np.zeros(2))
    assert occupancy.percent().size == 0
    with pytest.raises(ValueError, match="above 0"):
        Occupancy(0.0)


def test_deskew_undoes_a_steady_motion():
    end = planar(0.13, 0.02, 0.1, 0.005)
    end[:3, :3] = exponential([0.01, -0.02, 0.1])
    random = np.random.default_rng(0)
    still, offset = random.normal(size=(200, 3)) * 5, random.uniform(-0.02, 0.1, 200)
    seen = []
    for point, fraction in zip(still, offset / 0.1, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = exponential(fraction * np.array([0.01, -0.02, 0.1]))
        pose[:3, 3] = fraction * end[:3, 3]
        seen.append(transform(inverse(pose), point[None])[0])
    assert np.abs(deskew(np.array(seen), offset, end, 0.1) - still).max() < 1e-5


def test_deskew_without_motion_changes_nothing():
    points = scan(BASE_FROM_LIDAR, rays(8, 64))
    assert np.array_equal(deskew(points, np.linspace(0, 0.1, len(points)), np.eye(4), 0.1), points)
    with pytest.raises(ValueError, match="apart in time"):
        deskew(points, np.zeros(len(points)), np.eye(4), 0.0)


def test_the_trail_interpolates_carries_and_never_looks_ahead():
    trail = Trail()
    assert np.array_equal(trail.at(5), np.eye(4))
    trail.add(100, planar(1.0, 0.0, 0.0), 1.0, 0.0)
    assert trail.at(0)[0, 3] == trail.at(100)[0, 3] == trail.at(900)[0, 3] == 1.0
    trail.add(200, planar(2.0, 0.0, 0.2), 1.0, 0.0)
    assert trail.at(150)[0, 3] == pytest.approx(1.5)
    assert math.atan2(trail.at(150)[1, 0], trail.at(150)[0, 0]) == pytest.approx(0.1)
    assert trail.at(300)[0, 3] == 2.0
    trail.add(200, planar(3.0, 0.0, 0.0), 1.0, 0.0)  # a duplicate stamp replaces
    assert trail.at(150)[0, 3] == pytest.approx(2.0)


def test_steady_driving_follows_an_arc():
    trail = Trail()
    trail.add(0, np.eye(4), 1.0, math.pi / 2)
    quarter = trail.motion(1.0)
    radius = 2.0 / math.pi
    assert np.allclose(quarter[:2, 3], [radius, radius])
    assert np.allclose(quarter[:2, :2], [[0, -1], [1, 0]], atol=1e-12)
    assert np.allclose(trail.motion(0.5) @ trail.motion(0.5), quarter)
