"""A source of labelled frames: a recorded session once more, each point with the class of its buffer.

annotator:
  run: operators.labelled_session:LabelledSession
  config: {session: recordings/run.mcap, map: annotated/map.ply, buffer: annotated/buffers/run.ply}
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.contract import End, Source, Summary
from graph.geometry import inverse, transform
from graph.messages import PointCloud, Pose
from operators.annotation.files import load_buffer, shared_map
from operators.annotation.projection import Projector
from operators.annotation.tally import Tally
from operators.recorded_session import RecordedSession, load_poses


class LabelledSession(Source):
    """Give every n-th frame of a session whose pose is valid, labelled, at its stamp; then end.

    Where the session knows the truth, the Summary counts points by truth and label.
    """

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """The session and its annotation."""

        session: Path
        map: Path  # the refined one, PLY
        buffer: Path  # what the session saw besides, PLY with classes
        apart: float = 0.0  # metres between the two, at least; makes the projection faster
        every: int = 1
        frames: str | None = None  # topic
        poses: Path | None = None  # of `save_poses`; None: those that the session's localizer said

    class Outputs(msgspec.Struct):
        """A frame with labels, and where it was taken."""

        labelled: PointCloud | None = None
        pose: Pose | None = None

    config: Config

    def stream(self) -> Iterator[tuple[int, Any]]:
        """Yield each labelled frame, End with the last."""
        c = self.config
        self.tally = Tally()
        session = RecordedSession(c.session, frames=c.frames, known=None if c.poses is None else load_poses(c.poses))
        projector = Projector(load_buffer(c.buffer, shared_map(c.map), c.apart))
        pending: tuple[int, Any] | None = None
        for cloud, scan in session.clouds(every=c.every):
            if not scan.valid:
                continue
            if pending is not None:
                yield pending
            labels = projector.project(scan)
            world = transform(scan.world_from_lidar, scan.points)
            self.tally.add(labels, cloud.truth, cloud.moving, cloud.instance, world)
            pose = Pose(
                measured_at=cloud.measured_at,
                world_from_base=np.ascontiguousarray(scan.world_from_lidar @ inverse(cloud.base_from_lidar)),
                inliers=scan.inliers,
            )
            labelled = msgspec.structs.replace(cloud, label=labels, scores=None)
            pending = cloud.measured_at, self.Outputs(labelled, pose)
        if pending is None:
            yield 0, End("no frame has a valid pose")
        else:
            yield pending[0], [pending[1], End("all frames are labelled")]

    def on_end(self) -> Summary:
        """Count points by truth and label."""
        return Summary(self.tally.numbers())
