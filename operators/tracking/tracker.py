"""Who is who: points of moving people, frame by frame, made into tracks.

A point belongs to whomever it is nearest to, where that person is expected; the rest forms clumps, and a clump that is
seen a few times is a person. Who enters the lidar's blind ring is believed to slow down there, and is kept for a while.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from operators.tracking.clusters import centres, clumps, nearest_of
from operators.tracking.filter import MEASUREMENT, Belief, corrected, met, nobody, predicted

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class Habits(NamedTuple):
    """How people look to a lidar, and how long they are remembered."""

    reach: float = 10.0  # metres from the lidar: farther away, people do not matter
    gate: float = 0.5  # metres from where somebody is expected: a pace, half a step wide
    near: float = 1.05  # metres from the lidar: of those nearer but a part echoes, which tells half as well where
    near_gate: float = 0.35  # metres: other people's points are not theirs
    nearest: float = 0.5  # metres from the lidar: nobody steps onto the robot
    cell: float = 0.15  # metres between points of one clump
    least: int = 4  # points of somebody new
    depth: float = 0.1  # metres from the middle of what is seen to the middle of the body, away from the lidar
    edge: float = 1.0  # metres from the lidar: nearer, it is the far side that is seen, farther the near side
    known: int = 3  # sightings that make a person
    apart: float = 0.25  # metres: two people nearer than this are one
    forgotten: float = 0.7  # seconds without being seen
    blind: float = 1.15  # metres from the lidar: nearer, there is no echo from some or all of a person
    blind_for: float = 3.0  # seconds that somebody is remembered there
    slowing: float = 1.0  # seconds in which somebody unseen there comes to rest
    fastest: float = 1.6  # m/s


def looking(habits: Habits) -> Habits:
    """Return the habits with a second sensor that shows people in the ring where the lidar is blind."""
    return habits._replace(near=0.0, edge=0.0, blind=0.0, nearest=0.3)


class People(NamedTuple):
    """Those who are known, in the order in which they were met."""

    identity: npt.NDArray[np.int32]  # (k,) from 1
    place: Floats  # (k, 2) metres, world
    velocity: Floats  # (k, 2) m/s, world
    unseen: Floats  # (k,) seconds since the last sighting


class Tracker:
    """Follows people from frame to frame."""

    def __init__(self, habits: Habits | None = None) -> None:
        self.habits = habits or Habits()
        self.belief: Belief = nobody()
        self.identity: Ints = np.zeros(0, np.int64)
        self.sightings: Ints = np.zeros(0, np.int64)
        self.unseen: Floats = np.zeros(0)
        self.met = 0

    def observe(self, points: Floats, lidar: tuple[float, float], seconds: float) -> People:
        """Take in the points (n, 2 or 3; world, metres) of people seen from `lidar`, `seconds` after the last frame."""
        habits = self.habits
        floor = np.ascontiguousarray(points[:, :2], np.float64)
        eye = np.array(lidar)
        floor = floor[((floor - eye) ** 2).sum(axis=1) < habits.reach**2]
        self._carry_on(eye, seconds)
        gates = np.where(self._within(eye, habits.near), habits.near_gate, habits.gate)
        group = nearest_of(self._outside(floor, eye), self.belief.place, gates)
        self._correct(floor, group, eye)
        rest = floor[group < 0]
        clump = clumps(rest, habits.cell)
        count = int(clump.max(initial=-1)) + 1
        middle, number = centres(rest, clump, count)
        self._meet(self._outside(middle, eye)[number >= habits.least])
        self._forget(eye)
        return self.people()

    def people(self) -> People:
        """Return who is known by now."""
        known = self.sightings >= self.habits.known
        return People(
            self.identity[known].astype(np.int32),
            self.belief.place[known],
            self.belief.velocity[known],
            self.unseen[known],
        )

    def _outside(self, seen: Floats, eye: Floats) -> Floats:
        """Move what is seen of people (n, 2), their near side or all that the blind ring leaves, to their middle."""
        distance = np.sqrt(((seen - eye) ** 2).sum(axis=1))
        depth = np.clip(distance - self.habits.edge, -self.habits.depth, self.habits.depth)
        return self._at(seen, eye, distance + depth)

    def _at(self, place: Floats, eye: Floats, distance: Floats) -> Floats:
        """Move places (k, 2) to some distance (k,) from the lidar, at the bearing that they have."""
        away = place - eye
        length = np.maximum(np.sqrt((away**2).sum(axis=1)), 1e-6)
        return np.asarray(eye + away * (distance / length)[:, None])

    def _carry_on(self, eye: Floats, seconds: float) -> None:
        """Expect everybody to go on; those whom nobody sees in the blind ring come to rest."""
        habits = self.habits
        self.belief = predicted(self.belief, seconds)
        hidden = self._within(eye, habits.blind) & (self.unseen > 0.0)
        slower = np.where(hidden, max(0.0, 1.0 - seconds / habits.slowing), 1.0)
        distance = np.sqrt(((self.belief.place - eye) ** 2).sum(axis=1))
        place = self._at(self.belief.place, eye, np.maximum(distance, habits.nearest))
        self.belief = self.belief._replace(place=place, velocity=self.belief.velocity * slower[:, None])
        self.unseen = self.unseen + seconds

    def _correct(self, floor: Floats, group: Ints, eye: Floats) -> None:
        middle, number = centres(floor, group, len(self.identity))
        seen = number > 0
        deviation = MEASUREMENT * np.sqrt(1.0 + 8.0 / np.maximum(number, 1))  # few points tell less of the whole
        place = self._outside(middle, eye)
        deviation = np.where(self._within(eye, self.habits.near), 2.0 * deviation, deviation)
        belief = corrected(self.belief, place, deviation, seen)
        speed = np.sqrt((belief.velocity**2).sum(axis=1))
        slower = np.minimum(1.0, self.habits.fastest / np.maximum(speed, 1e-9))
        self.belief = belief._replace(velocity=belief.velocity * slower[:, None])
        self.sightings = self.sightings + seen
        self.unseen = np.where(seen, 0.0, self.unseen)

    def _meet(self, places: Floats) -> None:
        self.belief = self.belief.joined(met(places))
        count = len(places)
        self.identity = np.concatenate([self.identity, self.met + 1 + np.arange(count)])
        self.sightings = np.concatenate([self.sightings, np.ones(count, np.int64)])
        self.unseen = np.concatenate([self.unseen, np.zeros(count)])
        self.met += count

    def _within(self, eye: Floats, distance: float) -> npt.NDArray[np.bool_]:
        return np.asarray(((self.belief.place - eye) ** 2).sum(axis=1) < distance**2)

    def _forget(self, eye: Floats) -> None:
        """Let go of those unseen for too long, of passing glances, and of the younger of two in one place."""
        habits = self.habits
        patience = np.where(self._within(eye, habits.blind), habits.blind_for, habits.forgotten)
        patience = np.where(self.sightings >= habits.known, patience, 0.15)
        keep = self.unseen <= patience
        place = self.belief.place
        for i in np.flatnonzero(keep):
            older = keep[:i] & (((place[:i] - place[i]) ** 2).sum(axis=1) < habits.apart**2)
            keep[i] = not older.any()
        self.belief = self.belief.kept(keep)
        self.identity, self.sightings, self.unseen = self.identity[keep], self.sightings[keep], self.unseen[keep]
