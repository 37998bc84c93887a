"""What a person may say about a folder of scans."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

from operators.scans.poses import Format


class Settings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Where the scans are, and what the files do not say themselves."""

    folder: Path  # of scan files; or a .pcap file, or a ROS bag
    pattern: str = "*"  # which files of the folder
    stamps: Path | None = None  # one stamp a line, in the order of the files
    rate: float | None = None  # Hz, for scans without stamps; given, it also overrules stamps in file names
    poses: Path | None = None
    poses_format: Format = "auto"
    poses_of: Literal["base", "lidar", "camera"] = "base"  # what the poses place in the world
    calibration: Path | None = None  # KITTI calib.txt, for poses of the camera
    start_at_origin: bool = False  # take the first pose as the origin of odom
    lidar_height: float | None = None  # metres above the floor
    base_from_lidar: list[float] | None = None  # x y z, x y z roll pitch yaw, x y z qx qy qz qw, or 16 numbers
    min_range: float = 0.0  # metres
    max_range: float | None = None  # metres
    drop_duplicates: bool = False  # of scans or poses with one stamp keep the first
    allow_missing: bool = False  # import scans without a pose
    points_topic: str | None = None  # of a bag; None finds it
    odometry_topic: str | None = None  # of a bag; None finds it, else takes the transforms of /tf
    odom_frame: str | None = None  # of a bag's transforms
    base_frame: str | None = None
