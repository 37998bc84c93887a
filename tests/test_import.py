"""retracer import: sessions that are whole recordings, the same to the bit each time; or one sentence and nothing."""

from __future__ import annotations

import argparse
import json
import re

import numpy as np
import pytest

from graph.codec import decode
from graph.contract import Source
from graph.diff import compare
from graph.errors import UserError
from graph.geometry import inverse, planar
from graph.messages import Odometry, PointCloud
from graph.recording import Recording
from graph.shard import Shard
from operators.scan_folder import ScanFolder
from operators.scans import Session, Settings, write_tum
from operators.scans.import_command import add_arguments, import_session, run

SECOND = 1_000_000_000
PERIOD = SECOND // 10
START = 1_305_031_102_175_304_000


def points_of(number, count=30):
    return np.random.default_rng(number).normal(0, 5, (count, 3)).astype(np.float32)


def way(seconds):
    angle = 0.5 * seconds
    return planar(2.0 * np.sin(angle), 2.0 * (1.0 - np.cos(angle)), angle)


def save(path, points):
    np.c_[points, np.zeros(len(points))].astype("<f4").tofile(path)


def scans(folder, count=6, name="{:06d}.bin"):
    """A folder of KITTI scans, one per 0.1 s."""
    folder.mkdir()
    for n in range(count):
        save(folder / name.format(n), points_of(n))
    return folder


def stamped(folder, count=6):
    """The same, named by their stamps."""
    scans(folder, count)
    for n in range(count):
        stamp = START + n * PERIOD
        (folder / f"{n:06d}.bin").rename(folder / f"{stamp // SECOND}.{stamp % SECOND:09d}.bin")
    return folder


def tum(path, stamps):
    write_tum(path, stamps, [way((stamp - START) * 1e-9) for stamp in stamps])
    return path


def kitti(path, count=6):
    lines = [" ".join(f"{v:.17g}" for v in way(0.1 * n)[:3].reshape(-1)) for n in range(count)]
    path.write_text("\n".join(lines))
    return path


def content(path):
    """Decode a session: stamp and message of each frame, and of each odometry."""
    recording = Recording(path)
    assert recording.verdict.verdict == "COMPLETE"
    kinds = {"frame": PointCloud, "odometry": Odometry}
    found = {port: [] for port in kinds}
    for entry in recording.messages():
        found[entry.port].append((entry.stamp, decode(entry.payload, kinds[entry.port])))
    return found["frame"], found["odometry"]


