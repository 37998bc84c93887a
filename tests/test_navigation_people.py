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
    BELIEVED,
    BODY,
    COMES,
    COMING,
    COMING_COST,
    COMING_ROOM,
    EASY,
    NOBODY,
    STRIDE,
    WALK,
    nearby,
    person_room,
    surcharge,
    toll,
)
from operators.navigation.search import cost_to_go
from operators.navigation.window import DynamicWindow, Limits, way_around

OPEN = Surroundings(np.full((80, 80), 1.0, np.float32), 0.05, -2.0, -2.0)
RADIUS = Footprint().circumscribed
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


@given(walkers, numbers, numbers, st.floats(0.0, 2.0))
@settings(max_examples=100, deadline=None)
def test_room_is_that_to_the_nearest_who_goes_on_or_has_stopped(people, x, y, seconds):
    least = math.inf
    for row in people:
        standing = math.dist(row[:2], (x, y))
        speed = float(np.hypot(*row[2:]))
        feet = np.linspace(-1.0, 1.0, 401)[:, None] * STRIDE * min(1.0, speed / WALK)
        ahead = row[2:] / speed if speed > 1e-6 else np.array([1.0, 0.0])
        going = np.hypot(*(row[:2] + seconds * row[2:] + feet * ahead - (x, y)).T).min()
        least = min(least, standing - BODY, float(going) - BODY)
    found, along, across = person_room(people, seconds, x, y)
    assert found == pytest.approx(least, abs=2e-3)
    assert math.hypot(along, across) == pytest.approx(1.0)


def test_far_from_everybody_is_free():
    person = np.array([[RADIUS + BODY + EASY + 0.01, 0.0, 0.0, 0.0]])
    assert toll(person, RADIUS, 0.5, 0.0, 0.0, 0.0, 1.0, 1.3) == (0.0, False)
    assert toll(NOBODY, RADIUS, 0.5, 0.0, 0.0, 0.0, 1.0, 1.3) == (0.0, False)


def test_only_those_whom_the_robot_approaches_are_driven_into():
    person = np.array([[RADIUS + BODY, 0.0, 0.0, 0.0]])
    assert toll(person, RADIUS, 0.5, 0.0, 0.0, 0.0, 0.5, 1.3)[1]
    assert not toll(person, RADIUS, 0.5, 0.0, 0.0, 0.0, -0.2, 1.3)[1]
    assert not toll(person, RADIUS, 0.5, 0.0, 0.0, 0.0, 0.0, 1.3)[1]
    assert not toll(person, RADIUS, 0.5, 0.0, 0.0, math.pi / 2, 0.5, 1.3)[1]


def test_toll_falls_with_distance_and_with_time():
    def cost(distance, seconds=0.3):
        person = np.array([[RADIUS + BODY + distance, 0.0, 0.0, 0.0]])
        return toll(person, RADIUS, seconds, 0.0, 0.0, 0.0, 0.8, 1.3)[0]

    costs = [cost(distance) for distance in (0.1, 0.2, 0.3, 0.4)]
    assert all(near > far for near, far in itertools.pairwise(costs))
    assert cost(0.2, 1.5) < cost(0.2, 0.3)


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
@pytest.mark.parametrize("ahead", [0.8, 0.95])
def test_robot_gives_way_to_who_comes_towards_it(ahead, speed):
    choice = choose([[ahead, 0.0, -speed, 0.0]])
    assert choice.target.linear < 0.0 or abs(choice.target.angular) > 0.3
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


@given(walkers, numbers, numbers, st.floats(0.0, 2.0), st.floats(-math.pi, math.pi), st.floats(-0.6, 1.3))
@settings(max_examples=100, deadline=None)
def test_surcharge_is_what_misses_at_the_closest(people, x, y, seconds, yaw, speed):
    soon, met, sure = 0.0, 0.0, COMING_COST * max(0.0, 1.0 - seconds / BELIEVED)
    for row in people:
        pace = float(np.hypot(*row[2:]))
        if pace < COMES:
            continue
        reach = BODY + STRIDE * min(1.0, pace / WALK) + RADIUS + COMING_ROOM
        times = np.linspace(0.0, COMING, 801)[:, None]
        away = row[:2] + seconds * row[2:] - (x, y)
        away = np.hypot(*(away + times * (row[2:] - speed * np.array([math.cos(yaw), math.sin(yaw)]))).T)
        met = max(met, reach - away[0])
        soon = max(soon, reach - away.min() if away.argmin() > 0 else 0.0)
    found = surcharge(people, RADIUS, seconds, x, y, yaw, speed)
    assert found[1] == pytest.approx(sure * met, abs=1e-6)
    assert max(found) == pytest.approx(sure * max(soon, met), abs=2e-2)
