"""What the launcher and the process of an operator say to each other."""

from __future__ import annotations

from typing import Literal

import msgspec

from graph.wiring import NodeSpec

Phase = Literal["running", "paused", "idle", "ending", "finished"]


class SharedRing(msgspec.Struct, frozen=True):
    """The ring of one topic, as a process inherits it."""

    descriptor: int
    readers: tuple[str, ...]  # operators, in the order of their counters
    bells: tuple[int, ...] = ()  # descriptors that wake those readers who want it


class Boot(msgspec.Struct):
    """What the launcher tells a new process."""

    spec: NodeSpec
    endpoint: str
    prefix: str
    shard: str
    incarnation: int = 0
    log_level: str = "warning"
    rings: dict[str, SharedRing] = {}  # by topic; none where others than our processes listen
    bell: tuple[int, int] | None = None  # descriptors to hear and to ring its own

    def descriptors(self) -> set[int]:
        """Name all file descriptors that the process is to inherit."""
        rings = self.rings.values()
        return {
            *(ring.descriptor for ring in rings),
            *(bell for ring in rings for bell in ring.bells),
            *(self.bell or ()),
        }


class Control(msgspec.Struct):
    """A word of the launcher to all operators."""

    kind: Literal["start", "pause", "end", "stop", "finish", "exit"]
    stamp: int = 0  # start: the start on the monotonic clock; end: the last stamp of the run


class State(msgspec.Struct):
    """An operator's report to the launcher: how far it is, and how long its latest calls took."""

    phase: Phase
    stamp: int  # of the last call
    steps: int
    durations: tuple[int, ...] = ()  # nanoseconds, of the calls since the last report
    counts: tuple[int, ...] = ()  # messages put, by output port
    received: dict[str, int] = msgspec.field(default_factory=dict)  # by topic
    dormant: bool = False  # lockstep: nothing to do but what others may send
    end: int | None = None  # this operator's End, where it ends the run
    skipped: int = 0
