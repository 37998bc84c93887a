"""Large payloads of one topic, in memory that its writer and its readers share; Zenoh carries only their place.

The memory has no name: the launcher reserves it, every process inherits the descriptor, and it is gone with the last of
them, however they end. One copy in, and the reader decodes from where it lies.

A reader may look before Zenoh has told it: what stands before the newest payload says which message it is, and whether
it is there already. It need not look, and whoever does finds what Zenoh tells a little later.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import tempfile
import threading
import weakref
from collections import deque
from typing import Any, NamedTuple

import numpy as np

SIZE = 16 << 20  # bytes of payloads; pages are only taken when first written
LARGE = 1 << 15  # bytes of a payload that goes through it; smaller ones fit a packet
_LINE = 64  # bytes of a cache line: each counter has its own, and payloads begin on one
_POSITION, _LENGTH, _STATE, _INCARNATION, _SEQUENCE, _STAMP, _MARKED = range(7)  # the words before a payload
_WORDS = 56  # bytes of them; then comes the mark
_HEAD = 2 * _LINE  # bytes before a payload
MARK = _HEAD - _WORDS  # bytes of a mark that fits there
_COMING, _THERE = range(2)
_RETIRED = (1 << 64) - 1
_fence = threading.Lock()


def _order() -> None:
    """Let what this thread wrote be seen before what it writes next, and let it read on only then."""
    with _fence:
        pass


class Found(NamedTuple):
    """The newest message of a ring."""

    position: int
    length: int
    envelope: tuple[int, int, int]  # incarnation, sequence, stamp
    mark: bytes | None  # None while it is not there


def reserve(readers: int) -> int:
    """Return a descriptor of new shared memory for one writer and so many readers."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("retracer")
    else:
        with tempfile.TemporaryFile() as file:  # without a name from here on
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, _LINE * (1 + readers) + SIZE)
    return descriptor


def retire(descriptor: int, reader: int) -> None:
    """Wait no longer for a reader that is gone."""
    os.pwrite(descriptor, _RETIRED.to_bytes(8, "little"), _LINE * (1 + reader))


def _end(position: int, length: int) -> int:
    return -(-(position + _HEAD + length) // _LINE) * _LINE


class _Memory:
    """Counters, then payloads. Positions only grow; a payload lies at its position modulo SIZE, in one piece."""

    def __init__(self, descriptor: int, readers: int) -> None:
        self.start = _LINE * (1 + readers)
        self.bytes = mmap.mmap(descriptor, self.start + SIZE)
        counters = memoryview(self.bytes)[: self.start].cast("Q")
        self.counters = counters[:: _LINE // 8]  # one a line: written up to; then released up to, by reader
        self.newest = counters[1:2]  # where the newest payload begins
        self.floor = counters[2:3]  # nobody holds anything that lies before

    def words(self, position: int) -> memoryview:
        """Return the words before a payload."""
        begin = self.start + position % SIZE
        return memoryview(self.bytes)[begin : begin + _WORDS].cast("Q")


class RingWriter(_Memory):
    """The writing end: one process at a time. A writer that is started again goes on behind the last one."""

    def __init__(self, descriptor: int, readers: int, bells: tuple[int, ...] = ()) -> None:
        super().__init__(descriptor, readers)
        self.bells = bells

    def call(self) -> None:
        """Let the readers look: a payload is being written, or is there."""
        for bell in self.bells:
            with contextlib.suppress(BlockingIOError):  # it rings already
                os.write(bell, b"!")

    def allocate(self, length: int, envelope: tuple[int, int, int] = (0, 0, 0)) -> tuple[int, memoryview] | None:
        """Return position and memory of a new payload; None while readers hold too much.

        length: bytes. envelope: incarnation, sequence and stamp of the message.
        """
        head, *released_by = self.counters
        released = max(self.floor[0], min(head, *released_by))
        if released == head:  # all is read: begin again where the caches are warm
            position = released = self.floor[0] = -(-head // SIZE) * SIZE
        else:
            position = head if head % SIZE + _end(0, length) <= SIZE else -(-head // SIZE) * SIZE
        if _end(position, length) - released > SIZE:
            return None
        self.counters[0] = _end(position, length)
        words = self.words(position)
        words[_STATE], words[_POSITION], words[_LENGTH] = _COMING, position, length
        words[_INCARNATION], words[_SEQUENCE], words[_STAMP] = envelope
        _order()
        self.newest[0] = position
        begin = self.start + position % SIZE + _HEAD
        return position, memoryview(self.bytes)[begin : begin + length]

    def publish(self, position: int, mark: bytes) -> None:
        """Say that the payload at a position is there, with the mark that travels with it, and call the readers.

        A mark of more than MARK bytes finds no room: they hear of it otherwise.
        """
        if len(mark) > MARK:
            return
        words, begin = self.words(position), self.start + position % SIZE + _WORDS
        words[_MARKED] = len(mark)
        self.bytes[begin : begin + len(mark)] = mark
        _order()
        words[_STATE] = _THERE
        self.call()


class RingReader(_Memory):
    """The end of one reader."""

    def __init__(self, descriptor: int, readers: int, reader: int, *, copy: bool = False) -> None:
        super().__init__(descriptor, readers)
        self.counter = self.counters[1 + reader : 2 + reader]
        self.counter[0] = self.counters[0]  # what was put before nobody will read
        self.lock = threading.RLock()  # a payload may be let go while another is: garbage collection chooses its time
        self.held: deque[int] = deque()  # ends of the payloads, in the order in which they came
        self.loans: dict[int, Any] = {}
        self.copy = copy

    def read(self, position: int, length: int) -> bytes | memoryview:
        """Return a payload as it lies there, read-only; its place is free again when nothing refers to it any more.

        With `copy` a copy, so that the place is free at once. Payloads are read in the order in which they were put.
        """
        piece = np.frombuffer(self.bytes, np.uint8, length, self.start + position % SIZE + _HEAD)
        end = _end(position, length)
        if self.copy:
            copied = piece.tobytes()
            self.counter[0] = end
            return copied
        piece.flags.writeable = False
        with self.lock:
            self.held.append(end)
            self.loans[end] = weakref.ref(piece, lambda _: self._release(end))
        return piece.data

    def look(self) -> Found | None:
        """Return the newest message, if this reader has not let go of it; whether it has had it, its sequence tells."""
        position = self.newest[0]
        if position < self.counter[0]:  # its place may be another's by now
            return None
        words = self.words(position)
        there = words[_STATE] == _THERE
        _order()
        if words[_POSITION] != position:
            return None
        begin = self.start + position % SIZE + _WORDS
        mark = self.bytes[begin : begin + words[_MARKED]] if there else None
        return Found(position, words[_LENGTH], (words[_INCARNATION], words[_SEQUENCE], words[_STAMP]), mark)

    def _release(self, end: int) -> None:
        with self.lock:
            del self.loans[end]
            while self.held and self.held[0] not in self.loans:
                self.counter[0] = self.held.popleft()
