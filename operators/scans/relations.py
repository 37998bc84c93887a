"""Errors of a trajectory by relations: true motions between two moments (Kuemmerle et al., Autonomous Robots 2009).

A drift that has been closed counts once, where it arose, and no frame has to be aligned with another.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import Matrix, inverse, rotation_angle, wrap
from operators.scans.scan import ScanError
from operators.scans.session import placement
from operators.scans.stamps import nanoseconds
from operators.scans.trajectory import Trajectory

APART = 60.0  # seconds after which a place that is seen again is a revisit
REVISIT, ALIKE = 1.0, np.pi / 4  # metres and radians within which it is the same place, looked at the same way


class Relation(NamedTuple):
    """Where the robot was at the second moment, seen from where it was at the first."""

    first: int  # ns
    second: int
    motion: Matrix  # (4, 4) first_from_second


class RelationErrors(NamedTuple):
    """The error of each relation whose moments the trajectory covers, and how many it does not cover."""

    translation: npt.NDArray[np.float64]  # (n,) metres
    rotation: npt.NDArray[np.float64]  # (n,) radians
    missing: int


def read_relations(path: Path) -> list[Relation]:
    """Read lines `stamp stamp x y z roll pitch yaw`, seconds, metres, radians. Raises ScanError with the line."""
    found = []
    for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            if len(words) != 8:
                raise ValueError(
                    f"a relation has 8 numbers (two stamps, x y z, roll pitch yaw); there are {len(words)}"
                )
            motion = placement([float(word) for word in words[2:]])
            found.append(Relation(nanoseconds(words[0]), nanoseconds(words[1]), motion))
        except ValueError as error:
            raise ScanError(f"{path} line {number}: {str(error).removeprefix('base_from_lidar: ')}") from None
    if not found:
        raise ScanError(f"{path} holds no relations")
    return found


def relations_of(reference: Trajectory) -> list[Relation]:
    """Take motions of a trajectory for relations: between neighbouring poses, and from each to its nearest revisit.

    A revisit is a pose APART seconds later or more, within REVISIT metres and a heading within ALIKE radians: it counts
    what a loop that was not closed leaves. Raises ScanError without stamps.
    """
    if reference.stamps is None:
        raise ScanError("relations want stamps; without them nobody knows which poses belong together")
    stamps = reference.stamps.tolist()
    places = reference.poses[:, :3, 3]
    headings = np.arctan2(reference.poses[:, 1, 0], reference.poses[:, 0, 0])
    pairs = [(number - 1, number) for number in range(1, len(stamps))]
    for first in range(len(stamps)):
        away = np.linalg.norm(places - places[first], axis=1)
        again = (reference.stamps >= stamps[first] + APART * 1e9) & (np.abs(wrap(headings - headings[first])) < ALIKE)
        again &= away < REVISIT
        if again.any():
            pairs.append((first, int(np.argmin(np.where(again, away, np.inf)))))
    poses = reference.poses
    return [Relation(stamps[a], stamps[b], inverse(poses[a]) @ poses[b]) for a, b in pairs]


def relation_errors(estimate: Trajectory, relations: list[Relation]) -> RelationErrors:
    """Compare the motions of an estimate with the true ones; poses between stamps are interpolated.

    Raises ScanError if the estimate covers no relation.
    """
    if estimate.stamps is None:
        raise ScanError("relations want stamps; the estimate has none")
    translation, rotation = [], []
    for relation in relations:
        first, second = estimate.at(relation.first), estimate.at(relation.second)
        if first is None or second is None:
            continue
        wrong = inverse(relation.motion) @ inverse(first.pose) @ second.pose
        translation.append(float(np.linalg.norm(wrong[:3, 3])))
        rotation.append(rotation_angle(wrong))
    if not translation:
        raise ScanError(
            f"the estimate covers none of the {len(relations)} relations: it is from {estimate.stamps[0] / 1e9:.3f} to "
            f"{estimate.stamps[-1] / 1e9:.3f} s, they begin at {relations[0].first / 1e9:.3f} s; --offset shifts it"
        )
    return RelationErrors(np.array(translation), np.array(rotation), len(relations) - len(translation))
