"""How long the segmenter takes for a frame, beside a k-d tree and beside plain torch; how long a training step takes.

python -m benchmarks.segmenter
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from operators.kpconv.classifier import KPConvClassifier, classifier_of
from operators.kpconv.frames import Frames
from operators.kpconv.metrics import LABEL_OF_TRUTH
from operators.kpconv.network import batch_of
from operators.kpconv.plan import Plan
from operators.kpconv.pyramid import Pyramid
from operators.kpconv.settings import PRESETS
from operators.kpconv.training import Trainer
from operators.kpconv.weights import recipe_of

THREADS = 2
REPEATS = 15
TRAINING_STEPS, UNTIMED = 6, 2


def frames(count: int, lidar: str) -> tuple[list[Any], np.ndarray]:
    """Drive a little through the default building; returns frames and base_from_lidar."""
    from sim import World  # here: the extra `sim` may be absent

    world = World("sim/buildings/default.yaml", "medium", "A", seed=5, lidar=lidar)
    seen = []
    for _ in range(count):
        for _ in range(5):
            world.advance(0.5, 0.2)
        seen.append(world.scan())
    return seen, world.base_from_lidar()


def milliseconds(task: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the median time of a task, after one run that does not count."""
    task()
    return median_of(lambda _: task(), range(repeats))


def median_of(task: Callable[[Any], Any], given: Sequence[Any]) -> float:
    """Return the median time of a task in ms, over what it is given one after the other."""
    times = []
    for item in given:
        begin = time.perf_counter()
        task(item)
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times))


def tree_pyramid(pyramid: Pyramid, voxel: float) -> int:
    """Find the neighbours of a pyramid by k-d trees, without influences; returns how many there are."""
    found = 0
    trees = [cKDTree(points) for points in pyramid.points]
    for level, tree in enumerate(trees):
        radius = 2.5 * voxel * 2**level
        found += sum(map(len, tree.query_ball_point(pyramid.points[level], radius)))
        if level + 1 < len(trees):
            found += sum(map(len, tree.query_ball_point(pyramid.points[level + 1], radius)))
            found += len(trees[level + 1].query(pyramid.points[level])[1])
    return found


def row(name: str, value: float, unit: str, peer: str = "", peer_value: float | None = None) -> dict[str, Any]:
    """Make a row of the benchmark table; ratio: peer to ours for times, so that more is better."""
    ratio = None if peer_value is None else round(peer_value / value, 2)
    shown = None if peer_value is None else round(peer_value, 2)
    return {"name": name, "value": round(value, 2), "unit": unit, "peer": peer, "peer_value": shown, "ratio": ratio}


def frame_rows(lidar: str, preset: str = "realtime") -> list[dict[str, Any]]:
    """Time frames of a lidar: whole, pyramid beside scipy's tree, network beside plain torch.

    No two frames have equally many points, which is what a network's products notice.
    """
    seen, base_from_lidar = frames(2 * REPEATS, lidar)
    points, ring = seen[0].points, seen[0].ring
    settings = PRESETS[preset]
    torch.manual_seed(0)
    network = recipe_of(settings).network().eval()
    classifier = classifier_of(network, settings)
    for frame in seen[:REPEATS]:  # compilers and caches
        classifier.classify(frame.points, base_from_lidar, frame.ring)
    timed = seen[REPEATS:]
    whole = median_of(lambda frame: classifier.classify(frame.points, base_from_lidar, frame.ring).full(), timed)
    rows = [
        row(f"segmenter frame, {preset}, {lidar} ({len(points)} points)", whole, "ms"),
        row(f"segmenter rate, {preset}, {lidar}", 1e3 / whole, "frames/s"),
    ]
    if not isinstance(classifier, KPConvClassifier):
        return rows
    prepared = classifier.prepare(points, base_from_lidar, ring)
    pyramid, inputs = prepared.given
    tree = milliseconds(lambda: tree_pyramid(pyramid, settings.voxel), 3)
    mine = median_of(lambda frame: classifier.prepare(frame.points, base_from_lidar, frame.ring), timed)
    rows.append(row(f"segmenter pyramid, {preset}, {lidar}", mine, "ms", "scipy.spatial.cKDTree", tree))
    batch = batch_of(pyramid, inputs)
    with torch.no_grad():
        plain = milliseconds(lambda: network(batch, plain=True), 3)
    made = [classifier.prepare(frame.points, base_from_lidar, frame.ring) for frame in timed]
    fast = median_of(classifier.infer, made)
    rows.append(row(f"segmenter network, {preset}, {lidar}", fast, "ms", "plain torch", plain))
    return rows


def core_row(preset: str = "realtime") -> dict[str, Any]:
    """Measure the processor time of a frame on one thread, as graph.yaml has it."""
    seen, base_from_lidar = frames(2 * REPEATS, "paper")
    torch.set_num_threads(1)
    classifier = classifier_of(recipe_of(PRESETS[preset]).network().eval(), PRESETS[preset])
    spent = []
    for frame in seen:
        begin = time.process_time()
        classifier.classify(frame.points, base_from_lidar, frame.ring, full=False)
        spent.append(time.process_time() - begin)
    torch.set_num_threads(THREADS)
    return row(f"segmenter frame, {preset}, paper, one core", 1e3 * float(np.median(spent[REPEATS:])), "core-ms")


def training_rows(preset: str = "realtime") -> list[dict[str, Any]]:
    """Time training steps: batches made ahead by another thread, and the share of the time they are waited for."""
    seen, base_from_lidar = frames(4, "paper")
    data = Frames()
    for frame in seen:
        data.add(frame.points, LABEL_OF_TRUTH[frame.truth], base_from_lidar, frame.ring)
    torch.set_num_threads(1)  # the other core makes the batches
    trainer = Trainer(PRESETS[preset], Plan(steps=10**6), data)
    making = milliseconds(lambda: trainer.batch(0), 3)
    waited, begin = 0.0, time.perf_counter()
    for step, (batch, seconds) in enumerate(trainer.batches()):
        if step == UNTIMED:
            waited, begin = 0.0, time.perf_counter()
        waited += seconds
        trainer.learn(batch)
        if step == UNTIMED + TRAINING_STEPS - 1:
            break
    spent = time.perf_counter() - begin
    torch.set_num_threads(THREADS)
    return [
        row(f"segmenter training step, {preset}, batch {trainer.plan.batch}", 1e3 * spent / TRAINING_STEPS, "ms"),
        row(f"segmenter training, making a batch, {preset}", making, "ms"),
        row(f"segmenter training, waiting for batches, {preset}", 100.0 * waited / spent, "%"),
    ]


def rows() -> list[dict[str, Any]]:
    """Measure everything."""
    torch.set_num_threads(THREADS)
    return [
        *frame_rows("paper"),
        core_row(),
        *frame_rows("hdl32e"),
        *frame_rows("paper", "rangenet"),
        *training_rows(),
    ]


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
