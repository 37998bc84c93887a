"""People in the dynamic window: where they are when the robot comes, and that nobody is driven into."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.navigation.costmap import Costmap
from operators.navigation.footprint import Footprint, Surroundings
from operators.navigation.lattice import Lattice
from operators.navigation.motion import Twist, advance, towards
from operators.navigation.people import (
    AHEAD,
    BODY,
    EASY,
    HASTY,
    KEPT,
    LAG,
    NOBODY,
    REMEMBERED,
    SAME,
    SLOWLY,
    STRIDE,
    STUBBORN,
    WALK,
    Stubborn,
    apart,
    crowd,
    nearby,
    person_room,
    toll,
)
from operators.navigation.search import cost_to_go
from operators.navigation.window import DynamicWindow, Limits, way_around

OPEN = Surroundings(np.full((80, 80), 1.0, np.float32), 0.05, -2.0, -2.0)
RADIUS = Footprint().circumscribed
HALF = Footprint().body().half
numbers = st.floats(-3.0, 3.0)
walkers = st.lists(st.tuples(numbers, numbers, st.floats(-1, 1), st.floats(-1, 1)), max_size=5).map(
    lambda rows: np.array(rows, np.float64).reshape(-1, 4)
)


def way_ahead():
    lattice = Lattice(0.1, -60, -60, 120, 120)
    row, column = lattice.cell(5.0, 0.0)
    field = cost_to_go(np.full((120, 120), 8, np.int32), np.array([row * 120 + column]))
    return way_around(field, lattice, 0.0, 0.0, 4.0, 0.1 / (8 * 24) / 1.3)


def choose(people, *, now=None, window=None):
    window = window or DynamicWindow(Footprint(), Limits())
    return window.choose((0.0, 0.0, 0.0), now or Twist(), OPEN, way_ahead(), top_speed=1.3, walkers=np.array(people))


def outside(place, pose):
    """Plain twin: from a place (2,) to the nearest point of the robot's rectangle; to it, and how far, in its frame."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    ahead, aside = place[0] - pose[0], place[1] - pose[1]
    local = np.array([cosine * ahead + sine * aside, cosine * aside - sine * ahead])
    nearest = np.clip(local, (-HALF[0], -HALF[1]), HALF)
    return nearest, local - nearest


@given(
    numbers,
    numbers,
    st.floats(-1, 1),
    st.floats(-1, 1),
    st.floats(-math.pi, math.pi),
    st.floats(-0.5, 2.0),
    st.floats(0, 1),
)
@settings(max_examples=100, deadline=None)
def test_room_is_that_to_the_side_of_who_walks_and_to_their_feet(x, y, vx, vy, turned, seconds, feet):
    velocity, speed, pose = np.array([vx, vy]), math.hypot(vx, vy), (0.3, -0.2, turned)
    swing = np.linspace(-1.0, 1.0, 4001)[:, None] * feet * STRIDE * min(1.0, speed / WALK)
    places = np.array([x, y]) + seconds * velocity + swing * (velocity / speed if speed > 1e-6 else 0.0)
    place = places[np.argmin(np.hypot(*(places - pose[:2]).T))]  # of the feet that nearest to the robot's middle
    nearest, beyond = outside(place, pose)
    found, along, across, front, side = person_room(np.array([x, y, vx, vy]), HALF, seconds, feet, pose)
    assert found == pytest.approx(float(np.hypot(*beyond)) - BODY, abs=2e-3)
    assert math.hypot(along, across) == pytest.approx(1.0)
    if np.hypot(*beyond) > 0.05:
        assert (front, side) == pytest.approx(tuple(nearest), abs=5e-3)


def driving(people, speed, *, turn=0.0, seconds=0.5, turned=0.0):
    return toll(np.array(people).reshape(-1, 4), HALF, seconds, (0.0, 0.0, turned), speed, turn, 1.3)


def ahead(room):
    return [[HALF[0] + BODY + room, 0.0, 0.0, 0.0]]


def test_far_from_everybody_is_free():
    assert driving(ahead(EASY + 0.01), 1.0) == (0.0, False)
    assert driving([], 1.0) == (0.0, False)


def test_only_those_whom_the_robot_approaches_are_driven_into():
    assert driving(ahead(0.0), 0.5)[1]
    assert not driving(ahead(0.0), -0.2)[1]
    assert not driving(ahead(0.0), 0.0)[1]
    assert not driving(ahead(0.0), 0.5, turned=math.pi)[1]


