"""A map with fewer points and fewer bits, small enough to lie beside the code."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from operators.pointmap.voxel_map import MapPoints
from operators.pointmap.voxels import central_points

LEVEL = 0.9  # vertical part of a normal, of what lies level
WIDER = 2.5  # voxels of level surfaces to those of others: they hold only the height
PLACES, DIRECTIONS, SHARES = 500.0, 64.0, 16.0  # steps a metre; of a normal; of a score or a probability


def thinned(cloud: MapPoints, grain: float) -> MapPoints:
    """Keep of each voxel of `grain` metres the point nearest its centre; of level surfaces, of voxels 2.5 times that.

    Coordinates are rounded to 2 mm, normals to 1/64, scores and movable probabilities to 1/16, so that they pack well.
    """
    level = np.abs(cloud.normals[:, 2]) > LEVEL
    rows = []
    for part, size in ((np.flatnonzero(~level), grain), (np.flatnonzero(level), WIDER * grain)):
        x, y, z = np.ascontiguousarray(cloud.points[part].T)
        rows.append(part[central_points(x, y, z, size)])
    few = cloud.kept(np.sort(np.concatenate(rows)))
    return MapPoints(
        _rounded(few.points, PLACES),
        _rounded(few.normals, DIRECTIONS),
        _rounded(few.scores, SHARES),
        None if few.movable is None else _rounded(few.movable, SHARES),
        few.label,
    )


def _rounded(values: npt.NDArray[np.float32], steps: float) -> npt.NDArray[np.float32]:
    return (np.round(values * steps) / steps).astype(np.float32)
