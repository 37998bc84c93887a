"""Drawing in Rerun: what accumulates, what is judged, and what `retracer view` puts into an .rrd file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graph.cli import main
from graph.geometry import planar
from graph.graphfile import Clock, Edge, Graph, OperatorEntry, to_yaml
from graph.inprocess import launch_in_process
from tests.toy_robot import ERROR

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra 'view')")

from operators.views import palette
from operators.views.layout import eye_over, numbers_layout, robot_layout
from operators.views.scene import Scene
from operators.views.viewer import ViewerError, finish, has_display, open_stream, send_to

ROOT = Path(__file__).parent.parent
TICKS = 12
Row = dict[str, Any]


def rows(file: Path, entity: str) -> list[Row]:
    """Read all rows of an entity from an .rrd file, in the order of time: column to value; `seconds` is the stamp."""
    from rerun.chunk import RrdReader

    found: list[Row] = []
    for chunk in RrdReader(file).stream():
        if chunk.entity_path == f"/{entity}":
            found += chunk.to_record_batch().to_pylist()
    for row in found:
        if (stamp := row.pop("stamp", None)) is not None:
            row["seconds"] = stamp.total_seconds()
    return sorted(found, key=lambda row: row.get("seconds", -1.0))


def entities(file: Path) -> set[str]:
    """Name the entities of an .rrd file."""
    from rerun.chunk import RrdReader

    return {chunk.entity_path.removeprefix("/") for chunk in RrdReader(file).stream()}


def graph_of(name: str, run: str, **config: Any) -> Graph:
    """Make a graph of one operator that ticks and ends."""
    entry = OperatorEntry(run, {"tick": Edge("timer", "10hz")}, config)
    return Graph(Clock(end=name), {name: entry}, name, str(ROOT))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a recording of a toy robot, `toy.mcap`, and of a counter, `counter.mcap`."""
    folder = tmp_path_factory.mktemp("views")
    launch_in_process(graph_of("toy", "tests.toy_robot:ToyRobot", ticks=TICKS), record=folder / "toy.mcap")
    launch_in_process(graph_of("counter", "tests.sample_operators:Counter", last=5), record=folder / "counter.mcap")
    return folder


@pytest.fixture(scope="module")
def view(folder: Path) -> Path:
    """Return the view of the toy robot as an .rrd file."""
    assert main(["view", str(folder / "toy.mcap"), "--save", str(folder / "toy.rrd")]) == 0
    return folder / "toy.rrd"


# what accumulates


def test_heights_get_brighter_and_stay_colours() -> None:
    colours = palette.height_colours(np.linspace(-1.0, 5.0, 50))
    assert colours.shape == (50, 3)
    assert (np.diff(colours.astype(int).sum(axis=1)) >= 0).all()
    assert (palette.movable_colours(np.array([1.0])) == palette.LABELS[4].colour).all()


def test_classes_have_the_colours_of_their_legend() -> None:
    colours = palette.class_colours(np.array([6, 2, 200], np.uint8), palette.TRUTH)
    assert colours.tolist() == [list(palette.TRUTH[6].colour), list(palette.TRUTH[2].colour), [128, 128, 128]]
    assert len({entry.colour for entry in palette.TRUTH}) == len(palette.TRUTH)


def test_unknown_cells_are_transparent_and_occupied_ones_brightest() -> None:
    unknown, free, half, full = palette.occupancy_colours(np.array([[-1, 0, 50, 100]], np.int8))[0].astype(int)
    assert unknown[3] == 0
    assert free[3] == half[3] == full[3] == 255
    assert free[:3].sum() < half[:3].sum() < full[:3].sum()


# the scene


def scene_of(file: Path) -> Scene:
    stream = open_stream("test")
    send_to(stream, file=file)
    return Scene(stream)


def test_a_cloud_lies_where_its_sensor_was(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "scene.rrd")
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], np.float32)
    scene.at(1_500_000_000)
    scene.cloud("by_truth", points, planar(0.1, 0.2, 0.0, z=0.64), truth=np.array([6, 2], np.uint8))
    scene.cloud("by_label", points, np.eye(4), label=np.array([4, 1], np.uint8), truth=np.array([6, 2], np.uint8))
    scene.cloud("by_height", points, planar(0.0, 0.0, 0.0, z=-3.0))
    finish(scene.stream, patience=10.0)
    (row,) = rows(tmp_path / "scene.rrd", "world/by_truth")
    assert row["seconds"] == 1.5
    assert row["Points3D:positions"] == points.tolist()
    assert row["Points3D:class_ids"] == [6, 2]
    np.testing.assert_allclose(row["Transform3D:translation"], [[0.1, 0.2, 0.64]], rtol=1e-6)
    (row,) = rows(tmp_path / "scene.rrd", "world/by_label")
    assert row["Points3D:class_ids"] == [palette.FIRST_LABEL + 4, palette.FIRST_LABEL + 1]
    (row,) = rows(tmp_path / "scene.rrd", "world/by_height")
    low, high = ([colour >> shift & 255 for shift in (24, 16, 8)] for colour in row["Points3D:colors"])
    assert [low, high] == palette.height_colours(np.array([0.0, 3.0])).tolist()


