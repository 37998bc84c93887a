"""AMCL, Gmapping and the 2-D scan as operators: messages in, messages out."""

from __future__ import annotations

import numpy as np
import pytest
from test_pointmap_room import BASE_FROM_LIDAR, scan

from graph.check import check
from graph.codec import decode, encode
from graph.geometry import planar
from graph.messages import Odometry, PointCloud
from operators.amcl import Amcl, room_map
from operators.gmapping import Gmapping
from operators.montecarlo import MapError, save_map
from operators.pointmap.rehearsal import room_scan
from operators.scan2d import Scan2d

PERIOD = 100_000_000  # ns
MOUNT = planar(0.0, 0.0, 0.0, 0.64)


def frame(n, points=None):
    return PointCloud(measured_at=n * PERIOD, points=room_scan() if points is None else points, base_from_lidar=MOUNT)


def odometry(n, x=0.0, turn=0.0):
    return Odometry(measured_at=n * PERIOD, odom_from_base=planar(x, 0.0, turn), linear=0.0, angular=0.0)


@pytest.fixture
def map_file(tmp_path):
    save_map(tmp_path / "room.yaml", room_map())
    return tmp_path / "room.yaml"


def turns(localizer, count=6):
    """Turn on the spot in the middle of the made-up room."""
    told = []
    for n in range(count):
        localizer.on_odometry(odometry(n, turn=0.25 * n))
        told.append(localizer.on_frame(frame(n, room_scan(turn=0.25 * n))))
    return told


@pytest.mark.parametrize("kind", ["amcl", "gmapping"])
def test_each_is_a_drop_in_for_the_localizer_by_one_line(kind: str):
    report = check("untaught.yaml", swaps=[f"localizer=operators.{kind}:{kind.capitalize()}"])
    assert not report.mistakes


def test_amcl_says_where_it_is_and_its_map_once(map_file):
    told = turns(Amcl(Amcl.Config(map=map_file)))
    assert [output.occupancy is not None for output in told] == [True] + 5 * [False]
    for n, output in enumerate(told):
        assert output.pose.valid
        assert output.pose.measured_at == n * PERIOD
        assert np.abs(output.pose.world_from_base - planar(0.0, 0.0, 0.25 * n)).max() < 0.1
        assert decode(encode(output.pose), type(output.pose)).valid


def test_gmapping_says_where_it_is_and_what_it_has_mapped():
    told = turns(Gmapping(Gmapping.Config(particles=3)), 12)
    assert [output.occupancy is not None for output in told] == [True] + 9 * [False] + [True, False]
    for n, output in enumerate(told):
        assert np.abs(output.pose.world_from_base - planar(0.0, 0.0, 0.25 * n)).max() < 0.06
    cells = told[10].occupancy.cells
    assert set(np.unique(cells)) == {-1, 0, 100}
    assert (cells == 0).sum() * 0.0025 > 40.0  # square metres, of 48


@pytest.mark.parametrize("points", [np.zeros((0, 3), np.float32), np.full((50, 3), np.nan, np.float32)])
@pytest.mark.parametrize("kind", [Amcl, Gmapping])
def test_a_scan_without_returns_is_told_and_odometry_goes_on(kind, points, map_file):
    localizer = kind(kind.Config(map=map_file) if kind is Amcl else kind.Config(particles=2))
    turns(localizer, 2)
    localizer.on_odometry(odometry(2, turn=0.35))
    pose = localizer.on_frame(frame(2, points)).pose
    assert not pose.valid
    assert pose.reason == "the scan has no returns within its band of heights"
    assert np.abs(pose.world_from_base - planar(0.0, 0.0, 0.35)).max() < 0.1
    assert localizer.on_end()["frames_without_returns"] == 1


def test_the_same_messages_say_the_same_bytes(map_file):
    for kind, config in ((Amcl, {"map": map_file}), (Gmapping, {"particles": 3})):
        one, two = (turns(kind(kind.Config(**config)), 4) for _ in range(2))
        assert [encode(output.pose) for output in one] == [encode(output.pose) for output in two]


def test_amcl_finds_itself_from_anywhere_and_says_so_before(map_file):
    localizer = Amcl(Amcl.Config(map=map_file, global_localization=True))
    localizer.on_odometry(odometry(0))
    nothing = localizer.on_frame(frame(0, np.zeros((0, 3), np.float32))).pose
    assert not nothing.valid
    assert "anywhere" in nothing.reason
    place = turns(localizer)[-1].pose.world_from_base[:2, 3]
    assert np.abs(place).max() < 0.3


def test_a_map_that_is_not_there_or_will_not_do_is_told_by_name(map_file, tmp_path):
    with pytest.raises(FileNotFoundError):
        Amcl(Amcl.Config(map=tmp_path / "none.yaml"))
    map_file.write_text(map_file.read_text().replace("0.05", "-1"))
    with pytest.raises(MapError, match="it is -1"):
        Amcl(Amcl.Config(map=map_file))
    save_map(map_file, room_map()._replace(cells=np.zeros((9, 9), np.int8)))
    with pytest.raises(MapError, match=r"room\.yaml: the map has no occupied cell"):
        Amcl(Amcl.Config(map=map_file))


def test_a_flattened_cloud_is_localized_as_the_whole_is():
    points = scan(planar(0.5, 0.2, 0.3) @ BASE_FROM_LIDAR, noise=0.0, seed=0)
    cloud = PointCloud(measured_at=0, points=points, base_from_lidar=BASE_FROM_LIDAR)
    output = Scan2d().on_frame(cloud)
    again = Scan2d().on_frame(output.frame)
    assert output.scan.ranges.shape == (629,)
    assert np.isfinite(output.scan.ranges).sum() == len(output.frame.points)
    assert np.mean(np.isclose(output.scan.ranges, again.scan.ranges, atol=1e-4)) > 0.98
    bearings = output.scan.angle_min + output.scan.angle_increment * np.arange(629)
    assert np.isclose(bearings[0], -np.pi + 0.005)
    assert type(decode(encode(output.scan), type(output.scan))) is type(output.scan)
