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
from operators.tracking.things import CELL, KEPT, SIDE, Things
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
    assert list(ports_of(Tracker).inputs) == ["people", "near", "obstacles", "pose"]
    assert list(ports_of(Tracker).outputs) == ["tracks", "things"]
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


def seen_by(places, *, nearest, farthest, random, steps=3):
    """A cloud (n, 3) in the frame of a lidar over the origin, of people at places, between two ranges."""
    points = np.concatenate([body(place, (0.0, 0.0), random, 200) for place in places])
    away = np.linalg.norm(points - MOUNT[:3, 3], axis=1)
    return transform(inverse(MOUNT), points[(away > nearest) & (away < farthest)]).astype(np.float32)


def watch(path, seconds, *, near, obstacles=None):
    """Let a tracker operator follow somebody whom the lidar sees from 0.9 m on; `near`: with a second sensor."""
    random, tracker, said = np.random.default_rng(2), Tracker(), None
    for step in range(round(seconds / PERIOD)):
        stamp = step * 100_000_000
        stamped = {"measured_at": stamp, "base_from_lidar": MOUNT}
        place = path(step * PERIOD)
        tracker.on_people(PointCloud(points=seen_by([place], nearest=0.9, farthest=30.0, random=random), **stamped))
        if near:
            points = seen_by([place], nearest=0.1, farthest=2.0, random=random)
            tracker.on_near(PointCloud(points=points, **stamped))
        if obstacles is not None:
            points = transform(inverse(MOUNT), obstacles).astype(np.float32)
            tracker.on_obstacles(PointCloud(points=points, **stamped))
        said = tracker.on_pose(Pose(measured_at=stamp, world_from_base=np.eye(4))).tracks
    return said


def turning(time):
    """Walk up to the robot, and across its way where the lidar is blind."""
    return 2.0 - 0.8 * min(time, 1.6), 0.3 - 0.8 * max(0.0, time - 1.6)


def test_a_second_sensor_shows_who_walks_through_the_blind_ring():
    near, far = watch(turning, 2.4, near=True), watch(turning, 2.4, near=False)
    true = np.array(turning(2.3))
    assert near.blind == 0.0
    assert list(near.identity) == [1]
    assert near.unseen[0] == 0.0
    assert np.hypot(*(near.position[0] - true)) < 0.12
    assert np.hypot(*(near.velocity[0] - (0.0, -0.8))) < 0.3
    assert far.blind > 0.9
    off = [np.hypot(*(place - true)) for place in far.position]
    assert not off or min(off) > 0.2  # without it, nobody knows


def test_things_beside_the_robot_are_nobody():
    rng = np.random.default_rng(3)
    table = np.stack([rng.uniform(-0.8, 0.8, 2000), rng.uniform(0.6, 1.4, 2000), np.full(2000, 0.7)], axis=1)
    random, counts = np.random.default_rng(2), []
    for known in (table, None):
        tracker = Tracker()
        for step in range(30):
            stamped = {"measured_at": step * 100_000_000, "base_from_lidar": MOUNT}
            tracker.on_people(PointCloud(points=np.zeros((0, 3), np.float32), **stamped))
            seen = transform(inverse(MOUNT), table + random.normal(0.0, 0.01, table.shape)).astype(np.float32)
            tracker.on_near(PointCloud(points=seen, **stamped))
            if known is not None:
                tracker.on_obstacles(PointCloud(points=seen, **stamped))
            said = tracker.on_pose(Pose(measured_at=stamped["measured_at"], world_from_base=np.eye(4))).tracks
        counts.append(len(said.identity))
    assert counts[0] == 0
    assert counts[1] > 0


def test_what_is_flat_beside_the_robot_goes_out_as_the_sensor_saw_it():
    random, tracker, mount = np.random.default_rng(2), Tracker(), MOUNT @ planar(0.1, 0.0, 1.0)
    leaf = np.stack([random.uniform(-0.5, 0.5, 800), np.full(800, 0.6), random.uniform(0.2, 1.4, 800)], axis=1)
    for seen in (leaf, body((0.7, 0.0), (0.0, 0.0), random, 400)):
        cloud = PointCloud(
            measured_at=0, points=transform(inverse(mount), seen).astype(np.float32), base_from_lidar=mount
        )
        nothing = PointCloud(measured_at=0, points=np.zeros((0, 3), np.float32), base_from_lidar=MOUNT)
        for listen, said in ((tracker.on_people, nothing), (tracker.on_obstacles, nothing), (tracker.on_near, cloud)):
            listen(said)
        things = tracker.on_pose(Pose(measured_at=0, world_from_base=planar(3.0, -1.0, 2.0))).things
        assert things.measured_at == 0
        back = transform(things.base_from_lidar, things.points.astype(np.float64))
        if seen is leaf:
            assert len(back) > 700
            assert np.abs(back[:, 1] - 0.6).max() < 1e-4
        else:
            assert len(back) == 0


