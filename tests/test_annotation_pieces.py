"""Flat pieces of maps, on arrays: what they are, and that they leave and join as one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.annotation.buffer import classify, known_map
from operators.annotation.pieces import NOWHERE, flat_pieces, length_of_piece, share_of_piece
from operators.annotation.refinement import refine
from operators.annotation.session import LONG_TERM, PERMANENT
from operators.pointmap import MapPoints

FLOOR_HEIGHT = 0.06


def panel(
    start, direction: float, length: float, height: float = 2.0, noise: float = 0.004, seed: int = 0
) -> MapPoints:
    """An upright rectangle that starts at (x, y) and runs in a direction (radians), a point each 0.03 m, with noise."""
    along, up = np.meshgrid(np.arange(0.0, length, 0.03), np.arange(FLOOR_HEIGHT, height, 0.03), indexing="ij")
    along, up = along.ravel(), up.ravel()
    normal = np.array([-math.sin(direction), math.cos(direction), 0.0])
    points = np.stack([start[0] + along * math.cos(direction), start[1] + along * math.sin(direction), up], axis=1)
    points += np.random.default_rng(seed).normal(0.0, noise, (len(points), 1)) * normal
    count = len(points)
    return MapPoints(
        points.astype(np.float32), np.tile(normal, (count, 1)).astype(np.float32), np.ones(count, np.float32)
    )


def joined(*clouds: MapPoints) -> MapPoints:
    return MapPoints(*(np.concatenate([cloud[n] for cloud in clouds]) for n in range(3)))


@settings(deadline=None, max_examples=25)
@given(st.floats(0.0, math.pi), st.integers(0, 100))
def test_a_wall_is_one_piece_whichever_way_it_runs_and_the_next_wall_another(direction, seed):
    wall = panel((1.0, -2.0), direction, 2.5, seed=seed)
    corner = wall.points[-1, :2].astype(float) + 0.05
    other = panel(corner, direction + 0.5 * math.pi, 1.5, seed=seed + 1)
    pieces = flat_pieces(*joined(wall, other)[:2])
    first, second = pieces[: len(wall.points)], pieces[len(wall.points) :]
    main, main_other = np.bincount(first).argmax(), np.bincount(second).argmax()
    assert main != main_other
    assert (first == main).mean() > 0.97
    assert (second == main_other).mean() > 0.97


@pytest.mark.parametrize("gap", [0.2, 0.5])
def test_what_does_not_touch_or_lies_before_the_wall_is_a_piece_of_its_own(gap):
    wall = panel((0.0, 0.0), 0.0, 2.0, noise=0.0)
    beside, before = panel((2.0 + gap, 0.0), 0.0, 1.0, noise=0.0), panel((0.5, gap), 0.0, 1.0, noise=0.0)
    pieces = flat_pieces(*joined(wall, beside, before)[:2])
    assert len(set(pieces.tolist())) == 3


def test_level_points_and_none_have_no_piece():
    level = np.tile(np.float32((0.0, 0.0, 1.0)), (5, 1))
    assert (flat_pieces(np.random.default_rng(0).random((5, 3)).astype(np.float32), level) == NOWHERE).all()
    nothing = np.zeros((0, 3), np.float32)
    assert len(flat_pieces(nothing, nothing)) == 0
    assert len(share_of_piece(np.zeros(0, np.int64), np.zeros(0, np.bool_))) == 0


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 1000))
def test_shares_and_lengths_are_those_of_their_pieces(seed):
    rng = np.random.default_rng(seed)
    pieces, chosen = rng.integers(-1, 4, 60), rng.random(60) < 0.4
    points = rng.random((60, 3)).astype(np.float32)
    share, length = share_of_piece(pieces, chosen), length_of_piece(pieces, points)
    for n, piece in enumerate(pieces.tolist()):
        own = pieces == piece
        assert share[n] == (0.0 if piece == NOWHERE else chosen[own].mean())
        assert length[n] == (0.0 if piece == NOWHERE else np.ptp(points[own, :2], axis=0).max())


def test_a_leaf_leaves_whole_and_a_wall_loses_only_what_was_seen_through():
    leaf, wall = panel((0.0, 0.0), 1.5, 0.9), panel((0.0, 0.0), 0.0, 6.0)
    cloud = joined(wall, leaf)
    movable = np.zeros(len(cloud.points), np.float32)
    outer = np.hypot(leaf.points[:, 0], leaf.points[:, 1]) > 0.6
    movable[len(wall.points) :][outer] = 1.0  # a door that turned a little
    hole = (wall.points[:, 0] > 2.0) & (wall.points[:, 0] < 4.0)
    movable[: len(wall.points)][hole] = 0.95  # a third of the wall
    _, stays = refine(cloud, [movable])
    assert not stays[len(wall.points) :].any()
    np.testing.assert_array_equal(stays[: len(wall.points)], ~hole)


def test_a_shut_door_does_not_grow_together_with_its_wall_and_a_narrow_gap_does():
    left, right = panel((0.0, 0.0), 0.0, 2.0), panel((2.9, 0.0), 0.0, 2.0)
    known = known_map(joined(left, right))
    door = panel((2.02, 0.02), 0.0, 0.86)._replace(movable=np.zeros(0, np.float32))
    still = np.zeros(len(door.points), np.float32)
    assert (classify(known, door._replace(movable=still)).new.label == LONG_TERM).all()
    gap = panel((2.03, 0.0), 0.0, 0.15)
    gap = gap._replace(movable=np.zeros(len(gap.points), np.float32))
    assert (classify(known, gap).new.label == PERMANENT).all()


@pytest.mark.parametrize(("share", "leaves"), [(0.2, False), (0.3, True)])
def test_a_piece_leaves_whole_from_a_quarter_on(share, leaves):
    leaf = panel((0.0, 0.0), 0.0, 2.0)
    seen_through = leaf.points[:, 0] > np.quantile(leaf.points[:, 0], 1.0 - share)
    _, stays = refine(leaf, [np.where(seen_through, np.float32(1.0), np.float32(0.0))])
    np.testing.assert_array_equal(stays, np.zeros(len(stays), np.bool_) if leaves else ~seen_through)
