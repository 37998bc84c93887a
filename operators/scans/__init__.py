"""Scans and poses of anyone's robot: files and bags in, arrays out; trajectories out, and their errors.

scan = read_scan(Path("000000.bin"))
session = Session(Settings(folder=Path("velodyne"), poses=Path("poses.txt")))
"""

from operators.scans.accuracy import Accuracy, accuracy
from operators.scans.files import read_scan
from operators.scans.poses import read_poses
from operators.scans.scan import Scan, ScanError
from operators.scans.session import Frame, Session
from operators.scans.settings import Settings
from operators.scans.trajectory import Motion, Trajectory
from operators.scans.tum import write_tum

__all__ = [
    "Accuracy",
    "Frame",
    "Motion",
    "Scan",
    "ScanError",
    "Session",
    "Settings",
    "Trajectory",
    "accuracy",
    "read_poses",
    "read_scan",
    "write_tum",
]
