"""What a view gathers over time: clouds in layers, the trail, tracks of poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.geometry import planar, yaw

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra 'view')")

from operators.views.accumulation import LayeredCloud, Trail
from operators.views.tracks import Track, localization_error

increments = st.lists(
    st.lists(st.tuples(*[st.integers(-20, 20)] * 3), max_size=12).map(
        lambda cells: np.array(cells, float).reshape(-1, 3)
    ),
    max_size=20,
)


@given(increments)
@settings(max_examples=60, deadline=None)
def test_layers_hold_each_voxel_once_and_are_few(parts: list[np.ndarray]) -> None:
    cloud = LayeredCloud(voxel=1.0)
    shown: dict[int, np.ndarray] = {}
    sent = 0
    for part in parts:
        for layer in cloud.add(part + 0.5, np.zeros((len(part), 3), np.uint8)):
            assert len(layer.points) == len(layer.colours)
            shown[layer.level] = layer.points
            sent += len(layer.points)
    everything = {tuple(cell) for part in parts for cell in part}
    seen = [tuple(point - 0.5) for layer in shown.values() for point in layer]
    assert len(seen) == len(set(seen)) == len(cloud)
    assert set(seen) == everything
    levels = max(1, len(parts)).bit_length()
    assert len(shown) <= levels
    assert sent <= levels * len(everything)


def test_layers_keep_the_first_point_and_its_colour() -> None:
    cloud = LayeredCloud(voxel=1.0)
    colours = np.array([[1, 1, 1], [2, 2, 2]], np.uint8)
    (layer,) = cloud.add(np.array([[0.9, 0.1, 0.1], [0.2, 0.2, 0.2]]), colours)
    assert layer.points.tolist() == [[np.float32(0.9), np.float32(0.1), np.float32(0.1)]]
    assert layer.colours.tolist() == [[1, 1, 1]]
    assert cloud.add(np.array([[0.5, 0.5, 0.5]]), colours[:1]) == []


def test_a_cleared_cloud_says_which_layers_are_empty_now() -> None:
    cloud = LayeredCloud(voxel=1.0)
    for x in range(3):
        cloud.add(np.array([[x + 0.5, 0.0, 0.0]]), np.zeros((1, 3), np.uint8))
    assert {(layer.level, len(layer.points)) for layer in cloud.clear()} == {(0, 0), (1, 0)}
    assert len(cloud) == 0
    assert len(cloud.add(np.array([[0.5, 0.0, 0.0]]), np.zeros((1, 3), np.uint8))) == 1


@given(st.lists(st.tuples(*[st.floats(-50, 50)] * 3), max_size=200))
@settings(max_examples=60, deadline=None)
def test_a_trail_is_short_spaced_and_begins_where_the_way_began(way: list[tuple[float, float, float]]) -> None:
    trail = Trail(spacing=0.5, limit=16)
    for position in way:
        grown = trail.extend(np.array(position))
        assert len(trail.points) <= 16
        assert not grown or len(trail.points) == 1 or trail.spacing > 0.5 or np.allclose(trail.points[-1], position)
    if way:
        assert tuple(trail.points[0]) == way[0]
    if trail.spacing == 0.5:
        assert all(np.linalg.norm(b - a) >= 0.5 for a, b in zip(trail.points, trail.points[1:], strict=False))


# what is judged


@given(st.permutations(range(0, 100, 10)), st.integers(-5, 99))
def test_a_track_interpolates_whatever_the_order(stamps: list[int], wanted: int) -> None:
    track = Track()
    for stamp in stamps:
        track.add(stamp, planar(stamp * 0.1, 2.0, stamp * 0.01))
    pose = track.at(wanted)
    if not 0 <= wanted <= 90:
        assert pose is None
    else:
        assert pose is not None
        np.testing.assert_allclose((pose[0, 3], pose[1, 3], yaw(pose)), (wanted * 0.1, 2.0, wanted * 0.01), atol=1e-9)


def test_a_track_replaces_a_pose_and_forgets_the_oldest() -> None:
    track = Track(limit=5)
    for stamp in range(30):
        track.add(stamp, planar(0.0, 0.0, 0.0))
    track.add(29, planar(7.0, 0.0, 0.0))
    newest, oldest = track.at(29), track.at(0)
    assert newest is not None
    assert newest[0, 3] == 7.0
    assert oldest is None


@given(*[st.floats(-10, 10)] * 4, st.floats(-3, 3))
def test_the_localization_error_is_planar(x: float, y: float, dx: float, dy: float, turn: float) -> None:
    error = localization_error(planar(x + dx, y + dy, turn, z=0.3), planar(x, y, 0.0))
    assert error == pytest.approx(np.hypot(dx, dy), abs=1e-9)


# colours
