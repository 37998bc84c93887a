"""Which sessions may refine the map and teach: told by nothing that a robot cannot know."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from operators.annotation.session import Scan, Session
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
    most_seen_through: float = 0.025  # share of the long walls that it looked at; poses a hand's breadth off give 0.04


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


def known_points(voxels: VoxelMap, scan: Scan, angular_radius: float) -> tuple[int, int]:
    """Count the points of a frame above the floor, and those of them within 0.1 m of a point of the map.

    The frame is subsampled by 0.1 m. angular_radius: of the neighbourhoods of its normals, radians.
    """
    frame = prepare(scan.points, voxel_size=0.1, angular_radius=angular_radius)
    if not len(frame.points):
        return 0, 0
    world, normals = frame.moved(scan.world_from_lidar)
    plane = find_ground(world, normals)
    heights = world[:, 2] if plane is None else height_above(plane, world)
    above = world[heights > ABOVE]
    found, _ = voxels.nearest(above, NEAR)
    return len(above), int((found >= 0).sum())


def gather_evidence(
    session: Session,
    voxels: VoxelMap,
    targets: npt.NDArray[Any] | None = None,
    radius: float = 0.9,
    angular_radius: float = 1.5 * math.radians(1.33),
) -> Evidence:
    """Look at a session's poses and at what each tenth frame saw.

    targets: (k, 2) world, metres; NaN for those that the robot was never given; None where there were none.
    """
    path, inliers = np.zeros((len(session), 2)), np.zeros(len(session))
    frames, invalid, seen, known = 0, 0, 0, 0
    for scan in session:
        path[frames], inliers[frames] = scan.world_from_lidar[:2, 3], scan.inliers
        invalid += not scan.valid
        if frames % EVERY == 0:
            counts = known_points(voxels, scan, angular_radius)
            seen, known = seen + counts[0], known + counts[1]
        frames += 1
    wanted = np.zeros((0, 2)) if targets is None else np.asarray(targets, np.float64)
    return Evidence(
        frames=frames,
        targets=len(wanted),
        reached=targets_reached(path[:frames], wanted, radius),
        invalid=invalid,
        inliers=float(np.median(inliers[:frames])) if frames else 0.0,
        overlap=known / seen if seen else 0.0,
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
