"""A source of recorded scans: what `retracer import` runs.

sensor:
  run: operators.scan_folder:ScanFolder
  config: {folder: velodyne, poses: poses.txt, lidar_height: 1.73}
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from graph.contract import End, Source, Summary
from graph.messages import Odometry, PointCloud
from operators.scans import Frame, Session, Settings


class ScanFolder(Source):
    """Give the scans of a folder, a capture or a bag, each with the odometry at its stamp; then end."""

    class Config(Settings):
        """Where the scans are, and what the files do not say themselves."""

    class Outputs(msgspec.Struct):
        """A scan, and where odometry says the robot was when it was taken."""

        odometry: Odometry | None = None
        frame: PointCloud | None = None

    config: Config

    def stream(self) -> Iterator[tuple[int, Any]]:
        """Yield each frame at its stamp, End with the last. Raises ScanError where a file cannot be read."""
        self.session = Session(self.config)
        last = len(self.session) - 1
        for place, frame in enumerate(self.session):
            outputs = self.outputs(frame)
            yield frame.stamp, outputs if place < last else [outputs, End("all scans are in")]

    def outputs(self, frame: Frame) -> Outputs:
        """Turn a frame into messages."""
        cloud = PointCloud(
            measured_at=frame.stamp,
            points=frame.scan.points,
            base_from_lidar=self.session.base_from_lidar,
            ring=frame.scan.ring,
            time_offset=frame.scan.time_offset,
        )
        if frame.odometry is None:
            return self.Outputs(frame=cloud)
        pose, linear, angular = frame.odometry
        odometry = Odometry(measured_at=frame.stamp, odom_from_base=pose, linear=linear, angular=angular)
        return self.Outputs(odometry, cloud)

    def on_end(self) -> Summary:
        """Count what was read and what was left out."""
        return Summary(self.session.counts, duplicates=self.session.duplicates)
