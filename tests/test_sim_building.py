"""Buildings: the shipped ones are of the paper's scale and sound; files of every form are read, or refused by name."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from sim.boxes import read_boxes
from sim.building import Building, BuildingError, Door, Room, TablePosition, Tour
from sim.building_file import load
from sim.clearance import clearance, length_of
from sim.furniture import CHAIRS, TABLES
from sim.inspection import inspect
from sim.layout import ROBOT_RADIUS, draw, tour_way
from sim.masonry import wall_bodies
from sim.rosmap import read_map, rectangles
from sim.scenario import Scenario, load_scenario
from sim.solids import Truth
from tests.small_rooms import box_room, two_rooms

PLY = """ply
format ascii 1.0
comment two boxes and a point that is none of our business
element vertex 1
property float x
property float y
property float z
element box {count}
property float min_x
property float min_y
property float min_z
property float max_x
property float max_y
property float max_z
end_header
0 0 0
{rows}
"""


@functools.cache
def shipped(name: str) -> Building:
    return load(name)


@functools.cache
def way_of(name: str, tour: str) -> np.ndarray:
    return tour_way(shipped(name), tour)


def boxes(path: Path, *rows: str, count: int | None = None) -> Path:
    path.write_text(PLY.format(count=len(rows) if count is None else count, rows="\n".join(rows)))
    return path


@pytest.mark.parametrize(
    ("name", "size", "area", "doors", "tables"),
    [("default", (41.0, 41.0), 645.0, 28, 28), ("annex", (34.0, 25.0), 300.0, 14, 14)],
)
def test_shipped_buildings_are_of_the_paper_s_scale_and_sound(
    name: str, size: tuple[float, float], area: float, doors: int, tables: int
) -> None:
    building = shipped(name)
    x0, y0, x1, y1 = building.bounds()
    assert (x1 - x0, y1 - y0) == pytest.approx(size, abs=0.2)
    assert building.populated_area() == pytest.approx(area, rel=0.05)
    assert len(building.doors) >= doors
    assert len(building.tables) >= tables
    assert inspect(building) == []


@pytest.mark.parametrize(
    ("tour", "targets", "metres"), [("A", 7, 61), ("B", 11, 96), ("C", 19, 129), ("mapping", 34, 332)]
)
def test_tours_are_of_the_paper_s_length(tour: str, targets: int, metres: float) -> None:
    assert len(shipped("default").tours[tour].targets) == targets or tour == "mapping"
    assert length_of(way_of("default", tour)) == pytest.approx(metres, rel=0.11)


@pytest.mark.parametrize("name", ["default", "annex"])
def test_the_mapping_tour_sees_every_room(name: str) -> None:
    way = way_of(name, "mapping")
    assert [room.name for room in shipped(name).rooms if not room.contains(way).any()] == []


def test_walls_are_cut_by_doors_up_to_the_lintel() -> None:
    building = two_rooms("closed")
    middle = next(
        body for body in wall_bodies(building) if body.parts[0].x == pytest.approx(5.0) and len(body.parts) == 3
    )
    below, lintel, above = middle.parts
    assert lintel.z - lintel.dz / 2 == pytest.approx(2.0)
    assert below.y + below.dx / 2 == pytest.approx(2.55)
    assert above.y - above.dx / 2 == pytest.approx(3.45)


@given(st.floats(-math.pi, math.pi), st.floats(0.0, math.pi), st.sampled_from(["left", "right"]))
@settings(max_examples=40, deadline=None)
def test_a_leaf_turns_about_its_hinge_to_its_side(heading: float, angle: float, swing: str) -> None:
    door = Door((1.0, 2.0), math.degrees(heading), swing=swing)  # type: ignore[arg-type]
    leaf = door.leaf(angle, 0.15)
    corners = leaf.footprint() - door.hinge
    assert np.linalg.norm(corners, axis=1).min() < 0.1
    assert np.linalg.norm(corners, axis=1).max() < door.width + 0.1
    left = np.array([-math.sin(heading), math.cos(heading)])
    side = float(corners.mean(0) @ left) * (1 if swing == "left" else -1)
    assert side >= -1e-6


def test_walls_of_their_own_measures(tmp_path: Path) -> None:
    path = tmp_path / "low.yaml"
    path.write_text(
        "walls: [[[0, 0], [4, 0]], {line: [[0, 2], [4, 2]], thickness: 0.3, height: 1.1}]\nrooms: [{name: strip, "
        "rectangle: [0, 0, 4, 2]}]"
    )
    building = load(path)
    bodies = wall_bodies(building)
    assert (bodies[0].parts[0].dy, bodies[0].parts[0].dz) == (0.15, 2.5)
    assert (bodies[1].parts[0].dy, bodies[1].parts[0].dz) == (0.3, 1.1)
    assert building.rooms[0].polygon == [(0, 0), (4, 0), (4, 2), (0, 2)]


def test_every_mistake_of_form_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(
        "walls: [[[0, 0], [4]], [[0, 0], [1, 1]]]\nwindows: 3\ndoors: [{name: front, hinge: [0, 0], heading: north}]\n"
        "room: []\ntours: {A: {targets: 7}}\n"
    )
    with pytest.raises(BuildingError) as error:
        load(path)
    lines = str(error.value).splitlines()
    assert len(lines) == 5
    assert "walls[0]: Expected `array` of length 2, got 1 - at `[1]`" in lines[0]
    assert "there is no 'windows' in a building; there are name, wall" in lines[1]
    assert "doors[0] (front): Expected `float`, got `str` - at `heading`" in lines[2]
    assert "there is no 'room' in a building; did you mean 'rooms'?" in lines[3]
    assert "tours.A: Expected `array`, got `int` - at `targets`" in lines[4]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("walls: [", "not YAML"),
        ("- 1", "a building is a mapping"),
        ("", "a building is a mapping"),
        ("boxes: none.ply", "there is no file .*none.ply"),
        ("map: none.yaml", "there is no file .*none.yaml"),
        ("image: a.pgm\nresolution: 0.05", "not a ROS map: Object missing required field `origin`"),
        ("image: a.pgm\nresolution: 0.05\norigin: [0, 0, 0]", "the map's image is not there"),
        ("image: a.pgm\nresolution: 0\norigin: [0, 0, 0]", "a resolution of 0.0 m a cell"),
    ],
)
def test_files_that_are_no_buildings_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(BuildingError, match=sentence):
        load(path)


def test_boxes_of_a_ply_become_walls(tmp_path: Path) -> None:
    path = boxes(tmp_path / "two.ply", "0 0 0 4 0.2 2.5", "0 0 0 0.2 3 2.5")
    building = load(path)
    assert building.bounds() == (0, 0, 4, 3)
    assert [body.parts[0].dz for body in wall_bodies(building)] == [2.5, 2.5]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("obj", "line 1: a PLY file begins with 'ply'"),
        ("ply\nformat binary_little_endian 1.0", "line 2: format binary_little_endian"),
        ("ply\nformat ascii 1.0\nelement vertex 0\nend_header", "no element 'box'; there is vertex"),
        ("ply\nelement box 1\nproperty float min_x\nend_header", "element box has no property min_y, min_z, max_x"),
        ("ply\nelement box 1", "the header has no end_header"),
        ("ply\nnonsense", "line 2: 'nonsense' is not understood"),
    ],
)
def test_plys_without_boxes_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_text(text)
    with pytest.raises(BuildingError, match=sentence):
        read_boxes(path)


def test_rows_that_are_no_boxes_are_named_by_line(tmp_path: Path) -> None:
    with pytest.raises(BuildingError, match=r"line 18: '0 0 x 1 1 1' is not min_x"):
        read_boxes(boxes(tmp_path / "a.ply", "0 0 0 1 1 1", "0 0 x 1 1 1"))
    with pytest.raises(BuildingError, match=r"ends at line 17, before its last box"):
        read_boxes(boxes(tmp_path / "b.ply", "0 0 0 1 1 1", count=2))


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12), st.floats(0.05, 0.95))
@settings(max_examples=60, deadline=None)
def test_rectangles_cover_the_cells_and_nothing_twice(seed: int, rows: int, columns: int, share: float) -> None:
    cells = np.random.default_rng(seed).random((rows, columns)) < share
    count = np.zeros(cells.shape, int)
    found = rectangles(cells)
    for row, column, high, wide in found:
        count[row : row + high, column : column + wide] += 1
    np.testing.assert_array_equal(count, cells.astype(int))
    assert len(found) <= cells.sum()


@pytest.mark.parametrize("suffix", ["pgm", "png"])
@pytest.mark.parametrize("negate", [0, 1])
def test_occupied_cells_of_a_ros_map_are_raised(tmp_path: Path, suffix: str, negate: int) -> None:
    levels = np.full((6, 8), 254, np.uint8)
    levels[0, :] = 0  # the image's upper row is the map's highest
    levels[2:4, 1:3] = 0
    levels[5, 7] = 205  # unknown
    Image.fromarray(255 - levels if negate else levels).save(tmp_path / f"map.{suffix}")
    path = tmp_path / "map.yaml"
    path.write_text(f"image: map.{suffix}\nresolution: 0.5\norigin: [-1.0, 2.0, 0.0]\nnegate: {negate}\n")
    blocks = read_map(path, 2.5)
    assert [(block.low, block.high) for block in blocks] == [
        ((-0.5, 3.0, 0.0), (0.5, 4.0, 2.5)),
        ((-1.0, 4.5, 0.0), (3.0, 5.0, 2.5)),
    ]
    assert len({block.part_of for block in blocks}) == 2


def test_a_turned_ros_map_turns_its_walls(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 254]], np.uint8)).save(tmp_path / "map.pgm")
    path = tmp_path / "map.yaml"
    path.write_text(f"image: map.pgm\nresolution: 1.0\norigin: [2.0, 0.0, {math.pi / 2}]\n")
    (body,) = wall_bodies(load(path))
    corners = body.parts[0].footprint()
    np.testing.assert_allclose([corners.min(0), corners.max(0)], [[1, 0], [2, 1]], atol=1e-9)


def test_a_building_of_boxes_with_tours_is_sound_and_can_be_furnished(tmp_path: Path) -> None:
    """The same YAML with walls from a PLY, and from a ROS map of the same walls."""
    rows = ["0 0 0 10 0.2 2.5", "0 7.8 0 10 8 2.5", "0 0 0 0.2 8 2.5", "9.8 0 0 10 8 2.5"]
    boxes(tmp_path / "walls.ply", *rows)
    levels = np.full((80, 100), 254, np.uint8)
    levels[:2] = levels[-2:] = 0
    levels[:, :2] = levels[:, -2:] = 0
    Image.fromarray(levels).save(tmp_path / "walls.pgm")
    (tmp_path / "walls.yaml").write_text("image: walls.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n")
    layouts = []
    for walls in ("boxes: walls.ply", "map: walls.yaml"):
        path = tmp_path / "hall.yaml"
        path.write_text(
            f"{walls}\nstart: [1, 1, 0]\nrooms: [{{name: hall, rectangle: [0, 0, 10, 8], populated: true}}]\n"
            "tables: [{at: [6, 5]}]\ntours: {A: {targets: [[9, 1], [1, 7]]}}\n"
        )
        building = load(path)
        assert inspect(building) == []
        layout = draw(building, Scenario(tables=(1.0, 1.0)), "A", 1)
        assert sum(body.truth == Truth.TABLE for body in layout.bodies) == 1
        layouts.append(layout.free.distance)
    assert np.abs(layouts[0] - layouts[1]).max() < 0.11


def test_every_mistake_of_a_building_is_named_with_its_place() -> None:
    """Nineteen mistakes in one building: each stands in the report, and hardly more."""
    building = two_rooms("closed")
    broken = Building(
        name="broken",
        walls=[*building.walls, [(7, 3), (7, 3)], [(8.5, 0), (8.5, 1.5)]],
        doors=[
            *building.doors,
            Door((2.0, 3.0), 0.0, name="floating"),
            Door((5.0, 5.5), 90.0, name="long"),
            Door((5.0, 3.0), 90.0, name="second"),
            Door((1.0, 0.0), 0.0, name="tall", lintel=2.6),
            Door((3.0, 0.0), 0.0, name="slit", width=0.1),
        ],
        rooms=[
            Room("west", [(0, 0), (5, 0), (5, 6), (0, 6)]),
            Room("west", [(4, 1), (5, 1), (5, 5), (4, 5)]),
            Room("bow", [(6, 1), (8, 3), (8, 1), (6, 3)]),
            Room("line", [(6, 1), (8, 3)]),
        ],
        start=(2.0, 3.0, 0.0),
        tables=[
            *building.tables,
            TablePosition((5.0, 1.0)),
            TablePosition((2.5, 4.5), 0.0, ["desk"]),
            TablePosition((0.3, 5.7), 0.0, ["conference"]),
        ],
        tours={"A": Tour([(2.0, 4.5), (5.0, 1.0), (2.0, 0.2), (7.0, 4.5), (20.0, 1.0)]), "B": Tour([])},
    )
    found = inspect(broken)
    for sentence in (
        "wall 2 at (7, 3): begins and ends at the same place",
        "door slit at (3, 0): 0.1 m wide and 2 m high; nobody fits through",
        "room bow: its rim crosses itself near (7, 2)",
        "room line: 2 corners; a room has at least three",
        "2 rooms are named west",
        "door floating at (2, 3): no wall there; it goes to (2.9, 3)",
        "door long at (5, 5.5): reaches beyond the end of its wall; it goes to (5, 6.4)",
        "door second at (5, 3): overlaps door middle at (5, 2.55)",
        "door tall at (1, 0): 2.6 m high in a wall of 2.5 m",
        "room west is not closed: no wall from (4, 1) to (4.9, 1)",
        "rooms west and west overlap around (4.5, 3)",
        "table position 2 at (5, 1): is inside wall 4",
        "there is no table model 'desk'; there are conference",
        "table position 4 at (0.3, 5.7): none of its models fits; the nearest wall is",
        "tour A: target 1 at (5, 1) is inside wall 4",
        "tour A: target 2 at (2, 0.2) is 0.15 m from a wall; the robot needs 0.3 m",
        "tour A: target 3 at (7, 4.5) cannot be reached from target 0 at (2, 4.5)",
        "tour A: target 4 at (20, 1) is outside the building",
        "tour B: no targets",
    ):
        assert any(sentence in mistake for mistake in found), (sentence, found)
    assert len(found) < 26, found  # two rooms in one place are more than one mistake


def test_a_building_without_walls_and_a_missing_tour_are_named() -> None:
    assert inspect(Building()) == ["there are no walls; give walls, or boxes, or a map"]
    assert inspect(box_room(), ["Z"]) == ["there is no tour 'Z'; there are A"]
    assert inspect(box_room(start=None), ["A"]) == ["tour A: no start, and the building has none"]
    assert inspect(box_room(start=(math.nan, 0, 0)))[0] == "start: (nan, 0, 0) is no place"


@pytest.mark.parametrize("scenario", ["easy", "medium", "hard", "extreme", "mapping"])
def test_furniture_stands_clear_of_walls_targets_and_the_way(scenario: str) -> None:
    building, wanted = shipped("default"), load_scenario(scenario)
    layout = draw(building, wanted, "B", 3)
    walls = clearance(
        [body for body in layout.bodies if body.truth in (Truth.WALL, Truth.DOOR)], building.bounds(), 0.05
    )
    things = [body for body in layout.bodies if body.truth in (Truth.TABLE, Truth.CHAIR)]
    tables, chairs = (sum(body.truth == kind for body in things) for kind in (Truth.TABLE, Truth.CHAIR))
    low, high = wanted.tables
    assert math.floor(low * len(building.tables)) <= tables <= math.ceil(high * len(building.tables))
    assert 2.0 <= chairs / tables <= 4.0
    targets = np.array(building.tours["B"].targets)
    for body in things:
        corners = np.concatenate([part.footprint() for part in body.parts])
        assert walls.at(corners).min() > 0.0
        assert np.linalg.norm(corners[:, None] - targets, axis=2).min() > 0.6
    assert layout.free.at(layout.way).min() >= ROBOT_RADIUS - 0.05
    kinds = {body.name for body in things if body.truth == Truth.TABLE}
    if scenario in ("easy", "mapping"):
        assert not kinds & {"table cafe round", "table coffee round"}
    if scenario == "extreme":
        assert tables == len(building.tables)
        assert len(kinds) == len(TABLES) == len(CHAIRS) == 6
    doors = [body.parts[0] for body in layout.bodies if body.truth == Truth.DOOR]
    for door, leaf in zip(building.doors, doors, strict=True):
        middle = (np.array(door.hinge) + door.end()) / 2
        if np.linalg.norm(layout.way - middle, axis=1).min() < 0.4:
            assert abs(math.sin(leaf.yaw - math.radians(door.heading))) > 0.9  # open


def test_half_of_the_chairs_are_taken() -> None:
    building, scenario = shipped("annex"), load_scenario("extreme")
    layouts = [draw(building, scenario, "A", seed) for seed in range(3)]
    seats = sum(len(layout.seats) for layout in layouts)
    chairs = sum(body.truth == Truth.CHAIR for layout in layouts for body in layout.bodies)
    assert 0.4 < seats / chairs < 0.6


def test_doors_are_drawn_closed_or_open_by_seed() -> None:
    building, scenario = shipped("annex"), load_scenario("easy")
    angles = []
    for seed in (1, 1, 2):
        leaves = [body.parts[0].yaw for body in draw(building, scenario, "A", seed).bodies if body.truth == Truth.DOOR]
        angles.append(np.array(leaves) - [math.radians(door.heading) for door in building.doors])
    np.testing.assert_array_equal(angles[0], angles[1])
    assert (angles[0] != angles[2]).any()
    assert 1 < (np.abs(angles[0]) < 1e-9).sum() < 14


def test_the_command_names_mistakes_and_returns_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from graph.cli import main

    path, picture = tmp_path / "bad.yaml", tmp_path / "plan.png"
    path.write_text(
        "walls: [[[0, 0], [6, 0], [6, 4], [0, 4]]]\nrooms: [{name: den, polygon: [[0, 0], [6, 0], [6, 4], [0, 4]]}]\n"
        "start: [1, 1, 0]\ntours: {A: {targets: [[6, 2], [5, 3]]}}\ndoors: [{hinge: [2, 2], heading: 0}]\n"
    )
    assert main(["building", str(path), "--plot", str(picture)]) == 2
    said = capsys.readouterr().err
    assert "room den is not closed: no wall from (0, 3.9) to (0, 0.1)" in said
    assert "tour A: target 0 at (6, 2) is inside wall 1" in said
    assert "door 0 at (2, 2): no wall there" in said
    with Image.open(picture) as image:
        assert min(image.size) > 500
    assert main(["building", "annex", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["mistakes"] == []
    assert told["tours"].keys() == {"A", "B", "C", "mapping"}
    assert main(["building", "nowhere"]) == 2
    assert "shipped are annex, default" in capsys.readouterr().err
    assert main(["building", "annex", "--tour", "Z"]) == 2
    assert "has no tour 'Z'; it has A, B, C, mapping" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["building", "annex", "--plot", "plan.docx"])
    assert "'plan.docx' is no picture's name" in capsys.readouterr().err
