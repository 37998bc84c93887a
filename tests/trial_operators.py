"""Operators that put the runtime on trial: of many ports, sporadic, failing, leaving, with words at the end."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator

import msgspec

from graph import End, Operator, Sink, Source
from graph.messages import Tick
from tests.sample_operators import Count, CountOutputs, Relay

MODULUS = 1_000_003


class MixerOutputs(msgspec.Struct):
    """Two numbers."""

    x: Count | None = None
    y: Count | None = None


class MixerConfig(msgspec.Struct):
    """What a Mixer does."""

    seed: int = 0
    share: int = 50  # per cent of the calls that say something
    starts: bool = False  # says something in on_start
    ends: bool = False  # says something in on_end
    last: int | None = None  # number of the call that returns End
    stamps: tuple[int, ...] = ()  # of a source's stream, nanoseconds


class _Mixing:
    """A state that depends on every call and on their order, and decides what is said."""

    config: MixerConfig

    def __init__(self) -> None:
        self.state = self.config.seed + 1
        self.calls = 0

    def mix(self, number: int, value: int) -> Iterator[MixerOutputs | End]:
        self.state = (self.state * 31 + number * 7 + value) % MODULUS
        if self.state % 100 < self.config.share:
            yield MixerOutputs(x=self._count())
            if self.state % 3:
                yield MixerOutputs(x=self._count() if self.state % 2 else None, y=self._count())
        self.calls += 1
        if self.calls == self.config.last:
            yield End()

    def _count(self) -> Count:
        return Count(measured_at=self.calls, value=self.state)

    def on_start(self) -> Iterator[MixerOutputs | End] | None:
        return self._once() if self.config.starts else None

    def _once(self) -> Iterator[MixerOutputs]:
        yield MixerOutputs(x=self._count(), y=self._count())

    def on_end(self) -> Iterator[MixerOutputs] | None:
        return self._once() if self.config.ends else None


class Mixer(_Mixing, Operator):
    """Mix numbers of up to four ports, and ticks of two timers, into one state; say it now and then."""

    Config = MixerConfig
    Outputs = MixerOutputs

    def __init__(self, config: MixerConfig | None = None) -> None:
        Operator.__init__(self, config)
        _Mixing.__init__(self)

    def on_slow(self, tick: Tick | None) -> Iterator[MixerOutputs | End]:
        return self.mix(1, tick.measured_at)

    def on_a(self, count: Count | None) -> Iterator[MixerOutputs | End]:
        return self.mix(2, count.value)

    def on_b(self, count: Count | None) -> Iterator[MixerOutputs | End]:
        return self.mix(3, count.value)

    def on_fast(self, tick: Tick | None) -> Iterator[MixerOutputs | End]:
        return self.mix(4, tick.index)

    def on_c(self, count: Count | None) -> Iterator[MixerOutputs | End]:
        return self.mix(5, count.value)

    def on_d(self, count: Count | None) -> Iterator[MixerOutputs | End]:
        return self.mix(6, count.value)


class Listener(Mixer):
    """A Mixer that only listens at three of its ports."""

    def on_a(self, count: Count | None) -> None:
        self.hear(2, count.value)

    def on_fast(self, tick: Tick | None) -> None:
        self.hear(4, tick.index)

    def on_d(self, count: Count | None) -> None:
        self.hear(6, count.value)

    def hear(self, number: int, value: int) -> None:
        self.state = (self.state * 29 + number * 5 + value) % MODULUS


class MixerSource(_Mixing, Source):
    """Say mixed numbers at given stamps."""

    Config = MixerConfig
    Outputs = MixerOutputs

    def __init__(self, config: MixerConfig | None = None) -> None:
        Operator.__init__(self, config)
        _Mixing.__init__(self)

    def stream(self) -> Iterator[tuple[int, list[MixerOutputs | End]]]:
        for stamp in self.config.stamps:
            yield stamp, list(self.mix(0, stamp))


class Stumbling(Sink):
    """Fail at the first number."""

    def on_count(self, count: Count) -> None:
        raise RuntimeError("a sink that stumbles")


class Parent(Relay):
    """Start a process that outlives it, and say its number."""

    def on_start(self) -> None:
        self.child = subprocess.Popen(["sleep", "600"])

    def on_count(self, count: Count) -> CountOutputs:
        return CountOutputs(Count(measured_at=count.measured_at, value=self.child.pid))


class Leaving(Relay):
    """Leave the process at the fifth number, as if nothing were wrong."""

    def on_count(self, count: Count) -> CountOutputs:
        if count.value == 5:
            os._exit(0)
        return super().on_count(count)


class Stuttering(Relay):
    """Say each number twice, and fail between the two at `at`."""

    class Config(msgspec.Struct):
        at: int = 5
        offset: int = 0

    def on_count(self, count: Count) -> Iterator[CountOutputs]:
        yield super().on_count(count)
        if count.value == self.config.at:
            raise RuntimeError("stuttered")
        yield super().on_count(count)


class LastWords(Relay):
    """Say one more number at the end."""

    def on_end(self) -> CountOutputs:
        return CountOutputs(Count(measured_at=0, value=-1))


class Blocking(Source):
    """Give three numbers, then fail, or wait for what never comes."""

    class Config(msgspec.Struct):
        fails: bool = False

    Outputs = CountOutputs

    def stream(self) -> Iterator[tuple[int, CountOutputs]]:
        for index in range(3):
            yield index * 1000, CountOutputs(Count(measured_at=index * 1000, value=index))
        if self.config.fails:
            raise RuntimeError("unplugged")
        time.sleep(600.0)
