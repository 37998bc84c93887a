"""People who walk: where they will be when the robot gets there, and how much room they leave it.

A person is a disc, drawn out by its stride, that goes on at constant velocity or stops; with less and less said by that
as time passes. Nobody is driven into, who makes way is followed as fast as they leave, and passing close costs time.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.navigation.motion import Planar

Flags = npt.NDArray[np.bool_]
Walkers = npt.NDArray[np.float64]  # (k, 4): x, y in metres, velocity along x and y in m/s, now

BODY = 0.22  # metres from the middle of a person to its side
STRIDE = 0.30  # metres that feet swing ahead and behind besides, at a walk
WALK = 0.6  # m/s at which they do so fully
KEPT = 0.07  # metres kept free between a person and the robot's outline
AHEAD = 0.25  # seconds: and as far as the robot comes nearer in that time, for feet that are elsewhere than thought
SLOWLY = 0.25  # m/s up to which that is enough
HASTY = 0.2  # seconds: a faster robot leaves room for what it exceeds SLOWLY by in that time, beside people as well
AWAY = 0.3  # share of its speed at which the gap must grow for that room not to be asked for
LAG = 0.2  # seconds by which a track is late to say that somebody has stopped
EASY = 0.55  # metres from which passing a person costs nothing
BELIEVED = 2.0  # seconds for which a velocity says where somebody will be
CERTAIN = 1.5  # seconds within which nobody is driven into, by what is known now
PERSON_COST = 3.0  # seconds for each second's way at full speed with no room at all
NEAR = 0.25  # metres: nearer, even a robot that stands is better elsewhere
NEAR_COST = 1.5  # seconds a second with no room at all
RETREAT = 0.3  # of that while the robot makes off
GENTLE, SPEED_PER_METRE = 0.45, 2.5  # m/s towards somebody with no room, and m/s more for each metre of it
PASSING_SPEED_PER_METRE = 4.0  # the same for who passes somebody
HURRY_COST = 4.0  # seconds a second, at twice the speed that the room allows
CROWDED = 8  # weight, besides the 8 of open floor, of a cell where somebody stands, falling with the distance squared
YIELDED = 0.3  # share of that on the way that the robot is on
OURS = 2  # cells to each side of it
BODILY = 600  # weight where somebody stands who does not step aside
STUBBORN, STANDS = 0.66, 0.3  # metres from the robot's middle and m/s: who is nearer and slower does not step aside
REMEMBERED = 200  # periods for which that is expected of them
SAME = 0.4  # metres that somebody may seem to jump in a period
PASSING = 0.45, 0.80  # metres to the middle of a person at which passing costs all, and nothing
LINGERS = 0.5  # seconds: people are taken to be by then where the way leads past them
HURRIES = 0.3  # share of the weight that is left of who walks at a metre a second

NOBODY: Walkers = np.zeros((0, 4))


@njit(cache=True)
def person_room(
    walker: npt.NDArray[np.float64], half: tuple[float, float], seconds: float, feet: float, pose: Planar
) -> tuple[float, float, float, float, float]:
    """Return the metres between the robot's outline at a pose and the side of somebody (4,) who walks for some seconds.

    half: of the robot's length and width, metres; feet: share of a stride that feet swing ahead and behind; pose: x, y
    in metres, yaw. Besides, in the robot's frame: the unit vector to the walker, and the point of the outline that is
    nearest to it.
    """
    vx, vy = walker[2], walker[3]
    speed = math.sqrt(vx * vx + vy * vy)
    ahead, aside = walker[0] + seconds * vx - pose[0], walker[1] + seconds * vy - pose[1]
    if speed > 1e-6:
        swing = feet * STRIDE * min(1.0, speed / WALK)
        foot = min(swing, max(-swing, -(ahead * vx + aside * vy) / speed))
        ahead, aside = ahead + foot * vx / speed, aside + foot * vy / speed
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    ahead, aside = cosine * ahead + sine * aside, cosine * aside - sine * ahead
    px, py = min(half[0], max(-half[0], ahead)), min(half[1], max(-half[1], aside))
    away = math.sqrt((ahead - px) ** 2 + (aside - py) ** 2)
    if away < 1e-6:
        return -BODY, 1.0, 0.0, half[0], 0.0
    return away - BODY, (ahead - px) / away, (aside - py) / away, px, py


@njit(cache=True)
def toll(
    walkers: Walkers,
    half: tuple[float, float],
    seconds: float,
    pose: Planar,
    speed: float,
    turn: float,
    top_speed: float,
) -> tuple[float, bool]:
    """Return what a moment of driving costs near people, in seconds a second, and whether it drives into somebody.

    half: of the robot's length and width, metres; seconds: from now; pose: x, y, yaw; speed: m/s, forward; turn: rad/s,
    to the left. Everybody may go on, or have stopped LAG ago; who goes on makes way as fast as they leave.
    """
    pace = abs(speed)
    haste = max(0.0, pace - SLOWLY)
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    least, towards = math.inf, 0.0
    for index in range(len(walkers)):
        walker = walkers[index]
        for goes in range(2):
            later = min(seconds, BELIEVED) if goes else -LAG
            gap, along, across, front, side = person_room(walker, half, later, float(goes), pose)
            if gap >= EASY:
                continue
            approach = (speed - turn * side) * along + turn * front * across
            if goes:
                leaves = (cosine * walker[2] + sine * walker[3]) * along + (
                    cosine * walker[3] - sine * walker[2]
                ) * across
                approach -= min(max(leaves, 0.0), max(approach, 0.0))
            if gap < least:
                least, towards = gap, approach
            moves = approach > 0.02 or (haste > 0.0 and approach > -AWAY * pace)
            if moves and seconds <= CERTAIN and gap < KEPT + AHEAD * max(approach, 0.0) + HASTY * haste:
                return 0.0, True
    if least >= EASY:
        return 0.0, False
    sure = max(0.0, 1.0 - seconds / BELIEVED)
    room = max(least, 0.0)
    closeness = (EASY - room) / EASY
    cost = 0.0
    if least < NEAR:
        cost += NEAR_COST * (NEAR - max(least, -NEAR)) / NEAR
    if towards < -0.5 * pace:
        return RETREAT * sure * cost, False
    cost += PERSON_COST * closeness * closeness * pace / top_speed
    if towards > 0.0:
        cost += HURRY_COST * max(0.0, towards / (GENTLE + SPEED_PER_METRE * room) - 1.0)
    cost += HURRY_COST * max(0.0, pace / (GENTLE + PASSING_SPEED_PER_METRE * room) - 1.0)
    return sure * cost, False


@njit(cache=True)
def crowd(
    weights: npt.NDArray[np.int32],
    resolution: float,
    left: float,
    bottom: float,
    walkers: Walkers,
    stays: Flags,
    held: npt.NDArray[np.float64],
) -> None:
    """Add to the weights of a search what it costs to pass people; what is blocked stays so.

    weights: (rows, columns), on cells of `resolution` metres from the corner `left`, `bottom`, metres; stays: (k,) who
    does not step aside: there another way is sought. Most people do, and cost little. held: (n, 2) places of the way
    that the robot is on, metres, where they cost less still: between ways that are equal it does not change its mind.
    """
    ours = np.zeros(weights.shape, np.bool_)
    for index in range(len(held)):
        r, c = math.floor((held[index, 1] - bottom) / resolution), math.floor((held[index, 0] - left) / resolution)
        ours[max(r - OURS, 0) : max(r + OURS + 1, 0), max(c - OURS, 0) : max(c + OURS + 1, 0)] = True
    reach = math.ceil(PASSING[1] / resolution)
    for index in range(len(walkers)):
        speed = math.sqrt(walkers[index, 2] ** 2 + walkers[index, 3] ** 2)
        share = 1.0 - (1.0 - HURRIES) * min(1.0, speed)
        x, y = walkers[index, 0] + LINGERS * walkers[index, 2], walkers[index, 1] + LINGERS * walkers[index, 3]
        row, column = math.floor((y - bottom) / resolution), math.floor((x - left) / resolution)
        for r in range(max(row - reach, 0), min(row + reach + 1, weights.shape[0])):
            for c in range(max(column - reach, 0), min(column + reach + 1, weights.shape[1])):
                away = math.hypot(left + (c + 0.5) * resolution - x, bottom + (r + 0.5) * resolution - y)
                if weights[r, c] <= 0 or away >= PASSING[1]:
                    continue
                closeness = min(1.0, (PASSING[1] - away) / (PASSING[1] - PASSING[0]))
                crowded = CROWDED * share * closeness * closeness
                weights[r, c] += int(crowded * YIELDED if ours[r, c] else crowded)
                if stays[index] and away < PASSING[0]:
                    weights[r, c] += int(BODILY * share)


class Stubborn:
    """Who did not step aside when the robot came near, remembered so that it does not try the same again at once."""

    def __init__(self) -> None:
        self._place = np.zeros((0, 2))
        self._left = np.zeros(0, np.int64)  # periods

    def among(self, walkers: Walkers, robot: tuple[float, float]) -> Flags:
        """Say which of the walkers (k, 4) are known to stay, a period after the last call; robot: x, y in metres."""
        left = np.zeros(len(walkers), np.int64)
        lost = []
        for index in np.flatnonzero(self._left > 1):
            away = np.hypot(*(walkers[:, :2] - self._place[index]).T)
            nearest = int(np.argmin(away)) if len(walkers) else -1
            if nearest >= 0 and away[nearest] < SAME:
                left[nearest] = max(left[nearest], self._left[index] - 1)
            else:
                lost.append(index)
        near = np.hypot(walkers[:, 0] - robot[0], walkers[:, 1] - robot[1]) < STUBBORN
        left[near & (np.hypot(walkers[:, 2], walkers[:, 3]) < STANDS)] = REMEMBERED
        stays = left > 0
        self._place = np.concatenate([walkers[stays, :2], self._place[lost]])
        self._left = np.concatenate([left[stays], self._left[lost] - 1])
        return stays


def nearby(walkers: Walkers, x: float, y: float, reach: float) -> Walkers:
    """Return those within reach metres of a place, in their order."""
    away = np.hypot(walkers[:, 0] - x, walkers[:, 1] - y)
    return np.ascontiguousarray(walkers[away < reach])


@njit(cache=True)
def apart(points: npt.NDArray[np.float64], places: npt.NDArray[np.float64], radius: float) -> Flags:
    """Say which of the points (n, 2) are farther than `radius` from each of the places (k, 2), metres."""
    result = np.ones(len(points), np.bool_)
    for i in range(len(points)):
        for j in range(len(places)):
            if (points[i, 0] - places[j, 0]) ** 2 + (points[i, 1] - places[j, 1]) ** 2 < radius * radius:
                result[i] = False
                break
    return result
