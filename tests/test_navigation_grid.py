"""Rasters, distances, weights and searches, against plain twins and scipy."""

from __future__ import annotations

import heapq
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from graph.geometry import planar
from operators.navigation.costmap import CELL, COARSE, FREE, UNKNOWN, Costmap
from operators.navigation.distance import MOST_CELLS, distance_to
from operators.navigation.footprint import Footprint
from operators.navigation.lattice import Box, Lattice, lattice_around, moved, resampled, union
from operators.navigation.search import BLOCKED, DIAGONAL, KNIGHT, MOVES, STRAIGHT, UNIT, UNREACHED, cost_to_go, trace

places = st.floats(-50.0, 50.0)


@given(places, places, places, places)
@settings(max_examples=50, deadline=None)
def test_raster_covers_its_box(x, y, u, v):
    low, high = np.minimum((x, y), (u, v)), np.maximum((x, y), (u, v))
    lattice = lattice_around(0.05, low, high, block=4)
    for place in (low, high):
        row, column = lattice.cell(*place)
        assert lattice.inside(row, column)
        assert np.abs(np.array(lattice.centre(row, column)) - place).max() <= 0.5 * 0.05 + 1e-9
    assert lattice.rows % 4 == lattice.first_row % 4 == 0


def test_moving_there_and_back_keeps_cells():
    small, far = Lattice(0.1, 3, -2, 5, 7), Lattice(0.1, -10, 4, 6, 6)
    cells = np.arange(35, dtype=np.int16).reshape(5, 7)
    large = union(small, far)
    assert np.array_equal(moved(moved(cells, small, large, -1), large, small, -1), cells)
    assert (moved(cells, small, far, -1) == -1).sum() == 36 - 0  # they do not overlap: rows end at -4
    assert (moved(cells, small, large, -1) >= 0).sum() == 35


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.02, 0.07])
def test_map_keeps_its_places_on_the_raster(resolution):
    cells = np.full((int(2.8 / resolution), int(4.2 / resolution)), -1, np.int8)
    cells[3, 5] = 100
    cells[10:12, :] = 0
    target = lattice_around(CELL, (-5.0, -5.0), (5.0, 5.0))
    result = resampled(cells, (-1.4, -2.8), resolution, target)
    x, y = -1.4 + (5 + 0.5) * resolution, -2.8 + (3 + 0.5) * resolution
    rows, columns = np.nonzero(result == 100)
    centres = np.array(target.centre(rows, columns))
    assert len(rows) >= 1
    assert np.abs(centres - [[x], [y]]).max() <= 0.5 * (resolution + CELL)
    free = target.centre(*np.nonzero(result == 0))[1]
    assert free.min() >= -2.8 + 10 * resolution - CELL
    assert free.max() <= -2.8 + 12 * resolution + CELL


@given(st.integers(0, 1000), st.floats(0.0, 0.3), st.integers(1, 40), st.integers(1, 40))
@settings(max_examples=60, deadline=None)
def test_distances_are_scipys(seed, share, rows, columns):
    occupied = np.random.default_rng(seed).random((rows, columns)) < share
    found = distance_to(occupied, 0.05, 0.8)
    wanted = distance_transform_edt(~occupied) * 0.05 if occupied.any() else np.full((rows, columns), np.inf)
    assert np.abs(found - np.minimum(wanted, 0.8)).max() < 1e-6


def test_distance_names_a_limit_that_is_too_far():
    with pytest.raises(ValueError, match=f"at most {MOST_CELLS}"):
        distance_to(np.zeros((3, 3), np.bool_), 0.01, 2.0)