def test_a_session_holds_the_scans_and_the_odometry_at_their_stamps(tmp_path):
    folder = stamped(tmp_path / "scans")
    poses = tum(tmp_path / "poses.tum", [START + n * PERIOD // 5 for n in range(30)])
    told = import_session(folder, tmp_path / "session.mcap", poses=poses, lidar_height=0.64)
    assert told["frames"] == 6
    assert told["points"] == 180
    assert told["seconds"] == 0.5
    frames, odometry = content(tmp_path / "session.mcap")
    assert [stamp for stamp, _ in frames] == [stamp for stamp, _ in odometry] == [n * PERIOD for n in range(6)]
    for n, (stamp, cloud) in enumerate(frames):
        assert cloud.measured_at == stamp
        assert np.array_equal(cloud.points, points_of(n))
        assert np.array_equal(cloud.base_from_lidar, planar(0, 0, 0, 0.64))
        assert cloud.ring is None
        assert odometry[n][1].measured_at == stamp
        assert np.allclose(odometry[n][1].odom_from_base, way(0.1 * n), atol=1e-8)
        assert (odometry[n][1].linear, odometry[n][1].angular) == pytest.approx((1.0, 0.5), abs=1e-5)
    recording = Recording(tmp_path / "session.mcap")
    assert list(recording.graph.operators) == ["sensor"]
    assert recording.graph.clock.end == "sensor"
    assert len(recording.run.files[str(poses)]) == 64
    assert not list(tmp_path.glob("*.shards"))


@pytest.mark.parametrize("more", [{}, {"rate": 20.0}])
def test_scans_without_stamps_take_the_rate(tmp_path, more):
    import_session(scans(tmp_path / "scans"), tmp_path / "s.mcap", poses=kitti(tmp_path / "poses.txt"), **more)
    frames, odometry = content(tmp_path / "s.mcap")
    assert [stamp for stamp, _ in frames] == [n * PERIOD // (2 if more else 1) for n in range(6)]
    assert np.allclose(odometry[5][1].odom_from_base, way(0.5))
    assert odometry[2][1].linear == pytest.approx(2.0 if more else 1.0)


def test_scans_without_stamps_take_those_of_their_poses(tmp_path):
    poses = tum(tmp_path / "poses.tum", [START + n * 2 * PERIOD for n in range(6)])
    import_session(scans(tmp_path / "scans"), tmp_path / "s.mcap", poses=poses)
    frames, odometry = content(tmp_path / "s.mcap")
    assert [stamp for stamp, _ in frames] == [n * 2 * PERIOD for n in range(6)]
    assert np.allclose(odometry[3][1].odom_from_base, way(0.6), atol=1e-8)


def test_every_other_scan_of_kitti_takes_the_pose_of_its_number(tmp_path):
    poses = kitti(tmp_path / "poses.txt")
    import_session(scans(tmp_path / "scans"), tmp_path / "s.mcap", poses=poses, pattern="*[024].bin")
    _, odometry = content(tmp_path / "s.mcap")
    assert np.allclose([message.odom_from_base for _, message in odometry], [way(0.0), way(0.2), way(0.4)])
    with pytest.raises(UserError, match=r"6 poses for the 4 scans of .*, so which belongs to which cannot be told"):
        import_session(scans(tmp_path / "few", 4, "scan{}.bin"), tmp_path / "t.mcap", poses=poses)


def test_poses_of_the_lidar_or_the_camera_become_poses_of_the_base(tmp_path):
    base_from_lidar = planar(0.2, 0.1, 0.3, 1.7)
    camera_from_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1.0]])
    lidar = [way(0.1 * n) @ base_from_lidar for n in range(6)]
    start = inverse(lidar[0])
    lines = {
        "lidar": [start @ pose for pose in lidar],
        "camera": [camera_from_lidar @ start @ pose @ inverse(camera_from_lidar) for pose in lidar],
    }
    (tmp_path / "calib.txt").write_text("Tr: " + " ".join(map(str, camera_from_lidar[:3].reshape(-1))))
    folder = scans(tmp_path / "scans")
    for kind, matrices in lines.items():
        poses = tmp_path / f"{kind}.csv"
        poses.write_text("\n".join(",".join(f"{v:.17g}" for v in matrix.reshape(-1)) for matrix in matrices))
        more = {"calibration": tmp_path / "calib.txt"} if kind == "camera" else {}
        import_session(
            folder,
            tmp_path / f"{kind}.mcap",
            poses=poses,
            poses_of=kind,
            base_from_lidar=base_from_lidar.reshape(-1).tolist(),
            **more,
        )
        _, odometry = content(tmp_path / f"{kind}.mcap")
        for n, (_, message) in enumerate(odometry):
            moved = inverse(odometry[0][1].odom_from_base) @ message.odom_from_base
            assert np.allclose(moved, inverse(way(0.0)) @ way(0.1 * n), atol=1e-9)
    with pytest.raises(UserError, match="--calibration"):
        import_session(folder, tmp_path / "x.mcap", poses=poses, poses_of="camera")
    with pytest.raises(UserError, match="want a file of poses"):
        import_session(folder, tmp_path / "x.mcap", poses_of="lidar")


def test_far_poses_are_remarked_and_brought_home_on_demand(tmp_path):
    far = planar(500_000.0, 4_000_000.0, 1.0)
    write_tum(tmp_path / "utm.tum", [n * PERIOD for n in range(6)], [far @ way(0.1 * n) for n in range(6)])
    settings = Settings(folder=scans(tmp_path / "scans"), poses=tmp_path / "utm.tum")
    assert any("4000 km" in remark and "--start-at-origin" in remark for remark in Session(settings).remarks)
    import_session(settings.folder, tmp_path / "s.mcap", poses=settings.poses, start_at_origin=True)
    _, odometry = content(tmp_path / "s.mcap")
    assert np.allclose([message.odom_from_base for _, message in odometry], [way(0.1 * n) for n in range(6)], atol=1e-6)


def test_points_that_are_none_and_empty_frames_are_counted(tmp_path, capsys):
    folder = scans(tmp_path / "scans", 4)
    broken = points_of(1)
    broken[2, 0], broken[5] = np.nan, np.inf
    save(folder / "000001.bin", broken)
    save(folder / "000002.bin", points_of(2)[:0])
    save(folder / "000003.bin", points_of(3)[:10] * 100)
    assert run(parsed(folder, "-o", tmp_path / "s.mcap", "--max-range", "50", "--quiet")) == 0
    text = capsys.readouterr().out
    assert "4 frames over 0.3 s, 58 points" in text
    for sentence in (
        "2 points that are not finite were dropped",
        "10 points out of range, or at the origin, were dropped",
        "2 frames are empty",
        "4 frames have no odometry",
    ):
        assert sentence in text
    frames, odometry = content(tmp_path / "s.mcap")
    assert [cloud.points.shape for _, cloud in frames] == [(30, 3), (28, 3), (0, 3), (0, 3)]
    assert odometry == []


