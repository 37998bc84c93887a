"""Trajectories: files in and out, poses at a stamp, velocities, and errors by evo."""

from __future__ import annotations

import builtins

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.geometry import exponential, inverse, planar
from operators.scans import ScanError, Trajectory, accuracy, read_poses, write_tum
from operators.scans.bag import BagScans
from operators.scans.poses import read_calibration
from operators.scans.session import placement
from operators.scans.stamps import nanoseconds, read_stamps, stamp_of_name
from operators.scans.trajectory import derived, pose_of

SECOND = 1_000_000_000
finite = st.floats(-1000.0, 1000.0, allow_nan=False)


def pose(vector, place):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = exponential(vector), place
    return result


poses = st.builds(pose, st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(finite, finite, finite))


def drive(count=50, *, linear=1.0, angular=0.3, period=100_000_000, start=1_305_031_102_175_304_123):
    """A robot on a circle: stamps and poses."""
    seconds = np.arange(count) * period * 1e-9
    radius = linear / angular
    there = [
        planar(radius * np.sin(a), radius * (1.0 - np.cos(a)), a) for a in (angular * second for second in seconds)
    ]
    return Trajectory(np.array(there), start + np.arange(count) * period)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 10**10), poses), min_size=1, max_size=6), st.integers(0, 17 * 10**17))
def test_tum_files_come_back_with_exact_stamps(tmp_path_factory, steps, start):
    path = tmp_path_factory.mktemp("tum") / "way.tum"
    stamps = [start + int(step) for step in np.cumsum([step for step, _ in steps])]
    matrices = np.array([matrix for _, matrix in steps])
    write_tum(path, stamps, matrices)
    again = read_poses(path)
    assert again.stamps.tolist() == stamps
    assert np.abs(again.poses - matrices).max() < 3e-9
    assert all(len(line.split()) == 8 for line in path.read_text().splitlines())


def test_evo_reads_what_we_write(tmp_path):
    files = pytest.importorskip("evo.tools.file_interface")
    way = drive()
    write_tum(tmp_path / "way.tum", way.stamps, way.poses)
    theirs = files.read_tum_trajectory_file(tmp_path / "way.tum")
    assert np.allclose(theirs.poses_se3, way.poses, atol=1e-8)
    assert np.allclose(theirs.timestamps, way.stamps * 1e-9, atol=1e-6)


