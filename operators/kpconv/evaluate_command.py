"""Compare a trained segmenter with the truth of simulated sessions.

retracer evaluate weights.safetensors recordings/run.mcap --picture confusion.png
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from graph.codec import decode
from graph.errors import UserError
from graph.messages import PointCloud
from graph.recording import Recording
from graph.status import progress_bar
from operators.kpconv.classifier import Classifier, classifier_of
from operators.kpconv.figures import draw_evaluation
from operators.kpconv.metrics import Tally, table
from operators.kpconv.train_command import labelled_topic
from operators.kpconv.weights import WeightsError, load

UNTIMED = 3  # first frames, while compilers and caches warm up
STAGES = ("pyramid", "network", "points")  # pyramid: or the range image; points: scores back on all points
PRECISIONS = {"auto": None, "float32": torch.float32, "bfloat16": torch.bfloat16}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer evaluate`."""
    parser.add_argument("weights", type=Path)
    parser.add_argument("sessions", nargs="+", type=Path, metavar="SESSION", help="recordings with true classes")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take each N-th frame")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--precision", choices=sorted(PRECISIONS), default="auto")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the confusion and reliability")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def frames_of(path: Path, every: int) -> Iterator[PointCloud]:
    """Iterate over each so many-th frame of a recording that carries truth. Raises UserError where none does."""
    recording = Recording(path)
    topic = labelled_topic(recording, field="truth")
    for number, entry in enumerate(recording.messages(topic)):
        if number % every == 0:
            yield decode(entry.payload, PointCloud)


def evaluate(classifier: Classifier, frame: PointCloud, tally: Tally) -> list[float]:
    """Classify a frame at full resolution, count it, and return the seconds that each stage took."""
    begin = time.perf_counter()
    prepared = classifier.prepare(frame.points, frame.base_from_lidar, frame.ring)
    ready = time.perf_counter()
    scores = classifier.infer(prepared)
    inferred = time.perf_counter()
    labels, point_scores = classifier.finish(prepared, scores).full()
    done = time.perf_counter()
    assert frame.truth is not None
    distance = np.hypot(frame.points[:, 0], frame.points[:, 1])
    tally.add(labels, point_scores, frame.truth, distance, frame.moving, frame.instance)
    return [ready - begin, inferred - ready, done - inferred]


def latencies(seconds: list[list[float]]) -> dict[str, dict[str, float]]:
    """Return median and 95th percentile in ms of each stage and of the whole."""
    times = np.array(seconds[UNTIMED:] or seconds) * 1e3
    columns = {name: times[:, i] for i, name in enumerate(STAGES)} | {"whole": times.sum(1)}
    return {
        name: {"p50_ms": round(float(np.median(column)), 2), "p95_ms": round(float(np.percentile(column, 95)), 2)}
        for name, column in columns.items()
    }


def run(args: argparse.Namespace) -> int:
    """Evaluate and print. Raises UserError where weights or sessions cannot be read."""
    if args.every < 1 or args.threads < 1:
        raise UserError(f"--every and --threads want at least 1; given are {args.every} and {args.threads}")
    torch.set_num_threads(args.threads)
    try:
        network, header = load(args.weights)
    except WeightsError as error:
        raise UserError(str(error)) from error
    classifier = classifier_of(network, header.settings, PRECISIONS[args.precision])
    tally = Tally()
    seconds: list[list[float]] = []
    total = sum(Recording(path).counts.get(labelled_topic(Recording(path), field="truth"), 0) for path in args.sessions)
    with progress_bar("evaluating", quiet=args.json) as progress:
        for path in args.sessions:
            for frame in frames_of(path, args.every):
                seconds.append(evaluate(classifier, frame, tally))
                progress(len(seconds) * args.every / max(1, total))
    report: dict[str, Any] = tally.report()
    report |= {"latency": latencies(seconds), "threads": args.threads, "weights": str(args.weights)}
    report["settings"] = msgspec.to_builtins(header.settings)
    report["sessions"] = [path.name for path in args.sessions]
    if args.picture is not None:
        draw_evaluation(report, args.picture)
    print(json.dumps(report, indent=2) if args.json else text(report))
    return 0


def text(report: dict[str, Any]) -> str:
    """Lay out a report for people."""
    whole = report["latency"]["whole"]
    stages = ", ".join(f"{name} {report['latency'][name]['p50_ms']:.1f}" for name in STAGES)
    seen = f"{100 * report['near_walkers_seen']:.1f} % of {report['near_walkers']}"
    return "\n".join(
        [
            table(report),
            f"{report['frames']} frames: {whole['p50_ms']:.1f} ms a frame (p95 {whole['p95_ms']:.1f}) on "
            f"{report['threads']} threads: {stages}",
            f"called shortT: wall and ground {100 * report['structure_called_shortT']:.2f} %, furniture within 3 m "
            f"{100 * report['near_furniture_called_shortT']:.2f} %; walkers within 5 m: {seen} seen",
            f"calibration error {100 * report['calibration_error']:.2f} %",
        ]
    )