def test_two_imports_are_equal_to_the_bit(tmp_path):
    folder = stamped(tmp_path / "scans")
    poses = tum(tmp_path / "poses.tum", [START + n * PERIOD // 3 for n in range(20)])
    for name in ("one", "two"):
        import_session(folder, tmp_path / f"{name}.mcap", poses=poses)
    assert compare(Recording(tmp_path / "one.mcap"), Recording(tmp_path / "two.mcap")).equal


def test_rings_and_times_come_along_and_rings_count_from_below(tmp_path):
    (tmp_path / "scans").mkdir()
    turn, ring = np.meshgrid(np.linspace(0, 6, 50), np.arange(32))
    level = np.radians(20.0 - ring)  # ring 0 is the highest, as Ouster counts
    points = np.stack([np.cos(level) * np.cos(turn), np.cos(level) * np.sin(turn), np.sin(level)], -1).reshape(-1, 3)
    time = np.linspace(0, 0.1, 1600).astype(np.float32)
    np.savez(tmp_path / "scans" / "0.npz", points=points * 5, ring=ring.reshape(-1), time_offset=time)
    np.savez(tmp_path / "scans" / "1.npz", points=points[:3] * 5, ring=ring.reshape(-1)[:3], time_offset=time[:3])
    import_session(tmp_path / "scans", tmp_path / "s.mcap")
    (_, whole), (_, part) = content(tmp_path / "s.mcap")[0]
    assert np.array_equal(whole.ring, 31 - ring.reshape(-1))
    assert np.array_equal(whole.time_offset, time)
    assert part.ring.tolist() == [31, 31, 31]


def parsed(*words):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return parser.parse_args([str(word) for word in words])


def refused(tmp_path, folder, sentence, **settings):
    """Import what will not do: one sentence, and nothing is left behind."""
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match=sentence) as caught:
        import_session(folder, tmp_path / "bad.mcap", **settings)
    assert "\n" not in str(caught.value)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "bad.shards").exists()


def test_duplicate_stamps_are_refused_or_dropped(tmp_path):
    folder = scans(tmp_path / "scans")
    times = tmp_path / "times.txt"
    times.write_text("0.0\n0.1\n0.2\n0.2\n0.4\n0.5\n")
    refused(tmp_path, folder, "000003.bin has the stamp of 000002.bin, 0.2.*--drop-duplicates", stamps=times)
    told = import_session(folder, tmp_path / "s.mcap", stamps=times, drop_duplicates=True)
    assert (told["frames"], told["duplicates"]) == (5, 1)
    frames, _ = content(tmp_path / "s.mcap")
    assert np.array_equal(frames[3][1].points, points_of(4))
    times.write_text("0.0\n0.1\n0.2\n0.15\n0.4\n0.5\n")
    refused(tmp_path, folder, "000003.bin is stamped before 000002.bin", stamps=times, drop_duplicates=True)


def test_missing_poses_are_counted_and_named(tmp_path):
    folder = stamped(tmp_path / "scans")
    poses = tum(tmp_path / "poses.tum", [START + n * PERIOD for n in range(1, 4)])
    sentence = "3 of 6 scans have no pose, the first is 1305031102.175304000.bin at 1305031102.175 s: .*--allow-missing"
    refused(tmp_path, folder, sentence, poses=poses)
    told = import_session(folder, tmp_path / "s.mcap", poses=poses, allow_missing=True)
    assert told["frames_without_odometry"] == 3
    frames, odometry = content(tmp_path / "s.mcap")
    assert len(frames) == 6
    assert [stamp for stamp, _ in odometry] == [n * PERIOD for n in (1, 2, 3)]
    few = kitti(tmp_path / "few.txt", 5)
    refused(tmp_path, folder, "1 of 6 scans have no pose, .*there are 5 poses; --allow-missing", poses=few)
    other = tum(tmp_path / "other.tum", [n * PERIOD for n in range(6)])
    refused(tmp_path, folder, "6 of 6 scans .*another clock or another drive", poses=other, allow_missing=True)
    plain = scans(tmp_path / "plain")
    refused(tmp_path, plain, "6 scans of .* have no stamps, and .* has 3 poses, so which belongs", poses=poses)


def test_broken_scans_in_the_middle_leave_nothing_behind(tmp_path):
    folder = scans(tmp_path / "scans")
    (folder / "000004.bin").write_bytes(bytes(37))
    refused(tmp_path, folder, "000004.bin byte 32: it ends amid a point")


