"""Drive with AMCL, Gmapping and PointMap*, with labels and without, and localize on shared recordings with each.

retracer localizers -o build/localizers --weights weights.safetensors

AMCL's motion model reckons with wheels that slip when the robot pushes against somebody; else all have their defaults.
"""

from __future__ import annotations

import argparse
import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graph.codec import decode
from graph.errors import UserError
from graph.messages import OccupancyGrid, Odometry, Pose
from graph.recording import Recording
from graph.status import progress_bar
from operators.montecarlo.comparison import LABELS, METHODS, NAMES, Run
from operators.montecarlo.map_file import GridMap, load_map
from operators.montecarlo.picture import map_picture
from operators.montecarlo.report import write_report
from operators.rounds.session_command import launch, read_json, write_json
from operators.rounds.variants import listening_graph, robot, with_labels, written

TABLES = ("same", "driven")
SHARED = "operators.localizer:TrueLocalizer"  # drives the recordings that all localizers share
SLIPPING = {"odom_alpha3": 0.8}  # not amcl's 0.1: wheels that push against somebody turn, and the robot stands still
MAP_PERIOD = 5.0  # seconds between the maps of gmapping where nobody plans on them, as in ROS
Job = tuple[str, str, str, str, str]  # table, scenario, tour, method, labels


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer localizers`."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="done tours in it are kept")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="of the network; default: no network's labels")
    parser.add_argument("--building", type=Path, default=Path("sim/buildings/default.yaml"))
    parser.add_argument("--map", type=Path, default=Path("recordings/maps/default.yaml"), help="AMCL's, a map.yaml")
    parser.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="of SCENARIO-TOUR.mcap to localize on; default: drive them, with the truth in the loop",
    )
    parser.add_argument("--scenarios", nargs="+", default=["hard", "medium"], metavar="NAME")
    parser.add_argument("--tours", nargs="+", default=["A", "B", "C"], metavar="NAME")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--labels", nargs="+", default=None, choices=LABELS, help="default: all that can be had")
    parser.add_argument("--tables", nargs="+", default=list(TABLES), choices=TABLES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="keep the recordings of all tours")
    parser.add_argument("--json", action="store_true", help="print the tables as JSON")


def run(args: argparse.Namespace) -> int:
    """Run what is not done yet; report.html and report.json grow with each tour. Raises UserError in one sentence."""
    for path in (args.building, args.map, *([args.weights] if args.weights else [])):
        if not path.is_file():
            raise UserError(f"{path}: no such file")
    if args.recordings is not None and not args.recordings.is_dir():
        raise UserError(f"{args.recordings}: no such folder")
    wanted = args.labels or [labels for labels in LABELS if labels != "network" or args.weights]
    if "network" in wanted and args.weights is None:
        raise UserError("the network's labels want its weights: --weights FILE")
    args.output.mkdir(parents=True, exist_ok=True)
    settings = {name: str(getattr(args, name)) for name in ("building", "map", "weights", "recordings", "seed")}
    _same_settings(args.output / "settings.json", settings)
    todo = list(batches(args, wanted))
    runs: list[Run] = []
    with progress_bar("localizers", quiet=args.json) as progress:
        for place, jobs in enumerate(todo):
            if missing := [job for job in jobs if not _result(args, job).exists()]:
                _run(args, missing)
            runs += [Run(**read_json(_result(args, job))) for job in jobs]
            if missing or place == len(todo) - 1:
                write_report(args.output, runs, settings)
            progress((place + 1) / len(todo))
    report = args.output / "report.json"
    if args.json:
        print(json.dumps(read_json(report)["tables"], indent=2))
    else:
        print(text(read_json(report)["tables"]))
        print(f"written to {args.output / 'report.html'} and {report}")
    return 0


def batches(args: argparse.Namespace, wanted: list[str]) -> Iterator[list[Job]]:
    """Yield the jobs that one graph does: on a recording all methods listen at once, a robot drives with one."""
    for table in args.tables:
        for scenario in args.scenarios:
            for tour in args.tours:
                for labels in wanted:
                    jobs: list[Job] = [(table, scenario, tour, method, labels) for method in args.methods]
                    yield from [jobs] if table == "same" else [[job] for job in jobs]


def _same_settings(path: Path, settings: dict[str, str]) -> None:
    if path.exists() and (known := read_json(path)) != settings:
        different = ", ".join(name for name in settings if known.get(name) != settings[name])
        raise UserError(f"{path.parent} holds tours with other settings ({different}); name another folder")
    write_json(path, settings)


def _result(args: argparse.Namespace, job: Job) -> Path:
    folder: Path = args.output / "tours"
    return folder / f"{'-'.join(job)}.json"


def _run(args: argparse.Namespace, jobs: list[Job]) -> None:
    """Run a graph and write what became of each of its jobs."""
    table, scenario, tour, method, labels = jobs[0]
    if table == "driven":
        name = "-".join(jobs[0])
        graph = driven_graph(args, scenario, tour, method, labels)
    else:
        name = "-".join((table, scenario, tour, labels))
        graph = same_graph(args, _shared(args, scenario, tour), [job[3] for job in jobs], labels)
    recording, outcome = _launch(args, graph, name)
    read, said = Recording(recording), outcome["summaries"]
    for job in jobs:
        operator = "localizer" if table == "driven" else job[3]
        seconds = sorted(step.wall_duration / 1e9 for _, _, step in read.steps(operator) if step.port == "frame")
        updates = int(said.get(operator, {}).get("updates", len(seconds)))  # the others took next to nothing
        simulated = said["simulator"] if table == "driven" else {}
        ending = next((ending.replace("_", " ") for ending, yes in simulated.get("ending", {}).items() if yes), "")
        found = Run(
            *job,
            errors=np.round(distances(read, operator), 4).tolist(),
            ending=ending,
            reached=int(simulated.get("reached", 0)),
            targets=int(simulated.get("targets", 0)),
            update_ms=1e3 * float(np.median(seconds[-max(1, updates) :])),
        )
        result = _result(args, job)
        result.parent.mkdir(exist_ok=True)
        if job[3] == "gmapping":
            result.with_suffix(".png").write_bytes(_picture(args, read, operator))
        write_json(result, found._asdict())
    if not args.keep:
        recording.unlink()


def distances(recording: Recording, operator: str) -> npt.NDArray[np.float64]:
    """Return how far the poses (n,) that an operator said are from the true ones of the odometry, metres in the plane.

    Raises UserError if the recording holds none.
    """
    true: dict[int, npt.NDArray[np.float64]] = {}
    believed: dict[int, npt.NDArray[np.float64]] = {}
    for entry in recording.messages(f"{operator}/pose", "simulator/odometry"):
        if entry.operator == operator:
            pose = decode(entry.payload, Pose)
            believed[pose.measured_at] = pose.world_from_base[:2, 3]
            continue
        odometry = decode(entry.payload, Odometry)
        if odometry.true_world_from_base is not None:
            true[odometry.measured_at] = odometry.true_world_from_base[:2, 3]
    stamps = sorted(believed.keys() & true.keys())
    if not stamps:
        raise UserError(f"{recording.path} holds no pose of {operator} beside a true one")
    return np.hypot(*np.array([believed[stamp] - true[stamp] for stamp in stamps]).T)


def _picture(args: argparse.Namespace, recording: Recording, operator: str) -> bytes:
    """Draw the last map of an operator over the walls of AMCL's."""
    last = None
    for entry in recording.messages(f"{operator}/occupancy"):
        last = entry
    if last is None:
        raise UserError(f"{recording.path} holds no map of {operator}")
    grid = decode(last.payload, OccupancyGrid)
    return map_picture(GridMap(grid.cells, grid.origin, grid.resolution), load_map(args.map))


def _shared(args: argparse.Namespace, scenario: str, tour: str) -> Path:
    """Return the recording of a tour that all localizers share; drive it if none is given and it is not there."""
    if args.recordings is not None:
        given: Path = args.recordings / f"{scenario}-{tour}.mcap"
        if not given.is_file():
            raise UserError(f"{given}: no such file; --recordings wants one a tour")
        return given
    name = f"shared-{scenario}-{tour}"
    recording: Path = args.output / "recordings" / f"{name}.mcap"
    if not recording.exists():
        graph = drive_graph(args, scenario, tour, "truth")
        graph["operators"]["localizer"]["run"] = SHARED
        recording, _ = _launch(args, graph, name)
    return recording


def _launch(args: argparse.Namespace, graph: dict[str, Any], name: str) -> tuple[Path, dict[str, Any]]:
    """Launch a graph; returns its recording and its outcome."""
    file, recording = args.output / "graphs" / f"{name}.yaml", args.output / "recordings" / f"{name}.mcap"
    for path in (file, recording):
        path.parent.mkdir(exist_ok=True)
    file.write_text(written(graph, f"{name}: retracer localizers"), encoding="utf-8")
    partial = recording.with_name(f"part-{name}.mcap")
    outcome = launch(file, partial)
    partial.rename(recording)
    return recording, outcome


def _weights(args: argparse.Namespace) -> str | None:
    return None if args.weights is None else str(args.weights.resolve())


def drive_graph(args: argparse.Namespace, scenario: str, tour: str, labels: str) -> dict[str, Any]:
    """Return the whole robot on a tour, with these labels."""
    graph = robot()
    told = {"building": str(args.building.resolve()), "scenario": scenario, "tour": tour, "seed": args.seed}
    graph["operators"]["simulator"]["config"] = told
    with_labels(graph, labels, weights=_weights(args))
    return graph


def driven_graph(args: argparse.Namespace, scenario: str, tour: str, method: str, labels: str) -> dict[str, Any]:
    """Return the graph of a tour with a localizer in the loop."""
    graph = drive_graph(args, scenario, tour, labels)
    operators = graph["operators"]
    operators["localizer"] = _localizer(args, operators["localizer"], method)
    operators["triage"]["config"] = operators["triage"].get("config", {}) | {"localizer": method}
    return graph


def same_graph(args: argparse.Namespace, recording: Path, methods: list[str], labels: str) -> dict[str, Any]:
    """Return the graph in which localizers, each named by its method, listen to a recording side by side."""
    graph = listening_graph(robot(), str(recording.resolve()), labels, weights=_weights(args))
    operators = graph["operators"]
    triage, localizer = operators.pop("triage"), operators.pop("localizer")
    for method in methods:
        operators[f"triage_{method}"] = copy.deepcopy(triage) | {"config": {"localizer": method}}
        entry = operators[method] = _localizer(args, localizer, method)
        entry["inputs"]["frame"] = f"triage_{method}/localization"
        if method == "gmapping":
            entry["config"] = {"map_update_interval": MAP_PERIOD}
    return graph


def _localizer(args: argparse.Namespace, robots: dict[str, Any], method: str) -> dict[str, Any]:
    """Return the entry of a localizer, made of the robot's: another class and another map, and what is recorded."""
    entry = copy.deepcopy(robots)
    entry["run"] = METHODS[method]
    entry["config"] = {"map": str(args.map.resolve()), **SLIPPING} if method == "amcl" else {}
    digests = {"amcl": ("occupancy",), "gmapping": (), "pointmap": ("map", "occupancy")}[method]
    entry["record"] = dict.fromkeys(digests, "digest")
    return entry


def text(tables: dict[str, Any]) -> str:
    """Lay the tables out for people: mean errors in cm and factors."""
    lines = []
    for name, rows in tables.items():
        lines.append(f"{name}:")
        for row in rows:
            means = ", ".join(
                f"{labels} {100 * known['mean']:.1f} cm ({known['failed']} of {known['tours']} failed)"
                for labels, known in row["labels"].items()
            )
            factors = [f"{key.removeprefix('factor_')} {row[key]:.2f}" for key in row if key.startswith("factor_")]
            lines.append(
                f"  {row['scenario']} {NAMES[row['method']]}: {means}; factors: {', '.join(factors) or 'none'}"
            )
    return "\n".join(lines)
