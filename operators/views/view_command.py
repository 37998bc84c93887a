"""Show a recording in Rerun: in a window, as a web page, or as an .rrd file.

retracer view recordings/run.mcap --web
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from graph.codec import CodecError, decode, type_name
from graph.errors import UserError
from graph.recording import Entry, Recording
from graph.shard import STEP, SUMMARY
from graph.status import progress_bar
from graph.transport import free_port
from operators.dashboard import Display
from operators.views.layout import numbers_layout, robot_layout
from operators.views.scene import Scene
from operators.views.viewer import Viewer, ViewerError, finish, has_display, open_stream, send_to

CLOUDS, GRIDS = 300, 60  # how many of a topic are shown by default, evenly spread: a viewer keeps all in memory
CLOUD, GRID = "graph.messages.PointCloud", "graph.messages.OccupancyGrid"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer view`."""
    parser.add_argument("recording", type=Path)
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write what would be shown to a file")
    parser.add_argument("--web", action="store_true", help="serve a web page on this machine until Ctrl-C")
    parser.add_argument(
        "--every",
        type=_positive,
        metavar="N",
        help=f"show each N-th point cloud and grid; default: at most {CLOUDS} clouds and {GRIDS} grids a topic",
    )


def run(args: argparse.Namespace) -> int:
    """Show a recording. Raises UserError where it cannot be read, or nothing can show it."""
    recording = Recording(args.recording)
    window = not (args.web or args.save)
    if window and not has_display():
        raise UserError(
            "there is no display to open a window on; use --web for a web page or --save FILE.rrd for a file"
        )
    viewer = None
    try:
        if args.web or window:
            viewer = Viewer(free_port(), page=free_port() if args.web else None)
        stream = open_stream(args.recording.stem)
        send_to(stream, url=viewer.url if viewer else "", file=args.save)
        with progress_bar("drawing") as progress:
            draw(recording, stream, every=args.every, progress=progress)
        finish(stream, patience=600.0)
        if args.save:
            print(f"{args.save} holds the view; open it with: rerun {args.save}")
        if viewer is not None and viewer.address:
            print(f"the recording is at {viewer.address}\nCtrl-C ends", flush=True)
            _wait(viewer)
    except ViewerError as error:
        raise UserError(str(error)) from None
    finally:
        if viewer is not None and viewer.address:
            viewer.close()
    return 0


def draw(
    recording: Recording,
    stream: rr.RecordingStream,
    *,
    every: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Draw a recording into a Rerun stream, layout included; every: each so many-th cloud and grid of a topic."""
    display = Display(Scene(stream))
    known = {type_name(kind): kind for kind in display.ways}
    shown = [topic for topic, (name, _) in recording.types.items() if name in known]
    clouds = [topic for topic in shown if recording.types[topic][0] == CLOUD]
    best = next((topic for topic in clouds if topic.endswith("/classified")), next(iter(clouds), None))
    plots: dict[str, None] = {}

    def layout() -> rrb.Blueprint:
        if not shown:
            return numbers_layout(list(plots))
        hidden = [*(f"world/{topic}" for topic in clouds if topic != best), *display.scene.hidden]
        usual = float(np.percentile(display.latencies, 99)) if display.latencies else 0.0
        return robot_layout(eye=display.eye(), hidden=hidden, others=list(plots), slowest=1.5 * usual or None)

    if shown:
        stream.send_blueprint(layout())
    end = max(recording.verdict.end, 1)
    sinks = {spec.name for spec in recording.run.specs if spec.kind == "sink"}
    for entry in _thinned(recording, every):
        progress(min(entry.stamp / end, 1.0))
        kind = known.get(recording.types[entry.topic][0])
        if entry.port == STEP:
            if entry.operator not in sinks:
                display.step(entry.operator, entry.step())
        elif entry.port == SUMMARY:
            _sum_up(display, entry)
        elif kind is not None:
            _show(display, entry, kind)
        elif _numbers(display, entry, recording.types[entry.topic][0]):
            plots[f"fields/{entry.topic}"] = None
    display.finish()
    display.scene.at(recording.verdict.end)
    reasons = "".join(f"; {reason}" for reason in recording.verdict.reasons)
    display.scene.say("verdict", recording.verdict.verdict + reasons, "WARN" if reasons else "INFO")
    stream.send_blueprint(layout())


def _thinned(recording: Recording, every: int | None) -> Iterator[Entry]:
    """Iterate over a recording without most of what a viewer would only drown in."""
    most = {CLOUD: CLOUDS, GRID: GRIDS}
    steps: dict[str, int] = {}
    for topic, (name, _) in recording.types.items():
        if name in most:
            steps[topic] = every or -(-recording.counts.get(topic, 0) // most[name]) or 1
    met = dict.fromkeys(steps, 0)
    for entry in recording.entries():
        if entry.topic in steps:
            met[entry.topic] += 1
            if (met[entry.topic] - 1) % steps[entry.topic]:
                continue
        yield entry


def _show(display: Display, entry: Entry, kind: type[msgspec.Struct]) -> None:
    try:
        display.show(entry.topic, decode(entry.payload, kind), entry.stamp)
    except CodecError as error:  # of another version of the vocabulary
        display.scene.at(entry.stamp)
        if display.news(entry.topic, "unreadable", True):
            display.scene.say(entry.topic, f"messages of another version are not shown: {error}", "WARN")


def _numbers(display: Display, entry: Entry, name: str) -> bool:
    """Plot the numbers of a message of a type that nobody here knows. Returns whether it has any."""
    display.scene.at(entry.stamp)
    values = dict(_leaves(msgspec.msgpack.decode(entry.payload, ext_hook=lambda code, data: None)))
    values.pop("measured_at", None)
    for field, value in values.items():
        display.scene.number(f"fields/{entry.topic}", field, value)
    if display.news(entry.topic, "type", name):
        told = f"its numbers are plotted: {', '.join(values)}" if values else "it has no numbers to plot"
        display.scene.say(entry.topic, f"first message of type {name}; {told}")
    return bool(values)


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Iterate over the numbers in nested mappings, each with its path; numbers in lists are left out."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, (bool, int, float)):
        yield path or "value", float(value)


def _sum_up(display: Display, entry: Entry) -> None:
    display.scene.at(entry.stamp)
    for name, value in msgspec.msgpack.decode(entry.payload).items():
        shown = f"{value:.4g}" if isinstance(value, float) else value
        display.scene.say(entry.operator, f"{name} {shown}")


def _wait(viewer: Viewer) -> None:
    try:
        while viewer.alive:
            time.sleep(0.2)
    except KeyboardInterrupt:
        return
    raise UserError("the web viewer has ended by itself")


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"wants a whole number of at least 1, not {text}")
    return number
