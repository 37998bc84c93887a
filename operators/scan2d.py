"""A 2-D laser scan of a 3-D cloud: the nearest return of each bearing within a band of heights.

scan2d:
  run: operators.scan2d:Scan2d
  inputs: {frame: simulator/frame}
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from graph.contract import Operator
from graph.geometry import inverse, transform
from graph.messages import LaserScan, PointCloud
from operators.montecarlo.scan import Band, Scan2D, flatten


class Scan2d(Operator):
    """Flatten each cloud."""

    class Config(Band):
        """What of a cloud is seen."""

    class Outputs(msgspec.Struct):
        """The scan as ranges, and as the cloud of its end points, which a localizer takes as it takes the whole."""

        scan: LaserScan | None = None
        frame: PointCloud | None = None

    def on_frame(self, frame: PointCloud) -> Outputs:
        """Keep the nearest point of each bearing; the cloud that goes out lies in the lidar's frame."""
        c: Scan2d.Config = self.config
        scan = view(frame, c)
        base = np.zeros((len(scan.returns()), 3))
        base[:, :2] = scan.returns()
        base[:, 2] = (c.min_height + c.max_height) / 2.0  # a height within the band; the true ones are forgotten
        points = transform(inverse(frame.base_from_lidar), base).astype(np.float32)
        laser = LaserScan(
            measured_at=frame.measured_at,
            ranges=scan.ranges.astype(np.float32),
            angle_min=-math.pi + 0.5 * c.angle_increment,
            angle_increment=c.angle_increment,
            range_max=c.range_max,
            sensor=scan.sensor,
        )
        flat = PointCloud(measured_at=frame.measured_at, points=points, base_from_lidar=frame.base_from_lidar)
        return self.Outputs(laser, flat)


def view(frame: PointCloud, config: Band) -> Scan2D:
    """Flatten a cloud as the settings say."""
    return flatten(
        frame.points,
        frame.base_from_lidar,
        min_height=config.min_height,
        max_height=config.max_height,
        angle_increment=config.angle_increment,
        range_max=config.range_max,
    )
