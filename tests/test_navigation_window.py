"""The dynamic window, the footprint and the prediction of the pose."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.navigation.distance import distance_to
from operators.navigation.footprint import Footprint, Surroundings, inside, room
from operators.navigation.lattice import Lattice
from operators.navigation.motion import Commands, Progress, Twist, advance, paced, towards
from operators.navigation.search import cost_to_go
from operators.navigation.window import DynamicWindow, Limits, way_around

SIDE = 80  # cells of 0.05 m
angles = st.floats(-math.pi, math.pi)


def surroundings(occupied):
    return Surroundings(distance_to(occupied, 0.05, 1.0), 0.05, -2.0, -2.0)


def around_points(*points):
    occupied = np.zeros((SIDE, SIDE), np.bool_)
    for x, y in points:
        occupied[math.floor((y + 2.0) / 0.05), math.floor((x + 2.0) / 0.05)] = True
    return surroundings(occupied)


def way_to(x, y):
    """The way to a goal on open floor, 12 x 12 m around the origin."""
    lattice = Lattice(0.1, -60, -60, 120, 120)
    row, column = lattice.cell(x, y)
    field = cost_to_go(np.full((120, 120), 8, np.int32), np.array([row * 120 + column]))
    return way_around(field, lattice, 0.0, 0.0, 4.0, 0.1 / (8 * 24) / 1.3)


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), angles, st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
@settings(max_examples=100, deadline=None)
def test_room_is_the_distance_to_the_rectangle(x, y, yaw, px, py):
    footprint = Footprint()
    around = around_points((px, py))
    cell = np.array([math.floor((px + 2.0) / 0.05) + 0.5, math.floor((py + 2.0) / 0.05) + 0.5]) * 0.05 - 2.0
    away = cell - (x, y)
    forward = abs(math.cos(yaw) * away[0] + math.sin(yaw) * away[1])
    left = abs(math.cos(yaw) * away[1] - math.sin(yaw) * away[0])
    wanted = math.hypot(max(forward - 0.21, 0.0), max(left - 0.155, 0.0))
    found = room(around, footprint.body(), 0.4, x, y, yaw)
    if inside(footprint, *(np.array([c]) for c in cell), (x, y, yaw))[0]:
        assert found <= 0.2
    elif found < 0.4:
        assert abs(found - wanted) < 0.06
    else:
        assert wanted > 0.4 - 0.06


def test_footprint_radii_hold_its_outline():
    footprint = Footprint(0.6, 0.3)
    radii = np.hypot(*footprint.outline().T)
    assert radii.max() == pytest.approx(footprint.circumscribed)
    assert radii.min() >= footprint.inscribed
    assert radii.min() < footprint.inscribed + 0.01


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), angles)
def test_arcs_add_up(linear, angular, yaw):
    pose = (0.0, 0.0, yaw)
    for _ in range(100):
        pose = advance(*pose, linear, angular, 0.01)
    radius = linear / angular if abs(angular) > 1e-3 else math.inf
    end = yaw + angular
    if math.isfinite(radius):
        wanted = (radius * (math.sin(end) - math.sin(yaw)), radius * (math.cos(yaw) - math.cos(end)), end)
    else:
        wanted = (linear * math.cos(yaw + angular / 2), linear * math.sin(yaw + angular / 2), end)
    assert np.abs(np.subtract(pose, wanted)).max() < 1e-4


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.01, 0.5))
def test_velocities_change_by_little(now, wanted, most):
    result = towards(now, wanted, most)
    assert abs(result - now) <= most + 1e-12
    assert abs(result - wanted) <= abs(now - wanted) + 1e-12


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.01, 0.5), st.floats(1.0, 4.0))
def test_brakes_are_stronger_than_the_motor_and_work_towards_rest(now, wanted, faster, times):
    slower = times * faster
    assert paced(now, wanted, faster, faster) == towards(now, wanted, faster)
    result = paced(now, wanted, faster, slower)
    assert paced(-now, -wanted, faster, slower) == -result
    assert min(now, wanted) <= result <= max(now, wanted)
    assert abs(result - now) <= slower + 1e-12
    if abs(result) > abs(now):
        assert abs(result - now) <= faster + 1e-12
    if abs(now) >= slower and wanted * now <= 0.0:
        assert abs(result) == pytest.approx(abs(now) - slower)


def test_who_brakes_harder_may_drive_faster_towards_somebody():
    lattice = Lattice(0.1, -60, -60, 120, 120)
    row, column = lattice.cell(5.0, 0.0)
    field = cost_to_go(np.full((120, 120), 8, np.int32), np.array([row * 120 + column]))
    way = way_around(field, lattice, 0.0, 0.0, 4.0, 0.1 / (8 * 24) / 1.3)
    across = np.array([[1.3, y, 0.0, 0.0] for y in np.arange(-1.5, 1.6, 0.3)])  # a row of people
    room = Surroundings(np.full((80, 80), 1.0, np.float32), 0.05, -2.0, -2.0)
    chosen = []
    for braking in (1.0, 2.5):
        window = DynamicWindow(Footprint(), Limits(braking=braking))
        chosen.append(window.choose((0.0, 0.0, 0.0), Twist(0.5, 0.0), room, way, top_speed=1.3, walkers=across))
    assert chosen[1].target.linear > chosen[0].target.linear + 0.1


@pytest.mark.parametrize("latency", [0.0, 0.1, 0.25, 0.3])
def test_prediction_follows_the_commands_in_flight(latency):
    """Twin: a robot whose wheels obey each command `latency` after the measurement that it answers."""
    period, commands = 100_000_000, Commands(latency)
    random = np.random.default_rng(0)
    given_at, true = [], [(0.0, 0.0, 0.0)]
    for step in range(30):
        twist = Twist(float(random.uniform(-0.2, 1.3)), float(random.uniform(-1, 1)))
        given_at.append((step * period + round(latency * 1e9), twist))
        commands.give(step * period, twist)
    for millisecond in range(3500):
        active = [twist for since, twist in given_at if since <= millisecond * 1_000_000]
        true.append(advance(*true[-1], *(active[-1] if active else Twist()), 0.001))
    fresh = Commands(latency)
    for step in range(30):
        predicted = fresh.predict(step * period, *true[step * 100])
        assert np.abs(np.subtract(predicted, true[step * 100 + round(latency * 1000)])).max() < 2e-3
        fresh.give(step * period, given_at[step][1])


PERIOD = 100_000_000  # nanoseconds


def hindered_while(wanted, real, periods=8, *, noise=0.0, turn=1.0):
    """Drive by one command and move by another velocity; return what is said at each pose."""
    commands, progress, said = Commands(0.1), Progress(turn), []
    random = np.random.default_rng(0)
    pose = (1.0, 2.0, 3.0)
    for step in range(periods):
        measured = np.array(pose) + noise * random.standard_normal(3)
        said.append(progress.hindered(commands, step * PERIOD, *measured))
        commands.give(step * PERIOD, wanted)
        pose = advance(*pose, *(real if step else Twist()), 0.1)
    return said


@given(st.floats(-0.2, 1.3), st.floats(-1, 1), st.floats(0.0, 0.01))
def test_robot_that_gets_on_is_not_hindered(linear, angular, noise):
    wanted = Twist(linear, angular)
    assert not any(hindered_while(wanted, wanted, noise=noise))


@given(st.floats(0.4, 1.3), st.sampled_from([-1, 1]), st.floats(-0.5, 0.04), st.floats(-2, 2))
def test_robot_that_is_held_knows_its_speed(linear, sign, left, angular):
    """What is left of the speed is said, never the other way round; turns as far as the drive can."""
    said = hindered_while(Twist(sign * linear, 0.0), Twist(sign * left, angular))
    assert said[0] is None
    assert said[-1].linear == pytest.approx(sign * max(left, 0.0), abs=1e-3)
    assert said[-1].angular == pytest.approx(min(max(angular, -1.0), 1.0), abs=1e-6)


def test_robot_that_is_turned_knows_it():
    said = hindered_while(Twist(1.0, 0.0), Twist(1.0, -1.5))[-1]
    assert said.angular == -1.0
    assert said.linear == pytest.approx(1.0, rel=0.02)  # the chord of an arc


@pytest.mark.parametrize(("goal", "sign"), [((5.0, 0.05), 0), ((0.05, 5.0), 1), ((0.05, -5.0), -1)])
def test_open_floor_is_driven_towards_the_goal(goal, sign):
    window = DynamicWindow(Footprint(), Limits())
    choice = window.choose((0.0, 0.0, 0.0), Twist(), around_points(), way_to(*goal), top_speed=1.3)
    assert np.sign(round(choice.target.angular, 6)) == sign
    if sign == 0:
        assert choice.target.linear == 1.3
    assert choice.seconds < 8.0


@given(st.integers(0, 10_000), angles, st.floats(0.0, 1.3), st.floats(-1.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_chosen_arcs_touch_nothing_and_can_stop(seed, yaw, speed, turn):
    """Among random posts: the arc is free to its end, and the robot can still stop after the command's first period."""
    random = np.random.default_rng(seed)
    posts = random.uniform(-2.0, 2.0, (12, 2))
    around = around_points(*posts[np.hypot(*posts.T) > 0.5])
    body = Footprint().body()
    window = DynamicWindow(Footprint(), Limits())
    choice = window.choose((0.0, 0.0, yaw), Twist(speed, turn), around, way_to(4.0, 3.0), top_speed=1.3)
    if not math.isfinite(choice.seconds):
        return
    for pose in choice.trajectory[1:]:
        assert room(around, body, 0.3, *pose) >= 0.049
    pose, v, w = (
        choice.trajectory[1],
        towards(speed, choice.target.linear, 0.1),
        towards(turn, choice.target.angular, 0.25),
    )
    while abs(v) > 1e-9:
        v, w = towards(v, 0.0, 0.1), towards(w, choice.target.angular if abs(v) > 0.1 else 0.0, 0.25)
        pose = advance(*pose, v, w * min(1.0, abs(v) / 0.3), 0.1)
        assert room(around, body, 0.3, *pose) > -0.005  # sampled: the arc of the stop is another than the one looked at