def test_a_grid_is_cropped_to_what_is_known_and_turned_as_images_are(tmp_path: Path) -> None:
    cells = np.full((10, 12), -1, np.int8)
    cells[2, 3], cells[4, 6] = 100, 0
    scene = scene_of(tmp_path / "grid.rrd")
    scene.at(0)
    scene.grid("empty", np.full((3, 3), -1, np.int8), np.zeros(2), 0.5)
    scene.grid("grid", cells, np.array([-1.0, 2.0]), 0.5)
    finish(scene.stream, patience=10.0)
    assert "world/empty" not in entities(tmp_path / "grid.rrd")
    (row,) = rows(tmp_path / "grid.rrd", "world/grid")
    np.testing.assert_allclose(row["GridMap:translation"][0][:2], [-1.0 + 3 * 0.5, 2.0 + 2 * 0.5])
    image = np.frombuffer(bytes(row["GridMap:data"][0]), np.uint8).reshape(3, 4, 4)
    expected = palette.occupancy_colours(np.ascontiguousarray(cells[2:5, 3:7]))
    np.testing.assert_array_equal(image, expected[::-1])


def test_an_annotated_map_shows_classes_and_what_moves(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "map.rrd")
    scene.at(0)
    points, movable = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], np.float32), np.array([0.0, 1.0], np.float32)
    scene.map("map", points, incremental=False, movable=movable, label=np.array([2, 3], np.uint8))
    finish(scene.stream, patience=10.0)
    assert list(scene.hidden) == ["world/map/movable"]
    drawn = [rows(tmp_path / "map.rrd", f"world/map{part}/0")[-1] for part in ("", "/movable")]
    assert drawn[0]["Points3D:positions"] == drawn[1]["Points3D:positions"]
    assert drawn[0]["Points3D:colors"] != drawn[1]["Points3D:colors"]


def test_a_full_map_takes_the_place_of_all_before(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "map.rrd")
    for second, incremental in enumerate((False, True, True, False)):
        scene.at(second * 10**9)
        scene.map("map", np.array([[second, 0.0, 0.0]], np.float32), incremental=incremental)
    finish(scene.stream, patience=10.0)
    drawn = {level: rows(tmp_path / "map.rrd", f"world/map/{level}")[-1] for level in (0, 1)}
    assert drawn[0]["Points3D:positions"] == [[3.0, 0.0, 0.0]]
    assert drawn[1]["Points3D:positions"] == []
    assert drawn[1]["seconds"] == 3.0


# the layout


@given(*[st.floats(-40, 40)] * 4)
def test_the_eye_sees_the_whole_floor(x: float, y: float, u: float, v: float) -> None:
    eye = eye_over((x, y), (u, v))
    position, target = np.array(eye.position), np.array(eye.target)
    forward = (target - position) / np.linalg.norm(target - position)
    assert position[2] > 3.0
    for corner in [(a, b, 0.0) for a in (x, u) for b in (y, v)]:
        ray = np.array(corner) - position
        assert np.degrees(np.arccos(ray @ forward / np.linalg.norm(ray))) < 45.0


def test_layouts_can_be_made() -> None:
    assert robot_layout(eye=eye_over((0, 0), (5, 5)), hidden=["world/robot/x"], others=["fields/a/b"]) is not None
    assert numbers_layout([]) is not None


# the command


def test_a_recording_becomes_a_view(view: Path) -> None:
    drawn = entities(view)
    for entity in (
        "world/robot",
        "world/toy/frame",
        "world/toy/truth/trail",
        "world/toy/truth/people",
        "world/toy/pose/trail",
        "world/toy/map/0",
        "world/toy/occupancy",
        "world/toy/plan/path",
        "world/toy/plan/trajectory",
        "world/toy/goal",
        "plots/latency/toy",
        "plots/speed/toy/odometry",
        "plots/speed/toy/drive",
        "log/toy/text",
    ):
        assert entity in drawn
    assert len(rows(view, "world/toy/frame")) == TICKS


