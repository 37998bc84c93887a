"""How long the annotation of 1,000 frames takes, step by step, and how much memory it needs.

python -m benchmarks.annotation

Times are CPU times of one core, frames in memory; `retracer annotate --workers 2` shares the sessions among two. A
session is read twice from the disk and written once besides, 5 ms a frame.
"""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.pointmap import drive, row, whole_map
from operators.annotation.acceptance import gather_evidence
from operators.annotation.buffer import Classing, classify, known_map, new_points, trace_new
from operators.annotation.first_map import without_doubles
from operators.annotation.growing import GrowingBuffer
from operators.annotation.projection import Projector
from operators.annotation.refinement import refine, trace_map
from operators.annotation.session import Scan
from operators.pointmap import MapPoints, VoxelMap
from operators.pointray import RaySettings

FRAMES = 300  # measured; the table says seconds for 1,000
WARM_UP = 3


class Kept:
    """A session in memory."""

    name = "bench"

    def __init__(self, scans: list[Scan]) -> None:
        self.scans = scans

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self.scans)


class Watch:
    """CPU seconds of one step after the other."""

    def __init__(self) -> None:
        self.last = time.process_time()

    def lap(self, frames: int = FRAMES) -> float:
        """Return the seconds since the last lap, for 1,000 frames."""
        now = time.process_time()
        spent, self.last = now - self.last, now
        return 1000.0 * spent / frames


def annotate(initial: MapPoints, session: Kept) -> dict[str, float]:
    """Take all steps; returns the seconds of each for 1,000 frames, and of those that do not depend on their number."""
    rays, seconds = RaySettings(), {}
    watch = Watch()
    voxels = VoxelMap()
    voxels.insert(initial.points, initial.normals, initial.scores, -1)
    fixed = watch.lap(1000)
    gather_evidence(session, voxels)
    seconds["acceptance"] = watch.lap()
    movable, _ = trace_map(voxels, session, rays)
    seconds["tracing the map"] = watch.lap()
    refined, _ = refine(voxels.cloud(), [movable])
    known = known_map(refined)
    fixed += watch.lap(1000)
    new = new_points(known.voxels, session)
    seconds["buffer"] = watch.lap()
    buffer = classify(known, new.cloud(movable=trace_new(new, session, rays)), Classing())
    seconds["tracing the buffer, classes"] = watch.lap()
    projector = Projector(buffer)
    for scan in session:
        projector.project(scan)
    seconds["projection on every frame"] = watch.lap()
    seconds["once a batch"] = fixed
    return seconds


def live(initial: MapPoints, session: Kept) -> float:
    """Return the median core-milliseconds a frame of the annotator operator's work."""
    buffer = GrowingBuffer(initial, RaySettings())
    spent = []
    for number, scan in enumerate(session):
        begin = time.process_time()
        buffer.add(scan, known_too=number % 10 == 0)
        spent.append(1e3 * (time.process_time() - begin))
    return float(np.mean(spent[WARM_UP:]))


def rows() -> list[dict[str, Any]]:
    """Measure a drive through the whole building's map."""
    cloud = whole_map(seed=101)
    initial = cloud.kept(without_doubles(cloud, 0.03))
    record = drive("A", seed=21, count=FRAMES)
    scans = [
        Scan(points, pose @ record.base_from_lidar)
        for points, pose in zip(record.frames, record.world_from_base, strict=True)
    ]
    annotate(initial, Kept(scans[:WARM_UP]))  # compiles
    seconds = annotate(initial, Kept(scans))
    size = f"map of {len(initial.points) / 1e6:.1f} M points"
    found = [row(f"annotation of 1,000 frames, {step}", value, "s") for step, value in seconds.items()]
    found.append(row(f"annotation of 1,000 frames, all steps, one core, {size}", sum(seconds.values()), "s"))
    found.append(row("annotator operator, mean", live(initial, Kept(scans)), "ms"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    held = sum(scan.points.nbytes for scan in scans) / 2**30
    found.append(row(f"annotation, peak memory, {size}", peak - held, "GiB"))
    return found


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
