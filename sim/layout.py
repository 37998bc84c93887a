"""What a session draws before it begins: door angles, furniture, and who sits where."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sim.building import Building, BuildingError
from sim.clearance import Clearance, clearance, route
from sim.furniture import TABLES, chair_body, table_body
from sim.masonry import door_leaf, wall_bodies
from sim.scenario import Scenario
from sim.solids import Body

Array = npt.NDArray[np.float64]

RESOLUTION = 0.05  # metres, of the grids of free floor
ROBOT_RADIUS = 0.30  # metres: the circle around the robot's footprint, and a little
NEAR_PATH = 0.8  # metres: doors this near to the tour's way stand open
KEEP_CLEAR = 0.75  # metres between furniture and the way of the tour
TARGET_CLEAR = 1.3  # metres between furniture and a target
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
    walls = wall_bodies(building)
    bounds = building.bounds()
    empty = clearance(walls, bounds, RESOLUTION)
    way = _way(building, empty, tour)
    leaves = _leaves(building, way, rng)
    bodies = [*walls, *leaves]
    seats: list[Seat] = []
    targets = np.array([building.start_pose(tour)[:2], *building.tours[tour].targets])
    taken = clearance(bodies, bounds, RESOLUTION)
    shares: dict[int, float] = {}
    for place in building.tables:
        room = building.room_of(place.at)
        if room not in shares:
            shares[room] = float(rng.uniform(*scenario.tables))
        models = [name for name in (scenario.models or TABLES) if not place.models or name in place.models]
        draws = rng.random(2)
        if draws[0] >= shares[room] or not models:
            continue
        model = models[int(draws[1] * len(models))]
        yaw = math.radians(place.heading) + float(rng.normal(0.0, 0.06))
        x, y = np.array(place.at) + rng.normal(0.0, 0.08, 2)
        table = table_body(model, float(x), float(y), yaw)
        if not _fits(table, taken, way, targets, KEEP_CLEAR):
            continue
        bodies.append(table)
        chairs, sitting = _chairs(model, float(x), float(y), yaw, taken, way, targets, scenario, rng)
        bodies += chairs
        seats += sitting
    return Layout(bodies, seats, clearance(bodies, bounds, RESOLUTION), way)


def _way(building: Building, free: Clearance, tour: str) -> Array:
    """Find the way of the robot from the start through all targets, all doors open."""
    at = building.start_pose(tour)[:2]
    legs = []
    for index, target in enumerate(building.tours[tour].targets):
        leg = route(free, at, target, radius=ROBOT_RADIUS)
        if leg is None:
            raise BuildingError(f"building {building.name}, tour {tour}: target {index} at {target} cannot be reached")
        legs.append(leg)
        at = target
    return np.concatenate(legs)


def _leaves(building: Building, way: Array, rng: np.random.Generator) -> list[Body]:
    """Draw every door closed or at an angle; those on the tour's way stand wide open."""
    leaves = []
    for index, door in enumerate(building.doors):
        draws = rng.random(2)
        middle = (np.array(door.hinge) + door.end()) / 2
        if door.angle is not None:
            angle = 0.0 if door.angle == "closed" else math.radians(door.angle)
        elif np.linalg.norm(way - middle, axis=1).min() < NEAR_PATH:
            angle = math.radians(85.0 + 20.0 * draws[1])
        else:
            angle = 0.0 if draws[0] < CLOSED_SHARE else math.radians(15.0 + 90.0 * draws[1])
        leaves.append(door_leaf(building, index, angle))
    return leaves


def _chairs(
    model: str,
    x: float,
    y: float,
    yaw: float,
    free: Clearance,
    way: Array,
    targets: Array,
    scenario: Scenario,
    rng: np.random.Generator,
) -> tuple[list[Body], list[Seat]]:
    """Draw two to four chairs around a table, and who sits on them."""
    slots = TABLES[model].slots
    order = rng.permutation(len(slots))[: int(rng.integers(2, 5))]
    chairs, seats = [], []
    for index in order:
        slot = slots[index]
        kind = CHAIR_MODELS[int(rng.integers(len(CHAIR_MODELS)))]
        shift = rng.normal(0.0, [0.05, 0.05, 0.15])
        turn = yaw + slot.yaw + float(shift[2])
        place = x + math.cos(yaw) * slot.x - math.sin(yaw) * slot.y, y + math.sin(yaw) * slot.x + math.cos(yaw) * slot.y
        at = place[0] + float(shift[0]), place[1] + float(shift[1])
        occupied = rng.random() < scenario.occupied
        chair = chair_body(kind, *at, turn)
        if _fits(chair, free, way, targets, KEEP_CLEAR):
            chairs.append(chair)
            if occupied:
                seats.append(Seat(*at, turn))
    return chairs, seats


def _fits(body: Body, free: Clearance, way: Array, targets: Array, keep: float) -> bool:
    """Say whether a body stands clear of walls, doors, targets and the tour's way."""
    corners = np.concatenate([part.footprint() for part in body.parts])
    middle, reach = corners.mean(0), float(np.linalg.norm(corners - corners.mean(0), axis=1).max())
    points = np.concatenate([corners, middle[None]])
    if free.at(points).min() < 0.10:
        return False
    if np.linalg.norm(targets - middle, axis=1).min() < TARGET_CLEAR * 0.5 + reach:
        return False
    near = way[np.linalg.norm(way - middle, axis=1) < reach + keep]
    return not len(near) or _distance(corners, near) > keep


def _distance(corners: Array, points: Array) -> float:
    """Return the least distance in metres between a body's outline, densely sampled, and some points."""
    low, high = corners.min(0), corners.max(0)
    steps = np.maximum(np.ceil((high - low) / 0.1).astype(int), 1)
    x, y = np.meshgrid(np.linspace(low[0], high[0], steps[0] + 1), np.linspace(low[1], high[1], steps[1] + 1))
    box = np.stack([x.ravel(), y.ravel()], 1)
    return float(np.linalg.norm(box[:, None] - points[None], axis=2).min())
