"""CARMEN logs, relations, and the commands that read them."""

from __future__ import annotations

import bz2
import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest

from graph.cli import main
from graph.geometry import inverse, planar
from operators.scans import ScanError, Session, Settings
from operators.scans.carmen import log_trajectory, read_readings
from operators.scans.relations import read_relations, relation_errors, relations_of
from operators.scans.trajectory import Trajectory
from operators.scans.tum import write_tum

INTEL = Path(__file__).parents[2] / "shared" / "data" / "radish_intel"


def flaser(n: int, readings: int = 181, x: float | None = None) -> str:
    ranges = " ".join("2.00" for _ in range(readings - 1))
    x = 0.1 * n if x is None else x
    return f"FLASER {readings} {ranges} 81.83 {x} 0 0 {x} 0 0 {100 + 0.2 * n:.6f} host {0.2 * n:.6f}"


def robotlaser(n: int) -> str:
    return (
        f"ROBOTLASER1 0 -1.570796 3.141593 0.017453 20.0 0.01 0 3 1.0 2.0 20.0 1 0.5 "
        f"{0.1 * n + 0.2} 0 0 {0.1 * n} 0 0 0.5 0 1 0.3 0 {100 + 0.2 * n:.6f} host {0.2 * n:.6f}"
    )


def log(folder: Path, *lines: str, name: str = "run.clf") -> Path:
    path = folder / name
    odometry = "ODOM 0 0 0 0.5 0 0 100.000000 host 0.000000"
    data = "\n".join(["# message_name", "PARAM robot_frontlaser_offset 0.0 nohost 0", odometry, *lines, ""]).encode()
    path.write_bytes(
        gzip.compress(data) if name.endswith(".gz") else bz2.compress(data) if name.endswith(".bz2") else data
    )
    return path


@pytest.mark.parametrize("name", ["run.clf", "run.log.gz", "run.clf.bz2"])
def test_scans_and_odometry_come_in_whatever_the_log_is_packed_in(tmp_path: Path, name: str):
    session = Session(Settings(folder=log(tmp_path, *(flaser(n) for n in range(5)), name=name)))
    frames = list(session)
    assert [frame.stamp for frame in frames] == [n * 200_000_000 for n in range(5)]
    for n, frame in enumerate(frames):
        assert len(frame.scan.points) == 180  # a reading of 81.83 m means that nothing was met
        assert np.allclose(np.linalg.norm(frame.scan.points, axis=1), 2.0)
        assert np.allclose(frame.scan.points[0], [0.0, -2.0, 0.0], atol=1e-6)
        assert np.allclose(frame.odometry.pose[:3, 3], [0.1 * n, 0.0, 0.0])
    assert 0.07 < session.base_from_lidar[2, 3] < 1.06


def test_the_newer_record_says_its_own_angles_and_where_the_laser_is(tmp_path: Path):
    path = log(tmp_path, *(robotlaser(n) for n in range(3)))
    session = Session(Settings(folder=path))
    (frame, *_) = session
    assert len(frame.scan.points) == 2
    assert np.allclose(np.arctan2(frame.scan.points[1, 1], frame.scan.points[1, 0]), -math.pi / 2 + 0.017453, atol=1e-5)
    assert np.allclose(session.base_from_lidar[:2, 3], [0.2, 0.0])
    assert np.allclose(log_trajectory(path).poses[:, 0, 3], [0.2, 0.3, 0.4])


def test_late_lines_are_put_in_order_and_of_one_stamp_the_first_stays(tmp_path: Path):
    session = Session(Settings(folder=log(tmp_path, flaser(0), flaser(2), flaser(1), flaser(1, x=9.0))))
    assert [frame.odometry.pose[0, 3] for frame in session] == pytest.approx([0.0, 0.1, 0.2])
    assert any("1 scans were dropped" in remark for remark in session.remarks)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("FLASER 181 1.0 2.0", "line 5: FLASER: it has 2 of 181 readings"),
        (flaser(1).replace(" 2.00 ", " two ", 1), "line 5: FLASER: 'two' is no number; reading 1 of 181"),
        (flaser(1).rsplit(" ", 2)[0], "line 5: FLASER: 0 words follow the stamp"),
        ("FLASER -3 0 0 0", "line 5: FLASER: the number of readings is -3"),
        ("ODOM 0 0 nan 0 0 0 1 host 1", "line 5: ODOM: x, y, heading and velocities is nan, not a finite number"),
        ("ROBOTLASER1 0 1", "line 5: ROBOTLASER1: it ends where"),
    ],
)
def test_a_broken_line_is_told_by_its_number(tmp_path: Path, line: str, sentence: str):
    with pytest.raises(ScanError, match=sentence):
        read_readings(log(tmp_path, flaser(0), line))


