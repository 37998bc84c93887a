"""Check a building, draw its plan, and render it furnished and populated.

retracer building sim/buildings/default.yaml --plot plan.png --scenario extreme --tour A --seed 1 --snapshot world.png
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from graph.errors import UserError
from graph.status import progress_bar
from sim.building import Building, BuildingError
from sim.building_file import find, read
from sim.inspection import inspect
from sim.rosmap import write_map

PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer building`."""
    parser.add_argument("file", help="YAML of a building, PLY of boxes or map.yaml of a ROS map; or a shipped name")
    parser.add_argument("--plot", type=_picture, metavar="OUT.png", help="draw walls, doors, rooms, tables and tours")
    parser.add_argument("--snapshot", type=_picture, metavar="OUT.png", help="render the populated world")
    parser.add_argument("--map", type=_map, metavar="OUT.yaml", help="write its walls, doors open, as a ROS map")
    parser.add_argument("--scenario", default="easy", help="of the snapshot: a name or a file; default: easy")
    parser.add_argument("--tour", help="of the snapshot, or the only one to plot; default: the first, or all")
    parser.add_argument("--seed", type=int, default=1, help="of the snapshot; default: 1")
    parser.add_argument("--json", action="store_true", help="print what there is, and the mistakes, as JSON")


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(f"{text!r} is no picture's name; it ends in one of {', '.join(PICTURES)}")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"there is no folder {path.parent}")
    return path


def _map(text: str) -> Path:
    path = Path(text)
    if path.suffix not in (".yaml", ".yml"):
        raise argparse.ArgumentTypeError(f"{text!r} is no map's name; it ends in .yaml, and the image lies beside it")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"there is no folder {path.parent}")
    return path


def run(args: argparse.Namespace) -> int:
    """Check a building and draw it. Returns 2 if it has mistakes; raises UserError where it cannot be read."""
    try:
        source = find(args.file)
        building, form = read(args.file)
    except BuildingError as error:
        raise UserError(str(error)) from error
    if args.tour is not None and args.tour not in building.tours:
        raise UserError(f"{source} has no tour {args.tour!r}; it has {', '.join(building.tours) or 'none'}")
    mistakes = form + [f"{source}: {mistake}" for mistake in inspect(building)]
    if args.json:
        print(json.dumps(_contents(source, building, mistakes), indent=2))
    elif not mistakes:
        print(f"{source}: {_sentence(building)}; no mistakes")
    for mistake in () if args.json else mistakes:
        print(mistake, file=sys.stderr)
    if args.plot is not None and (building.segments() or building.blocks):
        from sim.plan_drawing import draw_plan

        draw_plan(building, args.plot, only=args.tour)
    if mistakes:
        return 2
    if args.map is not None:
        try:
            write_map(building, args.map)
        except BuildingError as error:
            raise UserError(str(error)) from error
    if args.snapshot is not None:
        _snapshot(args, source, building)
    return 0


def _snapshot(args: argparse.Namespace, source: Path, building: Building) -> None:
    tour = args.tour or next(iter(building.tours), None)
    if tour is None:
        raise UserError(f"{source} has no tours; a snapshot shows a session, which drives one")
    try:
        from sim.snapshot import draw_snapshot
        from sim.world import World
    except ModuleNotFoundError as error:
        raise UserError(str(error)) from error
    with progress_bar("rendering", quiet=args.json) as progress:
        try:
            world = World(source, args.scenario, tour, args.seed)
        except BuildingError as error:
            raise UserError(str(error)) from error
        counts = f"{len(world.crowd.position)} walkers, {len(world.seats)} sitters"
        title = f"{building.name}, {args.scenario}, tour {tour}, seed {args.seed}: {counts}"
        draw_snapshot(world, args.snapshot, title, progress=progress)


def _contents(source: Path, building: Building, mistakes: list[str]) -> dict[str, object]:
    return {
        "file": str(source),
        "name": building.name,
        "rooms": len(building.rooms),
        "doors": len(building.doors),
        "tables": len(building.tables),
        "populated_area_m2": building.populated_area(),
        "tours": {name: len(tour.targets) for name, tour in building.tours.items()},
        "mistakes": mistakes,
    }


def _sentence(building: Building) -> str:
    walls = len({segment.wall for segment in building.segments()}) + len(building.blocks)
    counts = ((walls, "walls"), (len(building.rooms), "rooms"), (len(building.doors), "doors"))
    parts = [f"{count} {what}" for count, what in (*counts, (len(building.tables), "table positions")) if count]
    if building.tours:
        parts.append(f"tours {', '.join(building.tours)}")
    return ", ".join(parts)
