"""Whole sessions: the robot's body, contacts, odometry, the same geometry in two engines, and the bits."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pybullet
import pytest

from graph.geometry import wrap, yaw
from sim import World
from sim.building import Block, Tour
from sim.odometry import OdometryNoise
from sim.physics import ACCELERATION, FASTEST, TOP_SPEED, TOP_TURN
from sim.scenario import Scenario
from sim.solids import Truth
from tests.small_rooms import NOBODY, box_room, two_rooms

Array = npt.NDArray[np.float64]

QUIET = OdometryNoise(0.0, 0.0, 0.0, 0.0, 0.0)
SCENARIOS = ("easy", "medium", "hard", "extreme", "mapping")


def bits(world: World, steps: int) -> str:
    """Drive a while and digest all that a session says."""
    digest = hashlib.sha256()
    for n in range(steps):
        frame, state = world.step(0.6, 0.5 * math.sin(n / 7)), world.state()
        for array in (*frame, *state):
            if array is not None:
                digest.update(np.asarray(array).tobytes())
    return digest.hexdigest()


def test_the_robot_drives_as_it_is_told() -> None:
    world = World(box_room(12.0, 12.0), NOBODY, "A", 0)
    start = world.motion.world_from_base
    np.testing.assert_allclose(start[:2, 3], [6.0, 6.0], atol=1e-3)
    world.advance(1.0, 0.0)
    assert world.motion.linear == pytest.approx(0.1 * ACCELERATION, rel=0.2)
    for _ in range(24):
        world.advance(1.0, 0.0)
    assert world.motion.linear == pytest.approx(1.0, abs=0.01)
    moved = world.motion.world_from_base[:2, 3] - start[:2, 3]
    assert moved[0] == pytest.approx(2.5 - 0.5 / ACCELERATION, abs=0.05)
    assert abs(moved[1]) < 0.01
    for _ in range(30):
        world.advance(0.0, 0.6)
    assert world.motion.angular == pytest.approx(0.6, abs=0.01)
    assert abs(world.motion.linear) < 0.01
    assert world.motion.world_from_base[2, 2] > 0.99999  # upright
    assert abs(world.motion.world_from_base[2, 3]) < 1e-3


def test_a_step_takes_a_command_too() -> None:
    class Command(NamedTuple):
        linear: float
        angular: float

    worlds = [World(box_room(), NOBODY, "A", 0) for _ in range(2)]
    frames = [worlds[0].step(0.7, -0.2), worlds[1].step(Command(0.7, -0.2))]
    np.testing.assert_array_equal(frames[0].points, frames[1].points)


@pytest.mark.parametrize("rate", [7.0, 15.0, 20.0])
def test_a_second_is_a_second_at_any_rate(rate: float) -> None:
    world = World(box_room(30.0, 12.0), Scenario(tables=(0.0, 0.0), wanderers=0.02), "A", 0, odometry=QUIET)
    for _ in range(round(3 * rate)):
        world.advance(1.0, 0.0, 1.0 / rate)
    assert world.time == pytest.approx(3.0)
    moved = world.motion.world_from_base[0, 3] - 15.0
    assert moved == pytest.approx(3.0 - 0.5 / ACCELERATION, abs=0.03)
    walked = world.crowd.walked - World(world.building, world.scenario, "A", 0).crowd.walked
    assert 1.5 < walked.max() < 3.0


def test_no_command_exceeds_what_the_robot_can() -> None:
    world = World(box_room(30.0, 12.0), NOBODY, "A", 0)
    for _ in range(30):
        world.advance(9.0, 9.0)
    assert world.motion.linear == pytest.approx(TOP_SPEED, abs=0.03)
    assert world.motion.angular == pytest.approx(TOP_TURN, abs=0.03)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_brakes_slow_the_robot_as_hard_as_they_are_and_change_nothing_else(sign: float) -> None:
    way = {}
    for braking in (1.0, 2.5):
        world = World(box_room(30.0, 12.0), NOBODY, "A", 0, braking=braking)
        for _ in range(15):
            world.advance(sign, 0.3)
        reached = world.motion.world_from_base.copy()
        assert sign * world.motion.linear == pytest.approx(1.0, abs=0.02)
        for _ in range(15):
            world.advance(0.0, 0.0)
        way[braking] = reached, float(np.hypot(*(world.motion.world_from_base - reached)[:2, 3]))
    assert np.array_equal(way[1.0][0], way[2.5][0])
    assert way[1.0][1] == pytest.approx(0.5 / 1.0, abs=0.04)
    assert way[2.5][1] == pytest.approx(0.5 / 2.5, abs=0.04)


def test_walls_stop_the_robot_and_count_once() -> None:
    world = World(box_room(6.0, 6.0), NOBODY, "A", 0)
    for _ in range(60):
        world.advance(1.0, 0.0)
    assert world.motion.world_from_base[0, 3] == pytest.approx(6.0 - 0.21, abs=0.02)
    assert world.collisions == {"people": 0, "things": 1}
    touched = world.state().contacts.tolist()
    assert len(touched) == 1
    assert world.truth[touched[0]] == Truth.WALL
    for _ in range(30):
        world.advance(-0.5, 0.0)
    assert len(world.state().contacts) == 0
    for _ in range(40):
        world.advance(1.0, 0.0)
    assert world.collisions["things"] == 2  # a new encounter


def test_a_low_table_top_stops_the_mast() -> None:
    board = Block((6.3, 3.5, 0.43), (6.9, 4.5, 0.46))  # the chassis fits below
    world = World(box_room(10.0, 8.0, blocks=[board]), NOBODY, "A", 0)
    for _ in range(40):
        world.advance(0.8, 0.0)
    assert world.motion.world_from_base[0, 3] == pytest.approx(6.3 - 0.03, abs=0.02)
    assert world.collisions["things"] == 1


def test_people_stop_the_robot_and_count() -> None:
    crowd = Scenario(tables=(0.0, 0.0), wanderers=0.0, followers=0.04, attentive=0.0)
    building = box_room(8.0, 8.0, start=(2.0, 4.0, 0.0), tours={"A": Tour([(7.0, 4.0)])})
    world = World(building, crowd, "A", 1)
    assert len(world.crowd.position) == 3
    for _ in range(150):
        before = world.motion.world_from_base[:2, 3]
        world.advance(0.6, 0.0)
        assert np.hypot(*(world.motion.world_from_base[:2, 3] - before)) < 0.1 * FASTEST + 0.01  # and nobody throws it
    assert world.collisions["people"] >= 1
    assert world.collisions["people"] < 60
    base = world.motion.world_from_base
    assert base[2, 2] > 0.99
    assert 0.0 < base[0, 3] < 8.0


def test_nothing_tips_the_robot_over_or_lifts_it() -> None:
    world = World(box_room(8.0, 8.0), NOBODY, "A", 0)
    robot, client = world.physics.robot, world.physics.client
    for roll, pitch, rise in ((8.0, 0.0, 0.0), (0.0, 8.0, 0.0), (0.0, 0.0, 3.0)):  # as bodies that overlap are parted
        velocity, _ = pybullet.getBaseVelocity(robot, physicsClientId=client)
        pybullet.resetBaseVelocity(robot, [*velocity[:2], rise], [roll, pitch, 0.0], physicsClientId=client)
        for _ in range(10):
            world.advance(0.5, 0.0)
            base = world.motion.world_from_base
            assert base[2, 2] > np.cos(np.radians(5.0))
            assert base[2, 3] < 0.03
    assert world.motion.linear == pytest.approx(0.5, abs=0.05)


def test_odometry_begins_at_the_truth_and_is_the_truth_without_noise() -> None:
    noisy, exact = (World(box_room(12.0, 12.0), NOBODY, "A", 3, odometry=noise) for noise in (None, QUIET))
    for world in (noisy, exact):
        state = world.state()
        np.testing.assert_allclose(state.odom_from_base, state.world_from_base, atol=1e-4)
        for _ in range(150):
            world.advance(0.8, 0.5)
    error = {}
    for name, world in (("noisy", noisy), ("exact", exact)):
        state = world.state()
        error[name] = float(np.linalg.norm(state.odom_from_base[:2, 3] - state.world_from_base[:2, 3]))
    assert error["exact"] < 0.03  # wheels slip a little even in physics
    assert 0.002 < error["noisy"] < 0.8
    assert abs(wrap(yaw(exact.state().odom_from_base) - yaw(exact.state().world_from_base))) < 1e-3
    assert exact.state().linear == pytest.approx(0.8, abs=0.02)
    assert exact.state().angular == pytest.approx(0.5, abs=0.02)


def test_both_engines_see_the_same_bodies() -> None:
    world = World("default", "extreme", "A", 3)
    for _ in range(3):
        world.advance(0.5, 0.4)
    pose, share = world.sensor(world.lidar)
    hits = world.lidar.shoot(pose, share, world.people())
    world.physics.place_people(world.capsules, world.radii, np.inf)
    directions = (world.lidar.directions @ pose[:3, :3].T).astype(np.float32).astype(np.float64)
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    part, met = world.physics.rays(origins, origins + 30.0 * directions)
    body = np.where(hits.distance <= 30.0, hits.body, -1)
    assert (body == met).mean() >= 0.999
    both = (body == met) & (met >= 0)
    assert np.median(np.abs(30.0 * part - hits.distance)[both]) < 1e-4
    people = both & (met >= len(world.bodies))
    assert people.sum() > 30
    assert np.percentile(np.abs(30.0 * part - hits.distance)[people], 90) < 0.01  # a rim may be another limb's


def test_people_by_density_and_truth_by_kind() -> None:
    world = World("default", "hard", "A", 5)
    area = world.building.populated_area()
    assert world.wanted_people == round(0.10 * area) + round(0.03 * area)
    assert len(world.crowd.position) == world.wanted_people
    assert int(world.crowd.following.sum()) == round(0.03 * area)
    state = world.state()
    assert (world.truth[state.people_instance[: world.wanted_people]] == Truth.MOVING_PERSON).all()
    assert (world.truth[state.people_instance[world.wanted_people :]] == Truth.STILL_PERSON).all()
    assert not state.people_moving[world.wanted_people :].any()
    chairs = sum(body.truth == Truth.CHAIR for body in world.bodies)
    assert 0.25 * chairs < len(world.seats) < 0.75 * chairs
    seated = {tuple(np.round(seat[:2], 6)) for seat in world.seats}
    assert len(seated) == len(world.seats)


def test_rooms_hold_their_people() -> None:
    world = World(two_rooms(90.0), Scenario(tables=(0.0, 0.0), wanderers=0.2), "A", 1)
    rooms = world.rooms_of(world.crowd.position)
    assert sorted(np.unique(rooms).tolist()) == [0, 1]
    assert abs(int((rooms == 0).sum()) - int((rooms == 1).sum())) <= 1


PROGRAM = """
from tests.test_sim_world import bits, crowded_session
print(bits(crowded_session(), 8))
"""


def crowded_session() -> World:
    return World("default", "hard", "B", 11, rolling=True, dropout=0.3)


def test_a_session_is_fixed_to_the_bit_in_any_process() -> None:
    root = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": str(root)}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, cwd=root, env=environment
    )
    assert ran.stdout.strip() == bits(crowded_session(), 8)


def test_another_seed_is_another_session() -> None:
    one, two, again = (World(two_rooms(90.0), Scenario(wanderers=0.1), "A", seed) for seed in (1, 2, 1))
    first = bits(one, 3)
    assert first != bits(two, 3)
    assert first == bits(again, 3)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_sixty_seconds_of_a_scenario(scenario: str) -> None:
    """Equal to the bit when run twice; nobody through walls, hardly anybody in furniture; a human pace."""
    digests = []
    for run in range(2):
        world = World("default", scenario, "B", 21)
        walls = World("default", scenario, "B", 21).layout  # the bodies that stand still
        digest = hashlib.sha256()
        inside, seconds, speeds = 0.0, 0.0, []
        way, along = world.layout.way, 0
        for _ in range(600):
            here = world.motion.world_from_base
            while along < len(way) - 1 and np.hypot(*(way[along] - here[:2, 3])) < 0.6:
                along += 1
            bearing = math.atan2(way[along][1] - here[1, 3], way[along][0] - here[0, 3]) - yaw(here)
            turn = float(wrap(bearing))
            before = world.crowd.position.copy()
            frame = world.step(max(0.0, 0.8 * math.cos(turn)), min(max(2.0 * turn, -1.0), 1.0))
            for array in (frame.points, frame.truth, frame.instance, world.state().odom_from_base, world.capsules):
                digest.update(array.tobytes())
            if run == 0:
                steps = world.crowd.position - before
                assert np.hypot(*steps.T).max() < 0.1 + 1e-9
                for share in (0.25, 0.5, 0.75, 1.0):
                    assert (walls.free.at(before + share * steps) > 0.0).all()
                inside += 0.1 * float((world.free.at(world.crowd.position) <= 0.0).sum())
                seconds += 0.1 * len(before)
                speeds.append(np.hypot(*world.crowd.velocity.T)[world.crowd.moving()])
        digests.append(digest.hexdigest())
        if run == 0:
            assert inside <= 0.01 * seconds
            assert 0.6 < np.concatenate(speeds).mean() < 1.0
            area = world.building.populated_area()
            scene = world.scenario
            assert len(world.crowd.position) == round(scene.wanderers * area) + round(scene.followers * area)
            assert world.still_there() > 0.85
    assert digests[0] == digests[1]
