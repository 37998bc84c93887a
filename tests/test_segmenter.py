"""The segmenter as an operator, and the verbs that train and evaluate it, on recordings of a toy room."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from test_kpconv_network import LIDAR, TINY, scene

from graph.check import require
from graph.contract import Source
from graph.errors import UserError
from graph.inprocess import launch_in_process
from graph.messages import PointCloud
from graph.recording import Recording
from graph.replay import replay
from operators.kpconv import evaluate_command, train_command
from operators.kpconv.spheres import SphereRecipe
from operators.kpconv.weights import Header, load, save
from operators.segmenter import Segmenter, TrueSegmenter

TRUTH_OF_LABEL = np.array([0, 1, 2, 5, 6], np.uint8)


def frame(seed: int, *, labelled: bool = True) -> PointCloud:
    """Draw a frame of a toy room with truth, and with labels if wanted."""
    points, labels = scene(seed, 1500)
    truth = TRUTH_OF_LABEL[labels]
    count = len(points)
    return PointCloud(
        measured_at=seed,
        points=points,
        base_from_lidar=LIDAR,
        ring=(np.arange(count) % 32).astype(np.uint8),
        time_offset=np.linspace(0.0, 0.1, count, dtype=np.float32),
        label=labels if labelled else None,
        truth=truth,
        moving=truth == 6,
        instance=labels.astype(np.int32),
    )


class Rooms(Source):
    """Show some rooms."""

    class Config(msgspec.Struct):
        first: int = 0
        count: int = 3
        labelled: bool = True

    class Outputs(msgspec.Struct):
        frame: PointCloud | None = None

    def stream(self) -> Iterator[tuple[int, Outputs]]:
        for number in range(self.config.count):
            yield number * 100_000_000, self.Outputs(frame(self.config.first + number, labelled=self.config.labelled))


Record = Callable[..., Path]


@pytest.fixture
def record(tmp_path: Path) -> Record:
    """Run a graph of rooms, and perhaps a segmenter, in this process."""

    def run(name: str, segmenter: str = "", **rooms: object) -> Path:
        config = json.dumps(rooms)
        text = "clock: {mode: lockstep, duration: 1s}\noperators:\n"
        text += f"  simulator: {{run: 'test_segmenter:Rooms', config: {config}}}\n{segmenter}"
        file = tmp_path / f"{name}.yaml"
        file.write_text(text)
        verdict, path = launch_in_process(require(file), record=tmp_path / f"{name}.mcap")
        assert verdict.verdict == "COMPLETE", verdict.reasons
        return path

    return run


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Save an untrained network."""
    torch.manual_seed(0)
    path = tmp_path / "weights.safetensors"
    save(path, SphereRecipe(TINY).network().state_dict(), Header(TINY))
    return path


def verb(module: object, *words: object) -> int:
    """Run a verb as the command line does."""
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)  # type: ignore[attr-defined]
    return module.run(parser.parse_args([str(word) for word in words]))  # type: ignore[attr-defined]


def test_a_frame_comes_out_subsampled_and_classified(weights: Path) -> None:
    given = frame(0)
    segmenter = Segmenter(Segmenter.Config(weights=weights, full=True))
    out = segmenter.on_frame(given)
    cloud, full = out.classified, out.full
    assert cloud.measured_at == given.measured_at
    assert 0 < len(cloud.points) < len(given.points)
    assert set(np.unique(cloud.label)) <= {1, 2, 3, 4}
    np.testing.assert_array_equal(cloud.scores.argmax(1) + 1, cloud.label)
    np.testing.assert_array_equal(full.points, given.points)
    nearest = ((given.points[:, None] - cloud.points[None]) ** 2).sum(2).argmin(1)
    assert (cloud.label[nearest] == full.label).mean() > 0.999  # but for ties
    apart = ((given.points[None] - cloud.points[:, None]) ** 2).sum(2)
    chosen = np.searchsorted(given.time_offset, cloud.time_offset)
    assert np.isclose(apart[np.arange(len(chosen)), chosen], apart.min(1), atol=1e-6).mean() > 0.98  # of its own voxel
    assert Segmenter(Segmenter.Config(weights=weights)).on_frame(given).full is None
    assert segmenter.on_end()["frames"] == 1


@pytest.mark.parametrize("kind", ["Segmenter", "TrueSegmenter"])
def test_it_replays_to_the_bit(kind: str, record: Record, weights: Path) -> None:
    entry = f"  segmenter:\n    run: operators.segmenter:{kind}\n    inputs: {{frame: simulator/frame}}\n"
    path = record(kind, f"{entry}    config: {{weights: {weights}}}\n")
    recording = Recording(path)
    assert recording.counts["segmenter/classified"] == 3
    assert replay(recording, operators=["segmenter"]).equal


