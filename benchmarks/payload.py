"""What the runtime does to a 1.2 MB cloud, step by step, and how fast it replays a recording of such clouds."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stations import POINTS, CloudMaker, cloud
from graph.check import require
from graph.codec import decode, digest, encode
from graph.graphfile import Graph
from graph.inprocess import launch_in_process
from graph.ledger import Step
from graph.memory import keep_pages
from graph.messages import PointCloud
from graph.node import Emission
from graph.recording import Recording
from graph.replay import replay
from graph.shard import Shard, schemas_of
from graph.wiring import wire

REPEATS = 300
SCANS = 200  # of a recording at 10 Hz

GRAPH = f"""
clock: {{mode: lockstep, end: maker}}
operators:
  maker:
    run: benchmarks.stations:{CloudMaker.__name__}
    inputs: {{tick: timer/10hz}}
    config: {{count: {SCANS}, timed: false}}
  pass: {{run: benchmarks.stations:CloudPass, inputs: {{cloud: maker/cloud}}}}
"""


def milliseconds(call: Callable[[], object]) -> float:
    """Return the median duration of a call."""
    taken = []
    for _ in range(REPEATS):
        begun = time.perf_counter_ns()
        call()
        taken.append(time.perf_counter_ns() - begun)
    return float(np.median(taken)) / 1e6


def shard_speed(graph: Graph, folder: Path, payload: bytes) -> float:
    """Return how many MB/s an operator's process writes to its shard."""
    spec = wire(graph)[0]
    shard = Shard(folder / "shard.mcap", spec, schemas_of({"cloud": PointCloud}))
    step = Step(0, "tick", 0, (), (), (), None, False, 0, 0)
    taken = milliseconds(lambda: shard.write([Emission("cloud", 0, 0, payload)], step))
    shard.close()
    return len(payload) / 1e3 / taken


def rows() -> list[dict[str, Any]]:
    """Measure the codec beside a plain copy, then replay."""
    keep_pages()
    message = cloud(POINTS)
    payload = encode(message)
    copied = milliseconds(lambda: bytearray(payload))
    steps = {
        "encode": milliseconds(lambda: encode(message)),
        "digest": milliseconds(lambda: digest(payload)),
        "decode": milliseconds(lambda: decode(payload, PointCloud)),
    }
    found: list[dict[str, Any]] = [
        {
            "name": f"{name} a cloud of 1.2 MB",
            "value": value,
            "unit": "ms",
            "peer": "a plain copy",
            "peer_value": copied,
            "ratio": value / copied,
        }
        for name, value in steps.items()
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clouds.yaml"
        path.write_text(GRAPH)
        graph = require(path)
        found.append({"name": "write a shard", "value": shard_speed(graph, Path(folder), payload), "unit": "MB/s"})
        begun = time.perf_counter()
        _, recorded = launch_in_process(graph, record=Path(folder) / "clouds.mcap")
        taken = time.perf_counter() - begun
        size = 2 * SCANS * len(payload) / 1e6
        found.append({"name": "record and merge clouds, one process", "value": size / taken, "unit": "MB/s"})
        told = replay(Recording(recorded))
    if not told.equal:
        raise RuntimeError("the replay of the benchmark's own recording diverged")
    speed = min(operator.times_real_time for operator in told.operators)
    found.append({"name": "replay of clouds at 10 Hz, the slower operator", "value": speed, "unit": "x real"})
    return found
