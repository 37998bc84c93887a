"""Save the occupancy map of a recording as ROS map.yaml and PGM.

retracer occupancy recordings/run.mcap -o map.yaml
"""

from __future__ import annotations

import argparse
from pathlib import Path

from graph.codec import decode
from graph.errors import UserError
from graph.messages import OccupancyGrid
from graph.recording import Recording
from operators.montecarlo.map_file import GridMap, MapError, save_map

KIND = "graph.messages.OccupancyGrid"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer occupancy`."""
    parser.add_argument("recording", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="MAP.yaml", help="the image lies beside it")
    parser.add_argument("--topic", metavar="TOPIC", help="default: the only occupancy grid")


def run(args: argparse.Namespace) -> int:
    """Save the last map. Raises UserError in one sentence."""
    if args.output.suffix not in (".yaml", ".yml"):
        raise UserError(f"{args.output} is no map's name; it ends in .yaml, and the image lies beside it")
    recording = Recording(args.recording)
    fitting = [topic for topic, (kind, _) in recording.types.items() if kind == KIND]
    wanted = [args.topic] if args.topic else fitting
    if len(wanted) != 1 or wanted[0] not in fitting:
        raise UserError(
            f"{args.recording} has occupancy grids on {', '.join(fitting) or 'no topic'}; name one by --topic"
        )
    last = None
    for entry in recording.messages(wanted[0]):
        last = entry
    if last is None:
        raise UserError(f"{args.recording} has no message on {wanted[0]}")
    grid = decode(last.payload, OccupancyGrid)
    try:
        save_map(args.output, GridMap(grid.cells, grid.origin, grid.resolution))
    except MapError as error:
        raise UserError(str(error)) from None
    print(f"{args.output}: {grid.cells.shape[1]} x {grid.cells.shape[0]} cells of {grid.resolution:g} m")
    return 0
