"""People in the lidar's blind ring: remembered there for as long as the frame has a shadow where they stand.

Nearer than 0.9 m the lidar is blind, but rays that somebody swallows return nothing: in a building every direction has
an echo, or something near has taken it. Whoever was followed into the ring is there as long as such a gap is, and moves
with it; where rays at the height of a trunk return from farther away, nobody stands.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from operators.navigation.people import Walkers

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

SECTORS = 120  # of 3 degrees: a thigh at arm's length is twice as wide
BLIND = 1.15  # metres from the lidar: nearer, some or all of a person has no echo
LEAST, MOST = 0.6, 0.78  # metres at which somebody stands who has just gone where nothing tells how near
SEEN = 0.15  # seconds: who was seen in the last frame or so
ASIDE = math.radians(30.0)  # that a gap may have moved since the last frame but some
NARROW = math.radians(60.0)  # a wider gap is that of a wall or a table
SHADOW = math.radians(9.0)  # half of a person's
FOLLOWING = 0.5  # share of the way into a gap by which a frame moves somebody
DOUBTS = 5  # frames without a gap after which nobody is there
MEMORY = 50  # frames for which a wide gap, of a wall or a table, may hide somebody
REST, RECEDING = 0.72, 0.4  # metres to which people step back, and the share of the missing way in a frame
STRANGER = math.radians(5.0), math.radians(22.0)  # half a gap that nothing explains: somebody's; wider, some people's
NOWHERE = math.radians(75.0)  # half a gap where the lidar does not look at all
NOTICED = 2  # frames of such a gap after which it counts
ONE = 0.25  # metres: two nearer to each other are one
TRUNK = 0.45, 1.4  # metres above the floor: lower, rays pass between the legs
BREADTH = 0.25  # metres: half of what somebody hides


class Hidden(NamedTuple):
    """Somebody in the ring whom the lidar does not see."""

    identity: int  # below 0: a stranger's
    x: float  # metres, world
    y: float
    doubts: int  # frames in a row without a gap
    frames: int  # since the last sighting


def gaps(passed: Flags) -> list[tuple[float, float]]:
    """Return the middle and half the width, in radians, of each run of two or more sectors that no ray passed."""
    if not passed.any():
        return [(0.0, math.pi)]
    count, first = len(passed), int(np.argmax(passed))
    empty = np.flatnonzero(~np.roll(passed, -first))
    found = []
    for run in np.split(empty, np.flatnonzero(np.diff(empty) > 1) + 1):
        if len(run) >= 2:
            middle = (first + 0.5 * float(run[0] + run[-1] + 1)) * 2.0 * math.pi / count
            found.append((middle, len(run) * math.pi / count))
    return found


def _occupied(bearing: Floats) -> Flags:
    """Say of each sector (SECTORS,) whether one of the bearings (n,), radians, lies in it."""
    sector = np.floor(bearing * (SECTORS / (2.0 * math.pi))).astype(np.int64) % SECTORS
    return np.asarray(np.bincount(sector, minlength=SECTORS) > 0)


def _turn(to: float, origin: float) -> float:
    return (to - origin + math.pi) % (2.0 * math.pi) - math.pi


class Presence:
    """Who is around, those included who went where the lidar is blind."""

    def __init__(self) -> None:
        self.hidden: list[Hidden] = []
        self.strangers = 0
        self._passed: Flags = np.ones(SECTORS, np.bool_)
        self._things: Flags = np.zeros(SECTORS, np.bool_)
        self._eye = (0.0, 0.0)

    def observe(self, points: npt.NDArray[np.float32], world_from_lidar: Floats, things: Floats) -> None:
        """Take in what a frame shows, people too: points (n, 3) in the lidar frame.

        things: places (m, 2) of what is known to stand in the ring, in the world: it swallows rays, too.
        """
        x, y, z = points.astype(np.float64).T
        at_somebody = world_from_lidar[2, 3] + z / np.maximum(np.hypot(x, y), 1e-6) * REST  # height of the ray there
        trunk = (at_somebody > TRUNK[0]) & (at_somebody < TRUNK[1])
        turn = math.atan2(world_from_lidar[1, 0], world_from_lidar[0, 0])
        self._passed = _occupied(np.arctan2(y[trunk], x[trunk]) + turn)
        self._eye = float(world_from_lidar[0, 3]), float(world_from_lidar[1, 3])
        self._things = _occupied(np.arctan2(things[:, 1] - self._eye[1], things[:, 0] - self._eye[0]))

    def company(self, identity: npt.NDArray[np.int32], walkers: Walkers, unseen: npt.NDArray[np.float32]) -> Walkers:
        """Return the people (k, 4) to keep clear of, from those (n, 4) whom a tracker follows.

        unseen: (n,) seconds since each was seen. Who is not seen and in the ring is where the gaps say.
        """
        eye = np.array(self._eye)
        offset = walkers[:, :2] - eye
        away = np.hypot(offset[:, 0], offset[:, 1])
        seen = unseen < SEEN
        known = {person.identity for person in self.hidden}
        for index in np.flatnonzero(~seen & (away < BLIND)):
            if int(identity[index]) not in known:
                share = min(max(float(away[index]), LEAST), MOST) / max(float(away[index]), 1e-6)
                x, y = eye + share * offset[index]
                self.hidden.append(Hidden(int(identity[index]), float(x), float(y), 0, 0))
        self.hidden = self._looked_for(gaps(self._passed), set(identity[seen].tolist()))
        self._notice()
        believed = [one for one in self.hidden if one.identity >= 0 or one.frames >= NOTICED]
        still = np.array([[one.x, one.y, 0.0, 0.0] for one in believed]).reshape(-1, 4)
        return np.concatenate([walkers[seen | (away >= BLIND)], still])

    def _looked_for(self, empty: list[tuple[float, float]], again: set[int]) -> list[Hidden]:
        """Move the hidden to their gaps; let go of those looked through, seen at once, or one with another."""
        kept: list[Hidden] = []
        for person in self.hidden:
            if person.identity in again and person.frames == 0:
                continue
            x, y = person.x - self._eye[0], person.y - self._eye[1]
            away, bearing = math.hypot(x, y), math.atan2(y, x)
            nearest, middle, half = math.inf, 0.0, 0.0
            for centre, width in empty:
                off = abs(_turn(centre, bearing)) - width
                if off < nearest:
                    nearest, middle, half = off, centre, width
            if nearest < ASIDE and away < BLIND:
                doubts = 0 if half < 0.5 * NARROW or person.frames < MEMORY else DOUBTS
                off = _turn(middle, bearing)
                bearing += FOLLOWING * math.copysign(max(0.0, abs(off) - max(0.0, half - SHADOW)), off)
            else:
                doubts = person.doubts + 1
            away += max(0.0, RECEDING * (REST - away))
            place = self._eye[0] + away * math.cos(bearing), self._eye[1] + away * math.sin(bearing)
            if doubts < DOUBTS and all(math.dist(place, (other.x, other.y)) > ONE for other in kept):
                kept.append(Hidden(person.identity, *place, doubts, person.frames + 1))
        return kept

    def _notice(self) -> None:
        """Suspect somebody in each direction that no ray passed and that neither a thing nor anybody known explains."""
        explained = self._passed | self._things | np.roll(self._things, 1) | np.roll(self._things, -1)
        for one in self.hidden:
            away, bearing = math.dist((one.x, one.y), self._eye), math.atan2(one.y - self._eye[1], one.x - self._eye[0])
            half = math.asin(min(1.0, BREADTH / max(away, 1e-6))) * SECTORS / (2.0 * math.pi)
            middle = bearing * SECTORS / (2.0 * math.pi)
            explained[np.arange(math.floor(middle - half), math.floor(middle + half) + 1) % SECTORS] = True
        for middle, half in gaps(explained):
            if not STRANGER[0] <= half <= NOWHERE:
                continue
            count = math.ceil(half / STRANGER[1])
            for index in range(count):
                bearing = middle + half * ((2 * index + 1) / count - 1.0)
                self.strangers += 1
                x, y = self._eye[0] + REST * math.cos(bearing), self._eye[1] + REST * math.sin(bearing)
                self.hidden.append(Hidden(-self.strangers, x, y, 0, 0))
