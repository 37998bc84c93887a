"""Bring the classes of a buffer back to the frames (paper section III-C, step 6)."""

from __future__ import annotations

import numpy as np

from graph.geometry import transform
from operators.annotation.buffer import Buffer
from operators.annotation.session import UNCERTAIN, Labels, Scan
from operators.pointmap import VoxelMap

REACH = 0.2  # metres; a point without any point of the buffer near it stays uncertain


class Projector:
    """The points of a buffer, ready to be asked for the nearest."""

    def __init__(self, buffer: Buffer) -> None:
        """Take a buffer. Raises ValueError where its new points have no classes."""
        if buffer.new.label is None:
            raise ValueError("labels are projected from a buffer with classes; this one has none")
        self.known, self.known_labels = buffer.known.voxels, buffer.known_labels
        self.new = VoxelMap(self.known.voxel_size)
        self.new_labels: Labels = buffer.new.label[self.new.insert_map(buffer.new)]
        # A point nearer to the known than half of what lies between known and new has no new point nearer still.
        self.apart = buffer.apart

    def project(self, scan: Scan) -> Labels:
        """Return the class (n,) of each point of a frame: that of the nearest point of the buffer."""
        labels = np.full(len(scan.points), UNCERTAIN, np.uint8)
        world = transform(scan.world_from_lidar, scan.points)
        found, distance = self.known.nearest(world, REACH)
        near = found >= 0
        labels[near] = self.known_labels[found[near]]
        if len(self.new):
            doubtful = np.flatnonzero(distance >= 0.5 * self.apart)
            nearer, gap = self.new.nearest(world[doubtful], REACH)
            wins = (nearer >= 0) & (gap < distance[doubtful])
            labels[doubtful[wins]] = self.new_labels[nearer[wins]]
        return labels
