"""What evaluation counts, on numbers that can be checked by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from operators.kpconv.figures import draw_curves, draw_evaluation
from operators.kpconv.metrics import Tally, table


def tally() -> Tally:
    """Count ten points."""
    truth = np.array([1, 1, 2, 2, 3, 4, 5, 6, 7, 0], np.uint8)
    labels = np.array([1, 2, 2, 4, 3, 3, 4, 4, 3, 1], np.uint8)
    scores = np.full((10, 4), 0.1, np.float32)
    scores[np.arange(10), labels - 1] = 0.7
    distance = np.array([1, 1, 1, 9, 1, 1, 1, 1, 1, 1], np.float32)
    result = Tally()
    result.add(labels, scores, truth, distance)
    return result


def test_rows_are_truth_and_columns_are_predictions() -> None:
    report = tally().report()
    assert report["points"] == 9
    assert report["confusion"]["ground"] == {"ground": 0.5, "permanent": 0.5, "longT": 0.0, "shortT": 0.0}
    assert report["recall"] == {
        "ground": 0.5, "wall": 0.5, "door": 1.0, "table": 1.0, "chair": 0.0, "moving person": 1.0, "still person": 1.0,
    }  # fmt: skip
    assert report["iou"] == pytest.approx({"ground": 0.5, "permanent": 1 / 3, "longT": 0.75, "shortT": 1 / 3})
    assert report["structure_called_shortT"] == 0.25
    assert report["near_furniture_called_shortT"] == 0.5
    assert "moving person" in table(report)


def test_calibration_is_confidence_against_truth() -> None:
    report = tally().report()
    assert sum(report["reliability"]["points"]) == 9
    assert report["calibration_error"] == pytest.approx(abs(0.7 - 6 / 9), abs=1e-6)


def test_walkers_count_when_they_are_near_and_have_points() -> None:
    result = Tally()
    instance = np.repeat([1, 2, 3, 4], [30, 30, 10, 30]).astype(np.int32)
    distance = np.where(instance == 4, 8.0, 2.0).astype(np.float32)
    labels = np.where(instance == 2, 3, 4).astype(np.uint8)
    labels[:10] = 2  # a third of the first one
    truth = np.full(100, 6, np.uint8)
    scores = np.full((100, 4), 0.25, np.float32)
    result.add(labels, scores, truth, distance, np.ones(100, np.bool_), instance)
    report = result.report()
    assert (report["near_walkers"], report["near_walkers_seen"]) == (2, 0.5)
    standing = Tally()
    standing.add(labels, scores, truth, distance, np.zeros(100, np.bool_), instance)
    assert standing.report()["near_walkers"] == 0


def test_nothing_counted_is_no_error(tmp_path: Path) -> None:
    report = Tally().report()
    assert report["points"] == 0
    assert table(report)
    draw_evaluation(report, tmp_path / "e.png")
    draw_curves([{"step": 1, "loss": 1.0, "recall": {}}], tmp_path / "c.png")
    assert (tmp_path / "e.png").stat().st_size > 1000
    assert (tmp_path / "c.png").stat().st_size > 1000
