"""Where frames were taken, for sessions that no localizer has seen: PointMap from the odometry on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graph.geometry import Matrix, inverse
from operators.annotation.session import Scan, Session
from operators.pointmap import MapPoints, PointMap
from operators.pointmap import Settings as MapSettings

LEVEL = 1e-9  # metres, or one minus the cosine of a tilt: the odometry knows of no slope


@dataclass(frozen=True)
class Aligned:
    """A session whose frames have other poses, and perhaps fewer points."""

    session: Session
    scans: list[tuple[Matrix, bool, float]]  # world_from_lidar, valid, inliers of each frame

    @property
    def name(self) -> str:
        """Return the name of the session."""
        return self.session.name

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        for scan, (pose, valid, inliers) in zip(self.session, self.scans, strict=True):
            yield scan._replace(world_from_lidar=pose, valid=valid, inliers=inliers)


def align_session(
    session: Session, initial: MapPoints | None = None, settings: MapSettings | None = None
) -> tuple[Aligned, PointMap]:
    """Align each frame with the map that grows from the initial one, as the localizer does; returns poses and map.

    Without odometry a frame starts where the last one was.
    """
    pointmap = PointMap(settings, initial=initial)
    world_from_odom, last = np.eye(4), np.eye(4)
    poses: list[tuple[Matrix, bool, float]] = []
    for scan in session:
        mount = np.eye(4) if scan.base_from_lidar is None else scan.base_from_lidar
        odom_from_base = last if scan.odom_from_base is None else scan.odom_from_base
        level = scan.odom_from_base is not None and is_level(odom_from_base)
        track = pointmap.track(scan.points, world_from_odom @ odom_from_base @ mount, mount if level else None)
        world_from_base = track.world_from_lidar @ inverse(mount)
        if scan.odom_from_base is None:
            last = world_from_base
        elif track.valid:
            world_from_odom = world_from_base @ inverse(odom_from_base)
        poses.append((track.world_from_lidar, track.valid, track.inliers))
    return Aligned(session, poses), pointmap


def is_level(pose: Matrix) -> bool:
    """Say whether a pose (4, 4) has neither height nor tilt."""
    return bool(abs(pose[2, 3]) < LEVEL and abs(pose[2, 2] - 1.0) < LEVEL)
