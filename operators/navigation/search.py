"""The cheapest way to the goal from every cell: Dijkstra's algorithm in whole numbers, on sixteen neighbours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

BLOCKED = 0  # weight of a cell that nothing may enter
UNREACHED = np.int32(2**31 - 1)

# A step's cost is its length times the mean weight of the cells that it touches, in units that keep it whole: 24 a cell
# of weight 1. 12, 17 and 27 are 12 times 1, sqrt(2) and sqrt(5), to 0.6 %; with knight's moves the longest detour that
# the raster forces on a straight way is 3 %, with eight neighbours it would be 8 %.
UNIT = 24
STRAIGHT, DIAGONAL, KNIGHT = 12, 17, 27
BORDER = 2  # cells, the reach of a knight's move: so wide a rim is blocked, that no move leaves the grid
MOVES = np.array(
    [
        *[(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)],
        *[(1, 2), (2, 1), (2, -1), (1, -2), (-1, -2), (-2, -1), (-2, 1), (-1, 2)],
    ],
    np.int64,
)  # (16, row and column)


class Field(NamedTuple):
    """What the search found: costs to the goal, UNREACHED where there is no way, and the next cell on the way."""

    cost: npt.NDArray[np.int32]  # (rows, columns), UNIT a cell of weight 1
    following: npt.NDArray[np.int32]  # (rows, columns), flat index; its own at the goal; nothing where there is no way


@njit(cache=True)
def _unlink(
    flat: int,
    bucket: int,
    heads: npt.NDArray[np.int32],
    after: npt.NDArray[np.int32],
    before: npt.NDArray[np.int32],
) -> None:
    if before[flat] >= 0:
        after[before[flat]] = after[flat]
    else:
        heads[bucket] = after[flat]
    if after[flat] >= 0:
        before[after[flat]] = before[flat]


@njit(cache=True)
def _link(
    flat: int,
    bucket: int,
    heads: npt.NDArray[np.int32],
    after: npt.NDArray[np.int32],
    before: npt.NDArray[np.int32],
) -> None:
    after[flat], before[flat] = heads[bucket], -1
    if heads[bucket] >= 0:
        before[heads[bucket]] = flat
    heads[bucket] = flat


@njit(cache=True)
def _search(
    weights: npt.NDArray[np.int32],  # (cells,)
    sources: npt.NDArray[np.int64],
    starting_costs: npt.NDArray[np.int32],
    moves: npt.NDArray[np.int64],  # (16, 3): flat steps to the end, to the first and to the second cell on the way
    target: int,
    margin: int,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Settle cells by buckets as wide as the cheapest step: within one, none can improve another (Dial)."""
    cells = len(weights)
    cost = np.full(cells, UNREACHED, np.int32)
    following = np.empty(cells, np.int32)
    after = np.empty(cells, np.int32)
    before = np.empty(cells, np.int32)
    most, least = 1, 1 << 20
    for flat in range(cells):
        if weights[flat] != BLOCKED:
            most, least = max(most, weights[flat]), min(least, weights[flat])
    width = 2 * STRAIGHT * least
    latest = 0
    for index in range(len(sources)):
        latest = max(latest, starting_costs[index])
    turns = max(2 * KNIGHT * most, latest) // width + 2
    heads = np.full(turns, -1, np.int32)
    waiting = 0
    for index in range(len(sources)):
        flat = sources[index]
        if weights[flat] == BLOCKED or cost[flat] <= starting_costs[index]:
            continue
        if cost[flat] == UNREACHED:
            waiting += 1
        else:
            _unlink(flat, (cost[flat] // width) % turns, heads, after, before)
        cost[flat], following[flat] = starting_costs[index], flat
        _link(flat, (cost[flat] // width) % turns, heads, after, before)
    end = np.int64(UNREACHED)
    turn = 0
    while waiting > 0 and turn * width <= end:
        bucket = turn % turns
        while heads[bucket] >= 0:
            flat = heads[bucket]
            _unlink(flat, bucket, heads, after, before)
            waiting -= 1
            so_far = cost[flat]
            if flat == target:
                end = np.int64(so_far) + margin
            here = weights[flat]
            for move in range(16):
                other = flat + moves[move, 0]
                there = weights[other]
                if there == BLOCKED or cost[other] <= so_far:
                    continue
                if move < 4:
                    reached = so_far + STRAIGHT * (here + there)
                else:
                    first, second = weights[flat + moves[move, 1]], weights[flat + moves[move, 2]]
                    if BLOCKED in (first, second):
                        continue  # it would cut a corner
                    if move < 8:
                        reached = so_far + DIAGONAL * (here + there)
                    else:
                        reached = so_far + KNIGHT * (here + there + first + second) // 2
                if reached >= cost[other]:
                    continue
                if cost[other] == UNREACHED:
                    waiting += 1
                else:
                    _unlink(other, (cost[other] // width) % turns, heads, after, before)
                cost[other], following[other] = reached, flat
                _link(other, (reached // width) % turns, heads, after, before)
        turn += 1
    return cost, following


def cost_to_go(
    weights: npt.NDArray[np.int32],
    sources: npt.NDArray[np.int64],
    starting_costs: npt.NDArray[np.int32] | None = None,
    *,
    start: tuple[int, int] | None = None,
    margin: int = 0,
) -> Field:
    """Find the cheapest way from every cell to the nearest source.

    weights (rows, columns): 0 blocked, else at least 1; a rim of BORDER cells counts as blocked. sources: flat indices
    of the goal cells; starting_costs: what each costs by itself, 0 by default. start: stop when all is settled up to
    the cost of this cell plus `margin`; cells beyond keep an upper bound. The order of settling is fixed, so that
    equal inputs give equal ways.
    Source: Dijkstra 1959; buckets: Dial 1969.
    """
    inner = np.zeros(weights.shape, np.int32)
    inner[BORDER:-BORDER, BORDER:-BORDER] = weights[BORDER:-BORDER, BORDER:-BORDER]
    columns = weights.shape[1]
    ends, halves = MOVES, np.trunc(MOVES / 2).astype(np.int64)  # a knight's move goes straight ahead, then aslant
    halves[4:8, 0] = MOVES[4:8, 0]  # a diagonal one goes between the cells above and beside
    moves = np.stack([ends, halves, ends - halves], axis=1) @ np.array([columns, 1])  # (16, 3)
    costs = np.zeros(len(sources), np.int32) if starting_costs is None else starting_costs.astype(np.int32)
    target = -1 if start is None else start[0] * columns + start[1]
    cost, following = _search(inner.reshape(-1), np.asarray(sources, np.int64), costs, moves, target, margin)
    return Field(cost.reshape(weights.shape), following.reshape(weights.shape))


@njit(cache=True)
def _trace(following: npt.NDArray[np.int32], start: int, most: int) -> npt.NDArray[np.int64]:
    cells = np.empty(most, np.int64)
    count = 0
    flat = start
    columns = following.shape[1]
    while count < most:
        cells[count] = flat
        count += 1
        step = following[flat // columns, flat % columns]
        if step == flat:
            break
        flat = step
    return cells[:count]


def trace(field: Field, row: int, column: int) -> npt.NDArray[np.int64]:
    """Return the cells (n, row and column) of the cheapest way from a cell to the goal; empty where there is none."""
    columns = field.cost.shape[1]
    if field.cost[row, column] == UNREACHED:
        return np.empty((0, 2), np.int64)
    flat = _trace(field.following, row * columns + column, field.cost.size)
    return np.stack([flat // columns, flat % columns], axis=1)
