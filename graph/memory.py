"""Keep freed memory in the process: messages of a megabyte come and go, and fresh pages cost more than the copies."""

from __future__ import annotations

import ctypes
import gc
import sys

LARGEST = 32 << 20  # bytes of an allocation that comes from the heap; the most that glibc accepts
KEPT = 256 << 20  # bytes of free heap that are not given back
GROWTH = 64 << 20  # bytes by which the heap grows

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # of mallopt(3)


def keep_pages() -> None:
    """Tell glibc to reuse the memory of large buffers; elsewhere do nothing.

    By default it maps a buffer of 1.2 MB afresh, the kernel zeroes it page by page, and it is unmapped again, several
    times a message; a cloud then takes twice as long from operator to operator.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None  # musl has none
    if mallopt is not None:
        for option, value in ((_MMAP_THRESHOLD, LARGEST), (_TRIM_THRESHOLD, KEPT), (_TOP_PAD, GROWTH)):
            mallopt(option, value)


def spare_garbage_collection() -> None:
    """Take all that exists now out of garbage collection: modules and models stay, and walking them takes long."""
    gc.collect()
    gc.freeze()
