"""Bring the classes of a buffer back to the frames (paper section III-C, step 6)."""

from __future__ import annotations

import numpy as np

from graph.geometry import transform
from operators.annotation.buffer import Buffer
from operators.annotation.session import UNCERTAIN, Labels, Scan

REACH = 0.2  # metres; a point without any point of the buffer near it stays uncertain


def project(buffer: Buffer, scan: Scan) -> Labels:
    """Return the class (n,) of each point of a frame: that of the nearest point of the buffer."""
    labels = np.full(len(scan.points), UNCERTAIN, np.uint8)
    world = transform(scan.world_from_lidar, scan.points)
    found, _ = buffer.voxels.nearest(world, REACH)
    near = found >= 0
    labels[near] = buffer.labels[found[near]]
    return labels
