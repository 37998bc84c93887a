"""The dynamic window: of all velocities within reach, the one whose arc brings the robot to the goal soonest.

Every arc is judged in seconds: the time to some point along it, the time that the search says is left from there, the
time to turn towards the way there, and a surcharge for passing close. Only points count from which the robot can still
stop before it touches anything. Source: Fox, Burgard and Thrun 1997; the way's cost as goal: Brock and Khatib 1999.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.navigation.footprint import Body, Footprint, Surroundings, room
from operators.navigation.lattice import Lattice
from operators.navigation.motion import Twist, advance, paced, towards
from operators.navigation.people import NOBODY, Walkers, nearby, toll
from operators.navigation.search import UNREACHED, Field

STEP = 0.1  # seconds between the poses of an arc: one period of the controller
COMFORT = 0.3  # metres of room from which passing costs nothing
CLOSE_COST = 6.0  # seconds for each second's way at full speed with no room at all
TOUCHING, SLACK = 0.02, 0.02  # metres of room: with less, a corner may come nearer by this, or nothing would move
CREEP, SPEED_PER_ROOM = 0.3, 3.0  # m/s with no room, and m/s more for each metre of it
HASTE_COST = 4.0  # seconds a second, at twice the speed that the room allows
TURN_COST = 1.3  # of the time that a turn towards the way takes: above 1, or the robot would never begin to turn
SWERVE_COST = 0.05  # seconds for each rad/s that the turn differs from the last choice: no dithering between equals
REVERSE_COST = 1.0  # seconds a second: the robot sees backwards as well, but is not meant to drive so
NOWHERE = 1e3  # seconds left from where no way leads to the goal
EVADING = 0.6  # m/s backwards, to get out of somebody's way
AMONG_PEOPLE = 15  # speeds to try there, finer the slower: where little is allowed, little more counts
WALKERS_WITHIN = 5.0  # metres: what both can walk and drive in 2 s
LOOK_AHEAD = 6  # cells of the search that the way is followed to find its direction


class Limits(NamedTuple):
    """What the drive can do."""

    speed: float = 1.3  # m/s
    reverse: float = 0.2  # m/s
    turn: float = 1.0  # rad/s
    acceleration: float = 1.0  # m/s^2
    turn_acceleration: float = 2.5  # rad/s^2
    braking: float = 1.0  # m/s^2, towards rest


class Choice(NamedTuple):
    """The velocities to aim for, and where they lead."""

    target: Twist
    trajectory: npt.NDArray[np.float64]  # (k, 3) x, y, yaw, the present pose first
    seconds: float  # to the goal, as judged; infinite when every arc ends in something


class Way(NamedTuple):
    """What the search says around the robot, on square cells."""

    seconds: npt.NDArray[np.float32]  # (rows, columns) left to the goal; NOWHERE where no way leads there
    direction: npt.NDArray[np.float32]  # (rows, columns) of the way, radians; nan at the goal
    resolution: float  # metres
    x: float  # of the lower left corner, metres
    y: float


@njit(cache=True)
def _cut(
    cost: npt.NDArray[np.int32], following: npt.NDArray[np.int32], top: int, left: int, size: int, scale: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    seconds = np.full((size, size), np.float32(NOWHERE), np.float32)
    direction = np.full((size, size), np.float32(np.nan), np.float32)
    columns = cost.shape[1]
    for row in range(max(0, -top), min(size, cost.shape[0] - top)):
        for column in range(max(0, -left), min(size, columns - left)):
            from_row, from_column = row + top, column + left
            if cost[from_row, from_column] == UNREACHED:
                continue
            seconds[row, column] = cost[from_row, from_column] * scale
            flat = from_row * columns + from_column
            for _ in range(LOOK_AHEAD):
                flat = following[flat // columns, flat % columns]
            down, right = flat // columns - from_row, flat % columns - from_column
            if down != 0 or right != 0:
                direction[row, column] = math.atan2(down, right)
    return seconds, direction


def way_around(field: Field, lattice: Lattice, x: float, y: float, side: float, seconds_per_cost: float) -> Way:
    """Cut a square of `side` metres around a position from a search's result on a raster."""
    size = math.ceil(side / lattice.resolution)
    row, column = lattice.cell(x, y)
    top, left = row - size // 2, column - size // 2
    seconds, direction = _cut(field.cost, field.following, top, left, size, seconds_per_cost)
    corner = (left + lattice.first_column) * lattice.resolution, (top + lattice.first_row) * lattice.resolution
    return Way(seconds, direction, lattice.resolution, *corner)


