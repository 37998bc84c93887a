"""Rigid transforms: the axioms of a group, and round trips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from graph.geometry import (
    Matrix,
    exponential,
    interpolate,
    inverse,
    logarithm,
    planar,
    rotation_angle,
    transform,
    wrap,
    yaw,
)

FIXED = settings(
    derandomize=True, deadline=None, database=None, max_examples=80, suppress_health_check=list(HealthCheck)
)
METRES = st.floats(-1e3, 1e3)
VECTORS = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@st.composite
def poses(draw: st.DrawFn) -> Matrix:
    axis = draw(VECTORS)
    length = float(np.linalg.norm(axis))
    angle = draw(st.floats(0.0, 3.1))
    pose = np.eye(4)
    pose[:3, :3] = exponential(axis / length * angle) if length > 1e-3 else np.eye(3)
    pose[:3, 3] = draw(METRES), draw(METRES), draw(METRES)
    return pose


def near(one: Matrix, two: Matrix, *, atol: float = 1e-9) -> bool:
    return bool(np.allclose(one, two, rtol=1e-9, atol=atol))


@settings(FIXED)
@given(poses(), poses(), poses())
def test_poses_are_a_group(a: Matrix, b: Matrix, c: Matrix) -> None:
    assert near((a @ b) @ c, a @ (b @ c))
    assert near(a @ inverse(a), np.eye(4), atol=1e-8)
    assert near(inverse(a) @ a, np.eye(4), atol=1e-8)
    assert near(inverse(a @ b), inverse(b) @ inverse(a), atol=1e-8)
    assert near(inverse(inverse(a)), a, atol=1e-8)


@settings(FIXED)
@given(poses(), poses(), st.integers(0, 9))
def test_transforms_act_on_points_one_after_the_other(a: Matrix, b: Matrix, count: int) -> None:
    points = np.linspace(-5.0, 5.0, 3 * count).reshape(count, 3)
    assert near(transform(a, transform(b, points)), transform(a @ b, points), atol=1e-7)
    assert near(transform(np.eye(4), points), points)
    moved = transform(a, points)
    if count > 1:
        assert np.allclose(
            np.linalg.norm(np.diff(moved, axis=0), axis=1), np.linalg.norm(np.diff(points, axis=0), axis=1)
        )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_transform_keeps_the_dtype(dtype: type) -> None:
    assert transform(planar(1.0, 2.0, 0.3), np.ones((5, 3), dtype)).dtype == dtype


@settings(FIXED)
@given(VECTORS)
def test_the_exponential_is_that_of_the_cross_product_matrix(vector: Matrix) -> None:
    x, y, z = 3.0 * vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    assert near(exponential(3.0 * vector), expm(cross))
    assert near(exponential(3.0 * vector), Rotation.from_rotvec(3.0 * vector).as_matrix())


@settings(FIXED)
@given(VECTORS, st.sampled_from([1e-12, 1e-9, 1e-7, 1e-4, 0.1, 1.0, 1.7]))
def test_the_logarithm_undoes_the_exponential(vector: Matrix, scale: float) -> None:
    assert np.allclose(logarithm(exponential(scale * vector)), scale * vector, rtol=1e-6, atol=1e-12)


@settings(FIXED)
@given(METRES, METRES, st.floats(-10.0, 10.0))
def test_a_planar_pose_has_its_heading_and_place(x: float, y: float, heading: float) -> None:
    pose = planar(x, y, heading, 0.5)
    assert pose[:3, 3].tolist() == [x, y, 0.5]
    assert math.cos(yaw(pose) - heading) == pytest.approx(1.0)
    assert near(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert near(pose[:3, :3], exponential([0.0, 0.0, heading]))


@settings(FIXED)
@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_lie_in_one_turn_and_mean_the_same(angle: float) -> None:
    wrapped = float(wrap(angle))
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)
    assert wrap(np.array([angle, angle])).shape == (2,)


@settings(FIXED)
@given(poses(), VECTORS, st.floats(1e-9, 3.0))
def test_the_angle_of_a_rotation_is_exact_near_zero_and_the_same_from_both_ends(
    pose: Matrix, axis: Matrix, angle: float
) -> None:
    length = float(np.linalg.norm(axis))
    turn = np.eye(4)
    turn[:3, :3] = exponential(axis / length * angle) if length > 1e-3 else exponential([angle, 0.0, 0.0])
    assert rotation_angle(turn) == pytest.approx(angle, rel=1e-6)
    assert rotation_angle(inverse(turn)) == pytest.approx(angle, rel=1e-6)
    assert rotation_angle(pose @ inverse(pose)) == pytest.approx(0.0, abs=1e-9)


@settings(FIXED)
@given(poses(), VECTORS, st.floats(0.0, 1.0))
def test_interpolation_goes_from_one_pose_to_the_other_at_constant_speed(a: Matrix, turn: Matrix, share: float) -> None:
    b = a.copy()
    b[:3, :3] = a[:3, :3] @ exponential(1.5 * turn)
    b[:3, 3] += 4.0
    assert near(interpolate(a, b, 0.0), a)
    assert near(interpolate(a, b, 1.0), b, atol=1e-8)
    between = interpolate(a, b, share)
    assert rotation_angle(inverse(a) @ between) == pytest.approx(share * rotation_angle(inverse(a) @ b), abs=1e-6)
    assert np.allclose(between[:3, 3] - a[:3, 3], share * 4.0)
