"""The ledger: one record a call, which is provenance, statistics and the key to replay."""

from __future__ import annotations

import msgspec

INFINITY = 2**62  # nanoseconds; later than any stamp


class Ref(msgspec.Struct, frozen=True, array_like=True):
    """One message of one topic."""

    topic: str
    incarnation: int
    sequence: int


class Skip(msgspec.Struct, frozen=True, array_like=True):
    """A message that its consumer will never handle, and why."""

    topic: str
    incarnation: int
    sequence: int
    why: str  # queue: newer ones displaced it; missed: a tick while busy; unhandled: no time was left; end: too late


class Emitted(msgspec.Struct, frozen=True, array_like=True):
    """A message that a call emitted: its bytes are known by their xxh3-128 digest."""

    port: str
    sequence: int
    digest: bytes


class Step(msgspec.Struct, frozen=True, array_like=True):
    """One call of an operator.

    `port` is an input, `start`, `end`, or `stream` for a source. Stamps are logical nanoseconds. `wall_*` are the
    only facts that differ between two runs: start since the epoch, and duration, both in nanoseconds.
    """

    index: int
    port: str
    stamp: int
    consumed: tuple[Ref, ...]
    skipped: tuple[Skip, ...]
    emitted: tuple[Emitted, ...]
    ended: str | None  # the reason, if the call returned End
    late: bool  # realtime: the message came after its deadline
    wall_start: int
    wall_duration: int

    def facts(self) -> tuple[object, ...]:
        """Return everything but the wall-clock fields."""
        return (self.index, self.port, self.stamp, self.consumed, self.skipped, self.emitted, self.ended, self.late)


class Mark(msgspec.Struct, frozen=True, array_like=True):
    """How far an operator is: everything it will ever emit with a stamp up to `watermark` has been put.

    `counts` is the number of messages put so far, one entry an output port in the order of Outputs.
    """

    watermark: int
    counts: tuple[int, ...]
    end: int | None = None  # the stamp at which the run ends, once this operator knows it
