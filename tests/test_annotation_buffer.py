"""Acceptance, refinement, classes and tallies, on arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.annotation.acceptance import Acceptance, Evidence, judge, targets_reached
from operators.annotation.buffer import Classing, classify, known_map, pooled
from operators.annotation.first_map import without_doubles
from operators.annotation.floor import floor_points
from operators.annotation.projection import Projector
from operators.annotation.refinement import Refinement, refine, seen_through, walls_of
from operators.annotation.session import GROUND, LONG_TERM, PERMANENT, SHORT_TERM, UNCERTAIN, Scan
from operators.annotation.tally import Tally, by_truth, measures, moved_doors
from operators.pointmap import MapPoints, VoxelMap
from operators.pointray import PointRay, RaySettings

GOOD = Evidence(frames=100, targets=3, reached=3, invalid=0, inliers=0.95, overlap=0.9)


def plane(axis: int, at: float, low=(0.0, 0.0, 0.0), high=(3.0, 3.0, 2.0), step: float = 0.03) -> MapPoints:
    """Points on a plane across an axis, with its normal."""
    grids = [np.array([at]) if n == axis else np.arange(low[n], high[n], step) + 0.5 * step for n in range(3)]
    points = np.stack([grid.ravel() for grid in np.meshgrid(*grids, indexing="ij")], axis=1).astype(np.float32)
    normals = np.zeros_like(points)
    normals[:, axis] = 1.0
    return MapPoints(points, normals, np.ones(len(points), np.float32))


def joined(*clouds: MapPoints) -> MapPoints:
    return MapPoints(*(np.concatenate([cloud[n] for cloud in clouds]) for n in range(3)))


def moving(cloud: MapPoints, share: float) -> MapPoints:
    return cloud._replace(movable=np.full(len(cloud.points), share, np.float32))


FLOOR = plane(2, 0.0)
WALL = plane(0, 0.0, low=(0.0, 0.0, 0.06))


def test_targets_are_reached_in_their_order():
    path = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0]])
    assert targets_reached(path, np.array([[0.5, 0.0], [5.0, 0.5], [5.0, 5.0]]), 0.9) == 3
    assert targets_reached(path, np.array([[5.0, 5.0], [0.0, 0.0]]), 0.9) == 1
    assert targets_reached(path, np.array([[0.0, 0.0], [np.nan, np.nan]]), 0.9) == 1
    assert targets_reached(path, np.zeros((0, 2)), 0.9) == 0


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"frames": 9}, "9 frames; 10 are needed"),
        ({"reached": 1}, "target 2 of 3 was not reached"),
        ({"invalid": 1}, "1 of 100 poses are not valid"),
        ({"inliers": 0.5}, "50 % inliers; 70 % are needed"),
        ({"overlap": 0.12}, "12 % of what it saw is in the map; 50 % are needed"),
    ],
)
def test_a_session_is_refused_with_every_reason(change, reason):
    assert judge(GOOD).accepted
    verdict = judge(GOOD._replace(**change))
    assert not verdict.accepted
    assert verdict.reasons == (reason,)
    assert len(judge(Evidence(0, 2, 0, 1, 0.0, 0.0)).reasons) == 5
    assert judge(GOOD._replace(reached=1), Acceptance(reached=False)).accepted


def test_what_any_session_saw_through_leaves_but_never_the_ground():
    cloud = joined(FLOOR, WALL)
    movable = np.zeros(len(cloud.points), np.float32)
    once = movable.copy()
    once[:50] = 1.0  # floor
    once[-20:] = 0.95  # wall
    refined, stays = refine(cloud, [movable, once, movable])
    assert stays[:-20].all()
    assert not stays[-20:].any()
    assert len(refined.points) == len(cloud.points) - 20
    again, _ = refine(cloud, [movable, once], Refinement(threshold=0.99))
    assert len(again.points) == len(cloud.points)


@settings(deadline=None, max_examples=25)
@given(st.lists(st.integers(0, 3), min_size=1, max_size=4, unique=True), st.integers(0, 5))
def test_refinement_knows_no_order_of_sessions(chosen, seed):
    sessions = [np.random.default_rng([seed, n]).random(len(WALL.points)).astype(np.float32) for n in chosen]
    each = Refinement(piece=2.0)  # each point alone: no piece has so large a share
    one, two = refine(WALL, sessions, each)[1], refine(WALL, sessions[::-1], each)[1]
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, np.max(sessions, axis=0) < 0.9)
    np.testing.assert_array_equal(refine(WALL, sessions)[1], refine(WALL, sessions[::-1])[1])


def test_new_points_get_the_class_of_their_probability():
    known = known_map(joined(FLOOR, WALL))
    box = plane(0, 1.5, low=(0.0, 1.0, 0.3), high=(3.0, 1.5, 1.2))
    for share, label in ((0.9, SHORT_TERM), (0.1, LONG_TERM), (0.55, UNCERTAIN)):
        made = classify(known, moving(box, share))
        assert set(made.new.label.tolist()) == {label}
    assert set(known.labels[: len(FLOOR.points)].tolist()) == {GROUND}
    assert set(known.labels[len(FLOOR.points) :].tolist()) == {PERMANENT}


def test_the_edge_of_a_hole_in_a_wall_closes_and_what_stands_before_it_does_not():
    cut = np.hypot(WALL.points[:, 1] - 1.5, WALL.points[:, 2] - 1.0) < 0.1
    known = known_map(joined(FLOOR, WALL.kept(~cut)))
    assert (classify(known, moving(WALL.kept(cut), 0.0)).new.label == PERMANENT).all()
    cupboard = plane(0, 0.08, low=(0.0, 1.0, 0.3), high=(3.0, 1.5, 1.2))
    assert (classify(known, moving(cupboard, 0.0)).new.label == LONG_TERM).all()
    across = plane(1, 1.5, low=(0.045, 0.0, 0.5), high=(0.6, 3.0, 1.5))  # a door leaf that stands open
    assert (classify(known, moving(across, 0.0)).new.label == LONG_TERM).mean() > 0.95
    assert (classify(known, moving(WALL.kept(cut), 0.9)).new.label == SHORT_TERM).all()


def test_legs_do_not_take_root_in_the_floor():
    known = known_map(FLOOR)
    leg = plane(0, 1.0, low=(0.0, 1.0, 0.06), high=(3.0, 1.3, 0.5))
    assert (classify(known, moving(leg, 0.1)).new.label == LONG_TERM).all()


def test_the_authors_ring_doubts_what_is_near_something_movable():
    known = known_map(joined(FLOOR, WALL))
    near = plane(0, 0.07, low=(0.0, 0.0, 0.5), high=(3.0, 0.3, 0.8))
    person = plane(0, 0.15, low=(0.0, 2.0, 0.5), high=(3.0, 2.3, 1.5))
    made = classify(known, moving(joined(near, person), 0.9), Classing(permanent="ring"))
    assert (made.new.label[: len(near.points)] == PERMANENT).all()
    assert (made.new.label[len(near.points) :] == SHORT_TERM).all()
    touching = plane(0, 0.12, low=(0.0, 2.0, 0.5), high=(3.0, 2.3, 1.5))
    doubt = classify(known, moving(touching, 0.9), Classing(permanent="ring", ring=0.125)).known_labels == UNCERTAIN
    assert not doubt.any()  # what is within the ring of the map is part of it
    with pytest.raises(ValueError, match="movable probabilities"):
        classify(known, WALL)


def test_ground_ends_at_the_feet_of_things():
    points = joined(FLOOR, WALL).points
    floor = floor_points(points, np.zeros(3), 0.05, 0.01)
    np.testing.assert_array_equal(floor, points[:, 2] < 0.05)
    legs = np.array([[1.0, 1.0, 0.055], [1.0, 1.0, 0.048], [2.0, 2.0, 0.048]], np.float32)
    assert floor_points(legs, np.zeros(3), 0.05, 0.01).tolist() == [False, False, True]


def test_points_take_the_class_of_the_nearest_and_far_ones_none():
    known = known_map(joined(FLOOR, WALL))
    box = moving(plane(0, 1.5, low=(0.0, 1.0, 0.3), high=(3.0, 1.5, 1.2)), 0.9)
    buffer = classify(known, box)
    points = np.array([[1.51, 1.2, 0.6], [0.02, 1.2, 0.6], [1.0, 1.0, 0.01], [2.5, 2.5, 1.5], [np.nan, 0, 0]])
    scan = Scan(points.astype(np.float32), np.eye(4))
    assert Projector(buffer).project(scan).tolist() == [SHORT_TERM, PERMANENT, GROUND, UNCERTAIN, UNCERTAIN]


@given(st.integers(0, 20))
def test_the_short_cut_of_the_projection_changes_nothing(seed):
    known = known_map(joined(FLOOR, WALL))
    rng = np.random.default_rng(seed)
    points = rng.uniform((0.05, 0.0, 0.05), (1.0, 3.0, 2.0), (400, 3)).astype(np.float32)
    normals = np.zeros_like(points)
    new = moving(MapPoints(points, normals, np.ones(400, np.float32)), 0.1)
    buffer = classify(known, new._replace(movable=rng.random(400).astype(np.float32)))
    scan = Scan(rng.uniform(-0.1, 1.5, (500, 3)).astype(np.float32), np.eye(4))
    np.testing.assert_array_equal(Projector(buffer).project(scan), Projector(buffer._replace(apart=0.0)).project(scan))


def test_a_map_without_doubles_has_one_point_a_voxel_on_both_grids():
    rng = np.random.default_rng(0)
    points = (rng.uniform(-1.0, 1.0, (20_000, 3)) * (1.0, 1.0, 0.02)).astype(np.float32)
    voxels = VoxelMap()
    voxels.insert(points, np.zeros_like(points), rng.random(20_000).astype(np.float32), 0)
    cloud = voxels.cloud()
    kept = cloud.kept(without_doubles(cloud, 0.03))
    assert len(kept.points) < 0.8 * len(cloud.points)
    for shift in (0.0, 0.015):
        cells = np.floor((kept.points.astype(np.float64) + shift) / 0.03)
        assert len(np.unique(cells, axis=0)) >= len(kept.points) - 2  # single precision at the borders
    again = VoxelMap()
    again.insert_map(kept)
    assert again.nearest(cloud.points, 0.06)[0].min() >= 0


def test_points_that_were_hardly_looked_at_ask_their_neighbours():
    places = np.array([[2.0, 0.0, 0.0], [2.04, 0.04, 0.0], [2.0, 1.5, 0.0]], np.float32) + 0.01
    voxels = VoxelMap()
    voxels.insert(places, np.tile(np.float32([-1.0, 0.0, 0.0]), (3, 1)), np.ones(3, np.float32), 0)
    tracer = PointRay(voxels, RaySettings())
    tracer.looks()
    tracer.counts[:3] = [[8, 8], [6, 3], [4, 0]]
    assert tracer.movable().tolist() == [0.5, 0.5, 0.5]
    np.testing.assert_allclose(pooled(tracer, edge=0.09), [11 / 14, 11 / 14, 0.5])
    tracer.counts[:3] = [[20, 20], [6, 3], [4, 0]]
    np.testing.assert_allclose(pooled(tracer, edge=0.09), [1.0, 23 / 26, 0.5])


def tallied(labels, truth, moves=None, instance=None, world=None):
    tally = Tally()
    labels, truth = np.array(labels, np.uint8), np.array(truth, np.uint8)
    world = np.zeros((len(labels), 3)) if world is None else world
    tally.add(labels, truth, None if moves is None else np.array(moves), instance, world)
    return tally.numbers()


def test_recall_counts_each_class_alone():
    told = tallied([1, 1, 2, 0, 4, 4, 3, 0], [1, 1, 2, 2, 6, 6, 7, 0], [0, 0, 0, 0, 1, 0, 0, 0])
    found = measures(by_truth([told], set()), list(told["points"]["unknown"].values()))
    assert found["recall"]["ground"] == 1.0
    assert found["recall"]["wall"] == 0.5
    assert found["recall_labelled"]["wall"] == 1.0
    assert found["points"]["moving person"] == found["points"]["person standing a moment"] == 1
    assert found["coverage"] == pytest.approx(6 / 8)
    assert found["precision"] == {"ground": 1.0, "permanent": 1.0, "longT": 1.0, "shortT": 1.0}
    assert "table" not in found["recall"]


def leaf(angle: float, count: int = 300) -> np.ndarray:
    """Points of a door leaf of 0.9 m, hinged at (5, 5)."""
    along = np.linspace(0.0, 0.9, count)
    return np.stack([5 + along * math.cos(angle), 5 + along * math.sin(angle), np.ones(count)], axis=1)


@pytest.mark.parametrize(("turn", "moved"), [(0.0, False), (0.05, False), (0.6, True), (math.pi, True)])
def test_a_door_moved_if_it_stands_otherwise_in_another_session(turn, moved):
    instance = np.full(300, 7, np.int32)
    sessions = [
        tallied(np.full(300, label), np.full(300, 3), instance=instance, world=leaf(angle))
        for label, angle in ((3, 1.0), (2, 1.0 + turn))
    ]
    assert moved_doors(sessions) == ({"7"} if moved else set())
    counts = by_truth(sessions, moved_doors(sessions))
    assert sum(counts["door" if moved else "door never moved"]) == 600
    assert measures(counts)["recall"]["door" if moved else "door never moved"] == 0.5


def test_who_looks_through_long_walls_is_known_by_them():
    random = np.random.default_rng(5)

    def upright(length: float, y: float) -> np.ndarray:
        count = int(1000 * length)
        return np.stack([random.uniform(0, length, count), np.full(count, y), random.uniform(0, 2, count)], axis=1)

    points = np.concatenate([upright(6.0, 0.0), upright(1.0, 3.0)]).astype(np.float32)
    normals = np.tile(np.array([0.0, -1.0, 0.0], np.float32), (len(points), 1))
    walls = walls_of(MapPoints(points, normals, np.ones(len(points), np.float32)))
    assert walls[:6000].mean() > 0.99
    assert not walls[6000:].any()  # a leaf of a door may go
    movable, looks = np.zeros(len(points), np.float32), np.full(len(points), 20, np.int32)
    movable[6000:] = 1.0
    assert seen_through(walls, movable, looks) == 0.0
    movable[:600] = 1.0
    assert seen_through(walls, movable, looks) == pytest.approx(0.1, abs=0.01)
    looks[:600] = 3  # too few to say so
    assert seen_through(walls, movable, looks) == 0.0
