"""AMCL: where the robot is on a known map of walls, by a particle filter and the 2-D scan of each frame.

localizer:
  run: operators.amcl:Amcl
  inputs: {odometry: simulator/odometry, frame: simulator/frame}
  config: {map: recordings/maps/default.yaml}
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.contract import Operator, Summary
from graph.geometry import planar, yaw
from graph.messages import OccupancyGrid, Odometry, PointCloud, Pose
from operators.montecarlo.amcl import Amcl as Filter
from operators.montecarlo.amcl import Parameters
from operators.montecarlo.map_file import OCCUPIED, GridMap, MapError, load_map
from operators.montecarlo.scan import Scan2D
from operators.pointmap.rehearsal import room_scan
from operators.pointmap.trail import Trail
from operators.scan2d import view

SECOND = 1_000_000_000  # nanoseconds
EMPTY = "the scan has no returns within its band of heights"


class Planar(Operator):
    """What localizers by 2-D scans share: odometry and a cloud in, a pose on the floor out."""

    class Outputs(msgspec.Struct):
        """The pose of every frame, and the map on which it is one."""

        pose: Pose | None = None
        occupancy: OccupancyGrid | None = None

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self.trail = Trail()
        self.frames = self.empty = self.updates = 0

    def on_odometry(self, odometry: Odometry) -> None:
        """Remember where wheels and gyro say the robot is."""
        self.trail.add(odometry.measured_at, odometry.odom_from_base, odometry.linear, odometry.angular)

    def odometry_at(self, stamp: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return x, y and heading (3,) by odometry."""
        pose = self.trail.at(stamp)
        return np.array([pose[0, 3], pose[1, 3], yaw(pose)])

    def scan(self, frame: PointCloud) -> Scan2D:
        """Flatten a frame, as if all of it were measured at once."""
        points = self.trail.steady(frame.points, frame.time_offset, frame.base_from_lidar)
        return view(msgspec.structs.replace(frame, points=points, **UNUSED), self.config)

    def pose(self, stamp: int, place: np.ndarray[Any, np.dtype[np.float64]], seen: bool, reason: str) -> Pose:
        """Say where the robot is; without returns it is where odometry carried it."""
        self.frames += 1
        self.empty += not seen
        x, y, heading = place.tolist()
        known = seen and not reason
        return Pose(
            measured_at=stamp,
            world_from_base=planar(x, y, heading),
            valid=known,
            reason="" if known else reason or EMPTY,
        )

    def on_end(self) -> Summary:
        """Count what was localized."""
        return Summary(frames=self.frames, updates=self.updates, frames_without_returns=self.empty)


UNUSED: dict[str, None] = dict.fromkeys(("ring", "time_offset", "label", "scores", "truth", "moving", "instance"))


def message(stamp: int, grid: GridMap) -> OccupancyGrid:
    """Turn a map into a message."""
    return OccupancyGrid(measured_at=stamp, cells=grid.cells, origin=grid.origin, resolution=grid.resolution)


class Amcl(Planar):
    """Move particles with the odometry, weigh them by the scan, draw as many anew as their spread asks for."""

    class Config(Parameters):
        """The map and where to begin; the rest are the parameters of amcl by their names in ROS (metres, radians)."""

        map: Path = Path("recordings/maps/default.yaml")  # map.yaml: walls, doors open
        initial_pose: tuple[float, float, float] | None = None  # x, y, heading; None: where odometry begins
        global_localization: bool = False  # the robot may be anywhere

    def __init__(self, config: Config | None = None) -> None:
        """Load the map. Raises MapError, a ValueError, in one sentence for a map or settings that will not do."""
        super().__init__(config)
        c: Amcl.Config = self.config
        grid = load_map(c.map)
        try:
            self.begin(grid)
        except MapError as error:
            raise MapError(f"{c.map}: {error}") from None

    def begin(self, grid: GridMap) -> None:
        """Take a map."""
        self.grid = grid
        self.filter = Filter(grid, self.config)
        self.started = False
        self.particles = self.recoveries = 0

    @classmethod
    def warm_up(cls) -> None:
        """Localize two scans of a made-up room, first anywhere, then somewhere."""
        for anywhere in (True, False):
            rehearsed = cls.__new__(cls)
            Planar.__init__(rehearsed, cls.Config(global_localization=anywhere, recovery_alpha_slow=0.001))
            rehearsed.begin(room_map())
            for n in range(2):
                pose = planar(0.2 * n, 0.0, 0.0)
                mount = planar(0.0, 0.0, 0.0, 0.64)
                rehearsed.on_odometry(Odometry(measured_at=n, odom_from_base=pose, linear=0.0, angular=0.0))
                rehearsed.on_frame(PointCloud(measured_at=n, points=room_scan(), base_from_lidar=mount))

    def on_frame(self, frame: PointCloud) -> Amcl.Outputs:
        """Say where the robot was when the frame was measured; the map goes out with the first."""
        c: Amcl.Config = self.config
        odometry, ends = self.odometry_at(frame.measured_at), self.scan(frame).returns()
        first = not self.started
        if first:
            self.started = True
            if not c.global_localization:
                x, y, heading = c.initial_pose or tuple(odometry.tolist())
                self.filter.put((x, y, heading))
        belief = self.filter.step(odometry, ends)
        self.updates += belief.updated
        self.particles += belief.particles * belief.updated
        self.recoveries += belief.recovering > 0.0
        nowhere = "" if belief.particles else "no scan has had returns yet, and the robot may be anywhere"
        pose = self.pose(frame.measured_at, belief.pose, len(ends) > 0, nowhere)
        return self.Outputs(pose, message(frame.measured_at, self.grid) if first else None)

    def on_end(self) -> Summary:
        """Count what was localized, and how many particles it took."""
        mean = self.particles / max(1, self.updates)
        return Summary(**super().on_end(), mean_particles=mean, recoveries=self.recoveries)


def room_map() -> GridMap:
    """Draw the map of the made-up room."""
    cells = np.zeros((130, 170), np.int8)
    cells[:5], cells[-5:], cells[:, :5], cells[:, -5:] = (OCCUPIED,) * 4
    return GridMap(cells, np.array([-4.25, -3.25]), 0.05)