def test_truth_becomes_the_four_classes() -> None:
    given = frame(0)
    given = msgspec.structs.replace(given, truth=(np.arange(len(given.points)) % 8).astype(np.uint8))
    out = TrueSegmenter(TrueSegmenter.Config(full=True)).on_frame(given)
    assert out.full.label[:8].tolist() == [0, 1, 2, 3, 3, 3, 4, 3]
    np.testing.assert_array_equal(out.full.scores[1:8].argmax(1) + 1, out.full.label[1:8])
    np.testing.assert_allclose(out.full.scores.sum(1), 1.0)
    cells = np.floor(out.classified.points / 0.08)
    assert len(np.unique(cells, axis=0)) == len(cells)
    where = {tuple(point): label for point, label in zip(given.points.tolist(), out.full.label.tolist(), strict=True)}
    assert [where[tuple(point)] for point in out.classified.points.tolist()] == out.classified.label.tolist()
    with pytest.raises(ValueError, match="only a simulator"):
        TrueSegmenter().on_frame(msgspec.structs.replace(given, truth=None))


def test_train_then_evaluate(record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = record("one"), record("two", first=5)
    output = tmp_path / "w.safetensors"
    small = ("--voxel", 0.25, "--width", 8, "--batch", 1, "--threads", 1)
    assert verb(train_command, one, "-o", output, "--held-out", two, "--steps", 22, "--check", 10, *small) == 0
    assert "22 steps" in capsys.readouterr().out
    _, header = load(output)
    assert header.sessions == ["one.mcap"]
    assert header.held_out == ["two.mcap"]
    assert header.training["steps"] == 22
    assert header.metrics["held_out_mean_recall"] > 0.0
    assert output.with_suffix(".png").exists()
    assert json.loads(output.with_suffix(".json").read_text())[-1]["step"] == 22
    picture = tmp_path / "confusion.png"
    assert verb(evaluate_command, output, two, "--threads", 1, "--json", "--picture", picture) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["points"] == 3 * 1500
    assert set(report["latency"]) == {"pyramid", "network", "points", "whole"}
    assert picture.exists()
    assert verb(evaluate_command, output, two, "--threads", 1, "--every", 2) == 0
    assert "2 frames" in capsys.readouterr().out


def test_labels_are_read_from_whatever_carries_them(record: Record, tmp_path: Path) -> None:
    bare = record("bare", labelled=False)
    with pytest.raises(UserError, match="no point clouds with labels; it has simulator/frame"):
        verb(train_command, bare, "-o", tmp_path / "w", "--steps", 20)
    session = record("session")
    assert train_command.labelled_topic(Recording(session)) == "simulator/frame"
    first = next(iter(evaluate_command.frames_of(bare, 1)))
    np.testing.assert_array_equal(first.points, frame(0).points)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--steps", "3"), "at least 20 steps"),
        (("--device", "cuda"), "no CUDA device"),
        (("--budget", "soon"), "a duration is such as"),
    ],
)
def test_what_cannot_be_trained_is_said(
    words: tuple[object, ...], message: str, record: Record, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=message):
        verb(train_command, record("a", count=1), "-o", tmp_path / "w", *words)


def test_weights_of_another_kind_are_refused(record: Record, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no such file; `retracer train"):
        verb(evaluate_command, tmp_path / "none.safetensors", record("a", count=1))


@pytest.mark.slow
def test_two_processes_learn_one_network(record: Record, tmp_path: Path) -> None:
    session, output = record("session"), tmp_path / "w.safetensors"
    words = f"{session} -o {output} --steps 20 --batch 2 --voxel 0.25 --width 8 --threads 2"
    code = f"""
import argparse, torch
from torch import distributed
from operators.kpconv import train_command as t
from operators.kpconv.training import Trainer
run = Trainer.run
def checked(self, **options):
    state = run(self, **options)
    for tensor in self.network.parameters():
        parts = [torch.empty_like(tensor) for _ in range(2)]
        distributed.all_gather(parts, tensor.detach())
        assert torch.equal(*parts)
    assert self.group.size == 2 and len(list(self.batch(0)[0].features)) > 0
    return state
Trainer.run = checked
parser = argparse.ArgumentParser()
t.add_arguments(parser)
raise SystemExit(t.run(parser.parse_args({words.split()!r})))
"""
    script = tmp_path / "run.py"
    script.write_text(code)
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(script)],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    _, header = load(output)
    assert header.training["processes"] == 2
    assert header.training["steps"] == 20
