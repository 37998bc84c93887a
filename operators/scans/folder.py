"""Where scans come from: the interface of all sources, and folders of scan files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from graph.geometry import Matrix
from operators.scans.files import READERS, read_scan
from operators.scans.scan import Scan, ScanError
from operators.scans.stamps import read_stamps, stamps_of_names
from operators.scans.trajectory import Trajectory


class Sweep(NamedTuple):
    """A scan that can be read: what sentences call it, and its stamp in ns of whatever clock, if it has one."""

    name: str
    stamp: int | None = None


class Scans:
    """Scans in the order in which they were taken. What a source does not know itself is None."""

    name: str
    sweeps: list[Sweep]
    odometry: Trajectory | None = None  # odom_from_base
    base_from_lidar: Matrix | None = None
    remarks: tuple[str, ...] = ()  # what a person should know

    def read(self, wanted: Sequence[int]) -> Iterator[Scan]:
        """Yield the scans at some places in `sweeps`, in ascending order. Raises ScanError, OSError."""
        raise NotImplementedError


class FolderScans(Scans):
    """The scan files of one folder in natural order of their names, or of the stamps in their names.

    stamps: a file of one stamp a line, in the order of the files. named: whether stamps in file names count.
    Raises ScanError if there are no scans, scans of several kinds, or not one stamp a scan.
    """

    def __init__(self, folder: Path, pattern: str = "*", *, stamps: Path | None = None, named: bool = True) -> None:
        self.name = str(folder)
        self.files = scan_files(folder, pattern)
        known: Sequence[int | None] | None = None
        if stamps is not None:
            known = read_stamps(stamps)
            if len(known) != len(self.files):
                raise ScanError(f"{stamps} has {len(known)} stamps for the {len(self.files)} scans of {folder}")
        elif named and (known := stamps_of_names([file.stem for file in self.files])) is not None:
            order = sorted(range(len(known)), key=known.__getitem__)  # stable: equal stamps stay in the order of names
            self.files, known = [self.files[place] for place in order], [known[place] for place in order]
        known = known or [None] * len(self.files)
        self.sweeps = [Sweep(file.name, stamp) for file, stamp in zip(self.files, known, strict=True)]

    def read(self, wanted: Sequence[int]) -> Iterator[Scan]:
        """Yield the scans at some places in `sweeps`."""
        for place in wanted:
            yield read_scan(self.files[place], stamp=self.sweeps[place].stamp)


def scan_files(folder: Path, pattern: str = "*") -> list[Path]:
    """List the scan files of a folder whose names match a pattern, in natural order.

    Raises ScanError if there are none (and says where there are some), or files of several kinds.
    """
    files = _scans_in(folder, pattern)
    if not files:
        more = [f"{count} in {place}" for place in _folders(folder) if (count := len(_scans_in(place, pattern)))]
        others = f"; there are {', '.join(more)}" if more else ""
        matching = "" if pattern == "*" else f" that match {pattern!r}"
        raise ScanError(f"{folder} holds no scans{matching}: no {', '.join(READERS)} files{others}")
    if len(kinds := sorted({file.suffix.lower() for file in files})) > 1:
        raise ScanError(f"{folder} holds scans of several kinds, {' and '.join(kinds)}; --pattern chooses")
    return files


def _scans_in(folder: Path, pattern: str) -> list[Path]:
    matching = (file for file in folder.glob(pattern) if file.suffix.lower() in READERS and file.is_file())
    return sorted(matching, key=_natural)


def _folders(folder: Path) -> list[Path]:
    return sorted(place for depth in ("*", "*/*") for place in folder.glob(depth) if place.is_dir())


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Return a key that sorts scan2 before scan10."""
    words = re.findall(r"\d+|\D+", path.name)
    return [(0, int(word), word) if word.isdecimal() else (1, 0, word) for word in words]
