"""What comes to a process: each message once and in order, whoever tells of it first, and nobody waits for the dead."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.inbox import Inbox, Sample
from graph.ring import RingReader, RingWriter, reserve

KEY = "data/maker/cloud"


@dataclass
class Line:
    """One writer and one reader, and what Zenoh has still to tell."""

    incarnation: int = 0
    sequence: int = 0
    under_way: list[Sample] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.descriptor = reserve(1)
        self.inbox = Inbox()
        self.inbox.expect(KEY, RingReader(self.descriptor, 1, 0))
        self.writer = RingWriter(self.descriptor, 1, (self.inbox.bell.ringing,))

    def begin(self, content: bytes) -> int:
        found = self.writer.allocate(len(content), (self.incarnation, self.sequence, self.sequence * 10))
        assert found is not None
        found[1][:] = content
        return found[0]

    def put(self, content: bytes, *, large: bool = True, mark: bytes = b"") -> None:
        """Put a message: into the ring if it is large, and under way."""
        envelope = (self.incarnation, self.sequence, self.sequence * 10)
        if large:
            place = self.begin(content)
            self.writer.publish(place, mark)
            self.under_way.append(Sample(KEY, b"", envelope, True, mark, place, len(content)))
        else:
            self.under_way.append(Sample(KEY, content, envelope, True, mark))
        self.sequence += 1

    def tell(self) -> None:
        """Let Zenoh tell of the next message."""
        self.inbox.put(self.under_way.pop(0))

    def take(self, timeout: float = 1e-3) -> list[tuple[int, int, bytes, bytes]]:
        return [(*item.envelope[:2], bytes(item.payload), item.mark) for item in self.inbox.take(timeout)]

    def close(self) -> None:
        self.inbox.bell.close()
        os.close(self.descriptor)


@pytest.fixture
def line() -> Iterator[Line]:
    made = Line()
    made.put(b"first")
    made.tell()
    assert made.take() == [(0, 0, b"first", b"")]
    yield made
    made.close()


def test_a_message_in_the_ring_is_taken_before_zenoh_tells_and_only_once(line: Line) -> None:
    line.put(b"second", mark=b"mark")
    assert line.take() == [(0, 1, b"second", b"mark")]
    line.tell()
    assert line.take() == []


def test_the_first_message_of_a_process_is_awaited_from_zenoh(line: Line) -> None:
    line.incarnation, line.sequence = 1, 0
    line.put(b"back again")
    assert line.take() == []
    line.tell()
    assert line.take() == [(1, 0, b"back again", b"")]
    line.put(b"and on")
    assert line.take() == [(1, 1, b"and on", b"")]


def test_a_message_does_not_overtake_a_smaller_one(line: Line) -> None:
    line.put(b"small", large=False)
    line.put(b"large")
    assert line.take() == []
    line.tell()
    assert line.take() == [(0, 1, b"small", b"")]
    assert line.take() == [(0, 2, b"large", b"")]


def test_what_is_being_written_is_not_taken_and_nobody_hangs_when_its_writer_dies(line: Line) -> None:
    line.begin(b"never finished")
    line.writer.call()
    begun = time.monotonic()
    assert line.take(0.05) == []
    assert time.monotonic() - begun >= 0.05
    line.writer = RingWriter(line.descriptor, 1, (line.inbox.bell.ringing,))
    line.incarnation, line.sequence = 1, 0
    line.put(b"its heir")
    line.tell()
    assert line.take() == [(1, 0, b"its heir", b"")]


def test_the_bell_wakes_a_sleeper(line: Line) -> None:
    waker = threading.Timer(0.1, line.put, (b"second",))
    waker.start()
    begun = time.monotonic()
    assert line.take(20.0) == [(0, 1, b"second", b"")]
    assert time.monotonic() - begun < 10.0
    waker.join()


def test_what_comes_over_the_wire_wakes_a_sleeper(line: Line) -> None:
    word = Sample("control", b"stop", (0, 0, 0))
    waker = threading.Timer(0.1, line.inbox.put, (word,))
    waker.start()
    assert line.inbox.take(20.0) == [word]
    waker.join()


@settings(deadline=None, max_examples=60)
@given(
    acts=st.lists(st.sampled_from(["large", "small", "tell", "take", "let go", "die", "look in vain"]), max_size=60),
)
def test_every_message_is_taken_once_and_in_order_whoever_tells_of_it(acts: list[str]) -> None:
    line = Line()
    sent: list[tuple[int, int, bytes]] = []
    taken: list[tuple[int, int, bytes]] = []
    held: list[tuple[Sample, bytes]] = []

    def take() -> None:
        for item in line.inbox.take(1e-4):
            held.append((item, bytes(item.payload)))
            taken.append((*item.envelope[:2], bytes(item.payload)))

    for number, act in enumerate(acts):
        if act in ("large", "small"):
            content = bytes([number]) * 50_000
            sent.append((line.incarnation, line.sequence, content))
            line.put(content, large=act == "large")
        elif act == "tell" and line.under_way:
            line.tell()
        elif act == "take":
            take()
        elif act == "let go" and held:
            held.pop(number % len(held))
        elif act == "die":
            line.begin(b"lost" * 10_000)
            line.writer = RingWriter(line.descriptor, 1, (line.inbox.bell.ringing,))
            line.incarnation, line.sequence = line.incarnation + 1, 0
        elif act == "look in vain":
            line.writer.call()
        assert all(bytes(item.payload) == content for item, content in held)
        assert taken == sent[: len(taken)]
    while line.under_way:
        line.tell()
    take()
    assert taken == sent
    held.clear()
    line.close()
