"""Tiny operators for the tests of the runtime: counting, relaying, adding, feeding back, failing, cheating."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from graph import End, Operator, Sink, Source, Summary
from graph.arrays import Array, array
from graph.messages import Message, Tick


class Count(Message, frozen=True, kw_only=True, eq=False):
    """A number."""

    value: int


class Sum(Message, frozen=True, kw_only=True, eq=False):
    """The sum of two numbers."""

    value: float


class Blob(Message, frozen=True, kw_only=True, eq=False):
    """Bytes by the thousand."""

    data: Annotated[Array, array("uint8", "n")]


class CountOutputs(msgspec.Struct):
    """One number."""

    count: Count | None = None


class Counter(Operator):
    """Count ticks from 0; end after `last` of them."""

    class Config(msgspec.Struct):
        start: int = 0
        step: int = 1
        last: int | None = None

    Outputs = CountOutputs

    ticks = 0

    def on_tick(self, tick: Tick) -> Iterator[CountOutputs | End]:
        value = self.config.start + self.config.step * self.ticks
        self.ticks += 1
        yield CountOutputs(Count(measured_at=tick.measured_at, value=value))
        if self.config.last is not None and self.ticks >= self.config.last:
            yield End(f"counted {self.ticks}")

    def on_end(self) -> Summary:
        return Summary(ticks=self.ticks)


class Relay(Operator):
    """Pass a number on, plus `offset`."""

    class Config(msgspec.Struct):
        offset: int = 0

    Outputs = CountOutputs

    def on_count(self, count: Count) -> CountOutputs:
        return CountOutputs(Count(measured_at=count.measured_at, value=count.value + self.config.offset))


class Adder(Operator):
    """Add the latest of two numbers whenever `right` arrives."""

    class Config(msgspec.Struct):
        scale: float = 1.0

    class Outputs(msgspec.Struct):
        sum: Sum | None = None

    left = 0

    def on_left(self, count: Count) -> None:
        self.left = count.value

    def on_right(self, count: Count) -> Adder.Outputs:
        return self.Outputs(Sum(measured_at=count.measured_at, value=self.config.scale * (self.left + count.value)))


class Feedback(Operator):
    """Integrate its own past: on each tick the sum of what has come back, plus one. End after `last` ticks."""

    class Config(msgspec.Struct):
        last: int | None = None

    Outputs = CountOutputs

    total = ticks = 0

    def on_back(self, count: Count) -> None:
        self.total = (self.total * 3 + count.value) % 1_000_003

    def on_tick(self, tick: Tick) -> Iterator[CountOutputs | End]:
        self.ticks += 1
        yield CountOutputs(Count(measured_at=tick.measured_at, value=self.total + 1))
        if self.ticks == self.config.last:
            yield End()

    def on_end(self) -> Summary:
        return Summary(total=self.total, ticks=self.ticks)


class Late(Operator):
    """Number its counts and listen to late ones only if wired."""

    Outputs = CountOutputs

    def on_late(self, count: Count | None) -> None: ...

    def on_count(self, count: Count) -> CountOutputs:
        return CountOutputs(count)


class Failing(Relay):
    """Raise at number `at`; by `how`: an exception, or the end of the process."""

    class Config(msgspec.Struct):
        at: int = 5
        offset: int = 0
        how: Literal["raise", "exit", "kill"] = "raise"

    def on_count(self, count: Count) -> CountOutputs:
        if count.value >= self.config.at:
            if self.config.how == "exit":
                os._exit(3)
            if self.config.how == "kill":
                os.kill(os.getpid(), 9)
            raise RuntimeError(f"failed at {count.value}, as configured")
        return super().on_count(count)


class WallClock(Relay):
    """Cheat: the wall clock decides its output."""

    def on_count(self, count: Count) -> CountOutputs:
        return CountOutputs(Count(measured_at=count.measured_at, value=time.time_ns()))


class Unseeded(Relay):
    """Cheat: an unseeded random number decides its output."""

    def on_count(self, count: Count) -> CountOutputs:
        value = random.SystemRandom().randrange(2**62)
        return CountOutputs(Count(measured_at=count.measured_at, value=value))


class BlobMaker(Operator):
    """Make `size` bytes at each tick, seeded."""

    class Config(msgspec.Struct):
        size: int = 1000
        seed: int = 0

    class Outputs(msgspec.Struct):
        blob: Blob | None = None

    def on_start(self) -> None:
        self.generator = np.random.default_rng(self.config.seed)

    def on_tick(self, tick: Tick) -> BlobMaker.Outputs:
        data = self.generator.integers(0, 256, self.config.size, np.uint8)
        return self.Outputs(Blob(measured_at=tick.measured_at, data=data))


class BlobBurst(BlobMaker):
    """Make several at each tick, small ones and large ones in any order."""

    def on_tick(self, tick: Tick) -> Iterator[BlobMaker.Outputs]:  # type: ignore[override]
        for size in self.generator.permutation(np.geomspace(1, self.config.size, 6).astype(int)):
            data = self.generator.integers(0, 256, size, np.uint8)
            yield self.Outputs(Blob(measured_at=tick.measured_at, data=data))


class BlobRelay(Operator):
    """Pass bytes on, each plus `offset`."""

    class Config(msgspec.Struct):
        offset: int = 1

    class Outputs(msgspec.Struct):
        blob: Blob | None = None

    def on_blob(self, blob: Blob) -> BlobRelay.Outputs:
        return self.Outputs(Blob(measured_at=blob.measured_at, data=blob.data + np.uint8(self.config.offset)))


class Slow(Relay):
    """Take `seconds` of the wall clock for each number."""

    class Config(msgspec.Struct):
        seconds: float = 0.01
        offset: int = 0

    def on_count(self, count: Count) -> CountOutputs:
        time.sleep(self.config.seconds)
        return super().on_count(count)


class Scans(Source):
    """Give `count` numbers, `period` ns apart."""

    class Config(msgspec.Struct):
        count: int = 10
        period: int = 100_000_000

    Outputs = CountOutputs

    def stream(self) -> Iterator[tuple[int, CountOutputs]]:
        for index in range(self.config.count):
            stamp = index * self.config.period
            yield stamp, CountOutputs(Count(measured_at=stamp, value=index))


class Screen(Sink):
    """Show numbers to nobody."""

    def on_count(self, count: Count) -> None: ...


class Inner(msgspec.Struct):
    """Settings within settings."""

    gain: float = 1.0
    file: Path | None = None


class Settings(Operator):
    """Take settings of every sort."""

    class Config(msgspec.Struct):
        needed: int
        speed: Annotated[float, msgspec.Meta(ge=0.0)] = 1.0
        mode: Literal["fast", "safe"] = "safe"
        map: Path | None = None
        layers: list[int] = []
        inner: Inner = msgspec.field(default_factory=Inner)
        by_name: dict[str, float] = {}

    def on_tick(self, tick: Tick) -> None: ...


class Both(Operator):
    """Listen to two numbers, and pass on the right one."""

    Outputs = CountOutputs

    def on_left(self, count: Count) -> None: ...

    def on_right(self, count: Count) -> CountOutputs:
        return CountOutputs(count)


class Maybe(Operator):
    """Listen to a number if there is one."""

    def on_count(self, count: Count | None) -> None: ...