@njit(cache=True)
def seconds_left(way: Way, x: float, y: float) -> float:
    """Interpolate the seconds left at a position between the cells around it from which a way leads to the goal."""
    x, y = (x - way.x) / way.resolution - 0.5, (y - way.y) / way.resolution - 0.5
    row, column = math.floor(y), math.floor(x)
    down, right = y - row, x - column
    total, share = 0.0, 0.0
    for a in range(2):
        for b in range(2):
            if 0 <= row + a < way.seconds.shape[0] and 0 <= column + b < way.seconds.shape[1]:
                value = float(way.seconds[row + a, column + b])
                if value < NOWHERE:
                    part = (down if a else 1.0 - down) * (right if b else 1.0 - right)
                    total += part * value
                    share += part
    return total / share if share > 1e-6 else NOWHERE


@njit(cache=True)
def least_room(padding: float, here: float, tolerated: float) -> float:
    """Return the metres of room that an arc must leave: who already stands closer may leave, not come closer still.

    tolerated: metres that do where the robot cannot move otherwise; else infinite. The room along a straight wall
    seems to vary by a centimetre, its cells being squares, and a robot that nearly touches it would never move again.
    """
    if here < TOUCHING:
        return here - SLACK
    return min(padding, here, tolerated)


@njit(cache=True)
def _roll(
    poses: npt.NDArray[np.float64],
    speeds: npt.NDArray[np.float64],
    turns: npt.NDArray[np.float64],
    rooms: npt.NDArray[np.float64],
    wanted: tuple[float, float],
    limits: Limits,
    around: Surroundings,
    body: Body,
    padding: float,
    walkers: Walkers,
    tolls: npt.NDArray[np.float64],
) -> int:
    """Fill in poses (steps + 1, 3) and the rest (steps + 1,); return the last step before a touch."""
    speed, turn = speeds[0], turns[0]
    for k in range(1, len(poses)):
        speed = paced(speed, wanted[0], limits.acceleration * STEP, limits.braking * STEP)
        turn = towards(turn, wanted[1], limits.turn_acceleration * STEP)
        x, y, yaw = advance(poses[k - 1, 0], poses[k - 1, 1], poses[k - 1, 2], speed, turn, STEP)
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, yaw
        speeds[k], turns[k] = speed, turn
        rooms[k] = room(around, body, COMFORT, x, y, yaw)
        if rooms[k] < padding:
            return k - 1
        if len(walkers):
            tolls[k], into = toll(walkers, body.half, k * STEP, (x, y, yaw), speed, turn, limits.speed)
            if into and abs(speed) > abs(speeds[k - 1]) - 0.9 * limits.braking * STEP:  # and does not brake
                return k - 1
    return len(poses) - 1


@njit(cache=True)
def _judge(
    poses: npt.NDArray[np.float64],
    speeds: npt.NDArray[np.float64],
    turns: npt.NDArray[np.float64],
    rooms: npt.NDArray[np.float64],
    tolls: npt.NDArray[np.float64],
    free: int,
    limits: Limits,
    way: Way,
) -> tuple[float, int]:
    """Return the least seconds to the goal over an arc's points before step `free`, and the step at which they are."""
    to_touch = math.inf
    if free < len(poses) - 1:
        to_touch = STEP * np.abs(speeds[1 : free + 1]).sum()
    best, at = math.inf, 0
    spent = 0.0
    for k in range(1, free + 1):
        pace = abs(speeds[k])
        to_touch -= pace * STEP
        spent += STEP + STEP * tolls[k]
        if rooms[k] < COMFORT:
            closeness = (COMFORT - rooms[k]) / COMFORT
            haste = max(0.0, pace / (CREEP + SPEED_PER_ROOM * rooms[k]) - 1.0)
            spent += STEP * (CLOSE_COST * closeness * closeness * pace / limits.speed + HASTE_COST * haste)
        if speeds[k] < 0.0:
            spent += STEP * REVERSE_COST
        if to_touch < pace * pace / (2.0 * limits.braking):
            continue  # too late to stop
        row = math.floor((poses[k, 1] - way.y) / way.resolution)
        column = math.floor((poses[k, 0] - way.x) / way.resolution)
        if row < 0 or row >= way.seconds.shape[0] or column < 0 or column >= way.seconds.shape[1]:
            break
        total = spent + seconds_left(way, poses[k, 0], poses[k, 1])
        missing = limits.speed - speeds[k]  # what is still to be gained costs the time that it takes
        total += missing * missing / (2.0 * limits.acceleration * limits.speed)
        ahead = float(way.direction[row, column])
        if not math.isnan(ahead):
            coming = turns[k] * abs(turns[k]) / (2.0 * limits.turn_acceleration)  # before the turn can end
            off = abs((ahead - poses[k, 2] - coming + math.pi) % (2.0 * math.pi) - math.pi)
            total += TURN_COST * off / limits.turn
            # Turning at speed leads away from the way by speed / turn * (1 - cos), and costs as much to come back.
            total += 2.0 * pace * (1.0 - math.cos(off)) / (limits.turn * limits.speed)
        if total < best:
            best, at = total, k
    return best, at


