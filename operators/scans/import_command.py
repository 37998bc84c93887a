"""Make a session of anyone's scans: files, a Velodyne capture, a CARMEN log or a ROS bag, with poses or odometry.

retracer import sequences/00/velodyne -o kitti00.mcap --poses 00.txt --poses-of lidar --lidar-height 1.73
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any, get_args

from mcap.reader import make_reader
from msgspec import msgpack

from graph.check import require
from graph.errors import UserError
from graph.graphfile import Clock, Graph, OperatorEntry
from graph.inprocess import launch_in_process
from graph.shard import SUMMARY
from graph.status import progress_bar
from operators.scans.poses import Format
from operators.scans.scan import ScanError
from operators.scans.session import RATE, Session
from operators.scans.settings import Settings
from operators.scans.stamps import SECOND

SENSOR = "sensor"  # the operator of an imported session
OPTIONS = [name for name in Settings.__struct_fields__ if name != "folder"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer import`; each option is a setting of the Source."""
    parser.add_argument(
        "folder",
        type=Path,
        metavar="DIR",
        help="a folder of scans, a .pcap file, a CARMEN log (.clf, .log, also .gz, .bz2), or a ROS bag",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="SESSION.mcap")
    scans = parser.add_argument_group("scans")
    scans.add_argument("--pattern", metavar="GLOB", help="which files of the folder; default: all scans")
    scans.add_argument("--stamps", type=Path, metavar="FILE", help="one stamp a line; default: those in file names")
    scans.add_argument("--rate", type=float, metavar="HZ", help=f"of scans without stamps; default: {RATE:g}")
    scans.add_argument("--min-range", type=float, metavar="M", help="drop nearer points")
    scans.add_argument("--max-range", type=float, metavar="M", help="drop farther points")
    scans.add_argument("--lidar-height", type=float, metavar="M", help="of the lidar above the floor")
    scans.add_argument(
        "--base-from-lidar",
        type=float,
        nargs="+",
        metavar="N",
        help="where the lidar is on the robot: x y z, and roll pitch yaw (rad) or qx qy qz qw; or 16 numbers",
    )
    scans.add_argument("--drop-duplicates", action="store_true", default=None, help="of one stamp keep the first")
    poses = parser.add_argument_group("poses")
    poses.add_argument("--poses", type=Path, metavar="FILE", help="TUM, KITTI, or 4x4 matrices as CSV")
    poses.add_argument("--poses-format", choices=get_args(Format), help="default: by the number of columns")
    poses.add_argument("--poses-of", choices=("base", "lidar", "camera"), help="whose poses they are; default: base")
    poses.add_argument("--calibration", type=Path, metavar="FILE", help="KITTI calib.txt, for poses of the camera")
    poses.add_argument("--start-at-origin", action="store_true", default=None, help="odom begins at the first pose")
    poses.add_argument("--allow-missing", action="store_true", default=None, help="import scans without a pose")
    bags = parser.add_argument_group("bags")
    bags.add_argument("--points-topic", metavar="TOPIC", help="default: the only PointCloud2")
    bags.add_argument("--odometry-topic", metavar="TOPIC", help="default: the only Odometry, else /tf")
    bags.add_argument("--odom-frame", metavar="FRAME", help="of /tf; default: odom, map or world")
    bags.add_argument("--base-frame", metavar="FRAME", help="default: of the odometry, base_footprint or base_link")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")


def run(args: argparse.Namespace) -> int:
    """Import a session. Raises UserError in one sentence; then nothing is left behind."""
    settings = {name: value for name in OPTIONS if (value := getattr(args, name)) is not None}
    told = import_session(args.folder, args.output, quiet=args.quiet or args.json, **settings)
    print(json.dumps(told, indent=2) if args.json else text(told))
    return 0 if told["verdict"] == "COMPLETE" else 1


def import_session(folder: Path, output: Path, *, quiet: bool = True, **settings: Any) -> dict[str, Any]:
    """Write a session of scans; settings as in Settings. Returns its path, its length in seconds and its counts.

    Raises UserError in one sentence for scans, poses or a disk that will not do; then nothing is left behind.
    """
    graph = graph_of(folder, output.stem, settings)
    parts = (output.with_suffix(".shards"), output.with_name(f"{output.name}.part"))
    if taken := [path for path in (output, *parts) if path.exists()]:
        raise UserError(f"{taken[0]} exists already; name another session")
    try:
        seconds = _length(Settings(folder=folder, **settings))
        with progress_bar(f"importing {folder}", quiet=quiet) as progress:
            verdict, path = launch_in_process(
                graph,
                record=output,
                command=shlex.join(["retracer", *sys.argv[1:]]),
                progress=lambda done: progress(min(done / seconds, 1.0)),
            )
    except BaseException as error:
        for part in parts:
            shutil.rmtree(part, ignore_errors=True)
            part.unlink(missing_ok=True)
        if isinstance(error, ScanError):
            raise UserError(str(error)) from None
        if isinstance(error, OSError) and error.errno:
            raise UserError(f"{error.filename or output}: {error.strerror}; nothing was kept") from None
        raise
    return {"session": str(path), "verdict": verdict.verdict, "seconds": verdict.end / 1e9, **_summary(path)}


def graph_of(folder: Path, name: str, settings: dict[str, Any]) -> Graph:
    """Build the graph of one source that an import runs. Raises UserError for settings that are none."""
    config = {key: str(value) if isinstance(value, Path) else value for key, value in settings.items()}
    entry = OperatorEntry(run="operators.scan_folder:ScanFolder", config={"folder": str(folder), **config})
    return require(Graph(clock=Clock(end=SENSOR), operators={SENSOR: entry}, name=name, root=str(Path.cwd())))


def text(told: dict[str, Any]) -> str:
    """Say the outcome in lines."""
    lines = [f"{told['session']}: {told['frames']} frames over {told['seconds']:.1f} s, {told['points']} points"]
    for name, what in (
        ("points_not_finite", "points that are not finite were dropped"),
        ("points_out_of_range", "points out of range, or at the origin, were dropped"),
        ("duplicates", "scans were dropped, as another has their stamp"),
        ("empty_frames", "frames are empty"),
        ("frames_without_odometry", "frames have no odometry"),
    ):
        lines += [f"  {told[name]} {what}"] if told[name] else []
    return "\n".join(lines)


def _length(settings: Settings) -> float:
    """Return how many seconds a session will have; finds what is wrong with it before anything is written."""
    return max(Session(settings).stamps[-1] / SECOND, 1e-9)


def _summary(path: Path) -> dict[str, Any]:
    """Read what the source counted, by the index: a session may be as large as the disk."""
    with path.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=[f"{SENSOR}/{SUMMARY}"]):
            return dict(msgpack.decode(message.data))
    return {}