def test_who_makes_way_may_be_followed_as_fast_as_they_leave():
    room = KEPT + 0.5 * AHEAD + HASTY * (0.5 - SLOWLY)  # of who stands, for a robot at 0.5 m/s
    behind = room - 0.02 + STRIDE * 0.5 / WALK  # as much nearer, but for the foot that is still behind
    leaving = [[HALF[0] + BODY + behind, 0.0, 0.5, 0.0]]
    assert driving(ahead(room - 0.02), 0.5)[1]
    assert not driving(leaving, 0.5, seconds=0.0)[1]
    assert driving(leaving, 0.9, seconds=0.0)[1]
    slower = [[HALF[0] + BODY + room - 0.02 + STRIDE * 0.2 / WALK, 0.0, 0.2, 0.0]]
    assert not driving(slower, 0.5, seconds=0.0)[1]
    assert driving(slower, 0.7, seconds=0.0)[1]


def test_who_walks_may_have_stopped_a_moment_ago():
    room = HALF[0] + BODY + KEPT + 0.5 * AHEAD + HASTY * (0.5 - SLOWLY)
    for spare in (-0.02, 0.02):
        assert driving([[room + spare + 0.9 * LAG, 0.0, 0.9, 0.0]], 0.5, seconds=1.0)[1] == (spare < 0.0)


def test_a_corner_that_turns_into_somebody_is_driven_into_them():
    corner = [[HALF[0], HALF[1] + BODY + 0.05, 0.0, 0.0]]  # beside the front, on the left
    assert driving(corner, 0.0, turn=1.0)[1]
    assert not driving(corner, 0.0, turn=-1.0)[1]


@given(st.floats(0.05, 1.3), st.floats(0.0, 0.54))
def test_the_faster_the_robot_comes_the_more_room_it_leaves(speed, room):
    needed = KEPT + AHEAD * speed + HASTY * max(0.0, speed - SLOWLY)
    assert driving(ahead(room), speed)[1] == (room < needed) or room == pytest.approx(needed)


@given(st.floats(0.05, 1.3), st.floats(0.0, 0.5))
def test_robot_passes_somebody_slowly_or_with_room(speed, room):
    beside = [[0.0, HALF[1] + BODY + room, 0.0, 0.0]]
    needed = KEPT + HASTY * (speed - SLOWLY)
    assert driving(beside, speed)[1] == (speed > SLOWLY and room < needed) or room == pytest.approx(needed)


def test_toll_falls_with_distance_and_with_time():
    costs = [driving(ahead(room), 0.8, seconds=0.3)[0] for room in (0.4, 0.44, 0.48, 0.52)]
    assert all(near > far > 0.0 for near, far in itertools.pairwise(costs))
    assert driving(ahead(0.4), 0.8, seconds=1.4)[0] < driving(ahead(0.4), 0.8, seconds=0.3)[0]


def weights_among(people, *, stays=False, held=()):
    weights = np.full((40, 40), 8, np.int32)
    weights[:, 0] = 0  # blocked
    walkers = np.array(people, np.float64).reshape(-1, 4)
    crowd(weights, 0.1, -2.0, -2.0, walkers, np.full(len(walkers), stays), np.array(held, np.float64).reshape(-1, 2))
    return weights


def test_a_way_past_people_costs_more_and_what_is_blocked_stays_so():
    alone = weights_among([])
    assert (alone[:, 1:] == 8).all()
    standing = weights_among([[1.0, 0.0, 0.0, 0.0]])
    assert (standing[:, 0] == 0).all()
    assert standing[20, 30] == 8 + 8
    assert 8 < standing[20, 24] < 8 + 8
    assert (standing[:, 1:20] == 8).all()  # 1 m away and more
    walking = weights_among([[1.0, 0.0, 0.0, 0.9]])
    assert 8 < walking[24, 30] < 8 + 8  # soon there, and soon gone
    assert walking[20, 30] < standing[20, 30]


def test_on_the_present_way_people_are_expected_to_make_room():
    person, way = [[0.6, 0.0, 0.0, 0.0]], [(-0.5, 0.1), (0.6, 0.1), (1.5, 0.1)]
    free, held = weights_among(person), weights_among(person, held=way)
    assert 8 < held[21, 26] < free[21, 26]
    assert held[26, 26] == free[26, 26]  # off the way
    assert weights_among(person, stays=True, held=way)[21, 26] > 500  # not those who do not
    assert np.array_equal(weights_among(person, held=[(-40.0, 50.0)]), free)


def test_who_does_not_step_aside_is_gone_around():
    assert weights_among([[0.6, 0.0, 0.0, 0.0]], stays=True)[20, 26] > 500
    assert weights_among([[0.6, 0.0, 0.0, 0.0]])[20, 26] <= 16