def test_logs_without_scans_and_cut_archives_are_refused(tmp_path: Path):
    with pytest.raises(ScanError, match="holds no scans"):
        read_readings(log(tmp_path))
    path = log(tmp_path, *(flaser(n, x=math.sin(n)) for n in range(400)), name="cut.log.gz")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ScanError, match="cannot be unpacked after line"):
        read_readings(path)


def arc(count: int = 50, slip: float = 0.0) -> Trajectory:
    """Drive an arc; slip: metres that one step in the middle is too long."""
    pose, poses = np.eye(4), []
    for n in range(count):
        poses.append(pose)
        pose = pose @ planar(0.2 + slip * (n == count // 2), 0.0, 0.03)
    return Trajectory(np.array(poses), np.arange(count, dtype=np.int64) * 200_000_000)


def test_relations_count_a_slip_once_and_want_no_alignment():
    truth, estimate = arc(), arc(slip=0.5)
    moved = estimate._replace(poses=planar(3.0, -2.0, 1.0) @ estimate.poses)
    errors = relation_errors(moved, relations_of(truth))
    assert errors.missing == 0
    assert errors.translation.sum() == pytest.approx(0.5)
    assert np.count_nonzero(errors.translation > 1e-9) == 1
    assert errors.rotation.max() < 1e-7


def test_relations_are_read_and_interpolated_between_stamps(tmp_path: Path):
    path = tmp_path / "arc.relations"
    path.write_text("# two stamps, x y z, roll pitch yaw\n0.1 0.5 0.4 0.01 0 0 0 0.06\n90 91 0 0 0 0 0 0\n")
    known = read_relations(path)
    assert np.allclose(known[0].motion, planar(0.4, 0.01, 0.06))
    errors = relation_errors(arc(), known)
    assert errors.missing == 1
    assert errors.translation[0] < 0.01
    with pytest.raises(ScanError, match="covers none of the 1 relations"):
        relation_errors(arc(), known[1:])
    path.write_text("0 1 2 3\n")
    with pytest.raises(ScanError, match="line 1: a relation has 8 numbers"):
        read_relations(path)


def test_the_command_evaluates_by_evo_and_by_relations(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("evo")
    truth, slipped = arc(), arc(slip=0.5)
    for name, known in (("truth.tum", truth), ("slipped.tum", slipped)):
        write_tum(tmp_path / name, known.stamps.tolist(), known.poses)
    lines = [f"{n * 0.2:.6f} {(n + 1) * 0.2:.6f} 0.2 0 0 0 0 0.03" for n in range(49)]
    (tmp_path / "arc.relations").write_text("\n".join(lines))
    assert main(["evaluate-trajectory", str(tmp_path / "slipped.tum"), str(tmp_path / "truth.tum"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    expected = np.linalg.norm((slipped.poses - truth.poses)[:, :3, 3], axis=1)
    assert told["translation"]["mean"] == pytest.approx(expected.mean(), abs=1e-6)
    arguments = ["evaluate-trajectory", str(tmp_path / "slipped.tum"), str(tmp_path / "arc.relations"), "--json"]
    assert main(arguments) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["relations"] == 49
    assert told["translation"]["mean"] == pytest.approx(0.5 / 49, abs=1e-6)
    assert main(["evaluate-trajectory", str(tmp_path / "none.tum"), str(tmp_path / "truth.tum")]) == 2


def test_relations_of_a_loop_tell_whether_it_was_closed():
    def rounds(drift):
        """Drive twice around a circle, a pose each second; what is estimated drifts sideways in the second round."""
        poses = [
            planar(5.0 * np.cos(angle) + drift * (n >= 120), 5.0 * np.sin(angle), angle + np.pi / 2)
            for n, angle in enumerate(np.arange(240) * np.pi / 60.0)
        ]
        return Trajectory(np.array(poses), np.arange(240, dtype=np.int64) * 1_000_000_000)

    relations = relations_of(rounds(0.0))
    revisits = [relation for relation in relations if relation.second - relation.first > 60e9]
    assert len(relations) == 239 + len(revisits)
    after = [(relation.second - relation.first) // 1_000_000_000 for relation in revisits]
    assert after == [120] * 120 + [119, 118, 117]  # the last three poses but one are within a metre of the last
    errors = relation_errors(rounds(0.3), relations).translation
    assert (errors > 1e-9).sum() == 1 + 120  # the step into the second round, and every revisit
    assert errors[239 : 239 + 120] == pytest.approx(0.3)


@pytest.mark.skipif(not INTEL.is_dir(), reason="the Intel log is not here")
def test_a_public_corrected_log_is_read_and_its_relations_hold_for_itself():
    known = log_trajectory(INTEL / "intel-corrected.log.gz")
    assert len(known.poses) == 910
    errors = relation_errors(known, relations_of(known))
    assert errors.translation.max() < 1e-9
    steps = [inverse(a) @ b for a, b in zip(known.poses, known.poses[1:], strict=False)]
    assert np.median([np.hypot(*step[:2, 3]) for step in steps]) < 1.0
