"""Bring the classes of a buffer back to the frames (paper section III-C, step 6)."""

from __future__ import annotations

import numpy as np

from graph.geometry import transform
from operators.annotation.session import UNCERTAIN, Labels, Scan
from operators.pointmap import MapPoints, VoxelMap

REACH = 0.2  # metres; a point without any point of the buffer near it stays uncertain


class Projector:
    """The points of a buffer, ready to be asked for the nearest."""

    def __init__(self, buffer: MapPoints, voxel: float = 0.03) -> None:
        """Take a buffer with labels. Raises ValueError where it has none."""
        if buffer.label is None:
            raise ValueError("labels are projected from a buffer with classes; this one has none")
        self.voxels = VoxelMap(voxel)
        self.labels: Labels = buffer.label[self.voxels.insert_map(buffer)]

    def project(self, scan: Scan) -> Labels:
        """Return the class (n,) of each point of a frame: that of the nearest point of the buffer."""
        labels = np.full(len(scan.points), UNCERTAIN, np.uint8)
        found, _ = self.voxels.nearest(transform(scan.world_from_lidar, scan.points), REACH)
        near = found >= 0
        labels[near] = self.labels[found[near]]
        return labels
