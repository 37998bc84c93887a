"""Gmapping: where the robot is, and the occupancy map that it draws, by particles that each have a map of their own.

localizer:
  run: operators.gmapping:Gmapping
  inputs: {odometry: simulator/odometry, frame: simulator/frame}
"""

from __future__ import annotations

from graph.contract import Summary
from graph.geometry import planar
from graph.messages import Odometry, PointCloud
from operators.amcl import SECOND, Planar, message
from operators.montecarlo.gmapping import Gmapping as Slam
from operators.montecarlo.gmapping import Settings
from operators.pointmap.rehearsal import room_scan


class Gmapping(Planar):
    """Match each scan with the map of each particle, weigh the particles, and draw the scan into their maps."""

    class Config(Settings):
        """The parameters of gmapping by their names in ROS (metres, radians), and how often the map goes out."""

        map_update_interval: float = 1.0  # seconds

    slam: Slam | None = None
    map_due = 0
    resamplings = 0

    def __init__(self, config: Config | None = None) -> None:
        """Check the settings. Raises ValueError in one sentence."""
        super().__init__(config)
        self.build((0.0, 0.0, 0.0))

    def build(self, start: tuple[float, float, float]) -> Slam:
        """Make particles at a pose."""
        return Slam(self.config, start=start)

    @classmethod
    def warm_up(cls) -> None:
        """Map four scans of a made-up room."""
        rehearsed = cls(cls.Config(particles=2, resampleThreshold=2.0))
        mount = planar(0.0, 0.0, 0.0, 0.64)
        for n in range(4):
            pose = planar(0.2 * n, 0.0, 0.0)
            rehearsed.on_odometry(Odometry(measured_at=n, odom_from_base=pose, linear=0.0, angular=0.0))
            rehearsed.on_frame(PointCloud(measured_at=n, points=room_scan(), base_from_lidar=mount))

    def on_frame(self, frame: PointCloud) -> Gmapping.Outputs:
        """Say where the robot was when the frame was measured; the map of the best particle now and then."""
        odometry, scan = self.odometry_at(frame.measured_at), self.scan(frame)
        if self.slam is None:
            x, y, heading = odometry.tolist()
            self.slam = self.build((x, y, heading))
        ends = scan.returns()
        step = self.slam.step(odometry, ends, scan.sensor)
        self.updates += step.updated
        self.resamplings += step.resampled
        grid = None
        if frame.measured_at >= self.map_due and self.slam.scans:
            self.map_due = frame.measured_at + round(self.config.map_update_interval * SECOND)
            grid = message(frame.measured_at, self.slam.grid())
        return self.Outputs(self.pose(frame.measured_at, step.pose, len(ends) > 0, ""), grid)

    def on_end(self) -> Summary:
        """Count what was localized, and what the maps take."""
        patches = self.slam.patches.in_use() if self.slam else 0
        return Summary(**super().on_end(), resamplings=self.resamplings, patches=patches)
