"""The simulator: the world that the robot drives in, and the judge of how well it does.

simulator:
  run: operators.simulator:Simulator
  inputs: {tick: timer/10hz, drive: {from: planner/drive, delay: 150ms}, pose: {from: localizer/pose, delay: 150ms},
    plan: {from: planner/plan, delay: 150ms}}
  config: {building: sim/buildings/default.yaml, scenario: easy, tour: A, seed: 1}

The robot is put at the start pose of its tour and knows it: odometry begins at world_from_base of the first tick, so
that a localizer without a map builds one in the world's frame. Frames are stamped with the end of their scan. What
arrives with a tick comes after it: the scan of that moment does not depend on it, and need not wait for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from graph.contract import End, Operator, Summary
from graph.geometry import Matrix
from graph.messages import Drive, Goal, Odometry, Plan, PointCloud, Pose, Tick, Truth
from sim.lidar import Lidar, LidarSpec
from sim.odometry import OdometryNoise
from sim.referee import Referee
from sim.rehearsal import rehearse
from sim.world import World

SECOND = 1_000_000_000  # nanoseconds
REMEMBERED = 5 * SECOND  # true poses kept, for estimates still to come


class Simulator(Operator):
    """Move the world on at each tick and say what the robot senses; end with the tour, or with the robot's luck."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """What fixes a session to the bit."""

        building: Path = Path("sim/buildings/default.yaml")
        scenario: str = "easy"  # name or file
        tour: str = "A"
        seed: int = 0
        lidar: str | LidarSpec = "paper"  # a preset (paper, hdl32e, blindspot), or the paper's with other measures
        near: str | LidarSpec | None = None  # a second one for the first's blind ring: blindspot, or other measures
        rolling: bool | None = None  # columns one after the other over the scan period; None: as the lidar says
        dropout: float | None = None  # share of returns lost at grazing incidence and far away, at most
        odometry: OdometryNoise = OdometryNoise()
        braking: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0  # m/s^2 at most, towards rest
        goal_radius: float = 0.9  # metres between the robot's own estimate and a target that it reaches
        patience: float = 5.0  # the tour ends after so many times its free driving time

    class Outputs(msgspec.Struct):
        """One lidar period."""

        frame: PointCloud | None = None
        odometry: Odometry | None = None
        goal: Goal | None = None
        truth: Truth | None = None
        near: PointCloud | None = None  # what the second lidar sees, if there is one

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c: Simulator.Config = self.config
        self.world = World(
            c.building,
            c.scenario,
            c.tour,
            c.seed,
            lidar=c.lidar,
            near=c.near,
            rolling=c.rolling,
            dropout=c.dropout,
            odometry=c.odometry,
            braking=c.braking,
        )
        self.referee = Referee(self.world.targets, self.world.length, patience=c.patience, radius=c.goal_radius)
        self.command = (0.0, 0.0)  # in force at the last tick
        self.orders: list[tuple[float, float, float]] = []  # that came since: seconds after it, m/s, rad/s
        self.asked = (0, 0)  # index of the target asked for, and since which stamp
        self.now: int | None = None  # stamp of the last tick
        self.poses: dict[int, Matrix] = {}  # true world_from_base by stamp, for estimates still to come

    @classmethod
    def warm_up(cls) -> None:
        rehearse()

    def on_tick(self, tick: Tick) -> Iterator[Outputs | End]:
        """Advance to the tick, scan, and say whether the tour goes on. Raises ValueError at a tick of another rate."""
        world, now = self.world, tick.measured_at
        if self.now is not None:
            seconds = (now - self.now) / SECOND
            scans = seconds * world.spec.rate
            if not np.isclose(scans, max(1, round(scans))):
                raise ValueError(
                    f"simulator.tick came after {seconds:g} s; the lidar wants timer/{world.spec.rate:g}hz"
                )
            world.advance(*self.command, seconds, self.orders)
        if self.orders:
            self.command = self.orders[-1][1:]
        self.now, self.orders = now, []
        state = world.state()
        self.poses = {stamp: pose for stamp, pose in self.poses.items() if stamp > now - REMEMBERED}
        self.poses[now] = state.world_from_base
        verdict = self.referee.watch(now / SECOND, state.world_from_base)
        yield self.Outputs(
            frame=self.cloud(world.lidar, now),
            odometry=Odometry(
                measured_at=now,
                odom_from_base=state.odom_from_base,
                linear=state.linear,
                angular=state.angular,
                true_world_from_base=state.world_from_base,
            ),
            goal=self.goal(now),
            truth=Truth(
                measured_at=now,
                world_from_base=state.world_from_base,
                people=state.people,
                people_moving=state.people_moving,
                people_instance=state.people_instance,
                contacts=state.contacts,
            ),
            near=None if world.near is None else self.cloud(world.near, now),
        )
        if verdict:
            yield End(verdict)

    def cloud(self, lidar: Lidar, now: int) -> PointCloud:
        """Scan with one of the robot's lidars."""
        scan = self.world.scan(lidar)
        return PointCloud(
            measured_at=now,
            points=scan.points,
            base_from_lidar=self.world.base_from_lidar(lidar),
            ring=scan.ring,
            time_offset=scan.time_offset,
            truth=scan.truth,
            moving=scan.moving,
            instance=scan.instance,
        )

    def on_drive(self, drive: Drive) -> None:
        """Obey from now on, which is seen at the next tick."""
        since = 0.0 if self.now is None else max(0.0, (self.stamp - self.now) / SECOND)
        self.orders.append((since, drive.linear, drive.angular))

    def on_pose(self, pose: Pose) -> None:
        """Judge what the robot believes against the truth of the same moment."""
        true = self.poses.get(pose.measured_at)
        if true is not None:
            self.referee.judge(pose.world_from_base, true)

    def on_plan(self, plan: Plan | None) -> None:
        """Go on with the next target once the planner, knowing of the present one, calls it unreachable."""
        assert plan is not None
        if plan.status == "unreachable" and plan.measured_at >= self.asked[1]:
            self.referee.skip()

    def goal(self, now: int) -> Goal:
        """Name the target to reach next, after the tour the last one."""
        targets = self.world.targets
        index = min(self.referee.index, len(targets) - 1)
        if index != self.asked[0]:
            self.asked = (index, now)
        return Goal(measured_at=now, target=targets[index], index=index, count=len(targets))

    def on_end(self) -> Summary:
        """Sum the session up, in numbers."""
        collisions = self.world.collisions
        return Summary(
            **self.referee.summary(),
            collisions=sum(collisions.values()),
            collisions_with_people=collisions["people"],
            collisions_with_things=collisions["things"],
            people=len(self.world.person_truth),
            walkers=len(self.world.crowd.position),
            walkers_wanted=self.world.wanted_people,
            people_still_there=self.world.still_there(),
        )
