"""The simulator: the world that the robot drives in, and the judge of how well it does.

simulator:
  run: operators.simulator:Simulator
  inputs: {tick: timer/10hz, drive: {from: planner/drive, delay: 100ms}, pose: {from: localizer/pose, delay: 100ms}}
  config: {building: sim/buildings/default.yaml, scenario: easy, tour: A, seed: 1}
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from graph.contract import End, Operator, Summary
from graph.geometry import Matrix
from graph.messages import Drive, Goal, Odometry, PointCloud, Pose, Tick, Truth
from sim.referee import Referee
from sim.world import World

SECOND = 1_000_000_000  # nanoseconds


class Simulator(Operator):
    """Move the world on at each tick and say what the robot senses; end with the tour, or with the robot's luck."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """What fixes a session to the bit."""

        building: Path = Path("sim/buildings/default.yaml")
        scenario: str = "easy"  # name or file
        tour: str = "A"
        seed: int = 0
        lidar: str = "paper"  # a preset
        rolling: bool = False  # columns one after the other over the scan period
        patience: float = 5.0  # the tour ends after so many times its free driving time

    class Outputs(msgspec.Struct):
        """One lidar period."""

        frame: PointCloud | None = None
        odometry: Odometry | None = None
        goal: Goal | None = None
        truth: Truth | None = None

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c: Simulator.Config = self.config
        self.world = World(c.building, c.scenario, c.tour, c.seed, lidar=c.lidar, rolling=c.rolling or None)
        self.referee = Referee(self.world.targets, self.world.layout.way, patience=c.patience)
        self.command = (0.0, 0.0)
        self.now: int | None = None  # stamp of the last tick
        self.poses: dict[int, Matrix] = {}  # true world_from_base by stamp, for poses still to come

    def on_drive(self, drive: Drive) -> None:
        """Obey from the next tick on."""
        self.command = (drive.linear, drive.angular)

    def on_pose(self, pose: Pose) -> None:
        """Judge what the robot believes."""
        true = self.poses.get(pose.measured_at)
        if true is not None:
            self.referee.judge(pose.measured_at / SECOND, pose.world_from_base, true)

    def on_tick(self, tick: Tick) -> Iterator[Outputs | End]:
        """Advance by one period, scan, and decide whether the tour goes on."""
        world = self.world
        if self.now is not None:
            world.advance(*self.command, (tick.measured_at - self.now) / SECOND)
        self.now = tick.measured_at
        state = world.state()
        self.poses = {stamp: pose for stamp, pose in self.poses.items() if stamp > self.now - 5 * SECOND}
        self.poses[self.now] = state.world_from_base
        verdict = self.referee.watch(self.now / SECOND, state.world_from_base)
        yield self.Outputs(self.frame(), self.odometry(), self.goal(), self.truth())
        if verdict:
            yield End(verdict)

    def frame(self) -> PointCloud:
        """Scan."""
        scan = self.world.scan()
        return PointCloud(
            measured_at=self.now or 0,
            points=scan.points,
            base_from_lidar=self.world.base_from_lidar(),
            ring=scan.ring,
            time_offset=scan.time_offset,
            truth=scan.truth,
            moving=scan.moving,
            instance=scan.instance,
        )

    def odometry(self) -> Odometry:
        """Read wheels and gyro."""
        state = self.world.state()
        return Odometry(
            measured_at=self.now or 0,
            odom_from_base=state.odom_from_base,
            linear=state.linear,
            angular=state.angular,
            true_world_from_base=state.world_from_base,
        )

    def goal(self) -> Goal:
        """Name the target to reach next."""
        index = min(self.referee.index, len(self.world.targets) - 1)
        return Goal(
            measured_at=self.now or 0, target=self.world.targets[index], index=index, count=len(self.world.targets)
        )

    def truth(self) -> Truth:
        """Say what is true."""
        state = self.world.state()
        return Truth(
            measured_at=self.now or 0,
            world_from_base=state.world_from_base,
            people=np.asarray(state.people, np.float64),
            people_moving=state.people_moving,
            people_instance=state.people_instance,
            contacts=state.contacts,
        )

    def on_end(self) -> Summary:
        """Sum the session up."""
        collisions = self.world.collisions
        return Summary(
            **self.referee.summary(),
            collisions=sum(collisions.values()),
            collisions_with_people=collisions["people"],
            collisions_with_things=collisions["things"],
            people=len(self.world.person_truth),
        )
