"""The two stages of `retracer annotate` that work on one session each; what they made is found again by its key."""

from __future__ import annotations

import functools
import json
import time
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graph.check import require
from graph.codec import digest
from graph.errors import UserError
from graph.geometry import inverse
from graph.graphfile import Clock, Graph, OperatorEntry
from graph.inprocess import launch_in_process
from graph.recording import Recording
from operators.annotation.acceptance import Acceptance, accept
from operators.annotation.alignment import align_session
from operators.annotation.buffer import Classing, classify, new_points, trace_new
from operators.annotation.files import save_buffer, shared_map
from operators.annotation.refinement import Refinement, seen_through, trace_map, walls_of
from operators.annotation.session import Floats
from operators.pointmap import MapPoints, Settings, VoxelMap, load_map
from operators.pointray import RaySettings
from operators.recorded_session import Known, RecordedSession, load_poses, save_poses

VERSION = 2  # of what the stages leave behind; another one makes everything anew
ANNOTATOR = "annotator"  # the operator of a labelled recording
LEAST_POSES = 0.9  # share of the frames that must have a pose


class Job(NamedTuple):
    """What all sessions of a batch share."""

    sessions: tuple[Path, ...]
    map: Path  # the initial one, then the refined one
    map_digest: str
    output: Path
    every: int
    frames: str | None  # topic
    poses: str | None  # topic
    align: bool
    acceptance: Acceptance
    refinement: Refinement
    classing: Classing
    resolution: float  # of the lidar, radians between two beams
    width: float  # of the frustums, radians

    @property
    def work(self) -> Path:
        """Return the folder of what the stages leave for the next run."""
        return self.output / "work"

    @property
    def buffers(self) -> Path:
        """Return the folder of the buffers."""
        return self.output / "buffers"

    @property
    def rays(self) -> RaySettings:
        """Return the settings of the tracing."""
        return RaySettings(height=self.resolution, width=self.width)

    @property
    def mapping(self) -> Settings:
        """Return the settings of the buffers."""
        return Settings(vertical_resolution=self.resolution)

    def refined(self, path: Path, map_digest: str) -> Job:
        """Return the job with the refined map."""
        return self._replace(map=path, map_digest=map_digest)


class Examined(NamedTuple):
    """What the first stage says of a session."""

    name: str
    accepted: bool
    reasons: tuple[str, ...]
    evidence: dict[str, Any]
    key: str


def session_key(job: Job, path: Path) -> str:
    """Say what a session is, and what the first stage does to it, in one word."""
    recording = Recording(path)
    known = (VERSION, recording.metadata, path.stat().st_size, job.frames, job.poses, job.align)
    return digest(
        repr((*known, job.acceptance, job.refinement, job.resolution, job.width, job.map_digest)).encode()
    ).hex()


def open_session(job: Job, path: Path, tell: Any) -> RecordedSession:
    """Open a session with the poses that the robot had, or with those of an alignment where it had none."""
    aligned = job.work / f"{path.stem}.poses.npz"
    known = load_poses(aligned) if aligned.exists() else None
    return RecordedSession(path, frames=job.frames, poses=job.poses, known=known, progress=tell)


def examine(job: Job, path: Path, tell: Any) -> Examined:
    """Accept a session or not; if so, trace the map with it and keep the movable probabilities of the map's points."""
    key = session_key(job, path)
    verdict_file = job.work / f"{path.stem}.examined.json"
    if (known := read_json(verdict_file)) is not None and known["key"] == key:
        examined = Examined(known["name"], known["accepted"], tuple(known["reasons"]), known["evidence"], key)
        if not examined.accepted or readable(traces(job, examined)):
            return examined
    for left in (verdict_file, job.work / f"{path.stem}.poses.npz"):
        left.unlink(missing_ok=True)
    begin = time.perf_counter()
    session = open_session(job, path, tell)
    cloud, voxels = shared_cloud(job.map, job.map_digest)
    if job.align or not session.located:
        aligned, _ = align_session(session, cloud, job.mapping)
        keep_poses(job, path, session, aligned.scans)
        session = open_session(job, path, tell)
    verdict = accept(session, voxels, targets=session.targets, settings=job.acceptance)
    reasons = verdict.reasons
    if session.without_pose > (1.0 - LEAST_POSES) * max(1, len(session)):
        reasons = (f"{session.without_pose} of its {len(session)} frames have no pose", *reasons)
    evidence: dict[str, Any] = {**verdict.evidence._asdict(), "without_pose": session.without_pose}
    examined = Examined(session.name, not reasons, reasons, evidence, key)
    if examined.accepted:
        movable, looks = trace_map(voxels, session, job.rays)
        walls = shared_walls(job.map, job.map_digest, job.refinement)
        through = seen_through(walls, movable, looks, job.refinement, least_looks=job.rays.least_looks)
        evidence["walls_seen_through"] = round(through, 5)
        if through > job.acceptance.most_seen_through:
            most = 100 * job.acceptance.most_seen_through
            reason = (
                f"it looks through {100 * through:.1f} % of the long walls, so its poses are off; {most:g} % may be"
            )
            examined = examined._replace(accepted=False, reasons=(reason,))
        else:
            save_arrays(traces(job, examined), movable=movable, looks=looks)
    evidence["seconds_examined"] = round(time.perf_counter() - begin, 2)
    write_json(verdict_file, examined._asdict())
    return examined