def test_nothing_half_written_is_left(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("operators.scans.tum.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_tum(tmp_path / "way.tum", [0], [np.eye(4)])
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="2 stamps and 1 poses"):
        write_tum(tmp_path / "way.tum", [0, 1], [np.eye(4)])


def rows(matrices, width):
    return [" ".join(f"{value:.12g}" for value in matrix.reshape(-1)[:width]) for matrix in matrices]


def test_kitti_and_csv_files_hold_the_same_poses(tmp_path):
    way = drive(5)
    seconds = [f"{stamp // SECOND}.{stamp % SECOND:09d}" for stamp in way.stamps.tolist()]
    texts = {
        "kitti.txt": "\n".join(rows(way.poses, 12)),
        "plain.csv": "\n".join(line.replace(" ", ",") for line in rows(way.poses, 16)),
        "stamped.csv": "stamp,"
        + ",".join(f"m{n}" for n in range(16))
        + "\n"
        + "\n".join(f"{s}, {line.replace(' ', ', ')}" for s, line in zip(seconds, rows(way.poses, 16), strict=True)),
        "commented.tum": "# t x y z qx qy qz qw\n\n" + "\n".join(f"{s} {n} 0 0 0 0 0 1" for n, s in enumerate(seconds)),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        read = read_poses(tmp_path / name)
        if name != "commented.tum":
            assert np.allclose(read.poses, way.poses, atol=1e-9), name
        assert (read.stamps is None) == (name in ("kitti.txt", "plain.csv"))
        assert read.stamps is None or read.stamps.tolist() == way.stamps.tolist()
    assert len(read_poses(tmp_path / "kitti.txt", "kitti").poses) == 5
    with pytest.raises(ScanError, match=r"line 1: poses have 8 for tum numbers a line; this one has 12"):
        read_poses(tmp_path / "kitti.txt", "tum")


LINES = ["0.0 0 0 0 0 0 0 1", "0.1 1 0 0 0 0 0 1", "0.2 2 0 0 0 0 0 1"]
UNIT12 = "1 0 0 0 0 1 0 0 0 0 1 0"

BROKEN = {
    "nothing": ([], "holds no poses"),
    "a comment": (["# t x y z"], "holds no poses"),
    "seven numbers": ([LINES[0][:-2]], "line 1: poses have 8 .*; this one has 7"),
    "a short line": ([*LINES, "0.3 1 2"], "line 4: it has 3 numbers; the lines before have 8"),
    "a word": ([*LINES, LINES[0].replace("1", "red")], "line 4: 'red' is no number"),
    "not a number": ([*LINES, "0.3 nan 0 0 0 0 0 1"], "line 4: a pose holds finite numbers only"),
    "a stamp that is none": ([*LINES, "inf 0 0 0 0 0 0 1"], "line 4: TUM stamps are seconds"),
    "no rotation": (["0.0 0 0 0 0 0 0 0"], "line 1: a quaternion .*; this one has 0"),
    "nanoseconds": (["1403636579763555584 0 0 0 0 0 0 1"], "line 1: TUM stamps are seconds"),
    "a stamp twice": ([*LINES, LINES[2]], "line 4: the stamp 0.2 is also that of line 3; --drop-duplicates"),
    "a stamp back": ([*LINES, LINES[1]], "line 4: the stamp 0.1 is before"),
    "a mirror": ([UNIT12, UNIT12.replace("1", "-1", 1)], "line 2: its rotation part is no rotation"),
    "column by column": (["1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1"], "line 1: the last row of a 4x4 pose is 0 0 0 1"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_pose_file_is_named_with_its_line(tmp_path, name):
    lines, sentence = BROKEN[name]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    with pytest.raises(ScanError, match=sentence) as caught:
        read_poses(tmp_path / "poses.txt")
    assert "poses.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_first_of_two_poses_with_one_stamp_is_kept_on_demand(tmp_path):
    (tmp_path / "poses.txt").write_text("\n".join([*LINES, LINES[2].replace("2 ", "9 ", 1).replace("0.9", "0.2")]))
    read = read_poses(tmp_path / "poses.txt", drop_duplicates=True)
    assert read.poses[:, 0, 3].tolist() == [0, 1, 2]


def test_the_calibration_places_the_lidar_in_the_camera(tmp_path):
    placed = "0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3"
    (tmp_path / "calib.txt").write_text(f"P0: {UNIT12}\nTr: {placed}\n")
    assert read_calibration(tmp_path / "calib.txt")[:3].reshape(-1).tolist() == [float(v) for v in placed.split()]
    (tmp_path / "calib.txt").write_text(f"P0: {UNIT12}\n")
    with pytest.raises(ScanError, match="no line 'Tr:'"):
        read_calibration(tmp_path / "calib.txt")
    (tmp_path / "calib.txt").write_text("Tr: 1 2 3")
    with pytest.raises(ScanError, match="line 1: Tr wants 12 numbers; there are 3"):
        read_calibration(tmp_path / "calib.txt")


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 4_900_000_000))
def test_a_pose_between_two_lies_between_them(after):
    way = drive()
    motion = way.at(int(way.stamps[0]) + after)
    angle = 0.3 * after * 1e-9
    assert np.abs(motion.pose[:3, 3] - [np.sin(angle) / 0.3, (1 - np.cos(angle)) / 0.3, 0]).max() < 0.5 * 0.05**2 * 0.3
    assert abs(np.arctan2(motion.pose[1, 0], motion.pose[0, 0]) - angle) < 1e-9


def test_there_is_no_pose_beyond_the_ends_or_in_a_gap():
    way = drive(20)
    stamps = way.stamps.tolist()
    assert way.at(stamps[0] - 2_000_000) is None
    assert way.at(stamps[-1] + 2_000_000) is None
    assert np.array_equal(way.at(stamps[0] - 1).pose, way.poses[0])  # one moment, through two texts
    assert np.array_equal(way.at(stamps[7]).pose, way.poses[7])
    gap = Trajectory(way.poses[[0, 15]], way.stamps[[0, 15]])
    assert gap.at(stamps[7]) is None
    with pytest.raises(ValueError, match="without stamps"):
        Trajectory(way.poses).at(0)
    measured = way._replace(velocities=np.c_[np.arange(20.0), np.arange(20.0) * 2])
    assert measured.at(stamps[3] + 25_000_000)[1:] == pytest.approx((3.25, 6.5))


@settings(max_examples=40, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0).filter(lambda w: abs(w) > 1e-3), poses)
def test_steady_driving_has_its_own_velocity_wherever_the_world_begins(linear, angular, world_from_start):
    way = drive(6, linear=linear, angular=angular)
    for motion in derived(way.stamps.tolist(), list(world_from_start[None] @ way.poses)):
        yawed = np.array([motion.linear, motion.angular])
        if np.allclose(world_from_start[2, :3], [0, 0, 1]):
            assert np.allclose(yawed, [linear, angular], atol=1e-6)
    level = planar(3.0, -4.0, 1.0)
    for motion in derived(way.stamps.tolist(), list(level @ way.poses)):
        assert (motion.linear, motion.angular) == pytest.approx((linear, angular), abs=1e-6)


def test_a_pose_that_is_missing_or_alone_stands_still():
    way = drive(3)
    assert derived([0, 1, 2], [None, way.poses[1], None])[1][1:] == (0.0, 0.0)
    assert derived([0, 1, 2], [None, way.poses[1], None])[0] is None
    far = derived([0, 5 * SECOND], [way.poses[0], way.poses[1]])
    assert [motion.linear for motion in far] == [0.0, 0.0]


def test_evo_finds_the_errors_that_were_made():
    pytest.importorskip("evo")
    true = drive(200)
    shift = planar(0.03, 0.04, 0.0)
    shifted = accuracy(true, Trajectory(shift @ true.poses, true.stamps))
    assert np.allclose(shifted.translation, 0.05)
    assert np.allclose(shifted.rotation, 0.0, atol=1e-7)
    assert shifted.drift.max() < 1e-9
    turned = accuracy(true, Trajectory(true.poses @ planar(0, 0, 0.01), true.stamps))
    assert np.allclose(turned.rotation, 0.01)
    assert turned.statistics()["rotation"]["rmse"] == pytest.approx(0.01)
    moved = Trajectory(planar(5, 6, 1.0) @ true.poses, true.stamps + 4_000_000)
    assert accuracy(true, moved, align=True).translation.max() < 1e-9
    assert accuracy(true, moved).statistics()["translation"]["median"] > 5.0
    stand = Trajectory(true.poses[:3], true.stamps[:3])
    assert set(accuracy(stand, stand).statistics()) == {"translation", "rotation"}  # too short a way to drift
    with pytest.raises(ScanError, match="no stamps in common"):
        accuracy(true, Trajectory(true.poses, true.stamps + 3600 * SECOND))
    with pytest.raises(ScanError, match="want stamps"):
        accuracy(true, Trajectory(true.poses))
    with pytest.raises(ScanError, match="one of the two has none"):
        accuracy(true, Trajectory(true.poses[:0], true.stamps[:0]))


@pytest.mark.parametrize(("package", "extra"), [("evo", "evo"), ("rosbags", "ros")])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, package, extra):
    real = builtins.__import__

    def without(name, *args, **more):
        if name.split(".")[0] == package:
            raise ImportError(name)
        return real(name, *args, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    (tmp_path / "x.bag").write_bytes(b"")
    use = {"evo": lambda: accuracy(drive(), drive()), "rosbags": lambda: BagScans([tmp_path / "x.bag"])}[package]
    with pytest.raises(ScanError, match=rf'pip install "retracer\[{extra}\]"'):
        use()


@pytest.mark.parametrize(
    ("stem", "stamp"),
    [
        ("1305031102.175304", 1_305_031_102_175_304_000),
        ("cloud_1305031102.175304123", 1_305_031_102_175_304_123),
        ("1305031102_175304123", 1_305_031_102_175_304_123),
        ("lidar-1305031102175", 1_305_031_102_175_000_000),
        ("1305031102175304", 1_305_031_102_175_304_000),
        ("1305031102175304123", 1_305_031_102_175_304_123),
        ("1305031102", 1_305_031_102_000_000_000),
        ("12.5", 12_500_000_000),
        ("000123", None),
        ("0000000123", None),
        ("scan12", None),
        ("room", None),
        ("20110926130225", None),  # a date, not a count of milliseconds
    ],
)
def test_stamps_are_read_off_file_names(stem, stamp):
    assert stamp_of_name(stem) == stamp


def test_files_of_stamps_hold_numbers_or_dates(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("# KITTI\n0.0\n1.036224e-01\n\n2.073e-01\n")
    assert read_stamps(path) == [0, 103_622_400, 207_300_000]
    path.write_text("2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26\n")
    assert read_stamps(path) == [1_317_042_145_964_389_445, 1_317_042_146_000_000_000]
    for text, sentence in (
        ("0.1\nsoon\n", "line 2: .*'soon' is no number"),
        ("nan\n", "line 1"),
        ("2011-99-26 00:00:00", "line 1"),
    ):
        path.write_text(text)
        with pytest.raises(ScanError, match=sentence):
            read_stamps(path)
    with pytest.raises(ValueError, match="no number"):
        nanoseconds("x")


def test_the_lidar_is_placed_by_three_six_seven_or_sixteen_numbers():
    wanted = planar(1.0, 2.0, 0.5, 3.0)
    quaternion = [0.0, 0.0, np.sin(0.25), np.cos(0.25)]
    for numbers in ([1, 2, 3, 0, 0, 0.5], [1, 2, 3, *quaternion], wanted.reshape(-1)):
        assert np.allclose(placement(numbers), wanted)
    assert np.array_equal(placement([1, 2, 3]), planar(1.0, 2.0, 0.0, 3.0))
    tilted = placement([0, 0, 0, 0.1, 0.2, 0.3])[:3, :3]
    assert np.allclose(tilted, exponential([0, 0, 0.3]) @ exponential([0, 0.2, 0]) @ exponential([0.1, 0, 0]))
    for numbers, sentence in (([1, 2], "it has 2"), ([0] * 16, "no rotation"), ([np.nan] * 3, "finite")):
        with pytest.raises(ScanError, match=sentence):
            placement(numbers)


@settings(max_examples=40, deadline=None)
@given(poses, st.floats(0, 1e-6))
def test_rounded_rotations_become_exact(matrix, rounding):
    exact = pose_of(matrix[:3, :3] + rounding, matrix[:3, 3])
    assert np.allclose(exact @ inverse(exact), np.eye(4), atol=1e-10)
    assert np.abs(exact - matrix).max() <= 3e-6
