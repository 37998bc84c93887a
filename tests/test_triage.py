"""Triage: every consumer gets its classes, nobody another's, and a frame without labels is split by height."""

from __future__ import annotations

import numpy as np
import pytest

from graph.contract import ports_of
from graph.geometry import planar
from graph.messages import PointCloud
from operators.triage import LABELS, TABLE, Triage, chosen

MOUNT = planar(0.0, 0.0, 0.0, 0.64)


def cloud(count=500, *, labelled=True):
    random = np.random.default_rng(3)
    return PointCloud(
        measured_at=7,
        points=random.uniform(-3.0, 3.0, (count, 3)).astype(np.float32),
        base_from_lidar=MOUNT,
        ring=random.integers(0, 32, count).astype(np.uint8),
        label=random.integers(0, 5, count).astype(np.uint8) if labelled else None,
        scores=random.random((count, 4)).astype(np.float32),
        instance=np.arange(count, dtype=np.int32),
    )


def test_ports_are_those_of_the_graph():
    assert list(ports_of(Triage).inputs) == ["frame"]
    assert list(ports_of(Triage).outputs) == ["localization", "planning", "people"]


@pytest.mark.parametrize("column", ["ours", "paper", "authors"])
def test_each_consumer_gets_its_classes_whole(column):
    frame = cloud()
    outputs = Triage(Triage.Config(column=column)).on_frame(frame)
    wanted = {
        "localization": TABLE["pointmap", column],
        "planning": TABLE["planner", column],
        "people": ("shortT",),
    }
    for port, names in wanted.items():
        got = getattr(outputs, port)
        keep = np.isin(frame.label, [LABELS.index(name) for name in names])
        assert np.array_equal(got.instance, frame.instance[keep])
        for name in ("points", "ring", "label", "scores"):
            assert np.array_equal(getattr(got, name), getattr(frame, name)[keep])
        assert got.measured_at == 7
        assert got.truth is None


def test_paper_hides_what_moves_from_everybody_but_the_tracker():
    outputs = Triage().on_frame(cloud())
    assert set(outputs.localization.label) == {1, 2}
    assert set(outputs.planning.label) == {0, 2, 3}
    assert set(outputs.people.label) == {4}


def test_classes_can_be_named():
    outputs = Triage(Triage.Config(localization=["permanent"], planning=["longT", "shortT"])).on_frame(cloud())
    assert set(outputs.localization.label) == {2}
    assert set(outputs.planning.label) == {3, 4}


def test_other_localizers_have_their_rows():
    frame = cloud()
    assert set(Triage(Triage.Config(localizer="amcl")).on_frame(frame).localization.label) == {2}
    assert set(Triage(Triage.Config(localizer="gmapping")).on_frame(frame).localization.label) == {0, 2, 3}
    with pytest.raises(ValueError, match=r"says nothing of amcl; there are authors, ours"):
        Triage(Triage.Config(localizer="amcl", column="paper"))


def test_without_labels_height_decides():
    frame = cloud(labelled=False)
    outputs = Triage().on_frame(frame)
    assert outputs.localization is frame
    assert outputs.people is None
    height = frame.points[:, 2] + 0.64
    assert np.array_equal(outputs.planning.instance, frame.instance[height > 0.1])


def test_tilted_lidar_knows_the_floor():
    tilt = MOUNT.copy()
    tilt[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    points = np.array([[0.60, 0.0, 0.0], [0.50, 0.0, 0.0]], np.float32)  # x looks down: 4 and 14 cm above the floor
    outputs = Triage().on_frame(PointCloud(measured_at=0, points=points, base_from_lidar=tilt))
    assert np.array_equal(outputs.planning.points, points[1:])


def test_empty_frames_pass():
    empty = cloud(0)
    outputs = Triage().on_frame(empty)
    assert all(len(getattr(outputs, port).points) == 0 for port in ("localization", "planning", "people"))


def test_summary_counts_points():
    triage = Triage()
    triage.on_frame(cloud())
    counts = triage.on_end()["points_a_frame"]
    label = cloud().label
    assert counts["localization"] == chosen(label, ["ground", "permanent"]).sum()
    assert counts["people"] == (label == 4).sum()
