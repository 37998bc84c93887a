"""Label recorded sessions without a human: refine the map with them, then give every point of their frames a class.

retracer annotate recordings/monday.mcap recordings/tuesday.mcap --map building.ply -o annotated
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from graph.codec import digest
from graph.errors import UserError
from graph.status import progress_bar
from operators.annotation.acceptance import Acceptance
from operators.annotation.buffer import Classing, ground_or
from operators.annotation.crew_command import crew
from operators.annotation.refinement import Refinement, refine
from operators.annotation.report import write_report
from operators.annotation.session import PERMANENT
from operators.annotation.stages_command import Examined, Job, examine, label, probabilities, shared_cloud
from operators.annotation.tally import by_truth, measures, moved_doors
from operators.pointmap import PlyError, save_map

LABELLED = ".labelled.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer annotate`."""
    parser.add_argument("sessions", nargs="+", type=Path, metavar="SESSION", help="recordings of tours")
    parser.add_argument("--map", type=Path, required=True, metavar="MAP.ply", help="of `retracer map`")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="a folder for what comes out")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="label each N-th frame; all are traced")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes, a session each")
    parser.add_argument("--ray", metavar="ADDRESS", help="a Ray cluster instead, that sees the same files; or 'local'")
    parser.add_argument("--frames", metavar="TOPIC", help="the point clouds; default: those of the lidar")
    parser.add_argument("--poses", metavar="TOPIC", help="where they were taken; default: what the localizer said")
    parser.add_argument(
        "--align", action="store_true", help="align anew from the odometry; done anyway where there are no poses"
    )
    parser.add_argument("--permanent", choices=("plane", "ring"), default="plane", help="ring: as the authors")
    parser.add_argument("--least-overlap", type=float, default=Acceptance().least_overlap, metavar="SHARE",
                        help="of what a session saw, that the map must have")  # fmt: skip
    parser.add_argument("--vertical-resolution", type=float, default=1.33, metavar="DEG", help="of the lidar")
    parser.add_argument(
        "--tau-short", type=float, default=Classing().short, metavar="P", help="shortT above; paper: 0.7"
    )
    parser.add_argument("--tau-long", type=float, default=Classing().long, metavar="P", help="longT below; paper: 0.4")
    parser.add_argument("--frustum-width", type=float, default=0.15, metavar="DEG", help="of the ray tracing")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")


def run(args: argparse.Namespace) -> int:
    """Annotate. Raises UserError in one sentence; what is finished is kept, and found again by the next run."""
    job = job_of(args)
    for folder in (job.output, job.work, job.buffers):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{folder} cannot be made: {error.strerror}") from None
    try:
        told = annotate(job, args)
    except OSError as error:
        raise UserError(f"{error.filename or job.output}: {error.strerror}; what is finished was kept") from None
    print(json.dumps(told, indent=2) if args.json else text(told))
    return 0


def job_of(args: argparse.Namespace) -> Job:
    """Check the command line. Raises UserError by name."""
    for name in ("every", "workers"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name} wants at least 1; it was given {getattr(args, name)}")
    for name, least in (("vertical-resolution", 0.1), ("frustum-width", 0.02)):
        if not least <= (given := getattr(args, name.replace("-", "_"))) <= 10.0:
            raise UserError(f"--{name} wants {least:g} to 10 degrees; it was given {given:g}")
    if not 0.0 <= args.tau_long <= args.tau_short <= 1.0:
        raise UserError(
            f"--tau-long and --tau-short are probabilities in this order; given are {args.tau_long}, {args.tau_short}"
        )
    names = [path.name for path in args.sessions]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UserError(f"two sessions are named {twice[0]}; what comes out of them would be one file")
    if missing := [path for path in args.sessions if not path.exists()]:
        raise UserError(f"{missing[0]}: no such recording")
    if args.output.exists() and not args.output.is_dir():
        raise UserError(f"{args.output} is a file; the outcome needs a folder")
    return Job(
        sessions=tuple(path.resolve() for path in args.sessions),
        map=args.map.resolve(),
        map_digest=check_map(args.map),
        output=args.output.resolve(),
        every=args.every,
        frames=args.frames,
        poses=args.poses,
        align=args.align,
        acceptance=Acceptance(least_overlap=args.least_overlap),
        refinement=Refinement(),
        classing=Classing(short=args.tau_short, long=args.tau_long, permanent=args.permanent),
        resolution=math.radians(args.vertical_resolution),
        width=math.radians(args.frustum_width),
    )