def test_wall_ahead_stops_the_robot_in_time():
    """A wall right across: speed falls to nothing before it, whatever the goal wants."""
    occupied = np.zeros((SIDE, SIDE), np.bool_)
    occupied[:, 70] = True  # x = 1.525
    around, way = surroundings(occupied), way_to(5.0, 0.0)
    window, pose, now = DynamicWindow(Footprint(), Limits()), (-0.5, 0.0, 0.0), Twist(1.3, 0.0)
    for _ in range(60):
        choice = window.choose(pose, now, around, way, top_speed=1.3)
        now = Twist(towards(now.linear, choice.target.linear, 0.1), towards(now.angular, choice.target.angular, 0.25))
        pose = advance(*pose, now.linear, now.angular, 0.1)
        assert room(around, Footprint().body(), 0.3, *pose) >= 0.03


def test_no_way_out_is_said():
    ring = [(0.24 * math.cos(a), 0.24 * math.sin(a)) for a in np.linspace(0, 2 * math.pi, 60)]
    choice = DynamicWindow(Footprint(), Limits()).choose(
        (0.0, 0.0, 0.0), Twist(1.0, 0.0), around_points(*ring), way_to(3.0, 0.0), top_speed=1.3
    )
    assert choice.target.linear <= 0.0 or not math.isfinite(choice.seconds)
