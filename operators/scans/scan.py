"""One scan of a lidar, whatever file or message it came in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Columns = Mapping[str, npt.NDArray[Any]]  # field name to one value a point

COORDINATES = ("x", "y", "z")
RINGS = ("ring", "channel", "laser_id", "line")  # Velodyne, Ouster; Hesai; others; Livox
TIMES = ("time_offset", "time", "t", "timestamp", "offset_time", "time_stamp")

LONGEST = 1.0  # seconds that a revolution may last; what is more is no offset but a time of day
ENOUGH = 50  # points that tell which end of the rings is up


class ScanError(ValueError):
    """Scans or poses that cannot be read: the message says in one sentence what is wrong, and where."""


class Scan(NamedTuple):
    """The points of one scan in the sensor's frame."""

    points: Floats  # (n, 3) metres
    ring: npt.NDArray[np.uint8] | None = None  # (n,)
    time_offset: Floats | None = None  # (n,) seconds after the stamp
    remark: str = ""  # what of the file could not be used


class Dropped(NamedTuple):
    """How many points were left out."""

    not_finite: int = 0
    out_of_range: int = 0


def scan_of(columns: Columns, name: str, *, stamp: int | None = None) -> Scan:
    """Build a scan of columns of one length, as files and messages name them.

    columns: at least x, y, z in metres; a ring (see RINGS) and a time (see TIMES: integers in ns, else seconds; of the
    day or after the stamp) are taken where they are. stamp: ns, of the scan. Raises ScanError without coordinates.
    """
    if missing := [axis for axis in COORDINATES if axis not in columns]:
        raise ScanError(
            f"{name} has no {' and no '.join(missing)}; its fields are {' '.join(columns) or 'none at all'}"
        )
    points = np.stack([np.asarray(columns[axis], np.float32) for axis in COORDINATES], axis=1)
    ring, time_offset, remarks = None, None, []
    for wanted in (field for field in RINGS if field in columns):
        if (ring := _rings(columns[wanted])) is None:
            remarks.append(f"its field {wanted!r} is not used: rings are whole numbers from 0 to 255")
        break
    for wanted in (field for field in TIMES if field in columns):
        if (time_offset := _offsets(columns[wanted], stamp)) is None:
            remarks.append(f"its field {wanted!r} is not used: it gives no times within {LONGEST:g} s of the stamp")
        break
    return Scan(points, ring, time_offset, "; ".join(remarks))


def _rings(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8] | None:
    with np.errstate(invalid="ignore"):
        ring = values.astype(np.uint8)
    return ring if np.array_equal(ring, values) else None


def _offsets(values: npt.NDArray[Any], stamp: int | None) -> Floats | None:
    """Return seconds after the stamp (n,), float32; None if the values cannot mean that."""
    unit = 1e-9 if values.dtype.kind in "iu" else 1.0
    candidates: list[npt.NDArray[Any]] = [values.astype(np.float64) * unit]
    if stamp is not None and values.dtype.kind in "iu":
        candidates.append((values.astype(np.int64) - stamp) * unit)
    elif stamp is not None and values.dtype == np.float64:
        candidates.append(values - stamp * 1e-9)
    for seconds in candidates:
        if not np.any(np.abs(seconds) > LONGEST):  # NaN passes: such points are dropped later
            return seconds.astype(np.float32)
    return None


def clean(scan: Scan, *, min_range: float = 0.0, max_range: float | None = None) -> tuple[Scan, Dropped]:
    """Leave out points that are not finite, lie at the origin (no return), or out of a range in metres."""
    points = scan.points.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        squared = np.einsum("ij,ij->i", points, points)
    finite = np.isfinite(points).all(axis=1)
    if scan.time_offset is not None:
        finite &= np.isfinite(scan.time_offset)
    near = finite & (squared > 0.0) & (squared >= min_range**2)
    if max_range is not None:
        near &= squared <= max_range**2
    dropped = Dropped(int(np.sum(~finite)), int(np.sum(finite & ~near)))
    if near.all():
        return scan, dropped
    ring = None if scan.ring is None else scan.ring[near]
    time_offset = None if scan.time_offset is None else scan.time_offset[near]
    return Scan(scan.points[near], ring, time_offset, scan.remark), dropped


def rings_fall(scan: Scan) -> bool | None:
    """Say whether ring 0 is the highest beam; None if the scan is too small to tell."""
    if scan.ring is None or len(scan.points) < ENOUGH or scan.ring.min() == scan.ring.max():
        return None
    x, y, z = scan.points.T.astype(np.float64)
    elevation = np.arctan2(z, np.hypot(x, y))
    ring = scan.ring.astype(np.float64)
    return bool(np.sum((ring - ring.mean()) * (elevation - elevation.mean())) < 0.0)


def turned(scan: Scan, beams: int) -> Scan:
    """Number the rings from the other end, of so many beams."""
    if scan.ring is None:
        return scan
    return scan._replace(ring=(beams - 1 - scan.ring.astype(np.int64)).astype(np.uint8))
