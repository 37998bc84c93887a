"""Pictures: the renderer sees what the lidar sees; the sheet of a session is drawn to the end."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

pytest.importorskip("pybullet")
pytest.importorskip("embreex")

from graph.geometry import planar
from sim import World, snapshot
from sim.render import PALETTE, ROBOT, Renderer, capsule_triangles, overhead, perspective
from sim.solids import Body, Box, Truth
from tests.small_rooms import box_room

FLOOR = Body("floor", Truth.GROUND, (Box(0, 0, -0.05, 20, 20, 0.1),))
WALL = Body("wall", Truth.WALL, (Box(4, 0, 1.25, 0.2, 6, 2.5),))
ROBOT_BODY = Body("robot", Truth.UNKNOWN, (Box(-2, 1, 0.2, 0.4, 0.4, 0.4),))
PERSON = np.array([[[[2.0, 0.0, 0.3], [2.0, 0.0, 1.5]]]])
RADIUS = np.array([[0.25]])


def renderer() -> Renderer:
    return Renderer([FLOOR, WALL], ROBOT_BODY, PERSON, RADIUS, np.array([Truth.MOVING_PERSON], np.uint8))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_a_capsule_s_mesh_lies_on_it_and_is_closed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends, radius = rng.normal(0, 1, (1, 2, 3)), rng.uniform(0.02, 0.4, 1)
    triangles = capsule_triangles(ends, radius)[0]
    a, b = ends[0]
    share = np.clip((triangles - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    distance = np.linalg.norm(triangles - (a + share[..., None] * (b - a)), axis=2)
    np.testing.assert_allclose(distance, radius[0], rtol=1e-6)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2
    np.testing.assert_allclose(normals.sum(0), 0.0, atol=1e-9)  # closed
    volume = np.einsum("ij,ij->", triangles[:, 0], normals) / 3
    exact = math.pi * radius[0] ** 2 * (np.linalg.norm(b - a) + 4 / 3 * radius[0])
    assert 0.85 * exact < volume < exact  # normals outward


def test_from_above_everything_is_where_it_stands() -> None:
    seen = renderer().kinds(overhead((-5.0, -5.0, 5.0, 5.0), 100))
    assert seen.shape == (100, 100)
    for x, y, kind in (
        (2.0, 0.0, Truth.MOVING_PERSON),
        (4.0, 2.0, Truth.WALL),
        (-2.0, 1.0, ROBOT),
        (0, 0, Truth.GROUND),
    ):
        assert seen[int((5.0 - y) * 10), int((x + 5.0) * 10)] == kind
    assert (seen == Truth.MOVING_PERSON).sum() == pytest.approx(100 * math.pi * 0.25**2, rel=0.2)


def test_the_eye_sees_the_person_before_the_wall() -> None:
    seen = renderer().kinds(perspective((0.0, 0.0, 1.0), 0.0, 0.0, (160, 90)))
    assert seen[45, 80] == Truth.MOVING_PERSON
    assert seen[45, 40] == Truth.WALL
    assert seen[45, 120] == Truth.WALL
    assert seen[0, 80] == -1  # the sky above the wall
    assert seen[89, 5] == Truth.GROUND
    left = renderer().kinds(perspective((0.0, 0.0, 1.0), 0.3, 0.0, (160, 90)))
    columns = np.flatnonzero((left == Truth.MOVING_PERSON).any(0))
    assert columns.min() > 80  # turned to the left, the person is on the right


def test_pictures_are_equal_to_the_bit_and_coloured_by_class() -> None:
    camera = perspective((0.0, 0.0, 1.0), 0.0, 0.0, (160, 90))
    picture = renderer().picture(camera)
    assert picture.shape == (45, 80, 3)
    assert picture.tobytes() == renderer().picture(camera).tobytes()
    body = picture[22, 40].astype(float)
    assert body / body.max() == pytest.approx(
        PALETTE[Truth.MOVING_PERSON] / PALETTE[Truth.MOVING_PERSON].max(), abs=0.1
    )


def test_shadows_fall_away_from_the_sun() -> None:
    above = renderer().picture(overhead((-5.0, -5.0, 5.0, 5.0), 200)).astype(float).sum(2)
    assert above[46, 65] < 0.85 * above[46, 40]  # north west of the person


def test_the_sheet_shows_the_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshot, "ABOVE", 200)
    monkeypatch.setattr(snapshot, "SIZE", (160, 90))
    monkeypatch.setattr(snapshot, "SETTLE", 0.3)
    monkeypatch.setattr(snapshot, "DPI", 30)
    world = World(box_room(), "extreme", "A", 1)
    told: list[float] = []
    snapshot.draw_snapshot(world, tmp_path / "sheet.png", "a room", progress=told.append)
    with Image.open(tmp_path / "sheet.png") as image:
        assert min(image.size) > 300
        colours = np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3) // 16, axis=0)
    assert len(colours) > 200
    assert told == sorted(told)
    assert 0.0 < told[0] < told[-1] <= 1.0


def test_a_world_of_boxes_is_driven_and_scanned(tmp_path: Path) -> None:
    """A building of boxes, without a single wall line; its doorway has no door."""
    (tmp_path / "walls.ply").write_text(
        "ply\nformat ascii 1.0\nelement box 6\n"
        + "".join(f"property float {end}_{axis}\n" for end in ("min", "max") for axis in "xyz")
        + "end_header\n0 0 0 10 .2 2.5\n0 5.8 0 10 6 2.5\n0 0 0 .2 6 2.5\n9.8 0 0 10 6 2.5\n"
        "4.9 0 0 5.1 2 2.5\n4.9 3.2 0 5.1 6 2.5\n"
    )
    (tmp_path / "flat.yaml").write_text(
        "boxes: walls.ply\nstart: [1, 2.6, 0]\ntables: [{at: [8, 4.4], models: [cafe]}]\n"
        "rooms: [{name: west, rectangle: [0, 0, 5, 6], populated: true}, {name: east, rectangle: [5, 0, 10, 6]}]\n"
        "tours: {A: {targets: [[8.5, 2.6]]}}\n"
    )
    world = World(tmp_path / "flat.yaml", "extreme", "A", 1)
    assert len(world.crowd.position) > 3
    frame = world.step(0.5, 0.0)
    assert {Truth.GROUND, Truth.WALL} <= set(np.unique(frame.truth).tolist())
    seen = {world.bodies[body].name for body in np.unique(frame.instance) if body < len(world.bodies)}
    assert {"block 2", "block 4", "block 5"} <= seen


def test_the_robot_is_put_where_it_is_seen_and_touches_nobody() -> None:
    world = World("annex", "hard", "A", 2)
    spot = snapshot.liveliest(world)
    assert spot.ahead > 2.0
    place = np.array([spot.x, spot.y]) + spot.ahead * np.array([math.cos(spot.heading), math.sin(spot.heading)])
    assert world.layout.free.at(place[None])[0] > 0.3
    assert np.linalg.norm(world.state().people[:, :2] - place, axis=1).min() > 0.5
    pose = planar(*place, spot.heading)
    seen = snapshot.renderer_of(world, pose).kinds(
        perspective((spot.x, spot.y, snapshot.EYES), spot.heading, snapshot.TILT, (320, 180))
    )
    assert (seen == ROBOT).sum() > 50
