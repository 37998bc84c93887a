"""Make the initial map of a building from a recorded mapping session.

retracer map recordings/mapping.mcap -o building.ply
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from graph.errors import UserError
from graph.status import progress_bar
from operators.annotation.first_map import FirstMap, first_map
from operators.pointmap import PlyError, Settings, load_map, save_map
from operators.pointmap.thinning import thinned
from operators.pointray import RaySettings
from operators.recorded_session import RecordedSession

PASSES = 3  # over the frames: map, trace, map again
MOST_INVALID = 0.1  # share of the frames; a map of more is no map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer map`."""
    parser.add_argument(
        "session", type=Path, metavar="SESSION", help="a recording of a tour of the whole building; or a map, to thin"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="MAP.ply")
    parser.add_argument("--frames", metavar="TOPIC", help="the point clouds; default: those of the lidar")
    parser.add_argument("--voxel", type=float, default=0.03, metavar="M", help="one point of the map a voxel")
    parser.add_argument("--threshold", type=float, default=0.7, help="movable probability beyond which points go")
    parser.add_argument("--vertical-resolution", type=float, default=1.33, metavar="DEG", help="of the lidar")
    parser.add_argument("--frustum-width", type=float, default=0.15, metavar="DEG", help="of the ray tracing")
    parser.add_argument("--thin", type=float, metavar="M", help="keep one point of so wide a voxel, for a small file")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")


def run(args: argparse.Namespace) -> int:
    """Map a session. Raises UserError in one sentence; then no map is written."""
    if not is_map(args.output):
        raise UserError(f"a map is a .ply or .ply.gz file; {args.output} is none")
    if args.thin is not None and not args.voxel <= args.thin <= 1.0:
        raise UserError(f"--thin wants metres from --voxel to 1; it was given {args.thin:g}")
    if not 0.0 < args.voxel <= 1.0:
        raise UserError(f"--voxel wants metres above 0, up to 1; it was given {args.voxel:g}")
    for name, least in (("vertical-resolution", 0.1), ("frustum-width", 0.02)):
        if not least <= (given := getattr(args, name.replace("-", "_"))) <= 10.0:
            raise UserError(f"--{name} wants {least:g} to 10 degrees; it was given {given:g}")
    if not 0.0 <= args.threshold <= 1.0:
        raise UserError(f"--threshold is a probability; it was given {args.threshold:g}")
    if not args.output.parent.is_dir():
        raise UserError(f"{args.output} cannot be written: there is no folder {args.output.parent}")
    if is_map(args.session):
        return thin(args)
    made, seconds = map_session(args)
    if args.thin is not None:
        made = made._replace(cloud=thinned(made.cloud, args.thin))
    try:
        save_map(args.output, made.cloud)
    except OSError as error:
        raise UserError(f"{args.output} cannot be written: {error.strerror}; nothing was kept") from None
    low, high = made.cloud.points.min(axis=0), made.cloud.points.max(axis=0)
    told: dict[str, Any] = {
        "map": str(args.output),
        "points": len(made.cloud.points),
        "frames": made.frames,
        "invalid": made.invalid,
        "inliers": made.inliers,
        "dropped": made.dropped,
        "size_m": [round(float(x), 2) for x in high - low],
        "seconds": seconds,
    }
    print(json.dumps(told, indent=2) if args.json else text(told))
    return 0


def is_map(path: Path) -> bool:
    """Say whether a path is named as a map."""
    return path.name.lower().endswith((".ply", ".ply.gz"))


def thin(args: argparse.Namespace) -> int:
    """Make a smaller map of a map. Raises UserError where it cannot be read or written."""
    if args.thin is None:
        raise UserError(f"{args.session} is a map already; --thin 0.1 makes a smaller one of it")
    if not args.session.is_file():
        raise UserError(f"{args.session}: no such map")
    try:
        whole = load_map(args.session)
        few = thinned(whole, args.thin)
        save_map(args.output, few)
    except (PlyError, OSError) as error:
        raise UserError(str(error)) from None
    told = {"map": str(args.output), "points": len(few.points), "of": len(whole.points)}
    print(json.dumps(told, indent=2) if args.json else f"{args.output}: {told['points']} of {told['of']} points")
    return 0


def map_session(args: argparse.Namespace) -> tuple[FirstMap, float]:
    """Map the session of the command line, with a bar. Returns also how many seconds the session lasted."""
    resolution = math.radians(args.vertical_resolution)
    done = 0.0
    with progress_bar(f"mapping {args.session}", quiet=args.quiet or args.json) as progress:
        last = 0.0

        def tell(share: float) -> None:
            nonlocal done, last
            done += 1.0 if share < last else 0.0
            last = share
            progress((done + share) / PASSES)

        session = RecordedSession(args.session, frames=args.frames, progress=tell)
        stamps = sorted(session.odometry)
        made = first_map(
            session,
            rays=RaySettings(height=resolution, width=math.radians(args.frustum_width)),
            threshold=args.threshold,
            settings=Settings(map_voxel=args.voxel, vertical_resolution=resolution),
        )
    if not made.frames or not len(made.cloud.points):
        raise UserError(f"{args.session}: its {made.frames} frames hold nothing that could be mapped")
    if made.invalid > MOST_INVALID * made.frames:
        raise UserError(
            f"{args.session}: {made.invalid} of {made.frames} frames could not be aligned, so there is no map; "
            "a mapping session is a slow tour with odometry"
        )
    return made, (stamps[-1] - stamps[0]) / 1e9 if stamps else float(np.nan)


def text(told: dict[str, Any]) -> str:
    """Say the outcome in lines."""
    width, depth, _ = told["size_m"]
    return (
        f"{told['map']}: {told['points']} points over {width:.1f} x {depth:.1f} m from {told['frames']} frames\n"
        f"  {100 * told['inliers']:.0f} % inliers, {told['invalid']} frames not aligned, "
        f"{100 * told['dropped']:.1f} % of the first map's points moved and were dropped"
    )
