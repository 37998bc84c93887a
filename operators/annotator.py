"""The annotator: while the robot drives it keeps what it sees and what moved; at the end it labels its frames.

annotator:
  run: operators.annotator:Annotator
  inputs: {frame: simulator/frame, odometry: simulator/odometry, pose: localizer/pose}
  config: {map: recordings/maps/default.ply, every: 10}
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.contract import Operator, Summary
from graph.geometry import planar
from graph.messages import MapCloud, Odometry, PointCloud, Pose
from operators.annotation.buffer import Classing
from operators.annotation.growing import GrowingBuffer
from operators.annotation.projection import Projector
from operators.annotation.session import LABELS, LONG_TERM, PERMANENT, SHORT_TERM, UNCERTAIN, Scan
from operators.pointmap import Trail, load_map
from operators.pointmap.rehearsal import room_scan
from operators.pointray import RaySettings

SECOND = 1_000_000_000  # nanoseconds
WAITING = 20  # frames that wait for their pose at most


class Annotator(Operator):
    """Collect frames at their poses, trace what is new, and label every n-th frame at the end of the session."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """What is known before, and how much is kept."""

        map: Path | None = None  # of the building, PLY; what it holds is permanent unless the session saw through it
        every: int = 10  # frames kept for labels: one of so many, 0.5 MB each
        trace_known: int = 10  # one frame of so many looks at the points of the map too, for the dashboard
        period: float = 5.0  # seconds between two messages of the annotated map
        grain: float = 0.12  # metres between its points
        vertical_resolution: float = math.radians(1.33)  # between two beams of the lidar
        frustum_width: float = math.radians(0.15)  # of the ray tracing

    class Outputs(msgspec.Struct):
        """The map with movable probabilities now and then; the labelled frames at the end."""

        map: MapCloud | None = None
        labelled: PointCloud | None = None

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c: Annotator.Config = self.config
        for name in ("every", "trace_known"):
            if getattr(c, name) < 1:
                raise ValueError(f"annotator.{name} wants at least 1; it was given {getattr(c, name)}")
        known = None if c.map is None else load_map(c.map)
        self.buffer = GrowingBuffer(known, RaySettings(height=c.vertical_resolution, width=c.frustum_width))
        self.trail = Trail()
        self.waiting: dict[int, PointCloud] = {}  # frames by stamp, until their pose is known
        self.kept: list[tuple[PointCloud, Scan]] = []
        self.due = 0
        self.refused = 0

    @classmethod
    def warm_up(cls) -> None:
        """Annotate two scans of a made-up room."""
        rehearsed = cls()
        for index in range(2):
            stamp = index * SECOND // 10
            mount = planar(0.0, 0.0, 0.0, 0.64)
            cloud = PointCloud(measured_at=stamp, points=room_scan(turn=0.02 * index), base_from_lidar=mount)
            rehearsed.on_frame(cloud)
            rehearsed.on_pose(Pose(measured_at=stamp, world_from_base=planar(0.0, 0.0, 0.02 * index)))
        for _ in rehearsed.on_end():
            pass

    def on_odometry(self, odometry: Odometry | None) -> None:
        """Remember how the robot moves, to straighten rolling scans."""
        if odometry is not None:
            self.trail.add(odometry.measured_at, odometry.odom_from_base, odometry.linear, odometry.angular)

    def on_frame(self, frame: PointCloud) -> None:
        """Keep a frame until its pose is known."""
        self.waiting[frame.measured_at] = frame
        while len(self.waiting) > WAITING:
            del self.waiting[min(self.waiting)]

    def on_pose(self, pose: Pose) -> Outputs | None:
        """Take in the frame of this pose, if the localizer believes it."""
        frame = self.waiting.pop(pose.measured_at, None)
        if frame is None:
            return None
        if not pose.valid:
            self.refused += 1
            return None
        points = self.trail.steady(frame.points, frame.time_offset, frame.base_from_lidar)
        scan = Scan(points, pose.world_from_base @ frame.base_from_lidar, True, pose.inliers)
        if self.buffer.frames % self.config.every == 0:
            self.kept.append((frame, scan))
        self.buffer.add(scan, known_too=self.buffer.frames % self.config.trace_known == 0)
        return self.annotated_map(pose.measured_at)

    def annotated_map(self, stamp: int) -> Outputs | None:
        """Return the map with movable probabilities and the classes that follow from them, when it is time."""
        if stamp < self.due:
            return None
        self.due = stamp + round(self.config.period * SECOND)
        points, movable, new = self.buffer.coarse(self.config.grain)
        label = np.where(new, UNCERTAIN, PERMANENT).astype(np.uint8)
        label[new & (movable < Classing().long)] = LONG_TERM
        label[movable > Classing().short] = SHORT_TERM
        return self.Outputs(map=MapCloud(measured_at=stamp, points=points, movable=movable, label=label))

    def on_end(self) -> Iterator[Any]:
        """Classify the buffer, give the kept frames their labels, and count them."""
        counts = np.zeros(len(LABELS), np.int64)
        if self.buffer.frames:
            projector = Projector(self.buffer.classified())
            for frame, scan in self.kept:
                labels = projector.project(scan)
                counts += np.bincount(labels, minlength=len(LABELS))
                yield self.Outputs(labelled=msgspec.structs.replace(frame, label=labels, scores=None))
        total = int(counts.sum())
        yield Summary(
            frames=self.buffer.frames,
            frames_labelled=len(self.kept),
            frames_without_a_valid_pose=self.refused,
            coverage=float(counts[1:].sum() / total) if total else 0.0,
            points=dict(zip(LABELS, counts.tolist(), strict=True)),
        )
