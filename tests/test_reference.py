"""A short tour among people, network included, still says what it said: recordings/reference_hard.mcap."""

from __future__ import annotations

from pathlib import Path

import pytest

from graph.recording import Recording
from graph.replay_report import Replay

REFERENCE = "recordings/reference_hard.mcap"
ROBOT = {"simulator", "segmenter", "triage", "localizer", "tracker", "planner", "annotator"}


@pytest.mark.replay(REFERENCE)
def test_a_short_tour_in_scenario_hard(replayed: Replay, request: pytest.FixtureRequest) -> None:
    assert {item.operator for item in replayed.operators} == ROBOT
    summary = Recording(Path(request.config.rootpath) / REFERENCE).summaries()["simulator"]
    assert (summary["reached"], summary["targets"], summary["collisions"]) == (3, 3, 0)
