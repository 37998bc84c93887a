"""The tracker among people of two legs: where they are, how fast, who is who, and who is remembered."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.contract import ports_of
from graph.geometry import inverse, planar, transform
from graph.messages import PointCloud, Pose
from operators.tracker import Tracker
from operators.tracking.clusters import centres, clumps, nearest_of
from operators.tracking.filter import corrected, met, predicted
from operators.tracking.tracker import Habits
from operators.tracking.tracker import Tracker as Tracking

PERIOD = 0.1  # seconds
MOUNT = planar(0.0, 0.0, 0.0, 0.64)


def body(place, eye, random, count=60):
    """The side of a person that faces the lidar: half a circle of 0.2 m, 0.3 to 1.5 m high."""
    away = np.arctan2(eye[1] - place[1], eye[0] - place[0])
    angle = away + random.uniform(-np.pi / 2, np.pi / 2, count)
    height = random.uniform(0.3, 1.5, count)
    return np.stack([place[0] + 0.15 * np.cos(angle), place[1] + 0.15 * np.sin(angle), height], axis=1)


def follow(paths, seconds, *, eye=(0.0, 0.0), hidden=lambda index, time: False, habits=None):
    """Follow people on paths (time -> x, y); return the tracker and what it said last."""
    random, tracker, people = np.random.default_rng(1), Tracking(habits), None
    for step in range(round(seconds / PERIOD)):
        time = step * PERIOD
        seen = [body(path(time), eye, random) for index, path in enumerate(paths) if not hidden(index, time)]
        people = tracker.observe(np.concatenate(seen) if seen else np.zeros((0, 3)), eye, PERIOD if step else 0.0)
    return tracker, people


def straight(x, y, vx, vy):
    return lambda time: (x + vx * time, y + vy * time)


def test_walkers_are_found_where_they_are_and_as_fast_as_they_go():
    paths = [straight(4.0, -1.0, -0.2, 0.9), straight(-3.0, 2.0, 0.8, 0.0), straight(2.0, 2.0, 0.0, 0.0)]
    _, people = follow(paths, 3.0)
    assert list(people.identity) == [1, 2, 3]
    for index, path in enumerate(paths):
        assert np.hypot(*(people.place[index] - path(2.9))) < 0.15
        assert np.hypot(*(people.velocity[index] - (np.array(path(1.0)) - path(0.0)))) < 0.25


def test_two_who_cross_stay_who_they_are():
    paths = [straight(3.0, -1.5, 0.0, 1.0), straight(3.6, 1.5, 0.0, -1.0)]
    _, people = follow(paths, 3.0)
    assert list(people.identity) == [1, 2]
    assert people.place[0, 1] > 1.0
    assert people.place[1, 1] < -1.0


def test_two_beside_each_other_are_two():
    paths = [straight(3.0, -1.0, 0.5, 0.0), straight(3.0, 1.0, 0.5, -0.4)]
    _, people = follow(paths, 3.0)
    assert len(people.identity) == 2


def test_who_is_hidden_for_a_moment_is_the_same_person_after_it():
    _, people = follow([straight(4.0, -2.0, 0.0, 1.0)], 4.0, hidden=lambda index, time: 1.5 < time < 2.0)
    assert list(people.identity) == [1]


def test_who_left_is_forgotten():
    _, people = follow([straight(4.0, 0.0, 0.0, 0.0)], 3.0, hidden=lambda index, time: time > 1.0)
    assert len(people.identity) == 0


def test_who_steps_into_the_blind_ring_is_remembered_there_and_comes_to_rest():
    _, people = follow([straight(2.5, 0.0, -1.0, 0.0)], 3.0, hidden=lambda index, time: time > 1.45)
    assert len(people.identity) == 1
    assert 0.45 < np.hypot(*people.place[0]) < 1.1
    assert np.hypot(*people.velocity[0]) < 0.35
    assert people.unseen[0] > 1.0
    _, people = follow([straight(2.5, 0.0, -1.0, 0.0)], 6.0, hidden=lambda index, time: time > 1.45)
    assert len(people.identity) == 0


@pytest.mark.parametrize("middle", [0.8, 0.9, 1.0, 1.2])
def test_who_is_half_in_the_blind_ring_is_not_mistaken_for_far_away(middle):
    """The lidar sees what of a body is beyond 0.9 m: of somebody near, the far side alone."""
    angle = np.linspace(-np.pi, np.pi, 200)
    whole = np.stack([middle + 0.15 * np.cos(angle), 0.15 * np.sin(angle), np.ones(200)], axis=1)
    away = np.hypot(whole[:, 0], whole[:, 1])
    seen = whole[(away > 0.9) & ((whole[:, 0] < middle) | (away < 1.05))]
    tracker = Tracking()
    for step in range(10):
        people = tracker.observe(seen, (0.0, 0.0), PERIOD if step else 0.0)
    assert len(people.identity) == 1
    assert abs(people.place[0, 0] - middle) < 0.13


def test_passing_glance_is_nobody():
    _, people = follow([straight(4.0, 0.0, 0.0, 0.0)], 1.0, hidden=lambda index, time: time < 0.85)
    assert len(people.identity) == 0


def test_far_away_does_not_matter():
    _, people = follow([straight(12.0, 0.0, 0.0, 0.0)], 1.0)
    assert len(people.identity) == 0
    _, people = follow([straight(12.0, 0.0, 0.0, 0.0)], 1.0, habits=Habits(reach=20.0))
    assert len(people.identity) == 1


def test_nobody_is_nobody():
    tracker, people = follow([], 1.0)
    assert people.place.shape == (0, 2)
    assert tracker.met == 0


points = st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), max_size=40).map(
    lambda pairs: np.array(pairs, np.float64).reshape(-1, 2)
)


@given(points)
@settings(max_examples=60, deadline=None)
def test_clumps_are_what_touches(places):
    found = clumps(places, 0.2)
    gap = np.abs(places[:, None] - places[None])
    same = found[:, None] == found[None]
    assert same[(gap < 1e-9).all(axis=2)].all()
    assert not (same & ~joined(places, 0.4 + 1e-9)).any()  # touching cells are at most two cells apart
    assert list(dict.fromkeys(found)) == list(range(len(set(found))))


def joined(places, reach):
    """Plain twin: which points are linked by steps of at most `reach` along each axis."""
    link = (np.abs(places[:, None] - places[None]) <= reach).all(axis=2)
    for _ in range(len(places)):
        link = link | (link @ link)
    return link


@given(points, points, st.floats(0.05, 2.0))
@settings(max_examples=60, deadline=None)
def test_points_belong_to_the_nearest_within_its_gate(places, people, gate):
    found = nearest_of(places, people, np.full(len(people), gate))
    away = np.sqrt(((places[:, None] - people[None]) ** 2).sum(axis=2))
    for index, owner in enumerate(found):
        if owner < 0:
            assert (away[index] >= gate - 1e-9).all()
        else:
            assert away[index, owner] <= away[index].min() + 1e-9


def test_centres_are_means():
    middle, number = centres(np.array([[0.0, 0.0], [2.0, 4.0], [9.0, 9.0]]), np.array([1, 1, -1]), 3)
    assert np.array_equal(number, [0, 2, 0])
    assert np.allclose(middle, [[0, 0], [1, 2], [0, 0]])


def test_filter_is_sure_of_what_it_sees_and_less_of_what_it_expects():
    belief = met(np.zeros((1, 2)))
    later = predicted(belief, 0.5)
    assert (later.variance[:, [0, 2]] > belief.variance[:, [0, 2]]).all()
    seen = corrected(later, np.array([[0.5, 0.0]]), np.array([0.06]), np.array([True]))
    assert (seen.variance[:, [0, 2]] < later.variance[:, [0, 2]]).all()
    assert 0.4 < seen.place[0, 0] < 0.5
    assert 0.5 < seen.velocity[0, 0] < 1.2
    assert seen.place[0, 1] == seen.velocity[0, 1] == 0.0
    unseen = corrected(later, np.array([[0.5, 0.0]]), np.array([0.06]), np.array([False]))
    assert all(np.array_equal(a, b) for a, b in zip(unseen, later, strict=True))


def messages(steps=20):
    random = np.random.default_rng(2)
    for step in range(steps):
        base = planar(0.05 * step, 0.0, 0.1 * step)
        points = transform(inverse(base @ MOUNT), body((4.0, 0.05 * step), base[:2, 3], random))
        stamp = step * 100_000_000
        yield (
            PointCloud(measured_at=stamp, points=points.astype(np.float32), base_from_lidar=MOUNT),
            Pose(measured_at=stamp, world_from_base=base),
        )


def test_operator_speaks_of_the_world_at_each_pose():
    assert list(ports_of(Tracker).inputs) == ["people", "pose"]
    tracker = Tracker()
    for people, pose in messages():
        tracker.on_people(people)
        said = tracker.on_pose(pose).tracks
    assert said.measured_at == pose.measured_at
    assert np.hypot(*(said.position[0] - [4.0, 0.95])) < 0.15
    assert said.velocity[0] == pytest.approx([0.0, 0.5], abs=0.2)
    assert tracker.on_end()["people_met"] == 1


def test_operator_waits_for_the_pose_of_a_frame_and_skips_those_without():
    tracker = Tracker()
    stream = list(messages(4))
    assert tracker.on_pose(stream[0][1]) is None
    for people, _ in stream[:3]:
        tracker.on_people(people)
    assert tracker.on_pose(stream[2][1]).tracks.measured_at == 200_000_000
    assert tracker.on_pose(stream[3][1]) is None


def test_two_runs_say_the_same():
    def run():
        tracker, said = Tracker(), []
        for people, pose in messages():
            tracker.on_people(people)
            tracks = tracker.on_pose(pose).tracks
            said.append((tracks.position.tobytes(), tracks.velocity.tobytes(), tracks.identity.tobytes()))
        return said

    assert run() == run()
