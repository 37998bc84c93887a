"""Rays against capsules: the kernel against a distance field in plain numpy."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.geometry import inverse, planar
from sim.capsules import capsule_distance, cast

Array = npt.NDArray[np.float64]


def gap(point: Array, a: Array, b: Array, radius: float) -> float:
    """Return the distance from a point to a capsule's surface, negative inside."""
    axis = b - a
    share = np.clip(np.dot(point - a, axis) / max(np.dot(axis, axis), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(point - a - share * axis) - radius)


def marched(direction: Array, a: Array, b: Array, radius: float) -> float:
    """March along a ray from the origin by the distance field (sphere tracing)."""
    t = 0.0
    for _ in range(2000):
        step = gap(direction * t, a, b, radius)
        if step < 1e-9:
            return t
        t += step
        if t > 100.0:
            break
    return math.inf


coordinate = st.floats(-4.0, 4.0)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)


@settings(deadline=None, max_examples=80)
@given(a=vector, b=vector, towards=vector, radius=st.floats(0.03, 0.5))
def test_a_ray_enters_where_the_distance_field_is_zero(a: Array, b: Array, towards: Array, radius: float) -> None:
    if gap(np.zeros(3), a, b, radius) < 1e-3 or np.linalg.norm(towards) < 1e-3:
        return
    direction = towards / np.linalg.norm(towards)
    distance = capsule_distance(*direction, *a, *b, radius)
    if math.isinf(distance):
        # what passes may touch within rounding, never enter
        nearest = min(gap(direction * t, a, b, radius) for t in np.linspace(0.0, 12.0, 400))
        assert nearest > -1e-6
    else:
        assert abs(gap(direction * distance, a, b, radius)) < 1e-6
        assert gap(direction * (distance - 1e-3), a, b, radius) > 0.0


@settings(deadline=None, max_examples=50)
@given(a=vector, b=vector, radius=st.floats(0.05, 0.5), share=st.floats(0.0, 1.0))
def test_a_ray_to_a_point_of_the_axis_hits(a: Array, b: Array, radius: float, share: float) -> None:
    target = a + share * (b - a)
    if gap(np.zeros(3), a, b, radius) < 1e-2:
        return
    direction = target / np.linalg.norm(target)
    distance = capsule_distance(*direction, *a, *b, radius)
    assert distance <= np.linalg.norm(target)
    assert abs(distance - marched(direction, a, b, radius)) < 1e-5


def test_a_ray_that_starts_inside_enters_nowhere() -> None:
    assert math.isinf(capsule_distance(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.3))


def grid(beams: int = 16, columns: int = 64) -> tuple[Array, Array]:
    up = np.radians(np.linspace(-25.0, 15.0, beams))
    around = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    elevation, azimuth = np.meshgrid(up, around, indexing="ij")
    parts = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return up, np.stack(parts, -1)


def everything(
    before: Array, after: Array, radii: Array, poses: Array, share: Array, rays: Array
) -> tuple[Array, Array]:
    """Try every ray against every capsule, in plain numpy and without any bounds."""
    beams, columns = rays.shape[:2]
    distance, body = np.full((beams, columns), 20.0), np.full((beams, columns), -1)
    for k, radius in enumerate(radii):
        for column in range(columns):
            world = before[k] + share[column] * (after[k] - before[k])
            a, b = world @ poses[column, :, :3].T + poses[column, :, 3]
            for beam in range(beams):
                t = capsule_distance(*rays[beam, column], *a, *b, radius)
                if t < distance[beam, column]:
                    distance[beam, column], body[beam, column] = t, k
    return distance, body


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 10_000), turning=st.booleans())
def test_no_ray_that_hits_is_left_out(seed: int, turning: bool) -> None:
    rng = np.random.default_rng(seed)
    up, rays = grid()
    columns, count = rays.shape[1], 8
    before = rng.uniform(-4.0, 4.0, (count, 2, 3)) * (1.0, 1.0, 0.3)
    before[:, 1] = before[:, 0] + rng.uniform(-0.5, 0.5, (count, 3))
    after = before + rng.uniform(-0.15, 0.15, (count, 1, 3))
    radii = rng.uniform(0.05, 0.3, count)
    share = np.arange(1, columns + 1) / columns if turning else np.ones(columns)
    turn = 0.2 if turning else 0.0
    poses = np.array([inverse(planar(0.1 * s, 0.0, turn * s, 0.2))[:3] for s in share])
    wanted, owner = everything(before, after, radii, poses, share, rays)
    distance = np.full(rays.shape[:2], 20.0, np.float32)
    body = np.full(rays.shape[:2], -1, np.int32)
    cosine = np.zeros(rays.shape[:2], np.float32)
    cast(before, after, radii, np.arange(count, dtype=np.int32), poses, share, up, rays, 50.0, distance, body, cosine)
    np.testing.assert_allclose(distance, wanted, atol=1e-5)
    differs = body != owner
    assert differs.mean() < 0.002  # two capsules at one distance, to the last bit of a float32
    assert (cosine[body >= 0] <= 1.0 + 1e-6).all()
    assert (cosine[body >= 0] >= 0.0).all()
