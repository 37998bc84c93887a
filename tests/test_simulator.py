"""The simulator as an operator: what it says at each tick, what it makes of drives and poses, how it ends."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from graph import End, Summary
from graph.check import require
from graph.codec import decode, encode
from graph.contract import ports_of
from graph.errors import UserError
from graph.loading import build_config
from graph.messages import Drive, Goal, Odometry, Plan, PointCloud, Pose, Tick, Truth
from graph.node import build_operator
from graph.wiring import wire
from operators.simulator import Simulator
from sim.physics import ACCELERATION

STEP = 100_000_000  # nanoseconds

ROOM = """
name: room
start: [1.5, 3.0, 0.0]
walls:
  - [[0, 0], [9, 0], [9, 6], [0, 6], [0, 0]]
rooms:
  - {name: room, polygon: [[0, 0], [9, 0], [9, 6], [0, 6]], populated: true}
tours:
  A: {targets: [[3.5, 3.0], [5.5, 3.0]]}
"""
EMPTY = "tables: [0.0, 0.0]\nwanderers: 0.0\n"


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, str]:
    (tmp_path / "room.yaml").write_text(ROOM)
    (tmp_path / "empty.yaml").write_text(EMPTY)
    return tmp_path / "room.yaml", str(tmp_path / "empty.yaml")


def make(files: tuple[Path, str], **config: object) -> Simulator:
    return Simulator(Simulator.Config(building=files[0], scenario=files[1], **config))  # type: ignore[arg-type]


def tick(simulator: Simulator, index: int) -> tuple[Simulator.Outputs, str]:
    """Tick once; return what it said, and why it ended, if it did."""
    said, ending = None, ""
    for answer in simulator.on_tick(Tick(measured_at=index * STEP, index=index)):
        if isinstance(answer, End):
            ending = answer.reason
        else:
            said = answer
    assert said is not None
    return said, ending


def test_ports_and_their_order() -> None:
    ports = ports_of(Simulator)
    assert list(ports.inputs) == ["tick", "drive", "pose", "plan"]
    told = {"frame": PointCloud, "odometry": Odometry, "goal": Goal, "truth": Truth, "near": PointCloud}
    assert ports.outputs == told


def test_an_unreachable_target_is_skipped_once(files: tuple[Path, str]) -> None:
    simulator = make(files)

    def plan(index: int, status: str) -> Plan:
        nothing = np.empty((0, 2)), np.empty((0, 3))
        return Plan(measured_at=index * STEP, path=nothing[0], trajectory=nothing[1], status=status)

    first, _ = tick(simulator, 0)
    simulator.on_plan(plan(0, "follow"))
    same, _ = tick(simulator, 1)
    simulator.on_plan(plan(1, "unreachable"))
    second, _ = tick(simulator, 2)
    simulator.on_plan(plan(1, "unreachable"))  # of the target before
    still, ending = tick(simulator, 3)
    assert [said.goal.index for said in (first, same, second, still)] == [0, 0, 1, 1]
    assert ending == ""
    simulator.on_plan(plan(3, "unreachable"))
    _, ending = tick(simulator, 4)
    assert ending == "tour finished"
    summary = simulator.on_end()
    assert (summary["reached"], summary["skipped"]) == (0, 2)


def test_everything_it_says_passes_the_codec(files: tuple[Path, str]) -> None:
    simulator = make(files, rolling=True)
    for index in range(3):
        said, _ = tick(simulator, index)
        for message in (said.frame, said.odometry, said.goal, said.truth):
            assert message is not None
            again = decode(encode(message), type(message))
            assert again.measured_at == index * STEP
    crowded = Simulator(Simulator.Config(scenario="hard", lidar="hdl32e", dropout=0.2))
    said, _ = tick(crowded, 0)
    assert said.frame is not None
    assert said.truth is not None
    frame = decode(encode(said.frame), PointCloud)
    assert len(frame.points) > 30_000
    assert frame.ring.max() == 31
    assert len(decode(encode(said.truth), Truth).people) > 80


def test_the_first_tick_shows_the_start(files: tuple[Path, str]) -> None:
    said, _ = tick(make(files), 0)
    assert said.odometry is not None
    assert said.goal is not None
    np.testing.assert_allclose(said.odometry.odom_from_base[:2, 3], [1.5, 3.0], atol=2e-3)
    np.testing.assert_allclose(said.odometry.odom_from_base, said.odometry.true_world_from_base, atol=1e-3)
    assert (said.goal.index, said.goal.count) == (0, 2)
    np.testing.assert_array_equal(said.goal.target, [3.5, 3.0])


def test_it_drives_until_the_tour_is_finished(files: tuple[Path, str]) -> None:
    simulator = make(files)
    simulator.on_drive(Drive(measured_at=0, linear=1.0, angular=0.0))
    goals, ending, index = [], "", 0
    while not ending:
        said, ending = tick(simulator, index)
        assert said.goal is not None
        goals.append(said.goal.index)
        index += 1
        assert index < 100
    assert ending == "tour finished"
    assert sorted(set(goals)) == [0, 1]
    summary = simulator.on_end()
    assert isinstance(summary, Summary)
    assert (summary["targets"], summary["reached"], summary["collisions"]) == (2, 2, 0)
    assert summary["driven_m"] == pytest.approx(5.5 - 0.9 - 1.5, abs=0.2)
    leaves = [*summary.values()]
    leaves += [value for entry in leaves if isinstance(entry, dict) for value in entry.values()]
    assert all(isinstance(value, (int, float, dict)) for value in leaves)
    msgspec.json.encode(summary)


@pytest.mark.parametrize("share", [0, 50, 75, 100])
def test_a_command_moves_nothing_before_it_came(files: tuple[Path, str], share: int) -> None:
    simulator = make(files)

    def x(index: int) -> float:
        said, _ = tick(simulator, index)
        assert said.truth is not None
        return float(said.truth.world_from_base[0, 3])

    before = [x(0), x(1)]
    simulator.stamp = STEP + share * STEP // 100  # when it arrives: a share of the period after the last tick
    simulator.on_drive(Drive(measured_at=0, linear=1.0, angular=0.0))
    after = x(2) - before[1]
    driven = (1.0 - share / 100) * STEP * 1e-9  # seconds
    assert after == pytest.approx(0.5 * ACCELERATION * driven**2, abs=2e-3 * (driven > 0) + 1e-4)
    assert x(3) - before[1] > after + 0.003


def test_a_pose_is_judged_against_its_own_moment(files: tuple[Path, str]) -> None:
    simulator = make(files)
    simulator.on_drive(Drive(measured_at=0, linear=1.0, angular=0.0))
    truths = []
    for index in range(15):
        said, _ = tick(simulator, index)
        assert said.truth is not None
        truths.append(said.truth.world_from_base)
        late = max(0, index - 5)  # a slow localizer: half a second
        believed = truths[late].copy()
        believed[1, 3] += 0.04
        simulator.on_pose(Pose(measured_at=late * STEP, world_from_base=believed))
    simulator.on_pose(Pose(measured_at=77, world_from_base=np.eye(4)))  # of no tick: cannot be judged
    errors = simulator.on_end()["localization_error_m"]
    assert errors["median"] == pytest.approx(0.04)
    assert errors["max"] == pytest.approx(0.04)


def test_a_lost_robot_ends_the_tour(files: tuple[Path, str]) -> None:
    simulator = make(files)
    said, _ = tick(simulator, 0)
    assert said.truth is not None
    believed = said.truth.world_from_base.copy()
    believed[0, 3] += 2.5
    simulator.on_pose(Pose(measured_at=0, world_from_base=believed))
    assert tick(simulator, 1)[1] == "lost"


def test_a_robot_without_a_driver_is_stuck(files: tuple[Path, str]) -> None:
    simulator = make(files)
    endings = [tick(simulator, index)[1] for index in range(152)]
    assert "stuck" in endings
    assert set(endings[:149]) == {""}


def test_it_asks_for_the_rate_of_its_lidar(files: tuple[Path, str]) -> None:
    simulator = make(files)
    tick(simulator, 0)
    with pytest.raises(ValueError, match="the lidar wants timer/10hz"):
        list(simulator.on_tick(Tick(measured_at=STEP // 2, index=1)))
    skipped = make(files)
    tick(skipped, 0)
    tick(skipped, 3)  # in realtime a tick may be missed
    assert skipped.world.time == pytest.approx(0.3)


def test_lidar_and_odometry_are_settings(files: tuple[Path, str]) -> None:
    config = build_config(
        Simulator,
        {"building": str(files[0]), "scenario": files[1], "lidar": {"beams": 16, "columns": 180, "rolling": True}}
        | {"odometry": {"wheel_scale": 0.0, "gyro_bias": 0.3}},
        files[0].parent,
    )
    simulator = Simulator(config)
    said, _ = tick(simulator, 0)
    assert said.frame is not None
    assert said.frame.ring is not None
    assert said.frame.ring.max() == 15
    assert len(said.frame.points) <= 16 * 180
    assert said.frame.time_offset is not None
    assert simulator.world.odometer.scale == 1.0


def test_a_second_lidar_sees_who_is_near_and_changes_nothing_else(files: tuple[Path, str]) -> None:
    one, two = make((files[0], "extreme"), seed=9), make((files[0], "extreme"), seed=9, near="blindspot")
    for index in range(3):
        for simulator in (one, two):
            simulator.on_drive(Drive(measured_at=0, linear=0.7, angular=0.4))
        first, second = tick(one, index)[0], tick(two, index)[0]
        assert first.near is None
        assert second.near is not None
        assert second.near.measured_at == second.frame.measured_at
        away = np.linalg.norm(second.near.points, axis=1)
        assert 0.1 <= away.min() < 0.9
        assert away.max() <= 2.0
        for port in ("frame", "odometry", "goal", "truth"):
            assert encode(getattr(first, port)) == encode(getattr(second, port))


def test_two_simulators_of_one_config_agree_to_the_bit(files: tuple[Path, str]) -> None:
    one, two = (make((files[0], "extreme"), seed=9) for _ in range(2))
    assert len(one.world.crowd.position) == 12
    for index in range(4):
        for simulator in (one, two):
            simulator.on_drive(Drive(measured_at=0, linear=0.7, angular=0.4))
        first, second = tick(one, index)[0], tick(two, index)[0]
        for port in ("frame", "odometry", "goal", "truth"):
            assert encode(getattr(first, port)) == encode(getattr(second, port))


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        ({"building": Path("castle")}, "no file castle; shipped are .*default"),
        ({"scenario": "panic"}, "no file panic; shipped are easy, extreme, hard, mapping, medium"),
        ({"tour": "Z"}, "building default has no tour 'Z'; it has A, B, C, mapping"),
        ({"lidar": "sonar"}, "there is no lidar 'sonar'; there are paper, hdl32e, blindspot"),
        ({"near": "sonar"}, "there is no lidar 'sonar'; there are paper, hdl32e, blindspot"),
    ],
)
def test_bad_settings_are_named(config: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Simulator(Simulator.Config(**config))  # type: ignore[arg-type]


def test_a_scenario_that_is_not_there_is_one_sentence_in_a_graph() -> None:
    spec = next(spec for spec in wire(require("graph.yaml", ("simulator.scenario=hrad",))) if spec.name == "simulator")
    with pytest.raises(UserError, match=r"^simulator: .*hrad"):
        build_operator(spec)
