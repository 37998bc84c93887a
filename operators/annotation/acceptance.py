"""Which sessions may refine the map and teach: told by nothing that a robot cannot know."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from operators.annotation.session import Session
from operators.pointmap import VoxelMap, find_ground, height_above, prepare

EVERY = 10  # frames; the overlap needs no more
NEAR = 0.1  # metres from a point of the map
ABOVE = 0.2  # metres; one floor looks like any other


class Acceptance(NamedTuple):
    """What a session must show."""

    reached: bool = True  # its last target, by its own estimate
    radius: float = 0.9  # metres around a target
    largest_invalid: int = 0  # poses
    least_inliers: float = 0.7  # median over the frames
    least_overlap: float = 0.5  # share of what it saw above the floor that the map has
    least_frames: int = 10


class Evidence(NamedTuple):
    """What a session shows."""

    frames: int
    targets: int
    reached: int  # targets in their order, by the robot's own estimate
    invalid: int  # poses
    inliers: float  # median
    overlap: float


class Verdict(NamedTuple):
    """Whether a session is accepted, and if not, everything that speaks against it."""

    accepted: bool
    reasons: tuple[str, ...]
    evidence: Evidence


def targets_reached(path: npt.NDArray[Any], targets: npt.NDArray[Any], radius: float) -> int:
    """Return how many targets (k, 2) a path (n, 2) reached, one after the other, each within the radius in metres."""
    reached = 0
    for place in path:
        while reached < len(targets) and math.dist(place, targets[reached]) <= radius:
            reached += 1
    return reached


def overlap(voxels: VoxelMap, session: Session, angular_radius: float = 1.5 * math.radians(1.33)) -> float:
    """Return the share of the points above the floor that lie within 0.1 m of a point of the map.

    Every tenth frame is looked at, subsampled by 0.1 m. 0 for a session without such points.
    """
    seen, known = 0, 0
    for number in range(0, len(session), EVERY):
        scan = session[number]
        frame = prepare(scan.points, voxel_size=0.1, angular_radius=angular_radius)
        if not len(frame.points):
            continue
        world, normals = frame.moved(scan.world_from_lidar)
        plane = find_ground(world, normals)
        heights = world[:, 2] if plane is None else height_above(plane, world)
        above = world[heights > ABOVE]
        found, _ = voxels.nearest(above, NEAR)
        seen += len(above)
        known += int((found >= 0).sum())
    return known / seen if seen else 0.0


def gather_evidence(
    session: Session, voxels: VoxelMap, targets: npt.NDArray[Any] | None = None, radius: float = 0.9
) -> Evidence:
    """Look at a session's poses and at what it saw. targets: (k, 2) world, metres, or None where there were none."""
    path, invalid, inliers = np.zeros((len(session), 2)), 0, np.zeros(len(session))
    for number in range(len(session)):
        scan = session[number]
        path[number] = scan.world_from_lidar[:2, 3]
        invalid += not scan.valid
        inliers[number] = scan.inliers
    wanted = np.zeros((0, 2)) if targets is None else np.asarray(targets, np.float64)
    return Evidence(
        frames=len(session),
        targets=len(wanted),
        reached=targets_reached(path, wanted, radius),
        invalid=invalid,
        inliers=float(np.median(inliers)) if len(session) else 0.0,
        overlap=overlap(voxels, session),
    )


def judge(evidence: Evidence, settings: Acceptance | None = None) -> Verdict:
    """Accept a session, or say everything that speaks against it."""
    settings = Acceptance() if settings is None else settings
    e, against = evidence, []
    if e.frames < settings.least_frames:
        against.append(f"{e.frames} frames; {settings.least_frames} are needed")
    if settings.reached and e.reached < e.targets:
        against.append(f"target {e.reached + 1} of {e.targets} was not reached")
    if e.invalid > settings.largest_invalid:
        against.append(f"{e.invalid} of {e.frames} poses are not valid")
    if e.inliers < settings.least_inliers:
        against.append(f"{100 * e.inliers:.0f} % inliers; {100 * settings.least_inliers:.0f} % are needed")
    if e.overlap < settings.least_overlap:
        against.append(
            f"{100 * e.overlap:.0f} % of what it saw is in the map; {100 * settings.least_overlap:.0f} % are needed"
        )
    return Verdict(not against, tuple(against), evidence)


def accept(
    session: Session,
    voxels: VoxelMap,
    *,
    targets: npt.NDArray[Any] | None = None,
    settings: Acceptance | None = None,
) -> Verdict:
    """Judge a session against the map: last target reached, poses valid, inliers, overlap."""
    settings = Acceptance() if settings is None else settings
    return judge(gather_evidence(session, voxels, targets, settings.radius), settings)
