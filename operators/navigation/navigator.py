"""The driver: from poses, maps, frames and goals to a velocity ten times a second, and what to do when that fails."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import Matrix, transform, wrap, yaw
from operators.navigation.costmap import CELL, COARSE, FREE, Costmap
from operators.navigation.footprint import Footprint, Surroundings
from operators.navigation.lattice import Lattice
from operators.navigation.motion import Commands, Planar, Progress, Twist, advance, paced, towards
from operators.navigation.people import NOBODY, Stubborn, Walkers, crowd, nearby
from operators.navigation.search import UNIT, UNREACHED, Field, cost_to_go, trace
from operators.navigation.window import STEP, DynamicWindow, Limits, way_around

REPLAN = 5  # periods between two searches
HELD = 3.0  # metres of the present way to which the robot rather keeps among people
BEYOND = 3.0  # metres of open floor by which a search goes on past the robot, to cover its window
ARRIVED = 0.25  # metres from the target at which the robot stops
NEARBY = 0.75  # metres around a target that is itself blocked: a place there serves, the goal's radius being 0.9
NEARBY_COST = 3.0  # metres of open floor that each metre from the blocked target counts
PATIENCE = 120  # periods without any way after which a target is called unreachable
STILL, STILL_TURN = 0.15, 0.6  # metres and radians: moving less than this
STILL_FOR = 30  # periods, is being stuck
ROOTED_FOR = 60  # periods in one place, is being stuck as well, however much the robot turns
ATTEMPTS = 8  # recoveries within FRESH metres after which a target is called unreachable
FRESH = 1.0  # metres
LOOSE = 0.3  # metres from where the robot was wedged
REST = 200  # periods after which an unreachable target is tried again
ABOUT = 1.0  # metres within which people may hem the robot in
CAREFUL_SPEED = 0.4  # m/s at most, while the localizer is not sure


class Decision(NamedTuple):
    """What to do now, and why."""

    twist: Twist
    path: npt.NDArray[np.float64]  # (n, 2) metres, world
    trajectory: npt.NDArray[np.float64]  # (k, 3) x, y, yaw, world
    status: str  # follow, recover, unreachable, arrived, wait


class Recovery:
    """Motions to get loose with, one after the other; each is left when it would touch something."""

    def __init__(self, attempt: int, turn: float, limits: Limits, *, crowded: bool = False) -> None:
        """Plan the motions. attempt: from 0, each does something else; turn: radians to the left to face the way.

        crowded: people are about; with them beside and behind, every other time the way out is ahead.
        """
        self.moved = False  # whether any of them was possible
        back = Twist(-limits.reverse, 0.0)
        side = math.copysign(0.8 * limits.turn, turn)
        spin, other = Twist(0.0, side), Twist(0.0, -side)
        facing = min(round(abs(turn) / (0.8 * limits.turn) / STEP), 40)
        self.motions: list[tuple[Twist, int]] = [
            [(back, 12), (spin, facing)],
            [(spin, facing), (Twist(), 10)],
            [(back, 20), (other, 20)],
            [(Twist(), 20), (back, 8), (spin, 20)],
        ][attempt % 4]
        if crowded and attempt % 2 == 1:
            self.motions = [(Twist(limits.reverse, 0.0), 20), (spin, facing)]


class Navigator:
    """A state machine: tell it the goal, the map and each frame; ask it for a velocity at each pose."""

    def __init__(
        self,
        footprint: Footprint | None = None,
        limits: Limits | None = None,
        *,
        padding: float = 0.05,
        inflation: float = 0.8,
        side: float = 4.0,
        horizon: float = 3.0,
        latency: float = 0.1,
    ) -> None:
        """Take lengths in metres and times in seconds.

        padding: kept free around the footprint; inflation: distance up to which the search keeps away from things;
        side: of the local window; horizon: of the arcs; latency: from a measurement to the effect of its command.
        """
        self.footprint = footprint or Footprint()
        self.limits = limits or Limits()
        self.costmap = Costmap(lethal=self.footprint.inscribed + padding + 0.5 * CELL, inflation=inflation)
        self.commands = Commands(latency)
        self._progress = Progress(self.limits.turn)
        self.window = DynamicWindow(self.footprint, self.limits, horizon=horizon, padding=padding)
        self._side = side
        self._goal: tuple[float, float] | None = None
        self._field: Field | None = None
        self._field_lattice = Lattice(CELL * COARSE, 0, 0, 0, 0)
        self._path = np.empty((0, 2))
        self._started = False
        self._until_replan = 0
        self._without_way = 0
        self._trail: deque[Planar] = deque(maxlen=ROOTED_FOR)
        self._recovery: Recovery | None = None
        self._attempts = 0
        self._attempt_place = (0.0, 0.0)
        self._given_up = 0  # periods left of not trying
        self._tolerated = math.inf  # metres of room that do since no recovery could move the robot
        self._wedged_at = (0.0, 0.0)  # where that was
        self._walkers = NOBODY
        self._stubborn = Stubborn()
        self._stays = np.zeros(0, np.bool_)  # of the walkers

    def set_goal(self, x: float, y: float) -> None:
        """Drive to a place (metres, world) from now on."""
        if self._goal == (x, y):
            return
        self._goal = (x, y)
        self._until_replan = 0
        self._without_way = self._attempts = self._given_up = 0
        self._recovery = None

    def set_map(self, cells: npt.NDArray[np.int8], origin: npt.ArrayLike, resolution: float) -> None:
        """Replace the map: cells (rows, columns) -1 unknown, 0 free to 100 occupied; its corner in metres, world."""
        self.costmap.set_map(cells, origin, resolution)

    def observe(self, points: npt.NDArray[np.float32], world_from_base: Matrix, base_from_lidar: Matrix) -> None:
        """Enter a frame: points (n, 3) in the lidar frame, and where the base was when it was taken."""
        self.costmap.observe(points, world_from_base @ base_from_lidar, float(world_from_base[2, 3]))

    def stand(self, points: npt.NDArray[np.float32], world_from_sensor: Matrix) -> None:
        """Enter what stands beside the robot: points (n, 3) of another sensor, in its frame, and where that was."""
        self.costmap.stand(transform(world_from_sensor, points.astype(np.float64))[:, :2])

    def meet(self, walkers: Walkers) -> None:
        """Keep clear of people (k, 4) from now on: x, y, metres and m/s, world, when a command takes effect."""
        self._walkers = walkers

    def step(self, measured_at: int, world_from_base: Matrix, *, valid: bool = True) -> Decision:
        """Decide what to do from a pose measured at a time in nanoseconds; drive carefully when it is not valid."""
        measured = float(world_from_base[0, 3]), float(world_from_base[1, 3]), yaw(world_from_base)
        hindered = self._progress.hindered(self.commands, measured_at, *measured)
        if hindered is None:
            now, pose = self.commands.latest, self.commands.predict(measured_at, *measured)
        else:
            now, pose = hindered, advance(*measured, *hindered, self.commands.latency)
        limits = self.limits
        wanted, status, trajectory = self._choose(measured, pose, now, limits.speed if valid else CAREFUL_SPEED)
        twist = Twist(
            paced(now.linear, wanted.linear, limits.acceleration * STEP, limits.braking * STEP),
            towards(now.angular, wanted.angular, limits.turn_acceleration * STEP),
        )
        self.commands.give(measured_at, twist)
        path = self._path if status in ("follow", "recover") else self._path[:0]
        return Decision(twist, path, np.array([pose]) if trajectory is None else trajectory, status)

    def _choose(
        self, measured: Planar, pose: Planar, now: Twist, top_speed: float
    ) -> tuple[Twist, str, npt.NDArray[np.float64] | None]:
        """Return the velocities to come to, the status and the trajectory.

        `pose` is `measured`, carried on to when the command takes effect; `now` the velocity that the robot has then.
        """
        if self._goal is None:
            return Twist(), "wait", None
        self.costmap.cover(pose[:2], self._goal)
        if not self._started:  # whoever put the robot down left it room to turn
            self._started = True
            self.costmap.trust(pose[0], pose[1], self.footprint.circumscribed + 2.0 * self.window.padding)
        self.costmap.clear_footprint(self.footprint, measured)
        left = math.dist(pose[:2], self._goal)
        if left < ARRIVED:
            self._trail.clear()
            return Twist(), "arrived", None
        if self._given_up > 0:
            self._given_up -= 1
            return Twist(), "unreachable", None
        self._stays = self._stubborn.among(self._walkers, pose[:2])
        if self._until_replan == 0:
            self._search(pose)
        self._until_replan -= 1
        if self._without_way > PATIENCE:
            return Twist(), "unreachable", None
        if math.dist(pose[:2], self._attempt_place) > FRESH:
            self._attempts, self._attempt_place = 0, pose[:2]
        if math.dist(pose[:2], self._wedged_at) > LOOSE:
            self._tolerated = math.inf
        around = self.costmap.window(pose[0], pose[1], self._side, self._side / 4.0)
        if self._recovery is None and self._stuck(pose):
            self._recover(pose)
        if self._recovery is not None:
            twist = self._get_loose(pose, around)
            if twist is not None:
                return twist, "recover", None
        assert self._field is not None
        seconds_per_cost = self._field_lattice.resolution / (FREE * UNIT) / self.limits.speed
        way = way_around(self._field, self._field_lattice, pose[0], pose[1], self._side, seconds_per_cost)
        top_speed = min(top_speed, math.sqrt(2.0 * self.limits.acceleration * left))  # so as to stop at the goal
        choice = self.window.choose(
            pose,
            now,
            around,
            way,
            top_speed=top_speed,
            walkers=self._walkers,
            tolerated=self._tolerated,
        )
        return choice.target, "follow", choice.trajectory

    def _search(self, pose: Planar) -> None:
        """Search from the goal; when what was seen leaves no way, by the map alone: people move on, and doors open."""
        assert self._goal is not None
        self._until_replan = REPLAN
        lattice = self.costmap.lattice.coarse(COARSE)
        start = lattice.cell(pose[0], pose[1])
        per_metre = FREE * UNIT / lattice.resolution
        for seen in (True, False):
            weights = self.costmap.weights(pose[:2], seen=seen)
            sources, costs = self._sources(weights, lattice, per_metre)
            if len(self._walkers):
                held = self._path[: round(HELD / lattice.resolution)]
                crowd(weights, lattice.resolution, *lattice.origin, self._walkers, self._stays, held)
            field = cost_to_go(weights, sources, costs, start=start, margin=round(BEYOND * per_metre))
            found = field.cost[start] != UNREACHED
            if found:
                break
        self._without_way = 0 if found and seen else self._without_way + REPLAN
        self._field, self._field_lattice = field, lattice
        cells = trace(field, *start)
        self._path = np.stack(lattice.centre(cells[:, 0], cells[:, 1]), axis=1)

    def _sources(
        self, weights: npt.NDArray[np.int32], lattice: Lattice, per_metre: float
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
        """Return the goal's cell, or the open ones near to it when it is blocked, each with what its distance costs."""
        assert self._goal is not None
        row, column = lattice.cell(*self._goal)
        if weights[row, column] > 0:
            return np.array([row * lattice.columns + column]), np.zeros(1, np.int32)
        reach = math.ceil(NEARBY / lattice.resolution)
        rows, columns = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1]
        x, y = lattice.centre(rows, columns)
        away = np.hypot(x - self._goal[0], y - self._goal[1])
        fit = (rows >= 0) & (rows < lattice.rows) & (columns >= 0) & (columns < lattice.columns) & (away <= NEARBY)
        flat = (rows * lattice.columns + columns)[fit]
        return flat, np.round(away[fit] * NEARBY_COST * per_metre).astype(np.int32)

    def _stuck(self, pose: Planar) -> bool:
        """Say whether the robot has hardly moved for STILL_FOR periods, or has but turned for ROOTED_FOR."""
        self._trail.append(pose)
        if len(self._trail) < STILL_FOR:
            return False
        trail = np.array(self._trail)
        still = np.hypot(trail[:, 0] - pose[0], trail[:, 1] - pose[1]) < STILL
        turned = np.abs(wrap(trail[-STILL_FOR:, 2] - pose[2])).max()
        return bool(still[-STILL_FOR:].all() and (turned < STILL_TURN or (len(trail) == ROOTED_FOR and still.all())))

    def _recover(self, pose: Planar) -> None:
        """Start getting loose, or give up for a while after too many attempts in one place.

        What the robot stood before and could not see, it takes for an obstacle from now on, until a ray passes there.
        """
        self.costmap.distrust(pose[0], pose[1])
        if self._attempts == ATTEMPTS:
            self._attempts, self._given_up, self._until_replan = 0, REST, 0
        ahead = self._path[min(6, len(self._path) - 1)] if len(self._path) else np.array(self._goal)
        turn = float(wrap(math.atan2(ahead[1] - pose[1], ahead[0] - pose[0]) - pose[2]))
        crowded = len(nearby(self._walkers, pose[0], pose[1], ABOUT)) > 0
        self._recovery = Recovery(self._attempts, turn, self.limits, crowded=crowded)
        self._attempts += 1

    def _get_loose(self, pose: Planar, around: Surroundings) -> Twist | None:
        """Return the present motion of the recovery, or None when it is over; the robot is wedged if it had none."""
        assert self._recovery is not None
        motions = self._recovery.motions
        while motions:
            twist, steps = motions.pop(0)
            if steps > 0 and self._free(pose, twist, around):
                motions.insert(0, (twist, steps - 1))
                self._recovery.moved |= twist != Twist()
                return twist
        if not self._recovery.moved:
            self._tolerated = min(self._tolerated, self.window.tolerated(pose, around))
            self._wedged_at = pose[:2]
        self._recovery = None
        self._until_replan = 0
        self._trail.clear()
        return None

    def _free(self, pose: Planar, twist: Twist, around: Surroundings) -> bool:
        """Say whether a motion of the recovery touches nothing and nobody in its next periods."""
        walkers, tolerated = self._walkers, self._tolerated
        return self.window.free_steps(pose, twist, around, 3, walkers=walkers, tolerated=tolerated) == 3