def test_who_stands_near_is_remembered_and_followed_and_forgotten():
    stubborn = Stubborn()
    there, passing = [STUBBORN - 0.1, 0.0, 0.0, 0.0], [0.0, STUBBORN - 0.1, 0.9, 0.0]
    far = [3.0, 0.0, 0.0, 0.0]
    assert stubborn.among(np.array([far, there, passing]), (0.0, 0.0)).tolist() == [False, True, False]
    assert stubborn.among(np.array([there, far]), (-5.0, 0.0)).tolist() == [True, False]  # though the robot has left
    assert stubborn.among(NOBODY, (-5.0, 0.0)).tolist() == []  # out of sight
    moved = [there[0] + 0.9 * SAME, 0.0, 0.0, 0.0]
    for _ in range(REMEMBERED - 4):
        assert stubborn.among(np.array([far, moved]), (-5.0, 0.0)).tolist() == [False, True]
    for _ in range(4):
        stays = stubborn.among(np.array([moved]), (-5.0, 0.0))
    assert not stays.any()
    other = Stubborn()
    other.among(np.array([there]), (0.0, 0.0))
    assert not other.among(np.array([[there[0] + 2.0 * SAME, 0.0, 0.0, 0.0]]), (-5.0, 0.0)).any()  # somebody else


def test_without_people_nothing_changes():
    far_away = [[40.0, 0.0, 0.0, 0.0]]
    one, two = choose(NOBODY), choose(far_away)
    assert one.target == two.target
    assert np.array_equal(one.trajectory, two.trajectory)
    assert len(nearby(np.array(far_away), 0.0, 0.0, 5.0)) == 0


@pytest.mark.parametrize("ahead", [0.9, 1.2, 1.6])
def test_nobody_who_stands_is_driven_into(ahead):
    """Half of the width is blocked by the person; the robot goes around or stops."""
    window, limits = DynamicWindow(Footprint(), Limits()), Limits()
    pose, now, least = (0.0, 0.0, 0.0), Twist(0.6, 0.0), math.inf
    person = np.array([[ahead, 0.0, 0.0, 0.0]])
    for _ in range(25):
        choice = window.choose(pose, now, OPEN, way_ahead(), top_speed=1.3, walkers=person)
        now = Twist(
            towards(now.linear, choice.target.linear, 0.1 * limits.acceleration),
            towards(now.angular, choice.target.angular, 0.1 * limits.turn_acceleration),
        )
        pose = advance(*pose, now.linear, now.angular, 0.1)
        least = min(least, math.dist(pose[:2], (ahead, 0.0)) - RADIUS - BODY)
        if pose[0] > 1.5:
            break
    assert least > -0.02


@pytest.mark.parametrize("speed", [0.5, 0.8])
@pytest.mark.parametrize("ahead", [0.6, 0.8])
def test_robot_stands_while_somebody_comes_towards_it(ahead, speed):
    assert choose([[ahead, 0.0, -speed, 0.0]]).target.linear <= 0.0
    assert choose(NOBODY).target.linear > 1.0


def test_robot_that_drives_brakes_for_who_comes_towards_it():
    for ahead in (0.8, 1.0, 1.3):
        assert choose([[ahead, 0.0, -0.8, 0.0]], now=Twist(0.6, 0.0)).target.linear <= 0.0


def test_robot_does_not_back_off_into_somebody_to_get_loose():
    window, behind = DynamicWindow(Footprint(), Limits()), np.array([[-0.52, 0.0, 0.0, 0.0]])
    assert window.free_steps((0.0, 0.0, 0.0), Twist(-0.2, 0.0), OPEN, 3) == 3
    assert window.free_steps((0.0, 0.0, 0.0), Twist(-0.2, 0.0), OPEN, 3, walkers=behind) == 0
    assert window.free_steps((0.0, 0.0, 0.0), Twist(0.2, 0.0), OPEN, 3, walkers=behind) == 3


def test_costmap_tells_what_stands_near():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    cells = np.zeros((80, 80), np.int8)
    cells[40, 50] = cells[40, 75] = 100
    costmap.set_map(cells, (-2.0, -2.0), 0.05)
    assert costmap.standing(0.0, 0.0, 1.0) == pytest.approx(np.array([[0.525, 0.025]]))


@given(walkers, walkers, st.floats(0.01, 2.0))
@settings(max_examples=50, deadline=None)
def test_points_at_nobody_are_those_outside_all_circles(points, people, radius):
    away = np.hypot(*(points[:, None, :2] - people[None, :, :2]).transpose(2, 0, 1))
    assert np.array_equal(apart(points[:, :2], people[:, :2], radius), (away >= radius).all(axis=1))
