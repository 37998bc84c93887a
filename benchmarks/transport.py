"""A 1.2 MB cloud from one operator's Outputs to the next one's on_ method, beside bare Zenoh and dora-rs."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers import dora_latencies, zenoh_latencies
from benchmarks.stations import WARM_UP
from graph.check import require
from graph.launcher import launch
from graph.recording import Recording

ROUNDS = 3  # each measures all in turn, since a machine is not the same a minute later
COUNT = 100  # clouds in a round
HERTZ = 20.0

GRAPH = """
clock: {{mode: lockstep, pace: realtime, end: maker}}
operators:
  maker: {{run: benchmarks.stations:CloudMaker, inputs: {{tick: timer/{hertz:g}hz}}, config: {{count: {count}}}}}
  meter: {{run: benchmarks.stations:CloudMeter, inputs: {{cloud: maker/cloud}}}}
"""


def latencies(count: int = COUNT, hertz: float = HERTZ) -> np.ndarray:
    """Run maker and meter as two operators, recorded as by default. Returns (count,) in milliseconds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.yaml"
        path.write_text(GRAPH.format(count=count + WARM_UP, hertz=hertz))
        graph = require(path)
        graph.root = "."
        outcome = launch(graph, record=Path(folder) / "cloud.mcap", quiet=True)
        if outcome.verdict.verdict != "COMPLETE":
            raise RuntimeError(f"the run was {outcome.verdict.verdict}: {outcome.verdict.reasons}")
        return np.array(Recording(outcome.recording).summaries()["meter"]["latencies"]) / 1e6


def rows() -> list[dict[str, Any]]:
    """Measure ours and the peers' in one run."""
    peers = {"bare Zenoh": zenoh_latencies, "dora-rs": dora_latencies}
    ours: list[np.ndarray] = []
    theirs: dict[str, list[np.ndarray]] = {peer: [] for peer in peers}
    for _ in range(ROUNDS):
        ours.append(latencies())
        for peer in list(peers):
            try:
                theirs[peer].append(peers[peer](COUNT + WARM_UP, HERTZ))
            except RuntimeError as error:
                print(f"{peer} left out: {error}")
                del peers[peer]
    found = [row for peer in peers for row in _rows(np.concatenate(ours), peer, np.concatenate(theirs[peer]))]
    return found or list(_rows(np.concatenate(ours), "", None))


def _rows(ours: np.ndarray, peer: str, theirs: np.ndarray | None) -> Iterator[dict[str, Any]]:
    for share in (50, 99):
        value = float(np.percentile(ours, share))
        other = None if theirs is None else float(np.percentile(theirs, share))
        yield {
            "name": f"cloud 1.2 MB, p{share}",
            "value": value,
            "unit": "ms",
            "peer": peer or None,
            "peer_value": other,
            "ratio": value / other if other else None,
        }