def test_a_frame_of_the_second_sensor_that_never_comes_is_done_without():
    random, tracker = np.random.default_rng(2), Tracker()
    for step in range(6):
        stamped = {"measured_at": step * 100_000_000, "base_from_lidar": MOUNT}
        tracker.on_people(
            PointCloud(points=seen_by([(2.0, 0.0)], nearest=0.9, farthest=30.0, random=random), **stamped)
        )
        if step < 3:
            tracker.on_near(PointCloud(points=np.zeros((0, 3), np.float32), **stamped))
        said = tracker.on_pose(Pose(measured_at=stamped["measured_at"], world_from_base=np.eye(4))).tracks
        assert (said.blind == 0.0) == (step < 3)
    assert list(said.identity) == [1]


def test_who_passes_is_no_thing_even_if_taken_for_one_now_and_then():
    things = Things()
    for step in range(40):
        things.observe(np.array([[0.05 * step, 0.0], [5.0 * CELL, 1.0]]), 0.1 * step, 1)
    assert not things.explain(np.array([[1.0, 0.0], [1.9, 0.0]]), 4.0).any()
    assert things.explain(np.array([[5.0 * CELL, 1.0]]), 4.0).all()


def test_who_is_mostly_taken_for_somebody_is_no_thing():
    things, place = Things(), np.array([[2.05, 0.05]])
    for step in range(60):
        (things.observe if step % 5 == 0 else things.doubt)(place, 0.1 * step, 4)
        assert not things.explain(place, 0.1 * step).any()
    for step in range(60, 70):
        things.observe(place, 0.1 * step, 4)
    assert things.explain(place, 7.0).all()
    things.doubt(place, 7.1, 4)  # once
    assert things.explain(place, 7.1).all()
    assert things.explain(place + np.array([CELL, 0.0]), 7.1).all()
    assert not things.explain(place + np.array([CELL, 0.0]), 7.1, beside=False).any()


@pytest.mark.parametrize("chair", [True, False])
def test_a_few_wrong_labels_make_nobody_of_a_chair_and_no_chair_of_somebody(chair):
    """What stands 2 m away is taken for the other in four frames in a row, after twelve in which it is not."""
    random, tracker, found = np.random.default_rng(4), Tracker(), []
    nothing = np.zeros((0, 3), np.float32)
    for step in range(64):
        stamped = {"measured_at": step * 100_000_000, "base_from_lidar": MOUNT}
        seen = seen_by([(2.0, 0.3)], nearest=0.9, farthest=30.0, random=random)
        obstacle = chair == (step % 16 < 12)
        tracker.on_people(PointCloud(points=nothing if obstacle else seen, **stamped))
        tracker.on_obstacles(PointCloud(points=seen if obstacle else nothing, **stamped))
        tracker.on_near(PointCloud(points=nothing, **stamped))
        found.append(
            len(tracker.on_pose(Pose(measured_at=step * 100_000_000, world_from_base=np.eye(4))).tracks.identity)
        )
    assert set(found[8:]) == {0 if chair else 1}


def test_near_without_obstacles_is_warned_of():
    wired = frozenset({"people", "near", "pose"})
    assert "near wants obstacles" in Tracker.missing(Tracker.Config(), wired)
    assert Tracker.missing(Tracker.Config(), wired | {"obstacles"}) == ""
    assert Tracker.missing(Tracker.Config(), frozenset({"people", "pose"})) == ""


window = st.tuples(st.integers(-500, 500), st.integers(-500, 500))
cells = st.lists(st.tuples(st.integers(0, SIDE - 1), st.integers(0, SIDE - 1)), min_size=1, max_size=30)


@given(st.lists(st.tuples(window, cells), min_size=1, max_size=4), st.integers(0, 9))
@settings(max_examples=60, deadline=None)
def test_things_are_remembered_where_they_were_and_nowhere_else(frames, seed):
    """Against a plain twin: a dictionary of cells, of which the torus holds those of the last frame that fall together.

    A frame reaches no farther than once around the torus.
    """
    things, held, everywhere = Things(), {}, []
    for corner, offsets in frames:
        filled = np.array(offsets) + corner
        things.observe((filled + 0.5) * CELL, 1.0)
        held |= {(x % SIDE, y % SIDE): (x, y) for x, y in filled.tolist()}
        everywhere.append(filled)
    probe = np.concatenate(everywhere)
    probe = probe + np.random.default_rng(seed).integers(-2, 3, probe.shape)
    expected = [any((x + i, y + j) in held.values() for i in (-1, 0, 1) for j in (-1, 0, 1)) for x, y in probe.tolist()]
    assert things.explain((probe + 0.5) * CELL, 2.0).tolist() == expected
    assert not things.explain((probe + 0.5) * CELL, 2.1 + KEPT).any()
