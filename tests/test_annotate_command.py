"""`retracer map` and `retracer annotate`, from recordings to labelled recordings, without a simulator."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from graph.cli import main
from graph.codec import decode
from graph.messages import PointCloud
from graph.recording import Recording
from operators.pointmap import load_map
from tests.room_tour import CUPBOARD, inside, record

COARSE = ("--frustum-width", "0.7")  # of the room's lidar, 512 columns


@pytest.fixture(scope="module")
def building(tmp_path_factory):
    """A mapping session with a cupboard and its map; two sessions without the cupboard, with people."""
    folder = tmp_path_factory.mktemp("building")
    record(folder / "mapping.mcap", cupboard=True, seed=1)
    assert main(["map", str(folder / "mapping.mcap"), "-o", str(folder / "map.ply"), *COARSE, "--quiet"]) == 0
    record(folder / "monday.mcap", chair=True, walks=True, seed=2)
    record(folder / "tuesday.mcap", walks=True, seed=3)
    return folder


@pytest.fixture(scope="module")
def annotated(building):
    """Both sessions annotated, and what the command printed."""
    arguments = ["monday.mcap", "tuesday.mcap", "--map", "map.ply", "-o", "out"]
    return annotate(building, arguments), building / "out"


def annotate(folder: Path, arguments: list[str]) -> dict:
    """Run `retracer annotate ... --json` with paths in a folder; returns what it printed."""
    import contextlib
    import io

    placed = [
        str(folder / word) if word.endswith((".mcap", ".ply")) or word[:3] == "out" else word for word in arguments
    ]
    told = io.StringIO()
    with contextlib.redirect_stdout(told):
        assert main(["annotate", *placed, *COARSE, "--json"]) == 0
    return json.loads(told.getvalue())


def frames(path: Path) -> list[PointCloud]:
    return [decode(entry.payload, PointCloud) for entry in Recording(path).messages("annotator/labelled")]


def test_the_initial_map_has_the_cupboard_and_the_refined_one_has_not(building, annotated):
    before, after = load_map(building / "map.ply"), load_map(annotated[1] / "map.ply")
    top = (CUPBOARD[0] + (0.0, 0.0, 0.3), CUPBOARD[1])
    assert inside(before.points, top).sum() > 50
    assert inside(after.points, top).sum() < 0.1 * inside(before.points, top).sum()
    assert len(after.points) > 0.97 * (len(before.points) - inside(before.points, CUPBOARD).sum())


def test_each_truth_class_gets_its_label(annotated):
    told, _ = annotated
    assert told["frames"] == 80
    assert told["coverage"] > 0.95
    least = {"ground": 0.98, "wall": 0.97, "chair": 0.85, "moving person": 0.85}
    for name, share in least.items():
        assert told["recall"][name] > share, (name, told["recall"])
        assert told["recall_labelled"][name] >= told["recall"][name]
    assert told["ground_and_wall_called_shortT"] < 0.003
    assert all(0.5 < value <= 1.0 for value in told["precision"].values())


def test_labelled_recordings_hold_the_frames_of_the_session(building, annotated):
    session = [decode(e.payload, PointCloud) for e in Recording(building / "monday.mcap").messages("sensor/frame")]
    labelled = frames(annotated[1] / "monday.labelled.mcap")
    assert [frame.measured_at for frame in labelled] == [frame.measured_at for frame in session]
    for frame, whole in zip(labelled, session, strict=True):
        np.testing.assert_array_equal(frame.points, whole.points)
        assert len(frame.label) == len(frame.points)
        assert frame.label.max() <= 4


def test_training_reads_labelled_recordings(annotated):
    from operators.kpconv.frames import Frames
    from operators.kpconv.train_command import load_session

    kept = Frames()
    load_session(annotated[1] / "monday.labelled.mcap", kept)
    assert len(kept) == 40
    assert (np.sum(kept.counts, axis=0) > 0).all()


def test_a_second_run_finds_everything_and_says_the_same(building, annotated):
    stamps = {path: path.stat().st_mtime_ns for path in annotated[1].glob("*.mcap")}
    again = annotate(building, ["monday.mcap", "tuesday.mcap", "--map", "map.ply", "-o", "out"])
    assert again == annotated[0]
    assert {path: path.stat().st_mtime_ns for path in annotated[1].glob("*.mcap")} == stamps


def test_an_interrupted_run_goes_on_where_it_was(building, annotated, tmp_path):
    (annotated[1] / "tuesday.labelled.mcap").unlink()
    kept = (annotated[1] / "monday.labelled.mcap").stat().st_mtime_ns
    again = annotate(building, ["monday.mcap", "tuesday.mcap", "--map", "map.ply", "-o", "out"])
    assert again["recall"] == annotated[0]["recall"]
    assert (annotated[1] / "tuesday.labelled.mcap").exists()
    assert (annotated[1] / "monday.labelled.mcap").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_every_third_frame_is_labelled_alike(building, annotated):
    told = annotate(building, ["monday.mcap", "--map", "map.ply", "-o", "out3", "--every", "3"])
    alone = annotate(building, ["monday.mcap", "--map", "map.ply", "-o", "out1"])
    assert told["frames"] == 14
    sparse, dense = frames(building / "out3/monday.labelled.mcap"), frames(building / "out1/monday.labelled.mcap")
    for few, all_ in zip(sparse, dense[::3], strict=True):
        assert few.measured_at == all_.measured_at
        np.testing.assert_array_equal(few.label, all_.label)
    assert alone["frames"] == 40


@pytest.mark.slow
def test_workers_change_no_bit(building, annotated):
    annotate(building, ["monday.mcap", "tuesday.mcap", "--map", "map.ply", "-o", "out2", "--workers", "2"])
    for name in ("map.ply", "buffers/monday.ply", "buffers/tuesday.ply"):
        assert (annotated[1] / name).read_bytes() == (building / "out2" / name).read_bytes()
    for one, two in zip(frames(annotated[1] / "monday.labelled.mcap"), frames(building / "out2/monday.labelled.mcap"),
                        strict=True):  # fmt: skip
        np.testing.assert_array_equal(one.label, two.label)


@pytest.mark.slow
def test_a_session_without_poses_is_aligned_by_its_odometry(building):
    record(building / "bare.mcap", chair=True, walks=True, poses=False, seed=5)
    told = annotate(building, ["bare.mcap", "--map", "map.ply", "-o", "out_bare"])
    assert told["frames"] == 40
    assert told["recall"]["wall"] > 0.97
    assert told["recall"]["chair"] > 0.85


def refusal(building, capsys, name: str, *more: str, **config) -> str:
    """Record a session that will not do; returns the sentence that says why."""
    path = record(building / f"{name}.mcap", seed=9, **config)
    code = main(["annotate", str(path), "--map", str(building / "map.ply"), "-o", str(building / f"out_{name}"), *more])
    assert code == 2
    assert not list((building / f"out_{name}").glob("*.mcap"))
    assert not (building / f"out_{name}" / "map.ply").exists()
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


def test_a_lost_session_never_erases_walls(building, capsys):
    said = refusal(building, capsys, "lost", shift=1.4)
    overlap = re.search(r"(\d+) % of what it saw is in the map", said)
    assert overlap
    assert int(overlap.group(1)) < 50


@pytest.mark.parametrize(
    ("name", "config", "reason"),
    [
        ("invalid", {"invalid": 5}, "5 of 40 poses are not valid"),
        ("unreached", {"reach": 1}, "target 2 of 2 was not reached"),
        ("poseless", {"skipped": 15}, "15 of its 40 frames have no pose"),
        ("short", {"steps": 6}, "6 frames; 10 are needed"),
        ("empty", {"frame_points": 0}, "0 % of what it saw is in the map"),
        ("thin", {"frame_points": 10}, "of what it saw is in the map"),
    ],
)
def test_sessions_that_will_not_do_are_refused_with_the_reason(building, capsys, name, config, reason):
    assert reason in refusal(building, capsys, name, **config)


@pytest.mark.slow
def test_a_refused_session_leaves_the_others_alone(building, annotated, capsys):
    record(building / "astray.mcap", shift=1.4, seed=4)
    told = annotate(building, ["monday.mcap", "astray.mcap", "tuesday.mcap", "--map", "map.ply", "-o", "out4"])
    assert list(told["sessions_refused"]) == ["astray"]
    assert told["recall"] == annotated[0]["recall"]
    assert (building / "out4/map.ply").read_bytes() == (annotated[1] / "map.ply").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["none.mcap", "--map", "map.ply", "-o", "out9"], "no such recording"),
        (["monday.mcap", "--map", "none.ply", "-o", "out9"], "makes a map"),
        (["monday.mcap", "--map", "monday.mcap", "-o", "out9"], "is not a PLY file"),
        (["monday.mcap", "--map", "bald.ply", "-o", "out9"], "has no normals"),
        (["monday.mcap", "monday.mcap", "--map", "map.ply", "-o", "out9"], "two sessions are named"),
        (["monday.mcap", "--map", "map.ply", "-o", "out9", "--every", "0"], "--every wants at least 1"),
        (["monday.mcap", "--map", "map.ply", "-o", "map.ply"], "is a file"),
        (["map.ply", "--map", "map.ply", "-o", "out9"], "not an MCAP file"),
    ],
)
def test_bad_input_is_one_sentence(building, capsys, arguments, sentence):
    (building / "bald.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
                                       "property float z\nend_header\n1 2 3\n")  # fmt: skip
    placed = [str(building / word) if not word.startswith("-") and word != "0" else word for word in arguments]
    assert main(["annotate", *placed]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert sentence in said[-1]
    assert "Traceback" not in "\n".join(said)


def test_a_map_that_is_refused_leaves_nothing(building, tmp_path, capsys):
    assert main(["map", str(building / "mapping.mcap"), "-o", str(tmp_path / "nowhere" / "map.ply")]) == 2
    assert "there is no folder" in capsys.readouterr().err
    path = record(tmp_path / "empty.mcap", frame_points=0, steps=12)
    assert main(["map", str(path), "-o", str(tmp_path / "map.ply"), "--quiet"]) == 2
    assert "hold nothing that could be mapped" in capsys.readouterr().err
    assert not (tmp_path / "map.ply").exists()


def test_the_map_is_a_ply_with_every_column(building):
    head = (building / "map.ply").read_bytes()[:400].decode("ascii", "replace")
    names = re.findall(r"property \w+ (\w+)", head)
    assert names == ["x", "y", "z", "nx", "ny", "nz", "score", "p_mov", "class"]
    cloud = load_map(building / "map.ply")
    assert set(np.unique(cloud.label)) == {1, 2}
    assert (cloud.movable <= 0.7).all()


def test_the_report_shows_maps_classes_and_truth(annotated):
    page = (annotated[1] / "report.html").read_text()
    assert page.count("<img src='data:image/png;base64,") == 2 + 2 * 2 + 1
    for words in ("Labels against the truth", "monday", "tuesday", "moving person", "Precision"):
        assert words in page


def test_a_full_disk_leaves_no_recording_behind(building, monkeypatch, capsys):
    from operators.annotation import stages_command as stages

    def full(path, buffer):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(stages, "save_buffer", full)
    arguments = [str(building / "monday.mcap"), "--map", str(building / "map.ply"), "-o", str(building / "out_full")]
    assert main(["annotate", *arguments]) == 2
    assert "No space left on device" in capsys.readouterr().err
    left = {path.suffix for path in (building / "out_full").rglob("*") if path.is_file()}
    assert left <= {".ply", ".json", ".npz", ".npy"}
    assert not list((building / "out_full").glob("*.mcap"))
    monkeypatch.undo()
    assert main(["annotate", *arguments, "--quiet"]) == 0


def test_a_map_is_thinned(building, tmp_path, capsys):
    few = tmp_path / "few.ply.gz"
    assert main(["map", str(building / "map.ply"), "--thin", "0.1", "-o", str(few), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    whole, made = load_map(building / "map.ply"), load_map(few)
    assert (told["points"], told["of"]) == (len(made.points), len(whole.points))
    assert 0.02 * len(whole.points) < len(made.points) < 0.5 * len(whole.points)
    assert main(["map", str(building / "map.ply"), "-o", str(few)]) == 2
    assert "is a map already; --thin 0.1 makes a smaller one of it" in capsys.readouterr().err
    assert main(["map", str(building / "map.ply"), "--thin", "2", "-o", str(few)]) == 2
    assert "--thin wants metres from --voxel to 1; it was given 2" in capsys.readouterr().err
    assert main(["map", str(building / "gone.ply"), "--thin", "0.1", "-o", str(few)]) == 2
    assert "no such map" in capsys.readouterr().err