def test_bad_settings_are_refused_in_one_sentence(tmp_path):
    folder = scans(tmp_path / "scans")
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("hello")
    for place, settings, sentence in (
        (tmp_path / "none", {}, "none: no such file or folder"),
        (tmp_path / "empty", {}, "empty holds no scans"),
        (tmp_path / "notes.txt", {}, "no folder of scans, no .pcap and no bag"),
        (folder, {"poses": tmp_path / "none.txt"}, "none.txt: No such file"),
        (folder, {"poses": tmp_path / "notes.txt"}, "notes.txt"),
        (folder, {"rate": 0.0}, "above 0 Hz; 0 was given"),
        (folder, {"min_range": 3.0, "max_range": 2.0}, "nearer than 2 m and beyond 3 m"),
        (folder, {"lidar_height": 1.0, "base_from_lidar": [0.0, 0.0, 1.0]}, "not by both"),
        (folder, {"base_from_lidar": [1.0, 2.0]}, "it has 2"),
        (folder, {"points_topic": "/points"}, "--points-topic is for bags; .* is no such thing"),
        (folder, {"colour": "red"}, "colour"),
        (folder, {"poses_format": "xml"}, "poses_format"),
    ):
        refused(tmp_path, place, sentence, **settings)
    (tmp_path / "there.mcap").write_bytes(b"mine")
    with pytest.raises(UserError, match="exists already"):
        import_session(folder, tmp_path / "there.mcap")
    assert (tmp_path / "there.mcap").read_bytes() == b"mine"
    with pytest.raises(UserError, match=r"a recording is an \.mcap file"):
        import_session(folder, tmp_path / "session.txt")


@pytest.mark.parametrize("where", ["shard", "merge"])
def test_a_full_disk_is_said_and_leaves_nothing_behind(tmp_path, monkeypatch, where):
    folder = scans(tmp_path / "scans")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    if where == "shard":
        monkeypatch.setattr(Shard, "write", full)
    else:
        monkeypatch.setattr("graph.merge.Verdict", full)  # the last thing of a merge, with most of it written
    refused(tmp_path, folder, "bad.mcap: No space left on device; nothing was kept")


def test_an_interrupted_import_leaves_nothing_behind(tmp_path, monkeypatch):
    folder = scans(tmp_path / "scans")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("graph.merge.Verdict", interrupt)
    with pytest.raises(KeyboardInterrupt):
        import_session(folder, tmp_path / "s.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["scans"]


def test_the_command_prints_what_it_did(tmp_path, capsys, monkeypatch):
    folder, poses = scans(tmp_path / "scans"), kitti(tmp_path / "poses.txt")
    monkeypatch.chdir(tmp_path)
    words = ["scans", "-o", "out/s.mcap", "--poses", "poses.txt", "--base-from-lidar", "-0.1", "0", "1.73", "--json"]
    assert run(parsed(*words)) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["session"] == "out/s.mcap"
    assert (told["verdict"], told["frames"], told["frames_without_odometry"]) == ("COMPLETE", 6, 0)
    frames, _ = content(tmp_path / "out" / "s.mcap")
    assert np.array_equal(frames[0][1].base_from_lidar, planar(-0.1, 0, 0, 1.73))
    assert Recording(tmp_path / "out" / "s.mcap").graph.operators["sensor"].config["folder"] == "scans"
    help_text = re.sub(r"\s+", " ", argparse_help())
    assert all(f"--{name.replace('_', '-')}" in help_text for name in Settings.__struct_fields__ if name != "folder")
    assert folder.is_dir()
    assert poses.is_file()


def argparse_help():
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return parser.format_help()


def test_the_source_ends_with_its_last_scan(tmp_path):
    folder = scans(tmp_path / "scans", 2)
    source = ScanFolder(ScanFolder.Config(folder=folder))
    assert isinstance(source, Source)
    (first, one), (second, two) = source.stream()
    assert (first, second) == (0, PERIOD)
    assert np.array_equal(one.frame.points, points_of(0))
    assert type(two[1]).__name__ == "End"
    assert source.on_end()["frames"] == 2


def test_a_bag_becomes_a_session(tmp_path):
    pytest.importorskip("rosbags")
    from test_scans_bags import BASE_FROM_LIDAR, Bag, robot
    from test_scans_bags import points_of as bag_points

    with Bag(tmp_path, "sqlite3") as bag:
        robot(bag)
    told = import_session(bag.path, tmp_path / "s.mcap")
    assert (told["frames"], told["frames_without_odometry"]) == (5, 0)
    frames, odometry = content(tmp_path / "s.mcap")
    assert np.array_equal(frames[4][1].points, bag_points(4))
    assert np.allclose(frames[0][1].base_from_lidar, BASE_FROM_LIDAR)
    assert np.allclose(odometry[3][1].odom_from_base, way(0.3))
    assert (odometry[3][1].linear, odometry[3][1].angular) == pytest.approx((1.0, 0.5))
    refused(tmp_path, bag.path, "--stamps is for folders of scans", stamps=tmp_path / "times.txt")
