"""Drop from a map what sessions saw through (paper section III-C, step 1)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from operators.annotation.floor import floor_points
from operators.annotation.pieces import flat_pieces, length_of_piece, share_of_piece
from operators.annotation.session import Floats, Session
from operators.pointmap import MapPoints, VoxelMap, find_ground
from operators.pointray import PointRay, RaySettings


class Refinement(NamedTuple):
    """When a point leaves the map."""

    threshold: float = 0.9  # movable probability; high, for what is missed now will be caught by another session
    tolerance: float = 0.10  # metres; ground never leaves
    clearance: float = 0.10
    piece: float = 0.25  # share of a flat piece; where so much of it leaves, the rest leaves too
    longest: float = 3.0  # metres of such a piece: longer ones are walls


def trace_map(voxels: VoxelMap, session: Session, rays: RaySettings) -> tuple[Floats, npt.NDArray[np.int32]]:
    """Return movable probability and looks (n,) of the points of a map by the valid frames of one session."""
    tracer = PointRay(voxels, rays)
    for scan in session:
        if scan.valid:
            tracer.add(scan.points, scan.world_from_lidar)
    return tracer.movable(), tracer.looks()


def walls_of(cloud: MapPoints, settings: Refinement | None = None) -> npt.NDArray[np.bool_]:
    """Say of each point of a map (n,) whether it belongs to a flat upright piece too long to be moved."""
    settings = Refinement() if settings is None else settings
    pieces = flat_pieces(cloud.points, cloud.normals)
    return length_of_piece(pieces, cloud.points) > settings.longest


def seen_through(
    walls: npt.NDArray[np.bool_],
    movable: Floats,
    looks: npt.NDArray[np.int32],
    settings: Refinement | None = None,
    *,
    least_looks: int = RaySettings().least_looks,
) -> float:
    """Return what share of the walls (n,) a session says it saw through, of those with enough looks (n,).

    movable: (n,) probability. Whoever does so has wrong poses: ICP may settle on the other face of a wall, and all of
    its residuals be small.
    """
    settings = Refinement() if settings is None else settings
    known = walls & (looks >= least_looks)
    return float((movable[known] >= settings.threshold).mean()) if known.any() else 0.0


def refine(
    cloud: MapPoints, movable: Iterable[Floats], settings: Refinement | None = None
) -> tuple[MapPoints, npt.NDArray[np.bool_]]:
    """Return the map without what any session saw through, and which points stayed.

    movable: probabilities (n,) of the points of the map, one array for each accepted session. Ground always stays. What
    is flat moves as one: of the leaf of a door that turned a little, the half by the hinges is where it was, and one
    that was shut hides the place where it stood open.
    """
    settings = Refinement() if settings is None else settings
    worst = np.zeros(len(cloud.points), np.float32)
    for probabilities in movable:
        worst = np.maximum(worst, probabilities)
    stays = worst < settings.threshold
    pieces = flat_pieces(cloud.points, cloud.normals)
    follows = share_of_piece(pieces, ~stays) >= settings.piece
    stays &= ~(follows & (length_of_piece(pieces, cloud.points) <= settings.longest))
    plane = find_ground(cloud.points, cloud.normals)
    if plane is not None:
        stays |= floor_points(cloud.points, plane, settings.tolerance, settings.clearance)
    return cloud.kept(stays)._replace(movable=worst[stays]), stays
