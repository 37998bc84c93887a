"""What the lidar has seen: entered at once, worn off by rays that pass, remembered where no ray looks."""

from __future__ import annotations

import numpy as np

from graph.geometry import planar
from operators.navigation.lattice import lattice_around
from operators.navigation.obstacles import (
    AZIMUTHS,
    ELEVATION_STEP,
    FIRST_ELEVATION,
    LIFE,
    NOTHING,
    SLOWLY,
    ObstacleLayer,
    panorama,
)

HEIGHT = 0.64
ELEVATION, AZIMUTH = np.meshgrid(np.radians(np.linspace(-30, 10, 32)), np.linspace(-np.pi, np.pi, 1024, endpoint=False))


def rays(reach):
    """Points at a horizontal distance `reach(azimuth)` from the lidar, on all beams above the floor, else the floor."""
    flat = np.broadcast_to(reach(AZIMUTH), AZIMUTH.shape)
    floor = np.where(ELEVATION < 0, HEIGHT / np.tan(np.maximum(-ELEVATION, 1e-6)), np.inf)
    flat = np.minimum(flat, floor)
    points = np.stack([flat * np.cos(AZIMUTH), flat * np.sin(AZIMUTH), flat * np.tan(ELEVATION)], axis=-1)
    return points.reshape(-1, 3)[np.linalg.norm(points.reshape(-1, 3), axis=1) > 0.9].astype(np.float32)


def layer():
    return ObstacleLayer(lattice_around(0.05, (-12.0, -12.0), (12.0, 12.0)))


def filled(obstacles):
    rows, columns = np.nonzero(obstacles.filled)
    return np.array(obstacles.lattice.centre(rows, columns)).T


def wall_with_post(distance, width=0.06):
    return rays(lambda a: np.where(np.abs(a) < width / 2, distance, 6.0))


def near(places, x, y, radius=0.3):
    return int((np.hypot(places[:, 0] - x, places[:, 1] - y) < radius).sum())


def test_panorama_is_the_nearest_range():
    points = np.random.default_rng(0).normal(0.0, 3.0, (500, 3)).astype(np.float32)
    image = panorama(points)
    x, y, z = points.T.astype(np.float64)
    flat = np.sqrt(x * x + y * y)
    rows = np.floor((np.arctan2(z, flat) - FIRST_ELEVATION) / ELEVATION_STEP).astype(int)
    columns = np.floor(np.arctan2(y, x) * AZIMUTHS / (2 * np.pi)).astype(int) % AZIMUTHS
    twin = np.full(image.shape, NOTHING, np.float32)
    for row, column, distance in zip(rows, columns, np.sqrt(flat * flat + z * z).astype(np.float32), strict=True):
        if 0 <= row < len(twin):
            twin[row, column] = min(twin[row, column], distance)
    assert np.array_equal(image, twin)


def test_only_what_is_above_the_floor_and_below_the_lidar_roof_counts():
    heights = np.array([0.02, 0.09, 0.3, 1.1, 1.3, 2.0])
    points = np.stack([np.full(6, 3.0), np.arange(6.0), heights - HEIGHT], axis=1).astype(np.float32)
    obstacles = layer()
    obstacles.observe(points, planar(0.0, 0.0, 0.0, HEIGHT))
    assert sorted(filled(obstacles)[:, 1].round().tolist()) == [2.0, 3.0]


def test_walls_are_where_they_are_from_any_pose():
    pose = planar(1.0, -2.0, 0.7, HEIGHT)
    obstacles = layer()
    obstacles.observe(rays(lambda a: np.full_like(a, 5.0)), pose)
    places = filled(obstacles)
    assert len(places) > 400
    assert np.abs(np.hypot(places[:, 0] - 1.0, places[:, 1] + 2.0) - 5.0).max() < 0.05


def test_what_leaves_is_worn_off_and_what_stays_stays():
    obstacles = layer()
    pose = planar(0.0, 0.0, 0.0, HEIGHT)
    obstacles.observe(wall_with_post(2.0), pose)
    assert near(filled(obstacles), 2.0, 0.0) > 0
    for _ in range(LIFE + 20):
        obstacles.observe(wall_with_post(2.0), pose)
    assert near(filled(obstacles), 2.0, 0.0) > 0
    for _ in range(LIFE):
        obstacles.observe(wall_with_post(6.0), pose)
    assert near(filled(obstacles), 2.0, 0.0) == 0
    assert near(filled(obstacles), 6.0, 0.0) > 0


def test_blind_ring_is_remembered_until_rays_pass():
    obstacles = layer()
    obstacles.observe(wall_with_post(1.2), planar(0.0, 0.0, 0.0, HEIGHT))
    silent = rays(lambda a: np.where(np.abs(a) < 0.4, 0.5, 6.0))  # the post, now near, swallows the rays
    for _ in range(100):
        obstacles.observe(silent, planar(0.7, 0.0, 0.0, HEIGHT))
    assert near(filled(obstacles), 1.2, 0.0) > 0
    for _ in range(LIFE):
        obstacles.observe(wall_with_post(6.0), planar(0.7, 0.0, 0.0, HEIGHT))
    assert near(filled(obstacles), 1.2, 0.0) == 0


def test_who_came_near_and_went_leaves_nothing_overhead_or_below():
    """At 0.5 m the beams see 0.35 to 0.73 m above the floor; head and feet of a person were seen from farther away."""
    obstacles = layer()
    person = rays(lambda a: np.where(np.abs(a) < 0.15, 1.5, 6.0))
    obstacles.observe(person, planar(0.0, 0.0, 0.0, HEIGHT))
    heights = [level for level in range(11) if obstacles._life[..., level].any()]
    assert len(heights) >= 9
    free = rays(lambda a: np.full_like(a, 6.0))
    free = free[np.abs(free[:, 2] / np.hypot(free[:, 0], free[:, 1])) < 0.2]  # ten beams of the middle alone
    for _ in range(LIFE * SLOWLY):
        obstacles.observe(free, planar(1.0, 0.0, 0.0, HEIGHT))
    assert near(filled(obstacles), 1.5, 0.0) == 0


def test_hidden_things_are_remembered():
    obstacles = layer()
    pose = planar(0.0, 0.0, 0.0, HEIGHT)
    obstacles.observe(wall_with_post(4.0), pose)
    for _ in range(100):
        obstacles.observe(wall_with_post(2.0, width=0.3), pose)
    assert near(filled(obstacles), 4.0, 0.0) > 0


def test_frames_without_floor_forget_who_has_gone():
    """A triage leaves out floor and people: no ray returns from behind legs, but the wall does from behind a chest."""
    obstacles = layer()
    pose = planar(0.0, 0.0, 0.0, HEIGHT)
    for flat in (wall_with_post(2.0), *[wall_with_post(6.0)] * LIFE):
        obstacles.observe(flat[flat[:, 2] > 0.1 - HEIGHT], pose)
        assert near(filled(obstacles), 6.0, 0.4) > 0
    assert near(filled(obstacles), 2.0, 0.0) == 0


def test_growing_keeps_what_is_known():
    obstacles = layer()
    obstacles.observe(wall_with_post(2.0), planar(0.0, 0.0, 0.0, HEIGHT))
    before = filled(obstacles)
    obstacles.grow(lattice_around(0.05, (-20.0, -14.0), (12.0, 30.0)))
    assert np.allclose(np.sort(before, axis=0), np.sort(filled(obstacles), axis=0))
