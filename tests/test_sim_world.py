"""Sessions: equal to the bit, labelled by what was hit, driven by physics, judged as the paper judges."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pybullet")
pytest.importorskip("embreex")

from graph.geometry import planar, transform, yaw
from sim import BuildingError, World, load
from sim.lidar import LidarSpec
from sim.referee import Referee
from sim.solids import Truth

SMALL = LidarSpec(beams=16, columns=128)
DEFAULT = "default"


def world(scenario: str = "easy", tour: str = "A", seed: int = 1, **options: object) -> World:
    return World(DEFAULT, scenario, tour, seed, lidar=options.pop("lidar", SMALL), **options)  # type: ignore[arg-type]


def test_two_sessions_of_one_seed_are_equal_to_the_bit_and_those_of_two_are_not() -> None:
    frames = []
    for seed in (5, 5, 6):
        session = world("hard", seed=seed)
        for index in range(12):
            frame = session.step(0.6, 0.4 * math.sin(index))
        frames.append((frame, session.state()))
    for first, second in zip(frames[0][0], frames[1][0], strict=True):
        assert first is second is None or first.tobytes() == second.tobytes()
    for first, second in zip(frames[0][1], frames[1][1], strict=True):
        assert np.asarray(first).tobytes() == np.asarray(second).tobytes()
    assert frames[0][0].points.tobytes() != frames[2][0].points.tobytes()


def test_labels_agree_with_the_body_that_was_hit() -> None:
    session = world("extreme", lidar=LidarSpec(noise=0.0))
    frame = session.scan()
    state = session.state()
    points = transform(state.world_from_base @ session.base_from_lidar(), frame.points.astype(np.float64))
    assert (frame.truth[points[:, 2] < 0.049] == Truth.GROUND).all()
    assert (points[frame.truth == Truth.GROUND, 2] < 0.051).all()
    still = (frame.instance < len(session.bodies)) & (frame.truth != Truth.GROUND)
    truths = np.array([body.truth for body in session.bodies])
    np.testing.assert_array_equal(frame.truth[still], truths[frame.instance[still]])
    persons = frame.instance >= len(session.bodies)
    assert persons.any()
    where = state.people[frame.instance[persons] - len(session.bodies), :2]
    assert np.linalg.norm(points[persons, :2] - where, axis=1).max() < 1.0
    assert set(np.unique(frame.truth[persons])) <= {Truth.GROUND, Truth.MOVING_PERSON, Truth.STILL_PERSON}


def test_the_robot_obeys_within_its_limits_and_the_odometry_follows() -> None:
    session = world("mapping")
    session.advance(5.0, 0.0)
    assert session.motion.linear == pytest.approx(0.1, abs=0.02)  # 1 m/s^2 for 0.1 s
    for _ in range(15):
        session.advance(0.5, 0.5)
    assert session.motion.linear == pytest.approx(0.5, abs=0.03)
    assert session.motion.angular == pytest.approx(0.5, abs=0.03)
    state = session.state()
    assert np.linalg.norm(state.odom_from_base[:2, 3] - state.world_from_base[:2, 3]) < 0.1
    assert abs(yaw(state.odom_from_base) - yaw(state.world_from_base)) < 0.05
    assert abs(state.world_from_base[2, 3]) < 0.005


def test_a_wall_stops_the_robot_and_counts_once() -> None:
    session = world("mapping")
    for _ in range(120):
        session.advance(1.0, 0.15)
    assert session.motion.linear < 0.2
    assert session.collisions["things"] == 1
    place = session.motion.world_from_base[:2, 3]
    assert session.layout.free.at(place[None])[0] > 0.1


def test_people_walk_at_a_human_pace_and_not_through_walls() -> None:
    session = world("hard", seed=3)
    session.physics.command = (0.0, 0.0)
    speeds, inside = [], 0
    robot = (20.5, 16.0, 0.0)
    for _ in range(300):
        before = session.crowd.position.copy()
        session.crowd.advance(0.1, session.layout.free, robot)
        speeds.append(np.linalg.norm(session.crowd.position - before, axis=1)[session.crowd.moving()] / 0.1)
        inside += int((session.layout.free.at(session.crowd.position) <= 0).sum())
    assert inside == 0
    assert 0.6 < np.concatenate(speeds).mean() < 1.0
    assert len(session.crowd.position) == session.wanted_people


def test_rolling_scans_carry_time_offsets_over_one_period() -> None:
    session = world(rolling=True)
    frame = session.step(0.5, 0.5)
    assert frame.time_offset is not None
    assert 0.0 <= frame.time_offset.min() < frame.time_offset.max() < 0.1


@pytest.mark.parametrize("tour", ["A", "B", "C", "mapping"])
def test_tours_are_of_the_paper_s_scale(tour: str) -> None:
    building = load(DEFAULT)
    wanted = {"A": (7, 61), "B": (11, 96), "C": (19, 129), "mapping": (44, 332)}[tour]
    session = world(tour=tour) if tour == "A" else None
    assert len(building.tours[tour].targets) == wanted[0]
    if session is not None:
        length = np.linalg.norm(np.diff(session.layout.way, axis=0), axis=1).sum()
        assert length == pytest.approx(wanted[1], rel=0.1)


def test_bad_names_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(BuildingError, match=r"no file nowhere; shipped are .*default"):
        World("nowhere", "easy", "A", 1)
    with pytest.raises(BuildingError, match=r"no file busy; shipped are easy, extreme, hard"):
        World(DEFAULT, "busy", "A", 1)
    with pytest.raises(BuildingError, match=r"has no tour 'Z'; it has A, B, C, mapping"):
        World(DEFAULT, "easy", "Z", 1)
    with pytest.raises(BuildingError, match=r"no lidar 'vlp'; there are paper, hdl32e"):
        World(DEFAULT, "easy", "A", 1, lidar="vlp")
    bad = tmp_path / "bad.yaml"
    bad.write_text("walls: 3")
    with pytest.raises(BuildingError, match=r"bad\.yaml: walls: Expected `array`, got `int`"):
        World(bad, "easy", "A", 1)


def test_the_referee_counts_targets_and_knows_when_a_robot_is_stuck_lost_or_late() -> None:
    targets, way = np.array([[1.0, 0.0], [2.0, 0.0]]), np.array([[0.0, 0.0], [2.0, 0.0]])
    referee = Referee(targets, way, patience=100.0)
    assert referee.watch(0.0, planar(0.0, 0.0, 0.0)) == ""
    referee.judge(0.1, planar(0.9, 0.0, 0.0), planar(2.8, 0.0, 0.0))  # believes to be there, and is not
    assert referee.watch(0.1, planar(2.8, 0.0, 0.0)) == ""
    assert referee.reached == 0
    referee.judge(0.2, planar(0.9, 0.0, 0.0), planar(0.95, 0.0, 0.0))
    assert referee.watch(0.2, planar(0.95, 0.0, 0.0)) == ""
    assert referee.reached == 1
    referee.judge(0.3, planar(1.95, 0.0, 0.0), planar(1.95, 0.0, 0.0))
    assert referee.watch(0.3, planar(1.95, 0.0, 0.0)) == "tour finished"
    lost = Referee(targets, way, patience=100.0)
    lost.judge(0.1, planar(5.0, 0.0, 0.0), planar(0.0, 0.0, 0.0))
    assert lost.watch(0.1, planar(0.0, 0.0, 0.0)) == "lost"
    stuck = Referee(targets, way, patience=100.0)
    verdicts = [stuck.watch(0.1 * index, planar(0.0, 0.0, 0.0)) for index in range(160)]
    assert verdicts[-1] == "stuck"
    assert verdicts[100] == ""
    late = Referee(targets, way, patience=1.0)
    assert late.watch(3.0, planar(0.0, 0.0, 0.0)) == "time is up"
