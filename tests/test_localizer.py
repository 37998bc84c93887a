"""The localizers as operators: messages in, messages out."""

from __future__ import annotations

import numpy as np
import pytest
from test_pointmap_room import BASE_FROM_LIDAR, scan

from graph.codec import decode, encode
from graph.contract import ports_of
from graph.geometry import inverse, planar
from graph.messages import MapCloud, OccupancyGrid, Odometry, PointCloud, Pose
from operators.localizer import Localizer, TrueLocalizer
from operators.pointmap import PlyError, save_map

PERIOD = 100_000_000  # ns


def truth(n):
    return planar(-2 + 0.1 * n, 0.5 * np.sin(0.2 * n), 0.1 * n)


def odometry(n, drift=0.002, stamp=None, **more):
    turned = planar(0.0, drift * n, drift * n) @ truth(n)
    stamp = n * PERIOD if stamp is None else stamp
    return Odometry(measured_at=stamp, odom_from_base=turned, linear=1.0, angular=1.0, **more)


def frame(n, points=None, stamp=None, **more):
    points = scan(truth(n) @ BASE_FROM_LIDAR, noise=0.008, seed=n) if points is None else points
    stamp = n * PERIOD if stamp is None else stamp
    return PointCloud(measured_at=stamp, points=points, base_from_lidar=BASE_FROM_LIDAR, **more)


def drive(localizer, steps=25):
    outputs = []
    for n in range(steps):
        localizer.on_odometry(odometry(n, true_world_from_base=truth(n)))
        outputs.append(localizer.on_frame(frame(n)))
    return outputs


def distance(pose, n):
    return float(np.linalg.norm((pose.world_from_base - truth(n))[:2, 3]))


def test_the_ports_are_those_of_the_graph():
    for kind in (Localizer, TrueLocalizer):
        ports = ports_of(kind)
        assert list(ports.inputs.items()) == [("odometry", Odometry), ("frame", PointCloud)]
        assert ports.outputs == {"pose": Pose, "map": MapCloud, "occupancy": OccupancyGrid}


def test_a_drive_is_followed_where_odometry_drifts():
    outputs = drive(Localizer())
    assert all(output.pose.valid for output in outputs)
    assert max(distance(output.pose, n) for n, output in enumerate(outputs)) < 0.05
    assert distance(outputs[-1].pose, 24) < 0.5 * np.linalg.norm((odometry(24).odom_from_base - truth(24))[:2, 3])
    assert [output.pose.measured_at for output in outputs] == [n * PERIOD for n in range(25)]


def test_two_localizers_say_the_same_bytes():
    for a, b in zip(drive(Localizer(), 12), drive(Localizer(), 12), strict=True):
        assert encode(a.pose) == encode(b.pose)
        assert (a.map is None) == (b.map is None)
        if a.map is not None:
            assert encode(a.map) == encode(b.map)
            assert encode(a.occupancy) == encode(b.occupancy)


def test_all_outputs_pass_the_codec():
    output = drive(Localizer(), 1)[0]
    for message in (output.pose, output.map, output.occupancy):
        assert type(decode(encode(message), type(message))) is type(message)


def test_the_messages_of_the_map_add_up_to_the_map():
    localizer = Localizer()
    outputs = drive(localizer)
    clouds = [output.map for output in outputs if output.map is not None]
    assert [n for n, output in enumerate(outputs) if output.map is not None] == [0, 10, 20]
    assert [cloud.incremental for cloud in clouds] == [False, True, True]
    points = np.concatenate([cloud.points for cloud in clouds])
    assert np.array_equal(points, localizer.mapper.pointmap.map.points[: len(points)])


def test_the_grid_knows_walls_boxes_and_free_floor():
    grid = drive(Localizer(Localizer.Config(occupancy_period=0.0)))[-1].occupancy

    def value(x, y):
        return grid.cells[tuple(np.floor((np.array([y, x]) - grid.origin[::-1]) / grid.resolution).astype(int))]

    near_wall = [value(6.99 + step, 0.3) for step in (-0.05, 0.0, 0.05)]
    assert max(near_wall) > 80
    assert max(value(1.01, 1.5), value(0.99, 1.5)) > 80
    assert 0 <= value(0.0, 0.0) < 10
    assert 0 <= value(-1.5, 0.0) < 10
    assert value(1.5, 1.9) == -1


def test_the_map_can_be_saved_and_started_from(tmp_path):
    first = Localizer()
    drive(first)
    save_map(tmp_path / "room.ply", first.mapper.pointmap.map.cloud())
    second = Localizer(Localizer.Config(map=tmp_path / "room.ply"))
    outputs = drive(second)
    assert max(distance(output.pose, n) for n, output in enumerate(outputs)) < 0.05
    assert len(outputs[0].map.points) >= len(first.mapper.pointmap.map)
    assert not outputs[0].map.incremental
    assert second.mapper.pointmap.map.created.min() == -1
    assert (outputs[0].occupancy.cells >= 0).sum() > 10_000


