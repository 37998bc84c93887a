"""Ten minutes of realtime: six operators, 1.2 MB clouds at 20 Hz, and not one message unaccounted for."""

from __future__ import annotations

from pathlib import Path

import pytest

from graph.check import require
from graph.launcher import launch
from graph.recording import Recording
from tests.conftest import Write

MINUTES = 10.0
RATE = 20  # Hz

SOAK = """
clock: {{mode: realtime, duration: {seconds}s}}
operators:
  maker:
    run: tests.sample_operators:BlobMaker
    inputs: {{tick: timer/{rate}hz}}
    config: {{size: 1200000}}
    record: digest
  one: {{run: tests.sample_operators:BlobRelay, inputs: {{blob: maker/blob}}, record: digest}}
  two: {{run: tests.sample_operators:BlobRelay, inputs: {{blob: one/blob}}, record: digest}}
  three: {{run: tests.sample_operators:BlobRelay, inputs: {{blob: two/blob}}, record: digest}}
  side: {{run: tests.sample_operators:BlobRelay, inputs: {{blob: maker/blob}}, record: digest}}
  counter: {{run: tests.sample_operators:Counter, inputs: {{tick: timer/{rate}hz}}}}
"""


def soak(graph_file: Write, tmp_path: Path, seconds: float) -> Recording:
    """Run the graph for a while and hold every edge's account."""
    graph = require(graph_file(SOAK.format(seconds=seconds, rate=RATE)))
    outcome = launch(graph, record=tmp_path / "soak.mcap", quiet=True)
    recording = Recording(outcome.recording)
    assert recording.verdict.verdict == "COMPLETE", recording.verdict.reasons
    for account in recording.verdict.accounts:
        assert account.lost == 0
        assert account.emitted == account.consumed + account.skipped
    return recording


@pytest.mark.slow
def test_ten_minutes_at_twenty_hertz_lose_nothing(graph_file: Write, tmp_path: Path) -> None:
    recording = soak(graph_file, tmp_path, MINUTES * 60)
    made = next(account.emitted for account in recording.verdict.accounts if account.topic == "maker/blob")
    missed = sum(skip.why == "missed" for _, _, step in recording.steps("maker") for skip in step.skipped)
    assert made + missed == pytest.approx(MINUTES * 60 * RATE, abs=2)


def test_two_seconds_of_it_lose_nothing(graph_file: Write, tmp_path: Path) -> None:
    recording = soak(graph_file, tmp_path, 2.0)
    assert recording.counts.get("maker/blob", 0) == 0
    assert len(list(recording.steps("three"))) > 10
