"""CARMEN logs, in which the public 2-D benchmarks come: ODOM, FLASER and ROBOTLASER1, plain or compressed."""

from __future__ import annotations

import bz2
import gzip
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from graph.geometry import inverse, planar
from operators.scans.folder import Scans, Sweep
from operators.scans.scan import Scan, ScanError
from operators.scans.stamps import SECOND
from operators.scans.trajectory import Trajectory

SUFFIXES = (".clf", ".log", ".clf.gz", ".log.gz", ".clf.bz2", ".log.bz2")
HEIGHT = 0.3  # metres above the floor at which the laser is taken to be, as logs do not say it
MAX_RANGE = 30.0  # metres from which on a reading of a FLASER record means that nothing was met; no log says it
FIELDS = {181: 1.0, 180: 1.0, 361: 0.5, 360: 0.5, 401: 0.25}  # readings: degrees between them, as CARMEN guesses


class Reading(NamedTuple):
    """One scan of the front laser."""

    line: int
    stamp: int  # ns, of the measurement
    ranges: tuple[float, ...]
    start: float  # bearing of the first range, radians
    step: float
    farthest: float  # metres
    laser: tuple[float, float, float]  # x, y, heading in the world: corrected in a corrected log
    robot: tuple[float, float, float]


class _Words:
    """The words of a line, taken one after the other. Raises ScanError with the line."""

    def __init__(self, path: Path, line: int, words: list[str]) -> None:
        self.path, self.line, self.words, self.at = path, line, words, 1

    def number(self, what: str) -> float:
        if self.at >= len(self.words):
            raise self.error(f"it ends where {what} should be")
        word = self.words[self.at]
        self.at += 1
        try:
            value = float(word)
        except ValueError:
            raise self.error(f"{word!r} is no number; {what} should be there") from None
        if math.isinf(value) or math.isnan(value):
            raise self.error(f"{what} is {word}, not a finite number")
        return value

    def numbers(self, count: int, what: str) -> tuple[float, ...]:
        return tuple(self.number(what) for _ in range(count))

    def pose(self, what: str) -> tuple[float, float, float]:
        x, y, heading = self.numbers(3, what)
        return x, y, heading

    def count(self, what: str) -> int:
        value = self.number(what)
        if value != int(value) or not 0 <= value <= 100_000:
            raise self.error(f"{what} is {value:g}")
        return int(value)

    def ranges(self, what: str) -> tuple[float, ...]:
        """Take a count and so many readings; inf and NaN among them mean that nothing was met."""
        count = self.count(f"the number of {what}s")
        found = []
        for word in self.words[self.at : self.at + count]:
            try:
                found.append(float(word))
            except ValueError:
                raise self.error(f"{word!r} is no number; {what} {len(found) + 1} of {count} should be there") from None
        self.at += count
        if len(found) < count:
            raise self.error(f"it has {len(found)} of {count} {what}s")
        return tuple(found)

    def stamp(self) -> int:
        """Take the stamp of the measurement, the host and the stamp of the logger. Returns the first, ns."""
        seconds = self.number("the stamp")
        if len(self.words) - self.at != 2:
            raise self.error(f"{len(self.words) - self.at} words follow the stamp; host and logger's stamp should")
        return round(seconds * SECOND)

    def error(self, text: str) -> ScanError:
        return ScanError(f"{self.path} line {self.line}: {self.words[0]}: {text}")


def is_log(path: Path) -> bool:
    """Say whether a file is a CARMEN log by its name."""
    return path.name.lower().endswith(SUFFIXES)


def open_log(path: Path) -> IO[str]:
    """Open a log as text, whether compressed or not."""
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="latin-1")
    if path.suffix == ".bz2":
        return bz2.open(path, "rt", encoding="latin-1")
    return path.open(encoding="latin-1")


