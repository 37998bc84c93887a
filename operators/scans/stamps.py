"""When scans were taken: stamps in file names, and in files of one stamp a line."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

from operators.scans.scan import ScanError

SECOND = 1_000_000_000  # nanoseconds
EPOCH = (10**18, 42 * 10**17)  # ns: the years 2001 to 2103; a whole number outside is a count, not a time

# A number below 1e11 is seconds (the year 5138), and so on: what is told without a unit is a time of this century.
_UNITS = ((Decimal(10) ** 11, 10**9), (Decimal(10) ** 14, 10**6), (Decimal(10) ** 17, 10**3))

_SPLIT = re.compile(r"(?<!\d)(\d{9,10})[_-](\d{9})$")  # seconds_nanoseconds, as ROS tools name files
_LAST = re.compile(r"(?<![\d.])\d+(\.\d+)?$")
_DATE = re.compile(r"(\d{4}-\d{2}-\d{2})[ T](\d{2}:\d{2}:\d{2})(\.\d+)?Z?$")


def nanoseconds(text: str) -> int:
    """Read a stamp: seconds, or milli-, micro- or nanoseconds if the number is too large for those. Returns ns.

    Raises ValueError for what is no finite number.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"{text!r} is no number") from None
    if not value.is_finite():
        raise ValueError(f"{text!r} is no time")
    factor = next((factor for bound, factor in _UNITS if abs(value) < bound), 1)
    return round(value * factor)


def stamp_of_name(stem: str) -> int | None:
    """Read the stamp in ns that a file name ends in; None for a mere number, such as 000123 or scan12."""
    if (match := _SPLIT.search(stem)) is not None:
        return int(match[1]) * SECOND + int(match[2])
    if (match := _LAST.search(stem)) is None:
        return None
    stamp = nanoseconds(match[0])
    return stamp if match[1] is not None or EPOCH[0] <= stamp < EPOCH[1] else None


def stamps_of_names(stems: Sequence[str]) -> list[int] | None:
    """Read the stamps in ns that file names end in; None unless all do."""
    stamps = [stamp for stem in stems if (stamp := stamp_of_name(stem)) is not None]
    return stamps if stamps and len(stamps) == len(stems) else None


def read_stamps(path: Path) -> list[int]:
    """Read a file of one stamp a line: a number (see nanoseconds), or a date and time as in KITTI. Returns ns.

    Raises ScanError with the line.
    """
    stamps = []
    for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), 1):
        if not (text := line.partition("#")[0].strip()):
            continue
        try:
            stamps.append(_of_date(match) if (match := _DATE.match(text)) else nanoseconds(text))
        except ValueError as error:
            raise ScanError(f"{path} line {number}: a stamp is a number of seconds or a date; {error}") from None
    return stamps


def _of_date(match: re.Match[str]) -> int:
    moment = datetime.datetime.fromisoformat(f"{match[1]}T{match[2]}+00:00")
    fraction = (match[3] or ".0")[1:10].ljust(9, "0")
    return int(moment.timestamp()) * SECOND + int(fraction)
