"""What a session draws before it begins: door angles, furniture, and who sits where."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sim.building import Building, BuildingError, TablePosition
from sim.clearance import Clearance, carve, clearance, length_of, route
from sim.furniture import TABLES, chair_body, table_body
from sim.masonry import door_leaf, wall_bodies
from sim.scenario import Scenario
from sim.solids import Body, Box, Truth

Array = npt.NDArray[np.float64]

RESOLUTION = 0.05  # metres, of the grids of free floor
ROBOT_RADIUS = 0.30  # metres: the circle around the robot's footprint, and a little
NEAR_PATH = 0.8  # metres: doors this near to the tour's way stand open
KEEP_CLEAR = 0.75  # metres between furniture and the way of the tour
TARGET_CLEAR = 0.65  # metres between furniture and a target
DETOUR = 3.0  # metres more that a tour goes to a target so as to pass the tables by
WALL_CLEAR = 0.10  # metres between furniture and walls
CLOSED_SHARE = 0.3  # of the doors that are on nobody's way
CHAIR_MODELS = ("school", "dining", "slatted", "shell", "armchair", "sled")


class Seat(NamedTuple):
    """A chair with somebody on it: position of the seat in metres, heading in radians."""

    x: float
    y: float
    yaw: float


class Layout(NamedTuple):
    """One session's building: all bodies that stand still, the seats taken, and the way of the tour."""

    bodies: list[Body]
    seats: list[Seat]
    free: Clearance  # with furniture and door leaves
    way: Array  # (n, 2), through all targets


def draw(building: Building, scenario: Scenario, tour: str, seed: int) -> Layout:
    """Draw one session's layout. Raises BuildingError if a target of the tour cannot be reached."""
    rng = np.random.default_rng([seed, 1])
    bounds = building.bounds()
    leaves = _leaves(building, tour_way(building, tour), rng)
    way = tour_way(building, tour, leaves)  # around the leaves that stand open
    bodies = [*wall_bodies(building), *leaves]
    targets = np.array([building.start_pose(tour)[:2], *building.tours[tour].targets])
    site = _Site(clearance(bodies, bounds, RESOLUTION), way, targets)
    seats: list[Seat] = []
    chosen, spare = _filled(building, scenario, rng)
    tables = 0
    for place in chosen + spare:
        if tables == len(chosen):
            break
        group, sitting = _group(place, site, scenario, rng)
        tables += bool(group)
        site.stand(group)
        bodies += group
        seats += sitting
    return Layout(bodies, seats, clearance(bodies, bounds, RESOLUTION), way)


def tour_way(building: Building, tour: str, leaves: list[Body] | None = None) -> Array:
    """Find the way (n, 2) of the robot from the start through all targets, past the tables' places where it can.

    leaves: the doors as they stand; absent: all open but those whose angle is fixed. Raises BuildingError by tour and
    target where the empty building has no way.
    """
    shell = wall_bodies(building) + (fixed_leaves(building) if leaves is None else leaves)
    bounds = building.bounds()
    empty = clearance(shell, bounds, RESOLUTION)
    furnished = clearance(shell + _reserved(building), bounds, RESOLUTION)
    at = building.start_pose(tour)[:2]
    legs = []
    for index, target in enumerate(building.tours[tour].targets):
        leg = route(empty, at, target, radius=ROBOT_RADIUS)
        if leg is None:
            raise BuildingError(f"building {building.name}, tour {tour}: target {index} at {target} cannot be reached")
        around = route(furnished, at, target, radius=ROBOT_RADIUS)
        longest = length_of(leg) + DETOUR
        legs.append(leg if around is None or length_of(around) > longest else around)
        at = target
    if not legs:
        raise BuildingError(f"building {building.name}, tour {tour}: no targets")
    return np.concatenate(legs)


def _reserved(building: Building) -> list[Body]:
    """Return, for each table position, a body as large as a table with its chairs and the room to keep clear."""
    bodies, room = [], 2 * (KEEP_CLEAR - ROBOT_RADIUS)
    for place in building.tables:
        dx, dy = (2.1, 2.1) if place.models and "conference" not in place.models else (3.2, 2.4)
        box = Box(*place.at, 0.5, dx + room, dy + room, 1.0, math.radians(place.heading))
        bodies.append(Body("table", Truth.TABLE, (box,)))
    return bodies


def fixed_leaves(building: Building) -> list[Body]:
    """Return the leaves of the doors whose angle the building fixes."""
    angles = [None if door.angle is None else _fixed(door.angle) for door in building.doors]
    return [door_leaf(building, index, angle) for index, angle in enumerate(angles) if angle is not None]


def _fixed(angle: float | str) -> float:
    return 0.0 if angle == "closed" else math.radians(float(angle))


