"""Hold a trajectory against a reference: absolute and relative error by evo, or the metric of a relations file.

retracer evaluate-trajectory run.mcap reference.tum --align; retracer evaluate-trajectory slam.mcap intel.relations
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.codec import decode
from graph.errors import UserError
from graph.messages import Odometry, Pose, Truth
from graph.recording import Recording
from graph.status import progress_bar
from operators.scans.accuracy import accuracy
from operators.scans.carmen import is_log, log_trajectory
from operators.scans.poses import read_poses
from operators.scans.relations import read_relations, relation_errors, relations_of
from operators.scans.scan import ScanError
from operators.scans.stamps import SECOND
from operators.scans.trajectory import Trajectory

KINDS: dict[str, tuple[type[msgspec.Struct], str]] = {
    "graph.messages.Pose": (Pose, "world_from_base"),
    "graph.messages.Truth": (Truth, "world_from_base"),
    "graph.messages.Odometry": (Odometry, "odom_from_base"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer evaluate-trajectory`."""
    what = "a recording, a pose file (TUM, KITTI, CSV) or a CARMEN log"
    parser.add_argument("estimate", type=Path, help=what)
    parser.add_argument("reference", type=Path, help=f"{what}; or a file that ends in .relations")
    parser.add_argument("--topic", metavar="TOPIC", help="of the estimate's recording; default: the only Pose")
    parser.add_argument("--true-topic", metavar="TOPIC", help="of the reference's recording; default: the only Truth")
    parser.add_argument("--offset", type=float, default=0.0, metavar="S", help="seconds added to the estimate's stamps")
    parser.add_argument("--align", action="store_true", help="first lay the estimate onto the reference")
    parser.add_argument("--tolerance", type=float, default=0.01, metavar="S", help="between stamps that are one moment")
    parser.add_argument("--delta", type=float, default=1.0, metavar="M", help="of driving over which drift is measured")
    parser.add_argument(
        "--relations", action="store_true", help="take the reference's own motions and revisits for relations"
    )
    parser.add_argument("--json", action="store_true", help="print the errors as JSON")


def run(args: argparse.Namespace) -> int:
    """Evaluate and print. Raises UserError in one sentence."""
    try:
        with progress_bar("evaluating", quiet=args.json):
            told = evaluate(args)
    except (ScanError, UnicodeDecodeError) as error:
        raise UserError(str(error)) from None
    print(json.dumps(told, indent=2) if args.json else text(told))
    return 0


def evaluate(args: argparse.Namespace) -> dict[str, Any]:
    """Compute the errors by name."""
    estimate = shifted(trajectory(args.estimate, "graph.messages.Pose", args.topic), args.offset)
    by_file = args.reference.suffix == ".relations"
    if by_file or args.relations:
        known = (
            read_relations(args.reference)
            if by_file
            else relations_of(trajectory(args.reference, "graph.messages.Truth", args.true_topic))
        )
        errors = relation_errors(estimate, known)
        counts = {"relations": len(known), "not_covered": errors.missing}
        return counts | {name: spread(getattr(errors, name)) for name in ("translation", "rotation")}
    reference = trajectory(args.reference, "graph.messages.Truth", args.true_topic)
    return dict(
        accuracy(reference, estimate, align=args.align, tolerance=args.tolerance, delta=args.delta).statistics()
    )


def spread(errors: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, float]:
    """Return mean, standard deviation and maximum, as the metric is published; and the root of the mean square."""
    return {
        "mean": float(errors.mean()),
        "std": float(errors.std()),
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "max": float(errors.max()),
    }


def shifted(known: Trajectory, seconds: float) -> Trajectory:
    """Add seconds to all stamps."""
    return known if known.stamps is None else known._replace(stamps=known.stamps + round(seconds * SECOND))


def trajectory(path: Path, kind: str, topic: str | None) -> Trajectory:
    """Read a trajectory of whatever file. Raises ScanError, RecordingError, OSError."""
    if path.suffix == ".mcap":
        return recorded(Recording(path), kind, topic)
    return log_trajectory(path) if is_log(path) else read_poses(path)


def recorded(recording: Recording, kind: str, topic: str | None) -> Trajectory:
    """Read the poses of a topic, by default of the only one of a message type. Raises UserError that names topics."""
    fitting = [name for name, (known, _) in recording.types.items() if known in KINDS]
    wanted = [topic] if topic else [name for name in fitting if recording.types[name][0] == kind]
    if len(wanted) != 1 or wanted[0] not in fitting:
        asked = f"has no poses on '{topic}'" if topic else f"has {len(wanted)} topics of {kind}, so one has to be named"
        raise UserError(f"{recording.path} {asked}; poses are on {', '.join(fitting) or 'none'}")
    form, field = KINDS[recording.types[wanted[0]][0]]
    poses: dict[int, Any] = {}
    for entry in recording.messages(wanted[0]):
        message: Any = decode(entry.payload, form)
        poses[message.measured_at] = getattr(message, field)
    stamps = sorted(poses)
    return Trajectory(np.array([poses[stamp] for stamp in stamps]).reshape(-1, 4, 4), np.array(stamps, np.int64))


def text(told: dict[str, Any]) -> str:
    """Lay the errors out in lines: metres, and degrees for angles."""
    lines = []
    for name, value in told.items():
        if not isinstance(value, dict):
            lines.append(f"{name.replace('_', ' ')}: {value}")
            continue
        angle = name in ("rotation", "turn")
        scale, unit = (np.degrees(1.0), "deg") if angle else (1.0, "m")
        lines.append(f"{name} ({unit}): {', '.join(f'{key} {number * scale:.4f}' for key, number in value.items())}")
    return "\n".join(lines)
