"""The lidar: known distances, symmetries, people as capsules, and agreement with PyBullet's own rays."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("pybullet")
pytest.importorskip("embreex")

from graph.geometry import interpolate, planar
from sim.lidar import NOTHING, Hits, Lidar, LidarSpec, capsule_distance
from sim.solids import Body, Box, Truth, triangles_of

SPEC = LidarSpec(beams=16, columns=256, nearest=0.0, noise=0.0)
NOBODY = np.zeros((0, 1, 2, 3))
NO_RADII = np.zeros((0, 1))


def room(half: float = 5.0, *more: Body) -> list[Body]:
    """A square room around the origin with walls 0.1 m thick, and a floor."""
    walls = [
        Body("floor", Truth.GROUND, (Box(0, 0, -0.05, 4 * half, 4 * half, 0.1),)),
        Body("east", Truth.WALL, (Box(half + 0.05, 0, 4.0, 0.1, 2 * half, 8),)),
        Body("west", Truth.WALL, (Box(-half - 0.05, 0, 4.0, 0.1, 2 * half, 8),)),
        Body("north", Truth.WALL, (Box(0, half + 0.05, 4.0, 2 * half + 0.2, 0.1, 8),)),
        Body("south", Truth.WALL, (Box(0, -half - 0.05, 4.0, 2 * half + 0.2, 0.1, 8),)),
    ]
    return [*walls, *more]


def scan(
    bodies: list[Body], pose: np.ndarray, people: np.ndarray = NOBODY, radii: np.ndarray = NO_RADII
) -> tuple[Lidar, Hits]:
    lidar = Lidar(SPEC, *triangles_of(bodies))
    return lidar, lidar.shoot(pose, people, radii, len(bodies))


def test_rays_meet_the_walls_of_an_empty_room_at_the_known_distance() -> None:
    lidar, hits = scan(room(), planar(1.0, -2.0, 0.0, 0.64))
    world = lidar.directions * hits.distance[:, None] + [1.0, -2.0, 0.64]
    for body, axis, place in ((0, 2, 0.0), (1, 0, 5.0), (2, 0, -5.0), (3, 1, 5.0), (4, 1, -5.0)):
        assert (hits.body == body).sum() > 100
        np.testing.assert_allclose(world[hits.body == body, axis], place, atol=1e-4)
    assert (hits.body != NOTHING).all()


@given(st.integers(0, 255), st.floats(-3, 3), st.floats(-3, 3))
@settings(max_examples=15, deadline=None)
def test_turning_the_robot_turns_the_cloud(columns: int, x: float, y: float) -> None:
    step = 2 * math.pi / SPEC.columns
    _, straight = scan(room(), planar(x, y, 0.0, 0.64))
    _, turned = scan(room(), planar(x, y, columns * step, 0.64))
    expected = np.roll(straight.distance.reshape(SPEC.beams, -1), -columns, axis=1)
    np.testing.assert_allclose(turned.distance.reshape(SPEC.beams, -1), expected, atol=1e-3)


def test_a_closed_door_hides_what_is_behind_it() -> None:
    """The room's east wall has an opening; behind it stands a pillar."""
    parts = (Box(2.05, 2.75, 1.5, 0.1, 4.5, 3), Box(2.05, -2.75, 1.5, 0.1, 4.5, 3), Box(2.05, 0, 2.5, 0.1, 1.0, 1))
    wall, pillar = Body("wall", Truth.WALL, parts), Body("pillar", Truth.WALL, (Box(4, 0, 1.5, 0.4, 0.4, 3),))
    door = Body("door", Truth.DOOR, (Box(2.05, 0, 1.0, 0.04, 1.0, 2.0),))
    _, seen = scan(room(5.0, wall, pillar), planar(0, 0, 0, 0.64))
    _, hidden = scan(room(5.0, wall, pillar, door), planar(0, 0, 0, 0.64))
    assert (seen.body == 6).sum() > 20
    assert (hidden.body == 6).sum() == 0
    assert (hidden.body == 7).sum() >= (seen.body == 6).sum()


def _plain_capsule(direction: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> float:
    """March along the ray: the twin of the kernel."""
    places = np.arange(0.0, 12.0, 0.001)
    points = places[:, None] * direction
    share = np.clip(((points - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-12), 0, 1)
    inside = np.linalg.norm(points - (a + share[:, None] * (b - a)), axis=1) <= radius
    return float(places[np.argmax(inside)]) if inside.any() else math.inf


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_a_ray_meets_a_capsule_where_marching_along_it_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(0, 1, 3) + np.array([4.0, 0.0, 0.0])
    b = a + rng.normal(0, 0.5, 3)
    direction = (a + b) / 2 + rng.normal(0, 0.25, 3)
    direction /= np.linalg.norm(direction)
    radius = float(rng.uniform(0.05, 0.4))
    found, expected = capsule_distance(direction, a, b, radius), _plain_capsule(direction, a, b, radius)
    if math.isinf(expected) or math.isinf(found):  # a ray that grazes may fall either way at this step
        gap = min(_plain_capsule(direction, a, b, radius + 2e-4), capsule_distance(direction, a, b, radius + 2e-4))
        assert math.isinf(expected) == math.isinf(found) or math.isfinite(gap)
    else:
        assert abs(found - expected) < 2e-3


def test_people_stand_before_walls_and_behind_pillars() -> None:
    person = np.array([[[[3.0, 0.0, 0.3], [3.0, 0.0, 1.5]]]])
    radii = np.array([[0.25]])
    _, seen = scan(room(), planar(0, 0, 0.3, 0.64), person, radii)
    met = seen.distance[seen.body == len(room())]
    assert len(met) > 20
    assert 2.70 < met.min() < 2.80
    pillar = Body("pillar", Truth.WALL, (Box(1.5, 0, 1.5, 0.8, 0.8, 3),))
    _, hidden = scan(room(5.0, pillar), planar(0, 0, 0.3, 0.64), person, radii)
    assert (hidden.body == 6).sum() == 0


def test_a_rolling_scan_deskewed_with_the_true_motion_lies_on_the_walls() -> None:
    bodies = room()
    lidar = Lidar(SPEC, *triangles_of(bodies))
    before, after = planar(0.0, 0.0, 0.0, 0.64), planar(0.13, 0.02, 0.1, 0.64)
    poses = np.array([interpolate(before, after, column / SPEC.columns) for column in range(SPEC.columns)])
    hits = lidar.sweep(poses, [(0, SPEC.columns)], [NOBODY], NO_RADII, len(bodies))
    points = lidar.directions * hits.distance[:, None]
    mine = poses[lidar.column]
    world = np.einsum("nij,nj->ni", mine[:, :3, :3], points) + mine[:, :3, 3]
    skewed = points @ after[:3, :3].T + after[:3, 3]
    east = hits.body == 1
    assert np.abs(world[east, 0] - 5.0).max() < 1e-3
    assert np.abs(skewed[east, 0] - 5.0).max() > 0.05  # without de-skewing the wall bends


def test_the_grid_of_rays_is_the_sensor_s() -> None:
    spec = LidarSpec()
    lidar = Lidar(spec, *triangles_of(room()))
    tilt = np.degrees(np.arcsin(lidar.directions[:, 2])).reshape(spec.beams, spec.columns)
    np.testing.assert_allclose(tilt[:, 0], np.linspace(-25, 15, 32), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(lidar.directions, axis=1), 1.0)
    assert len(np.unique(lidar.column)) == 1024
    assert msgspec.structs.replace(spec, noise=0.0).noise == 0.0
