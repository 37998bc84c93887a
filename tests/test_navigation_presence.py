"""People in the lidar's blind ring: there as long as a shadow is, gone where rays pass."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.geometry import planar
from operators.navigation.presence import DOUBTS, NOTICED, SECTORS, Presence, gaps

MOUNT = planar(0.0, 0.0, 0.0, 0.64)


def walls(*shadows, x=0.0, y=0.0):
    """A round room of 4 m as the lidar at x, y sees it, without the directions (bearing, half width) of the shadows."""
    bearing = np.radians(np.arange(0.0, 360.0, 0.5))
    for middle, half in shadows:
        bearing = bearing[np.abs((bearing - middle + np.pi) % (2 * np.pi) - np.pi) > half]
    return np.stack([4.0 * np.cos(bearing) - x, 4.0 * np.sin(bearing) - y, np.zeros(len(bearing))], axis=1).astype("f4")


def meet(presence, frames, *, place=(0.75, 0.0), unseen=0.3, x=0.0, steps=1, things=()):
    """Show frames one after the other; somebody whom the tracker lost in the ring. Returns the last company."""
    company = np.zeros((0, 4))
    for step, frame in enumerate(frames):
        presence.observe(frame, planar(x, 0.0, 0.0, 0.64), np.array(things).reshape(-1, 2))
        known = step < steps
        company = presence.company(
            np.array([7] if known else [], np.int32),
            np.array([[*place, 0.1, 0.0]] if known else []).reshape(-1, 4),
            np.array([unseen] if known else [], np.float32),
        )
    return company


def test_who_went_where_the_lidar_is_blind_stays_as_long_as_a_shadow():
    presence = Presence()
    company = meet(presence, [walls((0.0, 0.2))] * 50)
    assert len(company) == 1
    assert math.dist(company[0, :2], (0.75, 0.0)) < 0.05
    assert (company[0, 2:] == 0.0).all()
    assert len(meet(presence, [walls()] * DOUBTS, steps=0)) == 0


def test_who_walks_around_the_robot_moves_with_the_shadow():
    frames = [walls((0.03 * step, 0.2)) for step in range(40)]
    company = meet(Presence(), frames)
    assert len(company) == 1
    assert abs(math.atan2(company[0, 1], company[0, 0]) - 1.17) < 0.15
    assert 0.6 < math.hypot(*company[0, :2]) < 0.9


def test_who_is_seen_is_where_it_is_seen():
    company = meet(Presence(), [walls()] * 3, unseen=0.0, steps=3)
    assert np.array_equal(company, [[0.75, 0.0, 0.1, 0.0]])


def test_robot_that_drives_on_leaves_who_stands_behind():
    presence = Presence()
    assert len(meet(presence, [walls((0.0, 0.2))] * 3)) == 1
    assert len(meet(presence, [walls((0.0, 0.2), x=-0.6)] * DOUBTS, x=-0.6, steps=0)) == 0


def test_shadow_that_nothing_explains_is_somebody():
    frames = [walls((1.0, 0.2))] * (NOTICED + 1)
    company = meet(Presence(), frames, steps=0)
    assert len(company) == 1
    assert abs(math.atan2(company[0, 1], company[0, 0]) - 1.0) < 0.06
    assert len(meet(Presence(), frames, steps=0, things=[(0.4, 0.5), (0.4, 0.6), (0.4, 0.7), (0.4, 0.8)])) == 0
    assert len(meet(Presence(), frames[:NOTICED], steps=0)) == 0


def test_two_beside_each_other_share_a_shadow():
    presence = Presence()
    people = np.array([[0.7, 0.2, 0.0, 0.0], [0.7, -0.2, 0.0, 0.0]])
    for step in range(20):
        presence.observe(walls((0.0, 0.45)), MOUNT, np.zeros((0, 2)))
        count = 2 if step == 0 else 0
        found = presence.company(np.array([1, 2][:count], np.int32), people[:count], np.full(count, 0.3, np.float32))
    assert len(found) == 2
    assert (np.abs(found[:, 1]) > 0.15).all()


def test_side_of_a_long_thing_nearby_moves_nobody():
    company = meet(Presence(), [walls((0.3, 1.0))] * 20)
    assert math.dist(company[0, :2], (0.75, 0.0)) < 0.01


def test_two_in_one_place_are_one():
    presence = Presence()
    presence.observe(walls((0.0, 0.2)), MOUNT, np.zeros((0, 2)))
    people = np.array([[0.8, 0.0, 0.0, 0.0], [0.8, 0.15, 0.0, 0.0]])
    assert len(presence.company(np.array([1, 2], np.int32), people, np.array([0.3, 0.3], np.float32))) == 1


def test_those_outside_the_ring_are_the_trackers():
    presence = Presence()
    presence.observe(walls(), MOUNT, np.zeros((0, 2)))
    people = np.array([[2.0, 0.0, 0.0, 0.5], [3.0, 1.0, 0.0, 0.0]])
    found = presence.company(np.array([1, 2], np.int32), people, np.array([0.0, 0.5], np.float32))
    assert np.array_equal(found, people)


@pytest.mark.parametrize("blocked", [False, True])
def test_all_or_nothing(blocked):
    assert gaps(np.full(SECTORS, not blocked)) == ([(0.0, math.pi)] if blocked else [])


@given(st.lists(st.booleans(), min_size=SECTORS, max_size=SECTORS))
@settings(max_examples=60, deadline=None)
def test_gaps_cover_runs_of_two_and_more(flags):
    passed = np.array(flags)
    width = 2.0 * math.pi / SECTORS
    covered = np.zeros(SECTORS, bool)
    for middle, half in gaps(passed):
        assert half > 0.9 * width
        off = (np.arange(SECTORS) + 0.5) * width - middle
        covered |= np.abs((off + math.pi) % (2.0 * math.pi) - math.pi) < half
    lonely = ~passed & np.roll(passed, 1) & np.roll(passed, -1)
    assert np.array_equal(covered, ~passed & ~lonely)


def test_wide_shadow_is_that_of_some_people_side_by_side():
    company = meet(Presence(), [walls((1.0, 0.6))] * (NOTICED + 1), steps=0)
    assert len(company) == 2
    bearing = np.sort(np.arctan2(company[:, 1], company[:, 0]))
    assert np.allclose(bearing, [0.7, 1.3], atol=0.1)
    assert len(meet(Presence(), [walls((1.0, 1.5))] * (NOTICED + 1), steps=0)) == 0  # the lidar does not look there


def test_rays_between_the_legs_say_nothing_of_the_trunk():
    low = walls()
    low[:, 2] = -4.0 * 0.64 / 1.2  # they hit the floor behind somebody
    frames = [np.concatenate([walls((1.0, 0.2)), low])] * (NOTICED + 1)
    assert len(meet(Presence(), frames, steps=0)) == 1
