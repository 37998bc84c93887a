"""How people walk: nobody through walls, followers in front of the robot, a fifth of the time standing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.clearance import Clearance, clearance
from sim.crowd import FIRST_STEP, Crowd, spots
from sim.figure import PARTS, figures, placed, radii, sitting, standing, walking
from sim.masonry import wall_bodies
from sim.steering import BODY, BREATH, CELL, ROBOT, neighbours, sample
from tests.small_rooms import two_rooms

Array = npt.NDArray[np.float64]

FAR = (100.0, 100.0, 0.0)


def floor(angle: float | str = 90.0) -> Clearance:
    building = two_rooms(angle)
    return clearance(wall_bodies(building), building.bounds(), 0.05)


def crowd(count: int, seed: int, *, followers: int = 0, attentive: float = 0.8) -> Crowd:
    rng = np.random.default_rng(seed)
    box = np.array([0.0, 0.0, 10.0, 6.0])
    places = spots(floor(), box, count, np.zeros((0, 3)), rng)
    return Crowd(places, np.arange(count) < followers, attentive, rng)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 1000), st.floats(-3.0, 12.0), st.floats(-3.0, 12.0))
def test_clearance_between_cells_is_bilinear(seed: int, x: float, y: float) -> None:
    grid = np.random.default_rng(seed).random((9, 8))
    column, row = int(np.floor(x)), int(np.floor(y))
    if 0 <= column < 7 and 0 <= row < 8:
        u, v = x - column, y - row
        corner = grid[row : row + 2, column : column + 2]
        wanted = np.array([1 - v, v]) @ corner @ np.array([1 - u, u])
    else:
        wanted = 0.0
    assert sample(grid, x, y) == pytest.approx(wanted, abs=1e-12)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 1000), st.integers(0, 60))
def test_neighbours_are_all_who_are_near(seed: int, count: int) -> None:
    places = np.random.default_rng(seed).uniform(-0.5, 7.5, (count, 2))  # some lie off the grid
    shape = (7, 8)
    order, begin = neighbours(places, np.zeros(2), shape)
    assert sorted(order.tolist()) == list(range(count))
    cell = np.clip((places / CELL).astype(int), 0, [shape[1] - 1, shape[0] - 1])
    for row in range(shape[0]):
        for column in range(shape[1]):
            index = row * shape[1] + column
            found = set(order[begin[index] : begin[index + 1]].tolist())
            assert found == set(np.flatnonzero((cell == (column, row)).all(1)).tolist())


@pytest.mark.parametrize("seed", range(4))
def test_nobody_walks_through_a_wall_or_into_anybody(seed: int) -> None:
    free = floor()
    people = crowd(20, seed)
    for _ in range(300):
        before = people.position.copy()
        people.advance(0.1, free, FAR)
        assert free.at(people.position).min() > BODY - 0.05  # half a cell's diagonal
        crossing = (before[:, 0] - 5.0) * (people.position[:, 0] - 5.0) < 0
        through = people.position[crossing, 1]
        assert ((through > 2.55) & (through < 3.45)).all()  # only by the door
        assert np.hypot(*(people.position - before).T).max() < 0.1 + 1e-9  # at most 1 m/s
        apart = np.hypot(*(people.position[:, None] - people.position[None]).transpose(2, 0, 1))
        np.fill_diagonal(apart, np.inf)
        assert apart.min() > BREATH - 0.1  # both may have stepped at once


def test_wanderers_walk_at_their_pace_and_stand_a_fifth_of_the_time() -> None:
    free, people = floor(), crowd(8, 1)
    speeds, stands, lengths = [], [], []
    previous = people.standing.copy()
    for _ in range(3000):
        people.advance(0.1, free, FAR)
        speeds.append(np.hypot(*people.velocity.T)[people.moving()])
        stands.append(people.standing > 0)
        lengths += people.standing[(previous <= 0) & (people.standing > 0)].tolist()
        previous = people.standing.copy()
    assert 0.6 < np.concatenate(speeds).mean() < 1.0
    assert 0.12 < np.mean(stands) < 0.28
    assert min(lengths) > 1.8
    assert max(lengths) < 20.0
    assert max(lengths) > 15.0


def test_followers_stand_in_front_of_the_robot() -> None:
    free, people = floor(), crowd(2, 3, followers=2)
    people.position[:] = [(1.0, 1.0), (1.0, 5.0)]
    for _ in range(120):
        people.advance(0.1, free, (2.0, 3.0, 0.0))
    ahead = people.position - (2.0, 3.0)
    assert (np.hypot(*ahead.T) < 1.6).all()
    assert (ahead[:, 0] > 0.2).all()  # in front
    wandering = crowd(2, 3, followers=2)
    wandering.advance(5.0, free, (2.0, 3.0, 0.0), np.zeros(2, np.bool_))
    assert (np.hypot(*(wandering.position - (2.0, 3.0)).T) > 1.6).any()


@pytest.mark.parametrize("attentive", [1.0, 0.0])
def test_attentive_people_keep_off_the_robot_and_others_do_not_step_on_it(attentive: float) -> None:
    free, least = floor(), np.inf
    people = crowd(10, 5, attentive=attentive)
    for _ in range(600):
        people.advance(0.1, free, (2.5, 3.0, 0.0))
        least = min(least, float((np.hypot(*(people.position - (2.5, 3.0)).T) - people.kept).min()))
    assert least > -1e-3
    if not attentive:
        assert least < 0.05  # they come up to it


def test_nobody_kicks_a_robot_that_stands() -> None:
    """No part of anybody comes within the circle around the robot, wherever they walk."""
    free, people, least = floor(), crowd(14, 5, attentive=0.0, followers=6), np.inf
    for _ in range(1200):
        people.advance(0.1, free, (2.5, 3.0, 0.0))
        parts = figures(people.phase(), people.stride_share(), people.height)
        parts = placed(parts, people.position[:, 0], people.position[:, 1], people.facing)
        away = np.hypot(parts[..., 0] - 2.5, parts[..., 1] - 3.0).min(-1) - radii(people.height, people.build)
        least = min(least, float(away.min()))
    assert least > ROBOT - 0.03
    assert least < ROBOT + 0.2  # they come near


def test_who_starts_to_walk_takes_small_steps_first() -> None:
    free, people = floor(), crowd(1, 1)
    people.standing[:], people.swing[:], people.velocity[:] = 0.0, 0.0, 0.0
    shares = []
    for _ in range(30):
        before = people.position.copy()
        people.advance(0.05, free, FAR)
        shares.append((float(np.hypot(*(people.position - before)[0])), float(people.stride_share()[0])))
    walked = np.cumsum([way for way, _ in shares])
    assert all(share <= way / FIRST_STEP + 1e-9 for way, (_, share) in zip(walked, shares, strict=True))
    assert shares[-1][1] == 1.0


def test_the_same_seed_walks_the_same_way() -> None:
    free, one, two, other = floor(), crowd(12, 7), crowd(12, 7), crowd(12, 8)
    for people in (one, two, other):
        people.advance(10.0, free, FAR)
    np.testing.assert_array_equal(one.position, two.position)
    assert (one.position != other.position).any()


def test_spots_are_apart_and_off_things() -> None:
    free = floor()
    found = spots(free, np.array([0.0, 0.0, 5.0, 6.0]), 12, np.array([[2.0, 3.0, 1.5]]), np.random.default_rng(1))
    assert len(found) == 12
    assert free.at(found).min() >= 0.27
    assert np.hypot(*(found - (2.0, 3.0)).T).min() >= 1.5
    apart = np.hypot(*(found[:, None] - found[None]).transpose(2, 0, 1)) + 9 * np.eye(12)
    assert apart.min() >= 0.4
    crammed = spots(free, np.array([0.0, 0.0, 2.0, 2.0]), 40, np.zeros((0, 3)), np.random.default_rng(1))
    assert 3 < len(crammed) < 20  # as many as there is room for


def test_feet_stay_on_the_floor_and_do_not_slide() -> None:
    gait = walking()
    phase = np.linspace(0.0, 1.0, 200)
    ones = np.ones(200)
    poses = figures(phase, ones, 1.7 * ones)
    breadth = radii(1.7 * ones, ones)
    bottom = (poses[..., 2] - breadth[:, :, None]).min((1, 2))
    assert bottom.min() > -0.01
    assert bottom.max() < 0.03
    assert (poses[..., 2] + breadth[:, :, None]).max() < 1.85
    foot = PARTS.index("right foot")
    walked = poses[:, foot, :, 0].mean(1) + phase * gait.stride * 1.7  # in the world
    low = poses[:, foot, :, 2].mean(1) < 0.075
    slide = np.abs(np.diff(walked))[low[1:] & low[:-1]]
    assert low.mean() > 0.3  # a foot stands for half of a stride
    assert np.median(slide) < 0.35 * gait.stride * 1.7 / 200  # and then is slower than the body by far


def test_limbs_keep_their_lengths() -> None:
    rng = np.random.default_rng(1)
    poses = figures(rng.random(400), rng.random(400), np.full(400, 1.7))
    lengths = np.linalg.norm(poses[:, :, 1] - poses[:, :, 0], axis=2)
    assert ((lengths.max(0) - lengths.min(0)) / lengths.mean(0)).max() < 0.01


def test_figures_have_human_measures() -> None:
    tall = standing() * 1.8
    head = tall[PARTS.index("head"), :, 2].max() + radii(np.array([1.8]), np.ones(1))[0, PARTS.index("head")]
    assert head == pytest.approx(1.8, abs=0.04)
    seat = sitting() * 1.7
    assert 0.35 < seat[PARTS.index("pelvis"), :, 2].mean() < 0.6
    assert seat[PARTS.index("left shank"), :, 0].mean() > 0.3  # legs ahead
    moved = placed(tall[None], np.array([2.0]), np.array([-1.0]), np.array([np.pi / 2]))
    np.testing.assert_allclose(moved[0, ..., 0], 2.0 - tall[..., 1], atol=1e-12)
    np.testing.assert_allclose(moved[0, ..., 1], -1.0 + tall[..., 0], atol=1e-12)
