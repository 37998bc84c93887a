"""The buffer map of a session, its movable probabilities and its classes (paper section III-C, steps 3 to 5).

A buffer is the refined map, which is permanent or ground, and what the session saw besides. The two are kept apart:
only the new points are traced and classified, and the known ones, a hundred times as many, are shared by all sessions.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from operators.annotation.floor import Booleans, floor_points
from operators.annotation.pieces import NOWHERE, flat_pieces, share_of_piece
from operators.annotation.session import (
    GROUND,
    LONG_TERM,
    PERMANENT,
    SHORT_TERM,
    UNCERTAIN,
    Floats,
    Labels,
    Session,
)
from operators.pointmap import MapPoints, PointMap, VoxelMap, find_ground, height_above
from operators.pointmap import Settings as MapSettings
from operators.pointray import PointRay, RaySettings
from operators.pointray.looks import FREE

POOL = 0.09  # metres: three voxels


class Classing(NamedTuple):
    """How probabilities become classes."""

    short: float = 0.6  # movable above; paper: 0.7
    long: float = 0.5  # movable below, but not part of the map; paper: 0.4
    ground: float = 0.05  # metres from the plane; the truth of simulators ends there too
    clearance: float = 0.01
    apart: float = 0.04  # metres from the known map: what is nearer is the known surface, measured with noise
    permanent: Literal["plane", "ring"] = "plane"  # "ring" as the authors
    ring: float = 0.10  # metres around the map, and around what can move
    thickness: float = 0.04  # metres from the plane of the nearest permanent point
    alike: float = 0.8  # cosine between its normal and that of the point that joins
    growth: float = 0.15  # metres along it
    piece: float = 0.6  # share of a flat piece; where so much of it joins all of it does, and none of it where less


class KnownMap(NamedTuple):
    """A refined map, ready to be searched."""

    voxels: VoxelMap
    labels: Labels  # (n,) permanent or ground
    plane: npt.NDArray[np.float64] | None  # (a, b, c) of the ground


def known_map(cloud: MapPoints, settings: Classing | None = None, voxel: float = 0.03) -> KnownMap:
    """Prepare a refined map: everything in it is permanent or ground."""
    settings = Classing() if settings is None else settings
    voxels = VoxelMap(voxel)
    voxels.insert(cloud.points, cloud.normals, cloud.scores, -1)
    return KnownMap(voxels, *ground_or(voxels.cloud(), PERMANENT, settings))


def ground_or(
    cloud: MapPoints, other: int, settings: Classing, plane: npt.NDArray[np.float64] | None = None
) -> tuple[Labels, npt.NDArray[np.float64] | None]:
    """Return a class (n,) for points near the ground, another for all others, and the plane of the ground."""
    labels = np.full(len(cloud.points), other, np.uint8)
    plane = find_ground(cloud.points, cloud.normals) if plane is None else plane
    if plane is not None:
        labels[floor_points(cloud.points, plane, settings.ground, settings.clearance)] = GROUND
    return labels, plane


class Buffer(NamedTuple):
    """The map of one session: what was known before, and what the session saw besides."""

    known: KnownMap
    known_labels: Labels  # (n,)
    new: MapPoints  # with movable and label
    apart: float  # metres between any new point and the nearest known one, at least


def new_points(
    known: VoxelMap, session: Session, settings: MapSettings | None = None, apart: float = Classing().apart
) -> VoxelMap:
    """Map the valid frames of a session at their own poses, unaligned, what is `apart` metres from the known map."""
    pointmap = PointMap(settings)
    for number, scan in enumerate(session):
        if scan.valid:
            enter_new(pointmap, known, scan.points, scan.world_from_lidar, number, apart)
    return pointmap.map


def enter_new(
    pointmap: PointMap,
    known: VoxelMap,
    points: npt.NDArray[np.float32],
    world_from_lidar: npt.NDArray[np.float64],
    number: int,
    apart: float,
) -> None:
    """Add to a map those subsampled points of a frame (n, 3) that the known map does not have."""
    frame = pointmap.prepare(points)
    world, normals = frame.moved(world_from_lidar)
    found, _ = known.nearest(world, apart)
    fresh = np.flatnonzero(found < 0)
    pointmap.map.insert(world[fresh], normals[fresh], frame.scores[fresh], number)


def trace_new(new: VoxelMap, session: Session, rays: RaySettings) -> Floats:
    """Return the movable probabilities (k,) of the new points, by the frames of their own session.

    The known points need none: they are permanent or ground. To leave them out makes the tracing several times faster.
    """
    tracer = PointRay(new, rays)
    for scan in session:
        if scan.valid:
            tracer.add(scan.points, scan.world_from_lidar)
    return pooled(tracer)


def pooled(tracer: PointRay, edge: float = POOL) -> Floats:
    """Return movable probabilities (k,); points that were hardly looked at take that of their surroundings.

    edge: of the cubes whose looks are put together where a point's own are too few, metres. People pass quickly: of one
    point of them there may be five looks, of the nine around it fifty.
    """
    movable, looks = tracer.movable(), tracer.looks()
    few = looks < tracer.settings.least_looks
    if not few.any():
        return movable
    cells = np.floor(tracer.voxels.points / edge).astype(np.int64)
    keys = (cells[:, 0] << 42) ^ ((cells[:, 1] & 0x1FFFFF) << 21) ^ (cells[:, 2] & 0x1FFFFF)
    _, cube = np.unique(keys, return_inverse=True)
    free = tracer.counts[: len(looks), FREE]
    looks_of, free_of = np.bincount(cube, looks), np.bincount(cube, free)
    told = few & (looks_of[cube] >= tracer.settings.least_looks)
    movable[told] = (free_of[cube[told]] / looks_of[cube[told]]).astype(np.float32)
    return movable


def classify(known: KnownMap, new: MapPoints, settings: Classing | None = None) -> Buffer:
    """Give each new point its class, in the order of overwriting: shortT, longT, permanent, ground.

    new: with movable probabilities. Raises ValueError without them.
    """
    settings = Classing() if settings is None else settings
    if new.movable is None:
        raise ValueError("points are classified by their movable probabilities; these have none")
    labels = np.full(len(new.points), UNCERTAIN, np.uint8)
    labels[new.movable > settings.short] = SHORT_TERM
    labels[new.movable < settings.long] = LONG_TERM
    known_labels = known.labels
    if settings.permanent == "plane":
        extend_along_planes(known, new, labels, settings)
    else:
        touched = extend_by_ring(known.voxels, new, labels, settings)
        known_labels = np.where(touched & (known_labels == PERMANENT), UNCERTAIN, known_labels).astype(np.uint8)
    plane = find_ground(new.points, new.normals) if known.plane is None else known.plane
    if plane is not None:
        floor = np.abs(height_above(plane, new.points)) < settings.ground
        labels[floor] = GROUND
    return Buffer(known, known_labels, new._replace(label=labels), settings.apart)


def subset(cloud: MapPoints, chosen: Booleans) -> VoxelMap:
    """Return a map of the chosen points alone."""
    voxels = VoxelMap()
    voxels.insert(cloud.points[chosen], cloud.normals[chosen], cloud.scores[chosen], 0)
    return voxels


def extend_by_ring(known: VoxelMap, new: MapPoints, labels: Labels, settings: Classing) -> Booleans:
    """Call permanent what is new within the ring of the known, but nothing within the ring of what can move.

    As the authors do it. Returns which known points (n,) are near something movable: they become uncertain.
    """
    found, _ = known.nearest(new.points, settings.ring)
    near = found >= 0
    remaining = subset(new, ~near & ((labels == LONG_TERM) | (labels == SHORT_TERM)))
    found, _ = remaining.nearest(new.points, settings.ring)
    labels[near & (found < 0)] = PERMANENT
    found, _ = remaining.nearest(known.points, settings.ring)
    return found >= 0


def extend_along_planes(known: KnownMap, new: MapPoints, labels: Labels, settings: Classing) -> None:
    """Call permanent what continues the planes of the known: holes in walls close, what stands before them stays out.

    A new point that nobody saw through joins when the nearest permanent point is near, its plane passes through the
    point, and both face the same way. What is flat belongs together: the edge of a hole in a wall is nearly all of its
    piece, the edge of a shut door is a small part. Ground does not grow: it would climb up the legs of the furniture.
    """
    candidates = np.flatnonzero(labels != SHORT_TERM)
    upright = known.labels == PERMANENT
    if not len(candidates) or not upright.any():
        return
    points, normals = new.points[candidates], new.normals[candidates]
    found, _ = known.voxels.nearest(points, settings.growth)
    offset = ((points - known.voxels.points[found]) * known.voxels.normals[found]).sum(axis=1)
    alike = np.abs((normals * known.voxels.normals[found]).sum(axis=1)) > settings.alike
    joins = (found >= 0) & upright[found] & alike & (np.abs(offset) < settings.thickness)
    pieces = flat_pieces(points, normals)
    joins = np.where(pieces == NOWHERE, joins, share_of_piece(pieces, joins) >= settings.piece)
    labels[candidates[joins]] = PERMANENT