def test_a_map_that_is_none_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.ply"):
        Localizer(Localizer.Config(map=tmp_path / "nowhere.ply"))
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(PlyError, match="not a PLY"):
        Localizer(Localizer.Config(map=tmp_path / "text.ply"))


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.ones((10, 3)), np.full((500, 3), np.nan)])
def test_a_blind_frame_gives_an_invalid_pose_carried_by_odometry(points):
    localizer = Localizer()
    drive(localizer, 10)
    before = len(localizer.mapper.pointmap.map)
    localizer.on_odometry(odometry(10))
    pose = localizer.on_frame(frame(10, points.astype(np.float32))).pose
    assert not pose.valid
    assert "usable points" in pose.reason
    assert distance(pose, 10) < 0.05
    assert len(localizer.mapper.pointmap.map) == before
    localizer.on_odometry(odometry(11))
    assert localizer.on_frame(frame(11)).pose.valid
    assert localizer.on_end()["invalid_poses"] == 1


def test_a_blind_start_is_survived():
    localizer = Localizer()
    empty = np.empty((0, 3), np.float32)
    output = localizer.on_frame(frame(0, empty))
    assert not output.pose.valid
    assert output.map is None
    assert output.occupancy is None
    localizer.on_odometry(odometry(1))
    assert localizer.on_frame(frame(1)).pose.valid


def test_a_frame_between_two_odometry_stamps_is_interpolated():
    localizer = Localizer()
    drive(localizer, 5)
    localizer.on_odometry(odometry(5))
    between = planar(0.0, 0.0, 0.0)
    between[:] = 0.5 * (truth(4) + truth(5))
    blind = frame(5, np.empty((0, 3), np.float32), stamp=4 * PERIOD + PERIOD // 2)
    pose = localizer.on_frame(blind).pose
    assert np.linalg.norm((pose.world_from_base - between)[:2, 3]) < 0.01


def test_stamps_that_come_twice_do_no_harm():
    localizer = Localizer()
    drive(localizer, 5)
    for _ in range(2):
        localizer.on_odometry(odometry(5))
        pose = localizer.on_frame(frame(5)).pose
        assert pose.valid
        assert distance(pose, 5) < 0.05
    localizer.on_odometry(odometry(3))  # older than what is known: the robot is where the last word says
    localizer.on_odometry(odometry(6))
    pose = localizer.on_frame(frame(6)).pose
    assert pose.valid
    assert distance(pose, 6) < 0.05


def test_a_frame_after_the_last_odometry_is_carried_and_still_aligned():
    localizer = Localizer()
    drive(localizer, 5)
    output = localizer.on_frame(frame(5))
    assert output.pose.valid
    assert distance(output.pose, 5) < 0.05


def test_a_jump_is_not_believed():
    localizer = Localizer(Localizer.Config(largest_jump=0.1))
    drive(localizer, 3)
    localizer.on_odometry(odometry(3))
    pose = localizer.on_frame(frame(3, scan(truth(3) @ planar(0.3, 0.0, 0.0) @ BASE_FROM_LIDAR))).pose
    assert not pose.valid
    assert "jump" in pose.reason


def rolling(n, linear, angular):
    """A scan of 0.1 s that starts at truth(n), seen from a base that drives and turns steadily."""
    parts, offsets = [], []
    for k in range(32):
        seconds = 0.1 * k / 32
        turn = angular * seconds
        chord = linear * seconds
        now = truth(n) @ planar(chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn)
        points = scan(now @ BASE_FROM_LIDAR)
        sector = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / (2 * np.pi) * 32).astype(int) % 32
        parts.append(points[sector == k])
        offsets.append(np.full(len(parts[-1]), seconds, np.float32))
    return np.concatenate(parts), np.concatenate(offsets)


def test_a_rolling_scan_is_straightened():
    points, offsets = rolling(0, 1.0, 1.0)
    errors = {}
    for name, offset in (("rolling", offsets), ("as if instantaneous", None)):
        localizer = Localizer()
        drive(localizer, 1)
        localizer.on_odometry(odometry(0, stamp=PERIOD))
        pose = localizer.on_frame(frame(0, points, stamp=PERIOD, time_offset=offset)).pose
        errors[name] = distance(pose, 0)
        assert pose.valid
    assert errors["rolling"] < 0.003
    assert errors["as if instantaneous"] > 0.02


def test_the_true_localizer_says_the_truth_and_maps():
    localizer = TrueLocalizer()
    outputs = drive(localizer, 12)
    assert all(np.allclose(output.pose.world_from_base, truth(n)) for n, output in enumerate(outputs))
    assert outputs[0].occupancy is not None
    assert outputs[10].map.incremental
    assert np.abs(inverse(truth(11)) @ outputs[11].pose.world_from_base - np.eye(4)).max() < 1e-12


def test_the_true_localizer_wants_the_truth():
    with pytest.raises(ValueError, match="only a simulator"):
        TrueLocalizer().on_odometry(odometry(0))