def check_map(path: Path) -> str:
    """Read a map and return the digest of its file. Raises UserError for one that will not do."""
    try:
        found = digest(path.read_bytes()).hex()
        shared_cloud(path.resolve(), found)
    except PlyError as error:
        raise UserError(str(error)) from None
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; `retracer map` makes a map") from None
    return found


def annotate(job: Job, args: argparse.Namespace) -> dict[str, Any]:
    """Examine all sessions, refine the map with the accepted, label these, and report."""
    quiet = args.quiet or args.json
    count = len(job.sessions)
    with (
        progress_bar(f"annotating {count} sessions", quiet=quiet) as progress,
        crew(args.workers, args.ray) as all_of,
    ):
        examined: list[Examined] = []
        for one in all_of(examine, job, job.sessions, lambda share: progress(0.4 * share)):
            examined.append(one)
            if not one.accepted and not args.json:
                print(f"{one.name} is not accepted: {'; '.join(one.reasons)}", file=sys.stderr)
        accepted = [one for one in examined if one.accepted]
        if not accepted:
            reasons = "; ".join(f"{one.name}: {', '.join(one.reasons)}" for one in examined)
            raise UserError(f"none of the {count} sessions is accepted: {reasons}")
        refined, gone = refined_map(job, accepted)
        progress(0.45)
        paths = [path for path, one in zip(job.sessions, examined, strict=True) if one.accepted]
        labelled = list(all_of(label, refined, paths, lambda share: progress(0.45 + 0.5 * share)))
        told = outcome(job, examined, labelled, gone)
        before = shared_cloud(job.map, job.map_digest)[0]
        write_report(job.output / "report.html", told, before, np.load(job.work / "stays.npy"), job.buffers)
    (job.output / "report.json").write_text(json.dumps(told, indent=2) + "\n")
    return told


def refined_map(job: Job, accepted: list[Examined]) -> tuple[Job, dict[str, Any]]:
    """Drop from the map what accepted sessions saw through. Returns the job of the second stage, and what went."""
    cloud, _ = shared_cloud(job.map, job.map_digest)
    movable = [probabilities(job, one, len(cloud.points)) for one in accepted]
    refined, stays = refine(cloud, movable, job.refinement)
    path = job.output / "map.ply"
    save_map(path, refined._replace(label=ground_or(refined, PERMANENT, job.classing)[0]))
    gone = {"points": len(cloud.points), "gone": int((~stays).sum()), "map": str(path)}
    np.save(job.work / "stays.npy", stays)
    return job.refined(path, digest(path.read_bytes()).hex()), gone


def outcome(job: Job, examined: list[Examined], labelled: list[dict[str, Any]], gone: dict[str, Any]) -> dict[str, Any]:
    """Put all numbers together."""
    tallies = [one["tally"] for one in labelled]
    moved = moved_doors(tallies)
    unknown = np.sum([list(tally["points"]["unknown"].values()) for tally in tallies], axis=0).tolist()
    counts = by_truth(tallies, moved)
    known = any(map(sum, counts.values()))
    sessions = {one.name: {"accepted": one.accepted, "reasons": list(one.reasons), **one.evidence} for one in examined}
    for one in labelled:
        own = by_truth([one["tally"]], moved)
        found = measures(own, list(one["tally"]["points"]["unknown"].values()))
        sessions[one["name"]] |= {
            "labelled": one["labelled"],
            "buffer": one["buffer"],
            "frames_labelled": one["tally"]["frames"],
            "seconds": one["seconds"],
            **(found if any(map(sum, own.values())) else {"coverage": found["coverage"]}),
        }
    told: dict[str, Any] = {
        "frames": sum(tally["frames"] for tally in tallies),
        "sessions_accepted": len(labelled),
        "sessions_refused": {one.name: list(one.reasons) for one in examined if not one.accepted},
    }
    found = measures(counts, unknown)
    told |= found if known else {"coverage": found["coverage"]}
    if known:
        told |= {"confusion": counts, "doors_moved": len(moved)}
    return told | {"refinement": gone, "sessions": sessions, "map": gone["map"], "output": str(job.output)}


def text(told: dict[str, Any]) -> str:
    """Say the outcome in lines."""
    gone = told["refinement"]
    lines = [
        f"{told['output']}: {told['frames']} labelled frames of {told['sessions_accepted']} sessions, "
        f"{100 * told['coverage']:.1f} % of the points have a label",
        f"  {gone['gone']} of {gone['points']} points left the map",
    ]
    for name, recall in told.get("recall", {}).items():
        right = told["recall_labelled"][name]
        lines.append(
            f"  {name:>24}: {100 * recall:6.2f} % of all its points right, {100 * right:6.2f} % of the labelled"
        )
    return "\n".join([*lines, f"  report: {told['output']}/report.html"])