def read_readings(path: Path) -> list[Reading]:
    """Read the scans of the front laser, in the order of their stamps. Raises ScanError with the line at fault."""
    found = list(_readings(path))
    if not found:
        raise ScanError(f"{path} holds no scans: no line begins with FLASER or ROBOTLASER1")
    return sorted(found, key=lambda reading: reading.stamp)  # stable; loggers write late what came late


def _readings(path: Path) -> Iterator[Reading]:
    number = 0
    try:
        with open_log(path) as stream:
            for number, line in enumerate(stream, 1):
                words = line.split()
                if not words or words[0] not in ("FLASER", "ROBOTLASER1", "ODOM"):
                    continue
                taken = _Words(path, number, words)
                if words[0] == "FLASER":
                    yield _flaser(taken)
                elif words[0] == "ROBOTLASER1":
                    yield _robotlaser(taken)
                else:  # the scans carry it; still, a broken line says that the log is broken
                    taken.numbers(6, "x, y, heading and velocities")
                    taken.stamp()
    except (EOFError, OSError) as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise ScanError(f"{path} cannot be unpacked after line {number}: {error}") from None


def _flaser(words: _Words) -> Reading:
    ranges = words.ranges("reading")
    laser, robot = words.pose("the pose of the laser"), words.pose("the pose of the robot")
    step = math.radians(FIELDS.get(len(ranges), 180.0 / max(1, len(ranges) - 1)))
    return Reading(words.line, words.stamp(), ranges, -math.pi / 2, step, MAX_RANGE, laser, robot)


def _robotlaser(words: _Words) -> Reading:
    words.number("the type of the laser")
    start, _, step, farthest = words.numbers(4, "start angle, field of view, resolution and maximum range")
    words.numbers(2, "accuracy and remission mode")
    ranges = words.ranges("reading")
    words.ranges("remission")
    laser, robot = words.pose("the pose of the laser"), words.pose("the pose of the robot")
    words.numbers(5, "velocities, safety distances and turn axis")
    return Reading(words.line, words.stamp(), ranges, start, step, farthest or MAX_RANGE, laser, robot)


def log_trajectory(path: Path) -> Trajectory:
    """Return where the scans of a log were taken, world_from_laser, at their stamps; of a corrected log the truth."""
    kept = _distinct(read_readings(path))
    poses = np.array([planar(*reading.laser) for reading in kept])
    return Trajectory(poses, np.array([reading.stamp for reading in kept], np.int64))


def _distinct(readings: list[Reading]) -> list[Reading]:
    return [reading for place, reading in enumerate(readings) if not place or reading.stamp > readings[place - 1].stamp]


class CarmenScans(Scans):
    """The scans of a log's front laser with the odometry that each carries; of scans of one stamp the first."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        everything = read_readings(path)
        self.readings = _distinct(everything)
        stamps = np.array([reading.stamp for reading in self.readings], np.int64)
        self.sweeps = [Sweep(f"line {reading.line}", reading.stamp) for reading in self.readings]
        self.odometry = Trajectory(np.array([planar(*reading.robot) for reading in self.readings]), stamps)
        first = self.readings[0]
        self.base_from_lidar = inverse(planar(*first.robot)) @ planar(*first.laser)
        self.base_from_lidar[2, 3] = HEIGHT
        self.remarks = (f"stamps count from {first.stamp / SECOND:.6f} s of the log's clock",)
        if dropped := len(everything) - len(self.readings):
            self.remarks += (f"{dropped} scans were dropped, as another has their stamp",)

    def read(self, wanted: Sequence[int]) -> Iterator[Scan]:
        """Yield the scans at some places in `sweeps`, as points in the plane of the laser."""
        for place in wanted:
            reading = self.readings[place]
            ranges = np.array(reading.ranges)
            bearings = reading.start + reading.step * np.arange(len(ranges))
            met = (ranges > 0.0) & (ranges < reading.farthest)  # NaN is neither
            points = np.stack([np.cos(bearings), np.sin(bearings), np.zeros(len(ranges))], axis=1) * ranges[:, None]
            yield Scan(points[met].astype(np.float32))
