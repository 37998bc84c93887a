"""Graphs and recordings that many tests share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from graph.check import require
from graph.inprocess import launch_in_process
from graph.recording import Recording

settings.register_profile("tests", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("tests")  # a first example may have to compile

ROOT = Path(__file__).parents[1]

CHAIN = """
clock: {mode: lockstep, end: counter}
operators:
  counter: {run: tests.sample_operators:Counter, inputs: {tick: timer/10hz}, config: {last: 30}}
  relay: {run: tests.sample_operators:Relay, inputs: {count: counter/count}, config: {offset: 1}}
  adder: {run: tests.sample_operators:Adder, inputs: {left: {from: relay/count, delay: 30ms}, right: counter/count}}
  feedback:
    run: tests.sample_operators:Feedback
    inputs: {back: {from: feedback/count, delay: 50ms}, tick: timer/20hz}
  maker: {run: tests.sample_operators:BlobMaker, inputs: {tick: timer/5hz}, config: {size: 3000}}
  blobs: {run: tests.sample_operators:BlobRelay, inputs: {blob: maker/blob}}
  screen: {run: tests.sample_operators:Screen, inputs: {count: relay/count}}
"""

Write = Callable[..., Path]


@pytest.fixture
def graph_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Write a graph file; the working directory is the checkout, where `tests.sample_operators` is found."""
    monkeypatch.chdir(ROOT)

    def write(text: str = CHAIN, name: str = "chain.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.fixture
def record(graph_file: Write, tmp_path: Path) -> Callable[..., Recording]:
    """Run a graph in this process and open its recording."""

    def run(
        text: str = CHAIN, *, name: str = "run.mcap", sets: tuple[str, ...] = (), swaps: tuple[str, ...] = ()
    ) -> Recording:
        graph = require(graph_file(text), sets, swaps)
        _, path = launch_in_process(graph, record=tmp_path / name)
        return Recording(path)

    return run