def _leaves(building: Building, way: Array, rng: np.random.Generator) -> list[Body]:
    """Draw every door closed or at an angle; those on the tour's way stand wide open."""
    leaves = []
    for index, door in enumerate(building.doors):
        draws = rng.random(2)
        middle = (np.array(door.hinge) + door.end()) / 2
        if door.angle is not None:
            angle = _fixed(door.angle)
        elif np.linalg.norm(way - middle, axis=1).min() < NEAR_PATH:
            angle = math.radians(85.0 + 20.0 * draws[1])
        else:
            angle = 0.0 if draws[0] < CLOSED_SHARE else math.radians(15.0 + 90.0 * draws[1])
        leaves.append(door_leaf(building, index, angle))
    return leaves


def _filled(
    building: Building, scenario: Scenario, rng: np.random.Generator
) -> tuple[list[TablePosition], list[TablePosition]]:
    """Draw the positions that get a table, and those that stand in where no table fits.

    Each gets one by the share of its room; their number is as near to the shares as can be.
    """
    shares = rng.uniform(*scenario.tables, len(building.rooms) + 1)  # the last: of no room
    order = rng.permutation(len(building.tables))
    reached = np.cumsum([shares[building.room_of(building.tables[index].at)] for index in order]) + rng.random()
    filled = np.diff(np.floor(reached), prepend=0.0) >= 1.0
    return [building.tables[index] for index in order[filled]], [building.tables[index] for index in order[~filled]]


def _group(
    place: TablePosition, site: _Site, scenario: Scenario, rng: np.random.Generator
) -> tuple[list[Body], list[Seat]]:
    """Draw a table for a position, of the first model that fits, two to four chairs around it, and who sits there."""
    models = [name for name in (scenario.models or TABLES) if not place.models or name in place.models]
    yaw = math.radians(place.heading) + float(rng.normal(0.0, 0.06))
    x, y = (float(value) for value in np.array(place.at) + rng.normal(0.0, 0.08, 2))
    for model in rng.permutation(models).tolist():
        table = table_body(model, x, y, yaw)
        if site.fits(table):
            chairs, seats = _chairs(model, x, y, yaw, site, scenario, rng)
            return [table, *chairs], seats
    return [], []


def _chairs(
    model: str, x: float, y: float, yaw: float, site: _Site, scenario: Scenario, rng: np.random.Generator
) -> tuple[list[Body], list[Seat]]:
    wanted = int(rng.integers(2, 5))
    chairs: list[Body] = []
    seats: list[Seat] = []
    slots = TABLES[model].slots
    for index in rng.permutation(len(slots)):
        slot = slots[index]
        kind = CHAIR_MODELS[int(rng.integers(len(CHAIR_MODELS)))]
        shift = rng.normal(0.0, [0.05, 0.05, 0.15])
        turn = yaw + slot.yaw + float(shift[2])
        place = x + math.cos(yaw) * slot.x - math.sin(yaw) * slot.y, y + math.sin(yaw) * slot.x + math.cos(yaw) * slot.y
        at = place[0] + float(shift[0]), place[1] + float(shift[1])
        occupied = rng.random() < scenario.occupied
        chair = chair_body(kind, *at, turn)
        if len(chairs) < wanted and site.fits(chair):
            chairs.append(chair)
            if occupied:
                seats.append(Seat(*at, turn))
    return chairs, seats


class _Site:
    """Where furniture may still stand: clear of walls, doors, other furniture, targets and the tour's way."""

    def __init__(self, free: Clearance, way: Array, targets: Array) -> None:
        self.free, self.way, self.targets = free, way, targets
        self.empty = np.ones(free.distance.shape, np.bool_)  # of furniture

    def stand(self, bodies: list[Body]) -> None:
        """Take the floor that some bodies need."""
        for body in bodies:
            for part in body.parts:
                carve(self.empty, part.footprint() - (self.free.x, self.free.y), self.free.resolution)

    def fits(self, body: Body) -> bool:
        """Say whether a body may stand where it is."""
        points = np.concatenate([sampled(part.footprint()) for part in body.parts])
        if self.free.at(points).min() < WALL_CLEAR:
            return False
        cells = np.rint((points - (self.free.x, self.free.y)) / self.free.resolution).astype(int)
        if not self.empty[cells[:, 1], cells[:, 0]].all():
            return False
        middle = points.mean(0)
        reach = float(np.linalg.norm(points - middle, axis=1).max())
        for places, keep in ((self.targets, TARGET_CLEAR), (self.way, KEEP_CLEAR)):
            near = places[np.linalg.norm(places - middle, axis=1) < reach + keep]
            if len(near) and np.linalg.norm(points[:, None] - near[None], axis=2).min() < keep:
                return False
        return True


def sampled(ring: Array) -> Array:
    """Return points (n, 2) all over a convex polygon, about 0.1 m apart on its rim."""
    following = np.roll(ring, -1, axis=0)
    pieces = []
    for a, b in zip(ring, following, strict=True):
        shares = np.linspace(0.0, 1.0, max(int(np.linalg.norm(b - a) / 0.1), 1), endpoint=False)
        pieces.append(a + shares[:, None] * (b - a))
    rim, middle = np.concatenate(pieces), ring.mean(0)
    return np.concatenate([middle + share * (rim - middle) for share in (0.0, 0.25, 0.5, 0.75, 1.0)])