def test_the_localization_error_is_plotted_at_each_pose(view: Path) -> None:
    curve = [row for row in rows(view, "plots/localization_error/toy/pose") if row.get("Scalars:scalars")]
    assert [row["seconds"] for row in curve] == pytest.approx([0.1 * tick for tick in range(TICKS)])
    np.testing.assert_allclose([row["Scalars:scalars"][0] for row in curve], 100 * ERROR)


def test_the_latency_is_that_of_the_ledger(folder: Path, view: Path) -> None:
    from graph.recording import Recording

    steps = [step for _, _, step in Recording(folder / "toy.mcap").steps("toy") if step.port == "tick"]
    curve = [row for row in rows(view, "plots/latency/toy") if row.get("Scalars:scalars")]
    assert [row["Scalars:scalars"][0] for row in curve] == pytest.approx([step.wall_duration / 1e6 for step in steps])
    assert [row["seconds"] for row in curve] == pytest.approx([step.stamp / 1e9 for step in steps])


def test_what_happens_is_told_once(view: Path) -> None:
    def told(name: str) -> list[str]:
        return [row["TextLog:text"][0] for row in rows(view, f"log/{name}")]

    assert told("toy/pose") == ["toy/pose: the pose is not valid: lost", "toy/pose: the pose is valid again"]
    assert told("toy/truth") == ["toy/truth: the robot touches 7"]
    assert [text.partition(":")[2][:12] for text in told("toy/goal")] == [" target 1 of", " target 2 of"]
    assert told("toy/plan") == ["toy/plan: follow"]
    assert "toy: reached 2" in told("toy")
    assert told("verdict") == ["verdict: COMPLETE"]


def test_every_shows_each_so_many_th_cloud(folder: Path) -> None:
    file = folder / "thin.rrd"
    assert main(["view", str(folder / "toy.mcap"), "--every", "5", "--save", str(file)]) == 0
    assert [row["seconds"] for row in rows(file, "world/toy/frame")] == pytest.approx([0.0, 0.5, 1.0])
    assert len(rows(file, "world/robot")) >= TICKS


def test_a_recording_of_unknown_messages_shows_their_numbers(folder: Path) -> None:
    file = folder / "counter.rrd"
    assert main(["view", str(folder / "counter.mcap"), "--save", str(file)]) == 0
    curve = [row for row in rows(file, "fields/counter/count/value") if row.get("Scalars:scalars")]
    assert [row["Scalars:scalars"][0] for row in curve] == [0.0, 1.0, 2.0, 3.0, 4.0]
    (text,) = (row["TextLog:text"][0] for row in rows(file, "log/counter/count"))
    assert "tests.sample_operators.Count" in text
    assert "value" in text


def test_messages_of_another_version_are_said_to_be_unreadable(tmp_path: Path) -> None:
    launch_in_process(graph_of("old", "tests.toy_robot:OldRobot"), record=tmp_path / "old.mcap")
    assert main(["view", str(tmp_path / "old.mcap"), "--save", str(tmp_path / "old.rrd")]) == 0
    texts = [row["TextLog:text"][0] for row in rows(tmp_path / "old.rrd", "log/old/drive")]
    assert len(texts) == 1
    assert "another version" in texts[0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["missing.mcap"], "missing.mcap: no such recording"),
        (["toy.mcap", "--save", "no_such_folder/toy.rrd"], "no_such_folder/toy.rrd"),
        (["toy.mcap"], "there is no display to open a window on; use --web"),
    ],
)
def test_bad_input_is_one_sentence(
    arguments: list[str],
    sentence: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", *arguments]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.parametrize("arguments", [["view", "toy.mcap"], ["launch", "toy.yaml", "--view"]])
def test_a_missing_extra_is_named_with_the_command_to_install_it(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "toy.yaml").write_text(to_yaml(graph_of("toy", "tests.toy_robot:ToyRobot")))
    monkeypatch.chdir(tmp_path)
    for name in [name for name in sys.modules if name.startswith(("operators.views", "operators.dashboard"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(arguments) == 2
    assert (
        'needs rerun, which is not installed; install it with: pip install "retracer[view]"' in capsys.readouterr().err
    )


def test_every_wants_a_whole_number(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["view", str(folder / "toy.mcap"), "--every", "0"])
    assert "at least 1" in capsys.readouterr().err


def test_a_display_is_what_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    assert not has_display()
    monkeypatch.setenv("DISPLAY", ":0")
    assert has_display()


def test_a_stream_that_cannot_go_anywhere_says_so() -> None:
    with pytest.raises(ViewerError, match="nonsense"):
        send_to(open_stream("test"), url="nonsense")
