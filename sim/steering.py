"""How people walk: the numba kernel of one update of all walkers.

The behaviours are those of the paper's simulation. A wanderer seeks a point 2 m ahead while its heading walks at
random; a follower aims at a point 1 to 1.25 m in front of the robot. Walls, things, each other and, if they are
attentive, the robot push within a margin of 0.5 m by 1/d^2. What the paper leaves open: wanderers turn away
from walls ahead, and nobody walks into anything.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MARGIN = 0.5  # metres: people and obstacles push within it
BODY = 0.22  # metres: half the breadth of a person
ROBOT = 0.27  # metres: half the diagonal of the robot
FOOT = 0.31  # of a person's height: how far feet reach ahead of the hips, and so keep off the robot besides ROBOT
BREATH = 0.38  # metres between the middles of two people, at the least
TURNING = 0.6  # rad/sqrt(s), of a wanderer's heading
STAND_SHARE = 0.2  # of its time that a wanderer stands
STAND = (2.0, 20.0)  # seconds at once
ARRIVED = 0.25  # metres from its aim at which a follower stops
RESPONSE = 0.4  # seconds in which velocity follows intent
PROBE = 1.0  # metres ahead at which a wanderer looks for walls
WALL_PUSH, PERSON_PUSH, ROBOT_PUSH = 0.05, 0.04, 0.15  # m^3/s: times 1/d^2 gives a velocity
STRONGEST = 3.0  # m/s
CELL = 1.0  # metres, of the grid that finds neighbours; at least MARGIN + 2 BODY


@njit(cache=True)
def sample(distance: Array, x: float, y: float) -> float:
    """Return the clearance at fractional column x and row y of a grid, bilinear; 0 outside."""
    rows, columns = distance.shape
    column, row = math.floor(x), math.floor(y)
    if column < 0 or row < 0 or column + 1 >= columns or row + 1 >= rows:
        return 0.0
    u, v = x - column, y - row
    low = distance[row, column] * (1.0 - u) + distance[row, column + 1] * u
    high = distance[row + 1, column] * (1.0 - u) + distance[row + 1, column + 1] * u
    return low * (1.0 - v) + high * v


@njit(cache=True)
def neighbours(
    position: Array, low: Array, shape: tuple[int, int]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Sort people into cells of CELL metres: the people in the order of their cells, and where each cell begins."""
    rows, columns = shape
    count = len(position)
    cell = np.empty(count, np.int64)
    begin = np.zeros(rows * columns + 1, np.int64)
    for i in range(count):
        column = min(max(int((position[i, 0] - low[0]) / CELL), 0), columns - 1)
        row = min(max(int((position[i, 1] - low[1]) / CELL), 0), rows - 1)
        cell[i] = row * columns + column
        begin[cell[i] + 1] += 1
    begin = np.cumsum(begin)
    order = np.empty(count, np.int64)
    filled = begin.copy()
    for i in range(count):
        order[filled[cell[i]]] = i
        filled[cell[i]] += 1
    return order, begin


