"""The buffer map of a session, its movable probabilities and its classes (paper section III-C, steps 3 to 5)."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from operators.annotation.floor import floor_points
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
from operators.pointmap import MapPoints, PointMap, VoxelMap, find_ground
from operators.pointmap import Settings as MapSettings
from operators.pointray import PointRay, RaySettings


class Classing(NamedTuple):
    """How probabilities become classes."""

    short: float = 0.7  # movable above
    long: float = 0.4  # movable below, but not part of the map
    ground: float = 0.05  # metres from the plane; the truth of simulators ends there too
    clearance: float = 0.01
    permanent: Literal["plane", "ring"] = "plane"  # "ring" as the authors
    ring: float = 0.10  # metres around the map, and around what can move
    thickness: float = 0.04  # metres from the plane of the nearest permanent point
    growth: float = 0.12  # metres along it, at each step
    steps: int = 4


class Buffer(NamedTuple):
    """The map of one session: what was known before, then what the session saw besides."""

    voxels: VoxelMap
    known: int  # points of the refined map, the first ones
    movable: Floats  # (n,) probability; 0 for the known
    labels: Labels  # (n,)


def fill_buffer(refined: MapPoints, session: Session, settings: MapSettings | None = None) -> PointMap:
    """Map all valid frames of a session at their own poses on top of the refined map; no new alignment."""
    pointmap = PointMap(settings, initial=refined)
    for scan in session:
        if scan.valid:
            pointmap.enter(pointmap.prepare(scan.points), scan.world_from_lidar)
    return pointmap


def new_points(pointmap: PointMap) -> MapPoints:
    """Return the points that the session added to the refined map."""
    return pointmap.map.cloud().kept(pointmap.map.created >= 0)


def trace_new(news: MapPoints, session: Session, rays: RaySettings) -> Floats:
    """Return the movable probabilities (n,) of the new points, by the frames of their own session.

    The known points need none: they are permanent or ground. To leave them out makes the tracing several times faster.
    """
    voxels = VoxelMap()
    order = voxels.insert_map(news)
    tracer = PointRay(voxels, rays)
    for scan in session:
        if scan.valid:
            tracer.add(scan.points, scan.world_from_lidar)
    movable = np.full(len(news.points), 0.5, np.float32)
    movable[order] = tracer.movable()
    return movable


def classify(pointmap: PointMap, news_movable: Floats, settings: Classing | None = None) -> Buffer:
    """Give each point of a buffer its class, in the order of overwriting: shortT, longT, permanent, ground.

    news_movable: probabilities (k,) of the points that the session added, in their order.
    """
    settings = Classing() if settings is None else settings
    cloud = pointmap.map.cloud()
    new = pointmap.map.created >= 0
    movable = np.zeros(len(cloud.points), np.float32)
    movable[new] = news_movable
    labels = np.full(len(cloud.points), UNCERTAIN, np.uint8)
    labels[new & (movable > settings.short)] = SHORT_TERM
    labels[new & (movable < settings.long)] = LONG_TERM
    labels[~new] = PERMANENT
    extend = extend_along_planes if settings.permanent == "plane" else extend_by_ring
    extend(cloud, labels, new, settings)
    plane = find_ground(cloud.points, cloud.normals)
    if plane is not None:
        labels[floor_points(cloud.points, plane, settings.ground, settings.clearance)] = GROUND
    return Buffer(pointmap.map, int((~new).sum()), movable, labels)


def subset(cloud: MapPoints, chosen: np.ndarray) -> VoxelMap:
    """Return a map of the chosen points alone."""
    voxels = VoxelMap()
    voxels.insert(cloud.points[chosen], cloud.normals[chosen], cloud.scores[chosen], 0)
    return voxels


def extend_by_ring(cloud: MapPoints, labels: Labels, new: np.ndarray, settings: Classing) -> None:
    """Call permanent what is new within the ring of the known, but nothing within the ring of what can move.

    As the authors do it. Known points near something movable become uncertain.
    """
    found, _ = subset(cloud, ~new).nearest(cloud.points, settings.ring)
    near = found >= 0
    remaining = new & ~near & ((labels == LONG_TERM) | (labels == SHORT_TERM))
    found, _ = subset(cloud, remaining).nearest(cloud.points, settings.ring)
    touched = found >= 0
    labels[near & new & ~touched] = PERMANENT
    labels[~new & touched] = UNCERTAIN


def extend_along_planes(cloud: MapPoints, labels: Labels, new: np.ndarray, settings: Classing) -> None:
    """Call permanent what continues the planes of the known: holes in walls close, what stands before them stays out.

    A new point that nobody saw through joins when the nearest permanent point is near and its plane passes through the
    point; a few steps close the hole that a cupboard left.
    """
    candidates = np.flatnonzero(new & (labels != SHORT_TERM))
    front = ~new
    for _ in range(settings.steps):
        if not len(candidates) or not front.any():
            return
        chosen = np.flatnonzero(front)
        found, _ = subset(cloud, front).nearest(cloud.points[candidates], settings.growth)
        near = found >= 0
        candidates_near, nearest = candidates[near], chosen[found[near]]
        apart = (cloud.points[candidates_near] - cloud.points[nearest]) * cloud.normals[nearest]
        joins = candidates_near[np.abs(apart.sum(axis=1)) < settings.thickness]
        labels[joins] = PERMANENT
        front = np.zeros(len(labels), np.bool_)
        front[joins] = True
        candidates = candidates[labels[candidates] != PERMANENT]