@functools.lru_cache(maxsize=1)
def shared_walls(path: Path, map_digest: str, refinement: Refinement) -> npt.NDArray[np.bool_]:
    """Return which points (n,) of the map belong to long walls; found once in each process."""
    return walls_of(shared_cloud(path, map_digest)[0], refinement)


@functools.lru_cache(maxsize=1)
def shared_cloud(path: Path, _digest: str) -> tuple[MapPoints, VoxelMap]:
    """Load the initial map once for all sessions that this process examines. Point n of one is point n of the other."""
    cloud = load_map(path)
    voxels = VoxelMap()
    if voxels.insert(cloud.points, cloud.normals, cloud.scores, -1) != len(cloud.points):
        cloud = voxels.cloud()
    return cloud, voxels


def keep_poses(job: Job, path: Path, session: RecordedSession, scans: list[Any]) -> None:
    """Write the poses of an alignment, for all who read the session later."""
    known = {}
    for stamp, (world_from_lidar, valid, inliers) in zip(session.stamps, scans, strict=True):
        known[stamp] = Known(world_from_lidar @ inverse(session.base_from_lidar), valid, inliers)
    save_poses(job.work / f"{path.stem}.poses.npz", known)


def traces(job: Job, examined: Examined) -> Path:
    """Return where the first stage keeps what it traced."""
    return job.work / f"{examined.name}.traces.npz"


def probabilities(job: Job, examined: Examined, points: int) -> Floats:
    """Return the movable probabilities (n,) that a session gave to the points of the map."""
    with np.load(traces(job, examined)) as file:
        movable: Floats = file["movable"]
    if len(movable) != points:
        raise UserError(f"{traces(job, examined)} is of another map; remove the folder {job.work}")
    return movable


def label(job: Job, path: Path, tell: Any) -> dict[str, Any]:
    """Make the buffer of an accepted session and its labelled frames. Returns what is known about them."""
    key = digest(repr((session_key(job, path), job.every, job.classing)).encode()).hex()
    record = job.output / f"{path.stem}.labelled.mcap"
    buffer = job.buffers / f"{path.stem}.ply"
    told_file = job.work / f"{path.stem}.labelled.json"
    finished = read_json(told_file)
    if finished is not None and finished["key"] == key and record.exists() and buffer.exists():
        return finished
    for left in (told_file, record, buffer, buffer.with_suffix(".npy")):
        left.unlink(missing_ok=True)
    begin = time.perf_counter()
    session = open_session(job, path, tell)
    known = shared_map(job.map, job.classing)
    new = new_points(known.voxels, session, job.mapping, job.classing.apart)
    movable = trace_new(new, session, job.rays)
    save_buffer(buffer, classify(known, new.cloud(movable=movable), job.classing))
    write_frames(job, path, buffer, record)
    summary = Recording(record).summaries()[ANNOTATOR]
    told = {
        "key": key,
        "name": session.name,
        "labelled": str(record),
        "buffer": str(buffer),
        "tally": summary,
        "seconds": round(time.perf_counter() - begin, 2),
    }
    write_json(told_file, told)
    return told


def write_frames(job: Job, path: Path, buffer: Path, record: Path) -> None:
    """Write the labelled frames of a session as a recording; it appears whole or not at all."""
    partial = record.with_name(f"{path.stem}.partial.mcap")
    partial.unlink(missing_ok=True)
    config: dict[str, Any] = {"session": str(path), "map": str(job.map), "buffer": str(buffer), "every": job.every}
    config["apart"] = job.classing.apart
    if job.frames is not None:
        config["frames"] = job.frames
    if (aligned := job.work / f"{path.stem}.poses.npz").exists():
        config["poses"] = str(aligned)
    entry = OperatorEntry(run="operators.labelled_session:LabelledSession", config=config)
    graph = Graph(clock=Clock(end=ANNOTATOR), operators={ANNOTATOR: entry}, name="labelled", root=str(Path.cwd()))
    try:
        launch_in_process(require(graph), record=partial)
        partial.replace(record)
    finally:
        partial.unlink(missing_ok=True)


def save_arrays(path: Path, **arrays: Any) -> None:
    """Write arrays; the file appears whole or not at all."""
    partial = path.with_name(f"{path.name}.part")
    try:
        with partial.open("wb") as file:
            np.savez(file, **arrays)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def readable(path: Path) -> bool:
    """Say whether arrays were written whole."""
    return path.exists() and zipfile.is_zipfile(path)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write numbers and words; the file appears whole or not at all."""
    partial = path.with_name(f"{path.name}.part")
    partial.write_text(json.dumps(content) + "\n")
    partial.replace(path)


def read_json(path: Path) -> dict[str, Any] | None:
    """Read what `write_json` wrote; None where there is nothing, or nothing whole."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None
