"""Operators that measure: what they read from the clock goes into their messages and their summaries."""

from __future__ import annotations

import time
from collections.abc import Iterator

import msgspec
import numpy as np

from graph import End, Operator, Summary
from graph.messages import Message, PointCloud, Tick

POINTS = 100_000  # of a cloud: 1.2 MB
WARM_UP = 20  # messages that do not count


def cloud(points: int, seed: int = 0, measured_at: int = 0) -> PointCloud:
    """Draw a cloud; seeded."""
    drawn = np.random.default_rng(seed).random((points, 3), np.float32)
    return PointCloud(measured_at=measured_at, points=drawn, base_from_lidar=np.eye(4))


class CloudMaker(Operator):
    """Send the same cloud at each tick; if `timed`, with the monotonic clock at that moment in `measured_at`."""

    class Config(msgspec.Struct):
        points: int = POINTS
        count: int = 100
        timed: bool = True

    class Outputs(msgspec.Struct):
        cloud: PointCloud | None = None

    def on_start(self) -> None:
        self.sent = 0
        self.points = cloud(self.config.points).points
        self.base_from_lidar = np.eye(4)

    def on_tick(self, tick: Tick) -> Iterator[CloudMaker.Outputs | End]:
        self.sent += 1
        at = time.monotonic_ns() if self.config.timed else tick.measured_at
        yield self.Outputs(PointCloud(measured_at=at, points=self.points, base_from_lidar=self.base_from_lidar))
        if self.sent == self.config.count:
            yield End()


class CloudMeter(Operator):
    """Tell the latency of each cloud, in nanoseconds, warm-up left out."""

    def on_start(self) -> None:
        self.latencies: list[int] = []

    def on_cloud(self, cloud: PointCloud) -> None:
        self.latencies.append(time.monotonic_ns() - cloud.measured_at)

    def on_end(self) -> Summary:
        return Summary(latencies=self.latencies[WARM_UP:])


class CloudPass(Operator):
    """Pass a cloud on."""

    Outputs = CloudMaker.Outputs

    def on_cloud(self, cloud: PointCloud) -> CloudMaker.Outputs:
        return self.Outputs(cloud)


class Number(Message, frozen=True, kw_only=True, eq=False):
    """A small message."""

    value: float


class NumberOutputs(msgspec.Struct):
    """One number."""

    number: Number | None = None


class Beat(Operator):
    """Send a number at each tick, `count` times."""

    class Config(msgspec.Struct):
        count: int = 100

    Outputs = NumberOutputs

    sent = 0

    def on_tick(self, tick: Tick) -> Iterator[NumberOutputs | End]:
        self.sent += 1
        yield NumberOutputs(Number(measured_at=tick.measured_at, value=float(self.sent)))
        if self.sent == self.config.count:
            yield End()


class Pass(Operator):
    """Pass a number on after `work` seconds of work."""

    class Config(msgspec.Struct):
        work: float = 0.0

    Outputs = NumberOutputs

    def on_number(self, number: Number) -> NumberOutputs:
        until = time.perf_counter() + self.config.work
        while time.perf_counter() < until:
            pass
        return NumberOutputs(number)
