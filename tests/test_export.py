"""retracer export: what other tools read of a recording is what it says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from graph.cli import main
from graph.codec import decode
from graph.geometry import planar
from graph.messages import Odometry, PointCloud
from graph.recording import Recording
from operators.scans.export_command import Bag, Translator

GRAPH = """
clock: {mode: lockstep, duration: 500ms}
operators:
  simulator:
    run: operators.simulator:Simulator
    inputs:
      tick: timer/10hz
      drive: {from: planner/drive, delay: 100ms}
      pose: {from: localizer/pose, delay: 100ms}
    config: {scenario: easy, tour: A, seed: 1}
  localizer:
    run: operators.localizer:TrueLocalizer
    inputs: {odometry: simulator/odometry, frame: simulator/frame}
  planner:
    run: operators.planner:Planner
    inputs: {goal: simulator/goal, map: localizer/occupancy, obstacles: simulator/frame, pose: localizer/pose}
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    from graph.check import require
    from graph.inprocess import launch_in_process

    folder = tmp_path_factory.mktemp("export")
    (folder / "graph.yaml").write_text(GRAPH)
    graph = require(folder / "graph.yaml")
    return Recording(launch_in_process(graph, record=folder / "run.mcap")[1])


def test_a_bag_says_what_the_recording_says(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bag" / "run.mcap"
    out.parent.mkdir()
    assert main(["export", str(recording.path), "-o", str(out), "--json"]) == 0
    counts = json.loads(capsys.readouterr().out)["topics"]
    assert counts["/simulator/frame"] == recording.counts["simulator/frame"] == counts["/localizer/pose"]
    assert counts["/simulator/truth/people"] == counts["/simulator/truth"]
    assert counts["/tf_static"] == 1
    clouds = [decode(entry.payload, PointCloud) for entry in recording.messages("simulator/frame")]
    odometry = [decode(entry.payload, Odometry) for entry in recording.messages("simulator/odometry")]
    seen: dict[str, list[Any]] = {}
    with AnyReader([out]) as bag:
        for connection, _, raw in bag.messages():
            seen.setdefault(connection.topic, []).append(bag.deserialize(raw, connection.msgtype))
    assert {topic: len(messages) for topic, messages in seen.items()} == counts
    for ours, theirs in zip(clouds, seen["/simulator/frame"], strict=True):
        stamp = theirs.header.stamp
        assert stamp.sec * 1_000_000_000 + stamp.nanosec == ours.measured_at
        names = [field.name for field in theirs.fields]
        kinds = [{2: "u1", 5: "i4", 7: "f4"}[field.datatype] for field in theirs.fields]
        offsets = [field.offset for field in theirs.fields]
        form = {"names": names, "formats": kinds, "offsets": offsets, "itemsize": theirs.point_step}
        table = np.frombuffer(theirs.data.tobytes(), np.dtype(form))
        assert np.array_equal(np.stack([table["x"], table["y"], table["z"]], 1), ours.points)
        assert ours.truth is not None
        assert np.array_equal(table["truth"], ours.truth)
        assert np.array_equal(table["moving"].astype(bool), ours.moving)
    for said, heard in zip(odometry, seen["/simulator/odometry"], strict=True):
        assert heard.pose.pose.position.x == said.odom_from_base[0, 3]
        assert heard.twist.twist.linear.x == said.linear


def test_only_the_topics_that_are_asked_for(recording: Recording, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    assert main(["export", str(recording.path), "-o", str(out), "--topics", "localizer/pose"]) == 0
    with AnyReader([out]) as bag:
        assert {connection.topic for connection in bag.connections} == {"/localizer/pose", "/tf"}


def test_a_topic_that_is_not_there_is_named(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run.mcap"
    assert main(["export", str(recording.path), "-o", str(out), "--topics", "localizer/pos"]) == 2
    assert "names localizer/pos; " in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_said_and_leaves_nothing_behind(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Bag, "write", full)
    out = tmp_path / "run.mcap"
    assert main(["export", str(recording.path), "-o", str(out)]) == 2
    assert f"{out}: No space left on device; nothing was kept" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_turns_and_grids_keep_their_sense() -> None:
    ros = Translator().ros
    pose = ros.pose(planar(1.0, 2.0, np.pi / 2))
    assert np.allclose([pose.orientation.z, pose.orientation.w], np.sqrt(0.5))
    cells = np.array([[0, 100, -1]], np.int8)
    grid = ros.grid(ros.header(5, "world"), cells, np.array([-1.0, 3.0]), 0.05)
    assert (grid.info.width, grid.info.height, list(grid.data)) == (3, 1, [0, 100, -1])
    assert grid.info.origin.position.y == 3.0
