"""The initial map: one tour of a nearly empty building, without what moved in it (paper section III-C)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import transform
from operators.annotation.alignment import Aligned, align_session
from operators.annotation.buffer import pooled
from operators.annotation.floor import floor_points
from operators.annotation.session import GROUND, PERMANENT, Floats, Scan, Session
from operators.pointmap import MapPoints, VoxelMap, find_ground
from operators.pointmap import Settings as MapSettings
from operators.pointray import PointRay, RaySettings

REACH = 0.1  # metres from a point of a frame to the point of the map that answers for it


@dataclass(frozen=True)
class Without:
    """A session without the points of its frames that lie nearest to something movable."""

    session: Aligned
    voxels: VoxelMap
    movable: Floats  # (n,) of the points of the map
    threshold: float

    @property
    def name(self) -> str:
        """Return the name of the session."""
        return self.session.name

    def __len__(self) -> int:
        return len(self.session)

    def __iter__(self) -> Iterator[Scan]:
        for scan in self.session:
            found, _ = self.voxels.nearest(transform(scan.world_from_lidar, scan.points), REACH)
            stays = (found < 0) | (self.movable[found] <= self.threshold)
            yield scan._replace(points=scan.points[stays])


class FirstMap(NamedTuple):
    """A map and what is known about how it came to be."""

    cloud: MapPoints
    frames: int
    invalid: int  # frames that could not be aligned
    inliers: float  # median
    dropped: float  # share of the points of the first pass that moved


def first_map(
    session: Session,
    *,
    rays: RaySettings | None = None,
    threshold: float = 0.7,
    settings: MapSettings | None = None,
    tolerance: float = 0.05,
) -> FirstMap:
    """Map a session, trace the map by its own frames, drop from the frames what moved, and map again.

    threshold: movable probability beyond which points are dropped. tolerance: metres, of what is called ground.
    """
    aligned, pointmap = align_session(session, settings=settings)
    tracer = PointRay(pointmap.map, rays)
    for scan in aligned:
        if scan.valid:
            tracer.add(scan.points, scan.world_from_lidar)
    movable = pooled(tracer)
    cleaned, again = align_session(Without(aligned, pointmap.map, movable, threshold), settings=settings)
    cloud = again.map.cloud()
    found, _ = pointmap.map.nearest(cloud.points, REACH)
    movable_again = np.where(found >= 0, movable[found], np.float32(0.5)).astype(np.float32)
    chosen = np.flatnonzero(movable_again <= threshold)
    chosen = chosen[without_doubles(cloud.kept(chosen), again.map.voxel_size)]
    cloud = cloud.kept(chosen)._replace(movable=movable_again[chosen])
    labels = np.full(len(cloud.points), PERMANENT, np.uint8)
    plane = find_ground(cloud.points, cloud.normals)
    if plane is not None:
        labels[floor_points(cloud.points, plane, tolerance, 0.01)] = GROUND
    return FirstMap(
        cloud._replace(label=labels),
        len(cleaned),
        sum(not valid for _, valid, _ in cleaned.scans),
        float(np.median([inliers for _, _, inliers in cleaned.scans])) if len(cleaned) else 0.0,
        float((movable > threshold).mean()) if len(movable) else 0.0,
    )


def without_doubles(cloud: MapPoints, voxel: float) -> npt.NDArray[np.int64]:
    """Return which points of a map to keep (k,), neighbours in space beside each other: one in each shifted voxel too.

    A floor at height 0 lies on the border of two layers of voxels and fills both: half of a building's points say
    nothing new. On a grid that is shifted by half a voxel one of each two stays, the one with the better normal.
    """
    shifted = MapPoints(cloud.points + np.float32(0.5 * voxel), cloud.normals, cloud.scores)
    best = np.argsort(-cloud.scores, kind="stable")
    voxels = VoxelMap(voxel)
    voxels.insert(shifted.points[best], shifted.normals[best], np.zeros(len(best), np.float32), 0)
    found, _ = voxels.nearest(shifted.points, 1e-4 * voxel)
    kept = np.zeros(len(best), np.bool_)
    _, first = np.unique(found[best], return_index=True)
    kept[best[first[-len(voxels) :]]] = True
    chosen = np.flatnonzero(kept)
    places = VoxelMap(voxel)
    return chosen[places.insert_map(cloud.kept(chosen))]
