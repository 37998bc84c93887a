"""People who walk: where they will be when the robot gets there, and how much room they leave it.

A person is a disc, drawn out by its stride, that goes on at constant velocity or stops; with less and less said by that
as time passes. Nobody is driven into, passing close costs time, and where somebody comes the robot is better elsewhere.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Walkers = npt.NDArray[np.float64]  # (k, 4): x, y in metres, velocity along x and y in m/s, now

BODY = 0.22  # metres from the middle of a person to its side
STRIDE = 0.22  # metres that feet swing ahead and behind besides, at a walk
WALK = 0.6  # m/s at which they do so fully
KEPT = 0.05  # metres kept free between a person and the robot's outline circle
EASY = 0.50  # metres from which passing a person costs nothing
BELIEVED = 2.0  # seconds for which a velocity says where somebody will be
CERTAIN = 1.0  # seconds within which nobody is driven into, by what is known now
PERSON_COST = 3.0  # seconds for each second's way at full speed with no room at all
NEAR = 0.25  # metres: nearer, even a robot that stands is better elsewhere
NEAR_COST = 3.0  # seconds a second with no room at all
RETREAT = 0.3  # of that while the robot makes off
GENTLE, SPEED_PER_METRE = 0.30, 2.0  # m/s with no room, and m/s more for each metre of it
HURRY_COST = 4.0  # seconds a second, at twice the speed that the room allows
COMING = 0.6  # seconds within which who comes towards a robot makes it give way
COMES = 0.4  # m/s from which somebody walks
COMING_ROOM = 0.1  # metres that shall be left then
COMING_COST = 8.0  # seconds for each metre of it that is missing

NOBODY: Walkers = np.zeros((0, 4))


@njit(cache=True)
def person_room(walkers: Walkers, seconds: float, x: float, y: float) -> tuple[float, float, float]:
    """Return the metres from a place to the nearest walker's side after some seconds, and the direction there.

    A walker may as well have stopped. Infinite without walkers; the direction is a unit vector.
    """
    least, along, across = math.inf, 1.0, 0.0
    for index in range(len(walkers)):
        speed = math.sqrt(walkers[index, 2] ** 2 + walkers[index, 3] ** 2)
        half = STRIDE * min(1.0, speed / WALK)
        forward, left = (walkers[index, 2] / speed, walkers[index, 3] / speed) if speed > 1e-6 else (1.0, 0.0)
        for share in range(2):
            ahead = walkers[index, 0] + share * seconds * walkers[index, 2] - x
            aside = walkers[index, 1] + share * seconds * walkers[index, 3] - y
            foot = share * min(half, max(-half, -(ahead * forward + aside * left)))  # who stands has feet together
            ahead, aside = ahead + foot * forward, aside + foot * left
            away = math.sqrt(ahead * ahead + aside * aside)
            if away - BODY < least:
                least = away - BODY
                if away > 1e-6:
                    along, across = ahead / away, aside / away
    return least, along, across


@njit(cache=True)
def toll(
    walkers: Walkers, radius: float, seconds: float, x: float, y: float, yaw: float, speed: float, top_speed: float
) -> tuple[float, bool]:
    """Return what a moment of driving costs near people, in seconds a second, and whether it drives into somebody.

    radius: of the robot's outline circle, metres; seconds: from now; speed: m/s, forward.
    """
    gap, along, across = person_room(walkers, min(seconds, BELIEVED), x, y)
    gap -= radius
    if gap >= EASY:
        return 0.0, False
    pace = abs(speed)
    approach = speed * (math.cos(yaw) * along + math.sin(yaw) * across)
    if gap < KEPT and seconds <= CERTAIN and approach > 0.02:
        return 0.0, True
    sure = max(0.0, 1.0 - seconds / BELIEVED)
    room = max(gap, 0.0)
    closeness = (EASY - room) / EASY
    cost = 0.0
    if gap < NEAR:
        cost += NEAR_COST * (NEAR - max(gap, -NEAR)) / NEAR
    if approach < -0.5 * pace:
        return RETREAT * sure * cost, False
    cost += PERSON_COST * closeness * closeness * pace / top_speed
    if approach > 0.0:
        cost += HURRY_COST * max(0.0, approach / (GENTLE + SPEED_PER_METRE * room) - 1.0)
    return sure * cost, False


@njit(cache=True)
def surcharge(
    walkers: Walkers, radius: float, seconds: float, x: float, y: float, yaw: float, speed: float
) -> tuple[float, float]:
    """Return what it costs, in seconds, to drive in some seconds where somebody walks, soon after and by then.

    radius: of the robot's outline circle, metres; speed: m/s, forward. The first counts the closest that anyone gets
    within COMING seconds more if both go on as they do, the second the present distance alone.
    """
    missing, missing_now = 0.0, 0.0
    for index in range(len(walkers)):
        along, across = walkers[index, 2], walkers[index, 3]
        pace = math.sqrt(along * along + across * across)
        if pace < COMES:
            continue
        ahead, aside = walkers[index, 0] + seconds * along - x, walkers[index, 1] + seconds * across - y
        reach = BODY + STRIDE * min(1.0, pace / WALK) + radius + COMING_ROOM
        missing_now = max(missing_now, reach - math.sqrt(ahead * ahead + aside * aside))
        along, across = along - speed * math.cos(yaw), across - speed * math.sin(yaw)
        square = max(along * along + across * across, 1e-6)
        closest = min(-(ahead * along + aside * across) / square, COMING)
        if closest > 0.0:
            ahead, aside = ahead + closest * along, aside + closest * across
            missing = max(missing, reach - math.sqrt(ahead * ahead + aside * aside))
    sure = COMING_COST * max(0.0, 1.0 - seconds / BELIEVED)
    return sure * missing, sure * missing_now


def nearby(walkers: Walkers, x: float, y: float, reach: float) -> Walkers:
    """Return those within reach metres of a place, in their order."""
    away = np.hypot(walkers[:, 0] - x, walkers[:, 1] - y)
    return np.ascontiguousarray(walkers[away < reach])
