"""What has come to a process and is not yet taken.

Zenoh brings every message. A neighbour on this machine also rings a bell when it begins to write a large one and when
that is there: who looks into the ring then has it before Zenoh tells, and drops what Zenoh tells later.
"""

from __future__ import annotations

import contextlib
import os
import queue
import select
import time
from collections.abc import Iterator
from typing import NamedTuple

from graph.ring import RingReader

INLINE = -1  # the place of a payload that travels with its message
WATCH = 5e-4  # seconds that a reader stays awake for what is being written


class Sample(NamedTuple):
    """What came in: data (`data/op/port`), a mark, a state, a control word; or a liveliness change."""

    key: str
    payload: bytes | memoryview
    envelope: tuple[int, int, int]  # incarnation, sequence, stamp; zeros where there is none
    alive: bool = True
    mark: bytes = b""  # the mark that travels with the last messages of a call
    place: int = INLINE  # in the ring of its topic
    length: int = 0


class Bell:
    """A pipe that anybody may ring who has its writing end, and that one process hears."""

    def __init__(self, ends: tuple[int, int] | None = None) -> None:
        self.hearing, self.ringing = ends or os.pipe()
        for end in self.ends:
            os.set_blocking(end, False)

    @property
    def ends(self) -> tuple[int, int]:
        """Return the descriptors to hear it and to ring it."""
        return self.hearing, self.ringing

    def ring(self) -> None:
        """Ring it; a bell that rings already may go on."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.ringing, b"!")

    def hush(self) -> None:
        """Forget that it rang."""
        with contextlib.suppress(BlockingIOError):
            os.read(self.hearing, 1 << 16)

    def wait(self, timeout: float) -> bool:
        """Wait for it at most so many seconds; say whether it rings."""
        return bool(select.select([self.hearing], [], [], timeout)[0])

    def close(self) -> None:
        """Give both ends back."""
        os.close(self.hearing)
        os.close(self.ringing)


class _Topic:
    """A topic whose large messages lie in a ring, and the next message of it."""

    def __init__(self, ring: RingReader) -> None:
        self.ring = ring
        self.next: tuple[int, int] | None = None  # incarnation and sequence, known from the first message on

    def had(self, sample: Sample) -> bool:
        """Say whether a message was seen in the ring already; else count it."""
        incarnation, sequence, _ = sample.envelope
        if self.next is not None and self.next[0] == incarnation and sequence < self.next[1]:
            return True
        self.next = incarnation, sequence + 1
        return False


class Inbox:
    """Filled by threads of Zenoh and by neighbours, emptied by one thread."""

    def __init__(self, bell: tuple[int, int] | None = None) -> None:
        self.queue: queue.SimpleQueue[Sample] = queue.SimpleQueue()
        self.topics: dict[str, _Topic] = {}  # by key
        self.bell = Bell(bell)
        self.waiting = False

    def expect(self, key: str, ring: RingReader) -> None:
        """Look for the messages under a key in a ring too."""
        self.topics[key] = _Topic(ring)

    def put(self, sample: Sample) -> None:
        """Add what has come, from any thread."""
        self.queue.put(sample)
        if self.waiting:
            self.bell.ring()

    def empty(self) -> bool:
        """Say whether nothing has come over the wire that was not taken."""
        return self.queue.empty()

    def take(self, timeout: float) -> list[Sample]:
        """Return what has come, waiting at most so many seconds for the first of it."""
        found = list(self._fetch())
        if found or timeout <= 0.0:
            return found
        until = time.monotonic() + timeout
        self.waiting = True
        while not found and (left := until - time.monotonic()) > 0.0:
            self.bell.hush()
            found = [*self._fetch(), *self._look()]
            if not found and self.bell.wait(left):
                found = list(self._watch())
        self.waiting = False
        return found

    def _fetch(self) -> Iterator[Sample]:
        while not self.queue.empty():
            sample = self.queue.get()
            topic = self.topics.get(sample.key)
            if topic is None:
                yield sample
            elif not topic.had(sample):
                yield sample if sample.place == INLINE else self._read(topic, sample)

    def _look(self) -> Iterator[Sample]:
        """Iterate over the messages that are there and that Zenoh has not told yet."""
        for key, topic in self.topics.items():
            if topic.next is None or (newest := topic.ring.look()) is None or newest.mark is None:
                continue
            if newest.envelope[:2] == topic.next:
                sample = Sample(key, b"", newest.envelope, True, newest.mark, newest.position, newest.length)
                topic.had(sample)
                yield self._read(topic, sample)

    def _watch(self) -> Iterator[Sample]:
        """Stay awake for a moment: somebody writes."""
        until = time.monotonic() + WATCH
        while self.queue.empty() and time.monotonic() < until:
            if found := list(self._look()):
                yield from found
                return
            time.sleep(0)
        yield from self._fetch()

    def _read(self, topic: _Topic, sample: Sample) -> Sample:
        return sample._replace(payload=topic.ring.read(sample.place, sample.length), place=INLINE)