def step_cost(weights, row, column, move):
    """Plain twin of one step: which cells it touches and what that costs; 0 when it may not be made."""
    down, right = (int(n) for n in MOVES[move])
    touched = [(row, column), (row + down, column + right)]
    if abs(down) == abs(right) == 1:
        touched += [(row + down, column), (row, column + right)]
    elif abs(down) == 2:
        touched += [(row + down // 2, column), (row + down // 2, column + right)]
    elif abs(right) == 2:
        touched += [(row, column + right // 2), (row + down, column + right // 2)]
    if not all(0 <= r < weights.shape[0] and 0 <= c < weights.shape[1] and weights[r, c] for r, c in touched):
        return 0
    values = [int(weights[place]) for place in touched]
    if len(values) == 2:
        return STRAIGHT * sum(values)
    return DIAGONAL * sum(values[:2]) if move < 8 else KNIGHT * sum(values) // 2


def dijkstra(weights, sources):
    """Plain twin of the search."""
    weights = np.pad(weights[2:-2, 2:-2], 2)
    cost = np.full(weights.shape, int(UNREACHED), np.int64)
    heap = []
    for flat, price in sources:
        place = divmod(flat, weights.shape[1])
        if weights[place] and price < cost[place]:
            cost[place] = price
            heapq.heappush(heap, (price, *place))
    while heap:
        so_far, row, column = heapq.heappop(heap)
        if so_far > cost[row, column]:
            continue
        for move in range(16):
            price = step_cost(weights, row, column, move)
            other = row + MOVES[move, 0], column + MOVES[move, 1]
            if price and so_far + price < cost[other]:
                cost[other] = so_far + price
                heapq.heappush(heap, (so_far + price, *other))
    return cost


def random_weights(seed, rows=17, columns=23, blocked=0.3):
    random = np.random.default_rng(seed)
    weights = random.integers(FREE, 90, (rows, columns)).astype(np.int32)
    weights[random.random(weights.shape) < blocked] = 0
    return weights


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.2, 0.4, 1.0]))
@settings(max_examples=25, deadline=None)
def test_search_is_optimal(seed, blocked):
    weights = random_weights(seed, blocked=blocked)
    sources = [(80, 0), (200, 3000), (201, 500), (81, 90_000)]
    field = cost_to_go(weights, np.array([s for s, _ in sources]), np.array([c for _, c in sources]))
    assert np.array_equal(field.cost, dijkstra(weights, sources))


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_way_costs_what_the_field_says(seed):
    weights = np.pad(random_weights(seed)[2:-2, 2:-2], 2)
    weights[5, 5] = FREE
    field = cost_to_go(weights, np.array([5 * 23 + 5]))
    for row, column in np.argwhere(field.cost < UNREACHED):
        way = trace(field, row, column)
        moves = [next(i for i in range(16) if tuple(MOVES[i]) == tuple(step)) for step in np.diff(way, axis=0)]
        total = sum(step_cost(weights, *cell, move) for cell, move in zip(way, moves, strict=False))
        assert total == field.cost[row, column]
        assert tuple(way[-1]) == (5, 5)
    for row, column in np.argwhere(field.cost == UNREACHED):
        assert len(trace(field, row, column)) == 0


@given(st.integers(0, 10_000), st.integers(0, 3000))
@settings(max_examples=25, deadline=None)
def test_early_end_changes_nothing_up_to_the_margin(seed, margin):
    weights = random_weights(seed, blocked=0.2)
    weights[8, 11] = weights[3, 3] = FREE
    whole = cost_to_go(weights, np.array([8 * 23 + 11])).cost
    part = cost_to_go(weights, np.array([8 * 23 + 11]), start=(3, 3), margin=margin).cost
    settled = whole <= min(int(whole[3, 3]) + margin, int(UNREACHED) - 1)
    assert np.array_equal(part[settled], whole[settled])
    assert (part >= whole).all()


def test_open_floor_is_nearly_straight():
    weights = np.full((81, 81), FREE, np.int32)
    field = cost_to_go(weights, np.array([40 * 81 + 40]))
    rows, columns = np.mgrid[:81, :81] - 40
    ratio = (field.cost / (FREE * UNIT) / np.maximum(np.hypot(rows, columns), 1.0))[2:-2, 2:-2]
    ratio[38, 38] = 1.0
    assert ratio.max() < 1.035
    assert ratio.min() > 0.999


def walled_map(gap):
    """A map 6 x 6 m, free but for a wall at x = 3 with a gap around y = 3."""
    cells = np.zeros((120, 120), np.int8)
    cells[:, 60] = 100
    cells[round((3 - gap / 2) / CELL) : round((3 + gap / 2) / CELL), 60] = 0
    return cells


@pytest.mark.parametrize(("gap", "passes"), [(0.9, True), (0.6, True), (0.3, False)])
def test_doors_pass_and_slits_do_not(gap, passes):
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(walled_map(gap), (0.0, 0.0), CELL)
    lattice = costmap.lattice.coarse(COARSE)
    weights = costmap.weights((1.0, 3.0))
    weights[costmap.cells.reshape(lattice.rows, COARSE, lattice.columns, COARSE).max(axis=(1, 3)) < 0] = 0
    row, column = lattice.cell(5.0, 3.0)
    field = cost_to_go(weights, np.array([row * lattice.columns + column]))
    assert (field.cost[lattice.cell(1.0, 3.0)] < UNREACHED) == passes


def test_unknown_floor_is_dearer_than_open_floor_and_near_things_dearest():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(walled_map(0.9), (0.0, 0.0), CELL)
    lattice = costmap.lattice.coarse(COARSE)
    weights = costmap.weights((1.0, 1.0))
    assert weights[lattice.cell(1.0, 1.0)] == FREE
    assert weights[lattice.cell(-0.5, 1.0)] == FREE + UNKNOWN
    assert weights[lattice.cell(3.0, 1.0)] == 0
    falling = [int(weights[lattice.cell(3.025 - away, 1.0)]) for away in (0.25, 0.35, 0.45, 0.65)]
    assert falling == sorted(falling, reverse=True)
    assert falling[-1] > FREE


def test_robot_that_stands_too_near_gets_away():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(walled_map(0.0), (0.0, 0.0), CELL)
    lattice = costmap.lattice.coarse(COARSE)
    near, far = (2.9, 1.0), (2.9, 3.0)
    weights = costmap.weights(near)
    assert weights[lattice.cell(*near)] > 0
    assert weights[lattice.cell(*far)] == 0


def test_raster_grows_and_keeps_what_it_knows():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(walled_map(0.9), (0.0, 0.0), CELL)
    before = {costmap.lattice.centre(r, c) for r, c in np.argwhere(costmap.cells == 100)}
    costmap.cover((25.0, -13.0))
    after = {costmap.lattice.centre(r, c) for r, c in np.argwhere(costmap.cells == 100)}
    assert {(round(x, 6), round(y, 6)) for x, y in before} == {(round(x, 6), round(y, 6)) for x, y in after}
    assert costmap.lattice.covers(25.0, -13.0, 3.9)


@given(st.floats(-3.0, 9.0), st.floats(-3.0, 9.0))
@settings(max_examples=30, deadline=None)
def test_window_holds_the_wall_and_what_nobody_has_seen(x, y):
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(walled_map(0.9), (0.0, 0.0), CELL)
    around = costmap.window(x, y, 4.0, 1.0)
    assert abs(around.x + 2.0 - x) <= CELL + 1e-9
    rows, columns = np.mgrid[:80, :80]
    u, v = around.x + (columns + 0.5) * CELL, around.y + (rows + 0.5) * CELL
    known = (u > 0) & (u < 6) & (v > 0) & (v < 6)
    wall = (np.abs(u - 3.025) < 0.025) & (np.abs(v - 3.0) > 0.45)
    assert np.array_equal(around.distance == 0, ~known | wall)


def test_unseen_floor_that_stops_the_robot_is_taken_for_an_obstacle():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(walled_map(0.9), (0.0, 0.0), CELL)
    costmap.distrust(0.2, 3.0)
    x, y = costmap.lattice.centre(*np.nonzero(costmap.obstacles.filled))
    assert len(x) > 300
    assert x.max() < 0.0
    assert np.hypot(x - 0.2, y - 3.0).max() < 1.1


def test_what_stands_at_places_is_in_the_way_there_and_nowhere_else():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(walled_map(0.9), (0.0, 0.0), CELL)
    costmap.weights((1.0, 1.0))
    places = np.array([[1.31, 4.02], [-3.49, 1.0], [1.33, 4.04]])
    costmap.stand(places)
    x, y = costmap.lattice.centre(*np.nonzero(costmap.obstacles.filled))
    assert np.allclose(np.stack([x, y], axis=1), [[-3.475, 1.025], [1.325, 4.025]])
    weights, coarse = costmap.weights((1.0, 1.0)), costmap.lattice.coarse(2)
    assert all(weights[coarse.cell(*place)] == BLOCKED for place in places)
    costmap.stand(np.zeros((0, 2)))
    assert costmap.obstacles.filled.sum() == 2


def test_floor_under_the_robot_is_free():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    costmap.set_map(np.full((120, 120), 100, np.int8), (0.0, 0.0), CELL)
    costmap.clear_footprint(Footprint(), (3.0, 3.0, math.pi / 4))
    freed = np.argwhere(costmap.cells == 0)
    x, y = costmap.lattice.centre(freed[:, 0], freed[:, 1])
    assert abs(len(freed) * CELL * CELL - 0.42 * 0.31) < 0.02
    assert np.hypot(x - 3.0, y - 3.0).max() <= Footprint().circumscribed


def test_costs_that_are_kept_are_those_computed_anew():
    """Map and frames change in parts; after each, the kept weights equal those of a costmap that sees all at once."""
    random = np.random.default_rng(3)
    kept = Costmap(lethal=0.2, inflation=0.8)
    cells = walled_map(0.9)
    for turn in range(8):
        place = random.integers(0, 110, 2)
        cells = cells.copy()
        cells[place[0] : place[0] + 4, place[1] : place[1] + 6] = random.choice([-1, 0, 100])
        kept.set_map(cells, (0.0, 0.0), CELL)
        where = tuple(random.uniform(-6.0, 14.0, 2))
        points = np.column_stack([random.uniform(-4, 4, (60, 2)), np.full(60, -0.2)]).astype(np.float32)
        kept.observe(points, planar(*where, 0.3 * turn, 0.64), 0.0)
        kept.clear_footprint(Footprint(), (*where, 0.1))
        weights = kept.weights(where)
        fresh = Costmap(lethal=0.2, inflation=0.8)
        fresh.cover(
            *(
                kept.lattice.centre(*corner)
                for corner in ((80, 80), (kept.lattice.rows - 81, kept.lattice.columns - 81))
            )
        )
        assert fresh.lattice == kept.lattice
        fresh.cells, fresh.obstacles = kept.cells, kept.obstacles
        fresh._stale = Box(0, fresh.lattice.rows, 0, fresh.lattice.columns)
        assert np.array_equal(weights, fresh.weights(where))


def test_places_too_far_apart_are_named():
    costmap = Costmap(lethal=0.2, inflation=0.8)
    with pytest.raises(ValueError, match="span 1016 x 16 m; the planner's raster holds 250 m a side"):
        costmap.cover((0.0, 0.0), (1000.0, 0.0))
