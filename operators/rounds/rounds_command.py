"""Drive, label, learn, and drive better: the paper's first experiment, round after round, with its report.

retracer rounds --rounds 4 -o rounds

A killed run goes on where it was when the same command is given again.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import Any

import yaml

from graph.durations import nanoseconds
from graph.errors import UserError
from operators.rounds.experiment_command import Experiment, Settings
from operators.rounds.schedule import FEWEST, MOST_ROUNDS, SCENARIOS, TOURS

CABIN = Path(__file__).parent / "cabin.yaml"
QUICK_SCENARIOS, QUICK_STEPS = ("easy", "hard"), 60


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer rounds`."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="a folder for everything")
    parser.add_argument("--rounds", type=int, default=4, help="before the last one, which has true labels")
    parser.add_argument("--building", type=Path, metavar="FILE", help="instead of the default building")
    parser.add_argument("--scenarios", default=",".join(SCENARIOS), metavar="A,B", help="of every round")
    parser.add_argument("--tours", metavar="A,B", help="of every scenario; default: A, B, C as far as there are such")
    parser.add_argument("--seed", type=int, default=1, help="from which each session's own seed follows")
    parser.add_argument("--budget", default="15min", metavar="TIME", help="of each training")
    parser.add_argument("--steps", type=int, help="of each training, instead of a budget: the same bits again")
    parser.add_argument("--every", type=int, default=10, metavar="N", help="label each N-th frame")
    parser.add_argument("--lidar", default="paper", help="a preset of the simulator's")
    parser.add_argument("--repeats", type=int, default=1, metavar="N", help="of the hardest tours, people predicted")
    parser.add_argument("--workers", type=int, metavar="N", help="sessions beside each other; default: 2 on two cores")
    parser.add_argument("--keep", action="store_true", help="keep all recordings, whatever the disk says")
    parser.add_argument("--quick", action="store_true", help="one short round in two rooms, in a few minutes")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the experiment. Raises UserError in one sentence; what is finished is found again by the next run."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = args.workers or min(2, cores)
    settings = settings_of(args, threads=max(1, cores // workers))
    if args.output.exists() and not args.output.is_dir():
        raise UserError(f"{args.output} is a file; the rounds need a folder")

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    told = Experiment(args.output, settings, workers=workers, keep=args.keep, say=say).run()
    print(json.dumps(brief(told, args.output), indent=2) if args.json else text(told, args.output))
    return 0


def settings_of(args: argparse.Namespace, threads: int) -> Settings:
    """Check the command line. Raises UserError by name."""
    most = {"rounds": MOST_ROUNDS, "seed": 100_000, "every": 1000, "repeats": 50, "steps": 10**8, "workers": 64}
    for name, largest in most.items():
        value = getattr(args, name)
        least = 20 if name == "steps" else FEWEST if name != "seed" else 0
        if value is not None and not least <= value <= largest:
            raise UserError(f"--{name} wants {least} to {largest}; it was given {value}")
    try:
        nanoseconds(args.budget)
    except ValueError as error:
        raise UserError(f"--budget: {error}") from error
    building = building_file(args)
    tours, mapping = tours_of(building, args.tours)
    scenarios = scenarios_of(args.scenarios)
    return Settings(
        building=str(building),
        rounds=1 if args.quick else args.rounds,
        scenarios=QUICK_SCENARIOS if args.quick else scenarios,
        tours=tours[:1] if args.quick else tours,
        mapping_tour=mapping,
        seed=args.seed,
        repeats=args.repeats,
        budget=None if args.steps or args.quick else args.budget,
        steps=args.steps or (QUICK_STEPS if args.quick else None),
        every=args.every,
        lidar=args.lidar,
        threads=threads,
    )


def building_file(args: argparse.Namespace) -> Path:
    """Return the file of the building. Raises UserError where there is none."""
    if args.building is not None:
        if not args.building.is_file():
            raise UserError(f"{args.building}: no such building")
        return Path(args.building).resolve()
    if args.quick:
        return CABIN
    return simulator_folder() / "buildings" / "default.yaml"


def simulator_folder() -> Path:
    """Return the folder of the simulator. Raises UserError where it is not installed."""
    found = importlib.util.find_spec("sim")
    if found is None or not found.submodule_search_locations:
        raise UserError("the simulator is not installed; the rounds want the extra `sim`")
    return Path(found.submodule_search_locations[0])


def scenarios_of(wanted: str) -> tuple[str, ...]:
    """Return the scenarios of the rounds. Raises UserError by name."""
    scenarios = tuple(name.strip() for name in wanted.split(",") if name.strip())
    known = sorted(path.stem for path in (simulator_folder() / "scenarios").glob("*.yaml"))
    if not scenarios or (missing := [name for name in scenarios if name not in known]):
        raise UserError(f"there is no scenario {(missing[0] if scenarios else wanted)!r}; there are {', '.join(known)}")
    return scenarios


def tours_of(building: Path, wanted: str | None) -> tuple[tuple[str, ...], str]:
    """Return the tours of the rounds, and that of the mapping: `mapping`, or the last. Raises UserError by name."""
    try:
        content: Any = yaml.safe_load(building.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{building} is no building: {error}") from error
    known = list(content.get("tours") or {}) if isinstance(content, dict) else []
    if not known:
        raise UserError(f"{building} has no tours; a building for the rounds names some, and one called mapping")
    if wanted is not None:
        tours = [name.strip() for name in wanted.split(",") if name.strip()]
        if not tours or (missing := [name for name in tours if name not in known]):
            raise UserError(f"{building} has no tour {missing[0] if tours else wanted!r}; it has {', '.join(known)}")
    else:
        tours = [name for name in TOURS if name in known] or [name for name in known if name != "mapping"] or known
    return tuple(tours), "mapping" if "mapping" in known else known[-1]


def brief(told: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the outcome without what only pictures need."""
    names = (
        "success",
        "success_predict",
        "success_lidar",
        "paper",
        "errors_cm",
        "comparison_cm",
        "driving",
        "failed",
        "hours",
        "disk_gb",
    )
    return {"report": str(folder / "report.html")} | {name: told[name] for name in names}


def text(told: dict[str, Any], folder: Path) -> str:
    """Say the outcome in lines."""
    scenarios = told["settings"]["scenarios"]
    lines = [f"{'':>10} " + " ".join(f"{name:>9}" for name in scenarios)]
    for row in [*told["success"], *told["success_predict"], *told["success_lidar"]]:
        cells = [row["cells"][name] for name in scenarios]
        shown = [
            f"{cell['success']:.0f} %{'*' if cell['completed'] else ' '}" if cell["sessions"] else "-" for cell in cells
        ]
        lines.append(f"{row['group']:>10} " + " ".join(f"{cell:>9}" for cell in shown))
    lines.append(f"* all tours completed; {told['hours']:.2f} hours; report: {folder / 'report.html'}")
    return "\n".join(lines)