@njit(cache=True)
def _choose(
    start: tuple[float, float, float],
    speed_now: float,
    turn_now: float,
    turn_before: float,
    speeds_wanted: npt.NDArray[np.float64],
    turns_wanted: npt.NDArray[np.float64],
    steps: int,
    limits: Limits,
    around: Surroundings,
    body: Body,
    padding: float,
    tolerated: float,
    way: Way,
    walkers: Walkers,
) -> tuple[float, float, float, npt.NDArray[np.float64]]:
    poses = np.empty((steps + 1, 3))
    speeds, turns, rooms, tolls = np.empty(steps + 1), np.empty(steps + 1), np.empty(steps + 1), np.zeros(steps + 1)
    poses[0, 0], poses[0, 1], poses[0, 2] = start
    speeds[0], turns[0] = speed_now, turn_now
    here = room(around, body, COMFORT, start[0], start[1], start[2])
    needed = least_room(padding, here, tolerated)
    best, best_speed, best_turn = math.inf, 0.0, 0.0
    trajectory = poses[:1].copy()
    for i in range(len(speeds_wanted)):
        for j in range(len(turns_wanted)):
            wanted = (speeds_wanted[i], turns_wanted[j])
            free = _roll(poses, speeds, turns, rooms, wanted, limits, around, body, needed, walkers, tolls)
            total, at = _judge(poses, speeds, turns, rooms, tolls, free, limits, way)
            total += SWERVE_COST * abs(turns_wanted[j] - turn_before)
            if total < best:
                best, best_speed, best_turn = total, wanted[0], wanted[1]
                trajectory = poses[: at + 1].copy()
    return best, best_speed, best_turn, trajectory


class DynamicWindow:
    """The local controller: what stands around the robot and the way to the goal in, velocities out."""

    def __init__(
        self,
        footprint: Footprint,
        limits: Limits,
        *,
        horizon: float = 3.0,
        padding: float = 0.05,
        speeds: int = 10,
        turns: int = 21,
    ) -> None:
        """Take horizon: seconds of an arc; padding: metres kept free around the outline; how many velocities to try."""
        self.limits = limits
        self.steps = round(horizon / STEP)
        self.padding = padding
        self._body = footprint.body()
        self._samples = speeds, turns
        self._turn_before = 0.0

    def choose(
        self,
        pose: tuple[float, float, float],
        now: Twist,
        around: Surroundings,
        way: Way,
        *,
        top_speed: float,
        walkers: Walkers = NOBODY,
        tolerated: float = math.inf,
    ) -> Choice:
        """Choose velocities to aim for, for the robot at a pose (x, y, yaw) that drives at `now`.

        top_speed in m/s. walkers: people (k, 4) to keep clear of, at the moment of the pose. tolerated: metres of
        room that do for a robot that cannot move otherwise, as `tolerated` says.
        """
        speeds, turns = self._samples
        reverse = [-min(self.limits.reverse, top_speed)]
        forward = np.linspace(0.0, top_speed, speeds)
        walkers = nearby(walkers, pose[0], pose[1], WALKERS_WITHIN)
        if len(walkers):  # who comes towards the robot is faster than it backs off otherwise
            reverse.append(-min(EVADING, top_speed))
            forward = top_speed * np.linspace(0.0, 1.0, AMONG_PEOPLE) ** 1.5
        best, speed, turn, trajectory = _choose(
            pose,
            now.linear,
            now.angular,
            self._turn_before,
            np.concatenate([reverse, forward]),
            np.linspace(-self.limits.turn, self.limits.turn, turns),
            self.steps,
            self.limits,
            around,
            self._body,
            self.padding,
            tolerated,
            way,
            walkers,
        )
        self._turn_before = turn
        return Choice(Twist(speed, turn), trajectory, best)

    def tolerated(self, pose: tuple[float, float, float], around: Surroundings) -> float:
        """Return the metres of room with which a robot at a pose (x, y, yaw) that cannot move may try again."""
        return max(room(around, self._body, COMFORT, *pose) - SLACK, 0.0)

    def free_steps(
        self,
        pose: tuple[float, float, float],
        twist: Twist,
        around: Surroundings,
        steps: int,
        *,
        walkers: Walkers = NOBODY,
        tolerated: float = math.inf,
    ) -> int:
        """Count the controller's periods for which a constant twist touches nothing and nobody, up to `steps`.

        walkers, tolerated: as `choose` takes them.
        """
        x, y, yaw = pose
        needed = least_room(self.padding, room(around, self._body, COMFORT, x, y, yaw), tolerated)
        for step in range(steps):
            x, y, yaw = advance(x, y, yaw, twist.linear, twist.angular, STEP)
            if room(around, self._body, COMFORT, x, y, yaw) < needed:
                return step
            if toll(walkers, self._body.half, step * STEP, (x, y, yaw), *twist, self.limits.speed)[1]:
                return step
        return steps
