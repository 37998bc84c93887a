"""Large payloads of one topic, in memory that its writer and its readers share; Zenoh carries only their place.

The memory has no name: the launcher reserves it, every process inherits the descriptor, and it is gone with the last of
them, however they end. One copy in, and the reader decodes from where it lies.
"""

from __future__ import annotations

import mmap
import os
import tempfile
import threading
import weakref
from collections import deque
from typing import Any

import numpy as np

SIZE = 16 << 20  # bytes of payloads; pages are only taken when first written
LARGE = 1 << 15  # bytes of a payload that goes through it; smaller ones fit a packet
_LINE = 64  # bytes of a cache line: each counter has its own, and payloads begin on one
_RETIRED = (1 << 64) - 1


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
    return -(-(position + length) // _LINE) * _LINE


class _Memory:
    """Counters, then payloads. Positions only grow; a payload lies at its position modulo SIZE, in one piece."""

    def __init__(self, descriptor: int, readers: int) -> None:
        self.start = _LINE * (1 + readers)
        self.bytes = mmap.mmap(descriptor, self.start + SIZE)
        # one a line: written up to; then released up to, by reader
        self.counters = memoryview(self.bytes)[: self.start].cast("Q")[:: _LINE // 8]


class RingWriter(_Memory):
    """The writing end: one process at a time. A writer that is started again goes on behind the last one."""

    def allocate(self, length: int) -> tuple[int, memoryview] | None:
        """Return position and memory of a new payload of `length` bytes; None while readers hold too much."""
        head, *released_by = self.counters
        released = min(head, *released_by)
        if released == head:
            position = released = -(-head // SIZE) * SIZE  # all is read: begin again where the caches are warm
        else:
            position = head if head % SIZE + length <= SIZE else -(-head // SIZE) * SIZE
        if position + length - released > SIZE:
            return None
        self.counters[0] = _end(position, length)
        begin = self.start + position % SIZE
        return position, memoryview(self.bytes)[begin : begin + length]


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

        With `copy` a copy, so that the place is free at once.
        """
        piece = np.frombuffer(self.bytes, np.uint8, length, self.start + position % SIZE)
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

    def _release(self, end: int) -> None:
        with self.lock:
            del self.loans[end]
            while self.held and self.held[0] not in self.loans:
                self.counter[0] = self.held.popleft()