@njit(cache=True)
def walk(
    position: Array,
    velocity: Array,
    heading: Array,
    standing: Array,
    follows: Flags,
    attentive: Flags,
    pace: Array,
    aim: Array,
    draws: Array,
    robot: Array,
    kept: Array,
    distance: Array,
    low: Array,
    resolution: float,
    seconds: float,
) -> None:
    """Move all walkers by one update; position, velocity (n, 2), heading and standing (n,) are changed in place.

    standing: seconds that a wanderer still stands. follows: who follows the robot just now, to its
    aim (n, 2). draws: (3, n): normal, uniform 0 to 1, uniform over STAND. robot: x, y. kept: (n,) from its middle
    within which nobody steps nearer. distance: clearance in metres of cells of `resolution` from `low`. Metres,
    radians, m/s.
    """
    count = len(position)
    rows, columns = distance.shape
    shape = (int(rows * resolution / CELL) + 1, int(columns * resolution / CELL) + 1)
    order, begin = neighbours(position, low, shape)
    old = position.copy()
    rate = seconds * STAND_SHARE / (1.0 - STAND_SHARE) / (0.5 * (STAND[0] + STAND[1]))
    near = np.empty(count, np.int64)
    for i in range(count):
        x, y = old[i, 0], old[i, 1]
        gx, gy = (x - low[0]) / resolution, (y - low[1]) / resolution
        here = sample(distance, gx, gy)
        standing[i] = max(standing[i] - seconds, 0.0)
        if not follows[i] and standing[i] <= 0.0 and draws[1, i] < rate:
            standing[i] = draws[2, i]
        heading[i] += TURNING * math.sqrt(seconds) * draws[0, i]
        speed = pace[i] if standing[i] <= 0.0 else 0.0
        dx, dy = math.cos(heading[i]), math.sin(heading[i])
        if follows[i]:
            wx, wy = aim[i, 0] - x, aim[i, 1] - y
            left = math.hypot(wx, wy)
            speed = 0.0 if left < ARRIVED else pace[i] * min(1.0, left / 0.5)
            dx, dy = wx / max(left, 1e-9), wy / max(left, 1e-9)
        elif speed > 0.0 and here < 2.0:
            heading[i] += 2.5 * seconds * _turn_away(distance, gx, gy, dx, dy, PROBE / resolution)
            dx, dy = math.cos(heading[i]), math.sin(heading[i])
        sx = sample(distance, gx + 1.0, gy) - sample(distance, gx - 1.0, gy)
        sy = sample(distance, gx, gy + 1.0) - sample(distance, gx, gy - 1.0)
        slope = max(math.hypot(sx, sy), 1e-9)
        gap = max(here - BODY, 0.05)
        push = min(WALL_PUSH / gap**2, STRONGEST) if gap < MARGIN else 0.0
        px, py = push * sx / slope, push * sy / slope
        found = 0
        column = min(max(int((x - low[0]) / CELL), 0), shape[1] - 1)
        row = min(max(int((y - low[1]) / CELL), 0), shape[0] - 1)
        for r in range(max(row - 1, 0), min(row + 2, shape[0])):
            for slot in range(
                begin[r * shape[1] + max(column - 1, 0)], begin[r * shape[1] + min(column + 2, shape[1])]
            ):
                j = order[slot]
                ax, ay = x - old[j, 0], y - old[j, 1]
                apart = math.hypot(ax, ay)
                if j == i or apart > MARGIN + 2.0 * BODY:
                    continue
                near[found] = j
                found += 1
                gap = max(apart - 2.0 * BODY, 0.05)
                push = min(PERSON_PUSH / gap**2, STRONGEST) / max(apart, 0.05)
                px, py = px + push * ax, py + push * ay
        ax, ay = x - robot[0], y - robot[1]
        apart = max(math.hypot(ax, ay), 0.05)
        gap = max(apart - ROBOT - BODY, 0.05)
        if attentive[i] and gap < MARGIN:
            push = min(ROBOT_PUSH / gap**2, STRONGEST) / apart
            px, py = px + push * ax, py + push * ay
        pressed = math.hypot(px, py)
        vx, vy = dx * speed + px, dy * speed + py
        limit = pace[i] if speed > 0.0 or pressed > 0.3 else 0.0
        shorten = min(1.0, limit / max(math.hypot(vx, vy), 1e-9))
        blend = min(1.0, seconds / RESPONSE)
        velocity[i, 0] += (vx * shorten - velocity[i, 0]) * blend
        velocity[i, 1] += (vy * shorten - velocity[i, 1]) * blend
        tx, ty = x + velocity[i, 0] * seconds, y + velocity[i, 1] * seconds
        for attempt in range(3):  # straight on, else along one axis, else not at all
            nx, ny = (x if attempt == 2 else tx), (y if attempt == 1 else ty)
            there = sample(distance, (nx - low[0]) / resolution, (ny - low[1]) / resolution)
            free = there >= BODY or there > here
            reach = math.hypot(nx - robot[0], ny - robot[1])
            free = free and (reach > kept[i] or reach >= apart)
            for n in range(found):
                between = math.hypot(nx - old[near[n], 0], ny - old[near[n], 1])
                free = free and (between > BREATH or between >= math.hypot(x - old[near[n], 0], y - old[near[n], 1]))
            if free:
                position[i, 0], position[i, 1] = nx, ny
                break
        velocity[i, 0], velocity[i, 1] = (position[i, 0] - x) / seconds, (position[i, 1] - y) / seconds
        went = math.hypot(velocity[i, 0], velocity[i, 1])
        if not follows[i] and speed > 0.0:
            if went < 0.15:  # stuck: turn round, each to their own side
                heading[i] += 2.5 * seconds * (1.0 if i % 2 == 0 else -1.0)
            elif pressed > 0.2:  # go on where one was pushed
                turn = math.atan2(velocity[i, 1], velocity[i, 0]) - heading[i]
                heading[i] += 0.3 * ((turn + math.pi) % (2.0 * math.pi) - math.pi)


@njit(cache=True)
def _turn_away(distance: Array, x: float, y: float, dx: float, dy: float, probe: float) -> float:
    """Return -1, 0 or 1: to which side to turn where a wall is ahead; cells."""
    ahead = min(
        sample(distance, x + dx * probe, y + dy * probe), sample(distance, x + 0.5 * dx * probe, y + 0.5 * dy * probe)
    )
    if ahead > 2.0 * BODY:
        return 0.0
    cosine, sine = 0.7071 * probe, 0.7071 * probe
    left = sample(distance, x + dx * cosine - dy * sine, y + dx * sine + dy * cosine)
    right = sample(distance, x + dx * cosine + dy * sine, y - dx * sine + dy * cosine)
    return 1.0 if left >= right else -1.0
