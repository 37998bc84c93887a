"""Drive with AMCL, Gmapping and PointMap*, with labels and without, and localize on shared recordings with each.

retracer localizers -o build/localizers --weights weights.safetensors
"""

from __future__ import annotations

import argparse
import copy
import json
from pathlib import Path
from typing import Any

import numpy as np

from graph.errors import UserError
from graph.recording import Recording
from graph.status import progress_bar
from operators.montecarlo.comparison import LABELS, METHODS, NAMES, Run
from operators.montecarlo.report import write_report
from operators.rounds.session_command import launch, read_json, read_track, write_json
from operators.rounds.tally import errors
from operators.rounds.variants import listening_graph, robot, with_labels, written

TABLES = ("driven", "same")
SHARED = "operators.localizer:TrueLocalizer"  # drives the recordings that all localizers share
Job = tuple[str, str, str, str, str]  # table, scenario, tour, method, labels


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer localizers`."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="done tours in it are kept")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="of the network; default: no network's labels")
    parser.add_argument("--building", type=Path, default=Path("sim/buildings/default.yaml"))
    parser.add_argument("--map", type=Path, default=Path("recordings/maps/default.yaml"), help="AMCL's, a map.yaml")
    parser.add_argument("--scenarios", nargs="+", default=["medium", "hard"], metavar="NAME")
    parser.add_argument("--tours", nargs="+", default=["A", "B", "C"], metavar="NAME")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--labels", nargs="+", default=None, choices=LABELS, help="default: all that can be had")
    parser.add_argument("--tables", nargs="+", default=list(TABLES), choices=TABLES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="keep the recordings of all tours")
    parser.add_argument("--json", action="store_true", help="print the tables as JSON")


def run(args: argparse.Namespace) -> int:
    """Run what is not done yet, and write report.html and report.json. Raises UserError in one sentence."""
    for path in (args.building, args.map, *([args.weights] if args.weights else [])):
        if not path.is_file():
            raise UserError(f"{path}: no such file")
    wanted = args.labels or [labels for labels in LABELS if labels != "network" or args.weights]
    if "network" in wanted and args.weights is None:
        raise UserError("the network's labels want its weights: --weights FILE")
    args.output.mkdir(parents=True, exist_ok=True)
    settings = {name: str(getattr(args, name)) for name in ("building", "map", "weights", "seed")}
    _same_settings(args.output / "settings.json", settings)
    jobs: list[Job] = [
        (table, scenario, tour, method, labels)
        for table in args.tables
        for scenario in args.scenarios
        for tour in args.tours
        for method in args.methods
        for labels in wanted
    ]
    runs = []
    with progress_bar("localizers", quiet=args.json) as progress:
        for place, job in enumerate(jobs):
            runs.append(_done(args, job))
            progress((place + 1) / len(jobs))
    write_report(args.output, runs, settings)
    report = args.output / "report.json"
    if args.json:
        print(json.dumps(read_json(report)["tables"], indent=2))
    else:
        print(text(read_json(report)["tables"]))
        print(f"written to {args.output / 'report.html'} and {report}")
    return 0


def _same_settings(path: Path, settings: dict[str, str]) -> None:
    if path.exists() and (known := read_json(path)) != settings:
        different = ", ".join(name for name in settings if known.get(name) != settings[name])
        raise UserError(f"{path.parent} holds tours with other settings ({different}); name another folder")
    write_json(path, settings)


def _done(args: argparse.Namespace, job: Job) -> Run:
    """Return a tour's result: that of an earlier call, or of a run now."""
    table, scenario, tour, method, labels = job
    result = args.output / "tours" / f"{'-'.join(job)}.json"
    if result.exists():
        return Run(**read_json(result))
    result.parent.mkdir(exist_ok=True)
    if table == "driven":
        graph = driven_graph(args, scenario, tour, method, labels)
    else:
        shared = _shared(args, scenario, tour)
        whole = drive_graph(args, scenario, tour, "truth")
        graph = listening_graph(whole, str(shared.resolve()), labels, weights=_weights(args))
        _localizer(graph, args, method)
    recording, outcome = _launch(args, graph, "-".join(job))
    track, _ = read_track(recording)
    seconds = [step.wall_duration for _, _, step in Recording(recording).steps("localizer") if step.port == "frame"]
    simulated = outcome if table == "driven" else {}
    found = Run(
        *job,
        errors=np.round(errors(track), 4).tolist(),
        ending=next((name.replace("_", " ") for name, yes in simulated.get("ending", {}).items() if yes), ""),
        reached=int(simulated.get("reached", 0)),
        targets=int(simulated.get("targets", 0)),
        update_ms=float(np.median(seconds)) / 1e6,
    )
    write_json(result, found._asdict())
    if not args.keep:
        recording.unlink()
    return found


def _shared(args: argparse.Namespace, scenario: str, tour: str) -> Path:
    """Return the recording of a tour that all localizers share; drive it if it is not there."""
    name = f"shared-{scenario}-{tour}"
    recording: Path = args.output / "recordings" / f"{name}.mcap"
    if not recording.exists():
        graph = drive_graph(args, scenario, tour, "truth")
        graph["operators"]["localizer"]["run"] = SHARED
        recording, _ = _launch(args, graph, name)
    return recording


def _launch(args: argparse.Namespace, graph: dict[str, Any], name: str) -> tuple[Path, dict[str, Any]]:
    file, recording = args.output / "graphs" / f"{name}.yaml", args.output / "recordings" / f"{name}.mcap"
    for path in (file, recording):
        path.parent.mkdir(exist_ok=True)
    file.write_text(written(graph, f"{name}: retracer localizers"), encoding="utf-8")
    partial = recording.with_name(f"part-{name}.mcap")
    outcome = launch(file, partial)
    partial.rename(recording)
    return recording, outcome.get("simulator", outcome)


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
    _localizer(graph, args, method)
    return graph


def _localizer(graph: dict[str, Any], args: argparse.Namespace, method: str) -> None:
    """Put a localizer into a graph: one line, its map, and its column of the triage."""
    operators = graph["operators"]
    entry = copy.deepcopy(operators["localizer"])
    entry["run"] = METHODS[method]
    entry["config"] = {"map": str(args.map.resolve())} if method == "amcl" else {}
    record = {"map": "digest", "occupancy": "digest"} if method == "pointmap" else {"occupancy": "digest"}
    operators["localizer"] = entry | {"record": record}
    operators["triage"]["config"] = operators["triage"].get("config", {}) | {"localizer": method}


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
