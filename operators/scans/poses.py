"""Pose files: TUM, KITTI and CSV of 4x4 matrices."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from graph.geometry import Matrix
from operators.scans.scan import ScanError
from operators.scans.stamps import nanoseconds
from operators.scans.trajectory import Trajectory, pose_of, rotation_of

Format = Literal["auto", "tum", "kitti", "csv"]

WIDTHS: dict[str, tuple[int, ...]] = {"tum": (8,), "kitti": (12,), "csv": (16, 17)}
MEANINGS = "8 (TUM: t x y z qx qy qz qw), 12 (KITTI: 3x4), 16 (4x4) or 17 (stamp and 4x4)"
LARGEST_SECOND = 1e11  # a TUM stamp above is no number of seconds


class Row(NamedTuple):
    """The words of one line of a text file, and which line it is."""

    number: int
    words: list[str]


def read_poses(path: Path, form: Format = "auto", *, drop_duplicates: bool = False) -> Trajectory:
    """Read a pose file; `auto` tells the format by the number of columns. Commas and blanks part; # begins a comment.

    TUM: seconds, x y z, qx qy qz qw. KITTI: the first three rows of 4x4. CSV: the rows of 4x4, a stamp before them if
    there are 17 numbers; the first line may be a heading. drop_duplicates: of poses with one stamp keep the first.
    Raises ScanError with the line.
    """
    rows = list(_rows(path))
    if rows and form in ("auto", "csv") and not _numeric(rows[0].words):
        del rows[0]
    if not rows:
        raise ScanError(f"{path} holds no poses")
    widths = WIDTHS.get(form, tuple(width for known in WIDTHS.values() for width in known))
    if (width := len(rows[0].words)) not in widths:
        wanted = MEANINGS if form == "auto" else f"{' or '.join(map(str, widths))} for {form}"
        raise ScanError(f"{path} line {rows[0].number}: poses have {wanted} numbers a line; this one has {width}")
    poses, stamps = [], []
    for number, words in rows:
        if len(words) != width:
            raise ScanError(f"{path} line {number}: it has {len(words)} numbers; the lines before have {width}")
        try:
            poses.append(_pose(words))
            stamps += [_stamp(words)] if width in (8, 17) else []
        except ValueError as error:
            raise ScanError(f"{path} line {number}: {error}") from None
    if not stamps:
        return Trajectory(np.array(poses))
    kept: list[int] = []
    for place, ((number, words), stamp) in enumerate(zip(rows, stamps, strict=True)):
        if kept and stamp < stamps[kept[-1]]:
            raise ScanError(f"{path} line {number}: the stamp {words[0]} is before that of the line above")
        if not kept or stamp > stamps[kept[-1]]:
            kept.append(place)
        elif not drop_duplicates:
            first = rows[kept[-1]].number
            raise ScanError(
                f"{path} line {number}: the stamp {words[0]} is also that of line {first}; "
                "--drop-duplicates keeps the first"
            )
    return Trajectory(np.array(poses)[kept], np.array(stamps, np.int64)[kept])


def read_calibration(path: Path) -> Matrix:
    """Read camera_from_lidar (4, 4) of a KITTI calib.txt: its line `Tr:` of 12 numbers. Raises ScanError."""
    for row in _rows(path):
        if row.words[0].rstrip(":") in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
            try:
                if len(row.words) != 13:
                    raise ValueError(f"Tr wants 12 numbers; there are {len(row.words) - 1}")
                values = np.array([_number(word) for word in row.words[1:]]).reshape(3, 4)
                return pose_of(values[:, :3], values[:, 3])
            except ValueError as error:
                raise ScanError(f"{path} line {row.number}: {error}") from None
    raise ScanError(f"{path} has no line 'Tr:' that places the lidar in the camera's frame")


def _rows(path: Path) -> Iterator[Row]:
    for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), 1):
        if words := line.partition("#")[0].replace(",", " ").replace(";", " ").split():
            yield Row(number, words)


def _numeric(words: list[str]) -> bool:
    try:
        _ = [float(word) for word in words]
    except ValueError:
        return False
    return True


def _stamp(words: list[str]) -> int:
    if len(words) == 8 and abs(float(words[0])) >= LARGEST_SECOND:
        raise ValueError(f"TUM stamps are seconds; {words[0]} is not (EuRoC, in ns and with qw first, is no TUM)")
    return nanoseconds(words[0])


def _pose(words: list[str]) -> Matrix:
    values = np.array([_number(word) for word in words])
    if len(words) == 8:
        return pose_of(rotation_of(values[4:]), values[1:4])
    matrix = np.eye(4)
    matrix.reshape(-1)[: min(len(words), 16)] = values[-16:]
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise ValueError("the last row of a 4x4 pose is 0 0 0 1; a matrix is written row by row")
    return pose_of(matrix[:3, :3], matrix[:3, 3])


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{word!r} is no number") from None
