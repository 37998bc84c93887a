"""Durations and timers as people write them (`100ms`, `1.5s`, `timer/10hz`), in whole nanoseconds."""

from __future__ import annotations

import functools
import re
from decimal import Decimal

_NANOSECONDS = {"h": 3_600 * 10**9, "min": 60 * 10**9, "s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_FRACTION = r"(\.[0-9]{1,9})?"
_SOME = r"(?=[0-9.]*[1-9])"  # not zero

DURATION = "|".join(  # a regular expression; no more digits than fit into 64 bits of ns
    rf"[0-9]{{1,{19 - len(str(size))}}}{_FRACTION}{unit}" for unit, size in _NANOSECONDS.items()
)
SPAN = rf"{_SOME}({DURATION})"  # a duration above zero
PERIOD = rf"{_SOME}([0-9]{{1,9}}{_FRACTION}hz|{DURATION})"  # the port of a timer


@functools.cache
def nanoseconds(duration: str | float) -> int:
    """Convert a duration (`100ms`, `1.5s`, `2min`, or seconds) into ns, rounded to the nearest. Raises ValueError."""
    if not isinstance(duration, str):
        return round(Decimal(repr(duration)) * 10**9)
    if re.fullmatch(DURATION, duration) is None:
        raise ValueError(f"a duration is such as 100ms, 1.5s or 2min; this is {duration!r}")
    amount = duration.rstrip("abcdefghijklmnopqrstuvwxyz")
    return round(Decimal(amount) * _NANOSECONDS[duration.removeprefix(amount)])


@functools.cache
def timer_period(port: str) -> int:
    """Return the period in ns of a timer's port (`10hz`, `0.5hz`, `100ms`), at least 1. Raises ValueError."""
    if re.fullmatch(PERIOD, port) is None:
        raise ValueError(f"a timer is such as timer/10hz or timer/100ms; this is timer/{port}")
    period = round(10**9 / Decimal(port[:-2])) if port.endswith("hz") else nanoseconds(port)
    return max(1, period)


def duration_text(value: int) -> str:
    """Write ns as the shortest duration that means exactly them: `100ms`, `90s`, `2min`."""
    unit = next((unit for unit, size in _NANOSECONDS.items() if value and value % size == 0), "s")
    return f"{value // _NANOSECONDS[unit]}{unit}"
