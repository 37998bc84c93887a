"""Flat upright surfaces: walls and doors' leaves are found at any angle, people and what is short are not."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.geometry import inverse, planar, transform
from graph.messages import PointCloud, Pose
from operators.tracker import Tracker
from operators.tracking.flat import ALONE, BESIDE, DIRECTIONS, FEW, LONG, SPAN, STRIP, flat

NOISE = 0.01  # metres


def leaf(length, *, turned=0.0, middle=(0.6, 0.1), count=300, seed=1):
    """Return points (count, 2) on an upright surface, as a sensor measures them."""
    random = np.random.default_rng(seed)
    along = np.linspace(-0.5 * length, 0.5 * length, count)
    direction = np.array([math.cos(turned), math.sin(turned)])
    return middle + along[:, None] * direction + random.normal(0.0, NOISE, (count, 2))


def person(x, y, *, count=80, seed=2):
    """Return points (count, 2) at the side of trunk and legs that faces the origin."""
    random = np.random.default_rng(seed)
    angle = math.atan2(-y, -x) + random.uniform(-1.4, 1.4, count)
    radius = np.where(random.random(count) < 0.5, 0.17, 0.06)
    legs = np.where(random.random(count) < 0.5, 0.1, -0.1) * (radius < 0.1)
    across = np.array([-y, x]) / math.hypot(x, y)
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], 1) + legs[:, None] * across


def twin(points):
    """Say the same with histograms: every line of the grid, every run of its spans."""
    found = np.zeros(len(points), bool)
    offset = points - points[0]
    reach = math.ceil(BESIDE / STRIP)
    for direction in range(DIRECTIONS):
        angle = math.pi * direction / DIRECTIONS
        off = np.floor((offset @ [-math.sin(angle), math.cos(angle)]) / STRIP).astype(int)
        along = np.floor((offset @ [math.cos(angle), math.sin(angle)]) / SPAN).astype(int)
        for strip in range(off.min(), off.max() + 1):
            on = (off == strip) | (off == strip + 1)
            full = [span for span in range(along.min(), along.max() + 1) if (on & (along == span)).sum() >= FEW]
            for _, run in itertools.groupby(enumerate(full), lambda item: item[1] - item[0]):
                spans = [span for _, span in run]
                within = np.isin(along, spans)
                around = within & (off >= strip - reach) & (off <= strip + 1 + reach)
                if len(spans) >= LONG and (on & within).sum() >= ALONE * around.sum():
                    found |= on & within
    return found


@given(st.floats(-math.pi, math.pi), st.floats(0.8, 1.5), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_a_door_is_flat_however_it_stands(turned, length, seed):
    assert flat(leaf(length, turned=turned, seed=seed)).mean() > 0.7


@given(st.floats(-math.pi, math.pi), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_what_is_no_longer_than_people_are_broad_is_not(turned, seed):
    assert not flat(leaf(0.45, turned=turned, seed=seed)).any()


@given(st.lists(st.tuples(st.floats(-1.1, 1.1), st.floats(0.4, 1.1)), min_size=1, max_size=4), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_people_are_not_flat(places, seed):
    crowd = np.concatenate([person(*place, seed=seed + index) for index, place in enumerate(places)])
    if len(places) == 1:
        assert not flat(crowd).any()
    assert np.array_equal(flat(crowd), twin(crowd))


@given(st.floats(-math.pi, math.pi), st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_kernel_and_twin_agree_where_somebody_stands_before_a_door(turned, seed):
    points = np.concatenate([leaf(0.9, turned=turned, seed=seed), person(0.3, 0.5, seed=seed)])
    assert np.array_equal(flat(points), twin(points))


def test_two_side_by_side_are_two_people():
    assert not flat(np.concatenate([person(0.7, -0.25), person(0.7, 0.25), person(0.7, 0.75)])).any()


def test_few_points_are_nothing():
    assert flat(np.zeros((0, 2))).tolist() == []
    assert not flat(leaf(0.9, count=10)).any()


@pytest.mark.parametrize("surface", [True, False])
def test_a_door_beside_the_robot_is_nobody_though_no_obstacle_was_seen_there(surface):
    """A leaf that the lidar has seen edge-on, if at all; a person of as many points is one."""
    mount, tracker = planar(0.0, 0.0, 0.0, 0.64), Tracker()
    nothing = np.zeros((0, 3), np.float32)
    for step in range(10):
        stamped = {"measured_at": step * 100_000_000, "base_from_lidar": mount}
        places = leaf(0.85, turned=0.3, seed=step) if surface else person(0.6, 0.1, count=300, seed=step)
        points = np.column_stack([places, np.linspace(0.2, 1.3, len(places))])
        tracker.on_people(PointCloud(points=nothing, **stamped))
        tracker.on_obstacles(PointCloud(points=nothing, **stamped))
        tracker.on_near(PointCloud(points=transform(inverse(mount), points).astype(np.float32), **stamped))
        said = tracker.on_pose(Pose(measured_at=stamped["measured_at"], world_from_base=np.eye(4))).tracks
    assert len(said.identity) == (0 if surface else 1)
