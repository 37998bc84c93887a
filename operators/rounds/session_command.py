"""Sessions: launched as processes of their own, and read back from their recordings."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graph.codec import decode
from graph.errors import UserError
from graph.geometry import yaw
from graph.lifeline import BOUND
from graph.messages import Odometry, PointCloud, Pose, Truth
from graph.recording import Recording
from operators.rounds.schedule import Session
from operators.rounds.tally import Track, driven_into, errors

ENCOUNTER = 10  # periods without touch after which a contact counts as a new one
KEPT = ("targets", "reached", "skipped", "driven_m", "time_s", "collisions_with_people", "collisions_with_things")
PICTURE = "picture.npz"


def verb(arguments: Sequence[str | Path], log: Path, *, threads: int = 1) -> str:
    """Run a verb of retracer as a process; return what it printed. Raises UserError with its last lines if it fails."""
    environment = {**os.environ, **dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), str(threads))}
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as errors_file:
        done = subprocess.run(
            [sys.executable, "-m", "graph.cli", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=errors_file,
            text=True,
            env={**environment, BOUND: "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            check=False,
        )
    if done.returncode != 0:
        last = log.read_text(errors="replace").strip().splitlines()[-5:]
        raise UserError(f"retracer {arguments[0]} failed ({log}): {' / '.join(last) or 'it said nothing'}")
    return done.stdout


def launch(graph: Path, recording: Path) -> dict[str, Any]:
    """Launch a graph file and return its outcome; what a launch that was killed left behind makes room."""
    recording.unlink(missing_ok=True)
    shutil.rmtree(recording.with_suffix(".shards"), ignore_errors=True)
    arguments: list[str | Path] = ["launch", graph, "--record", recording, "--quiet", "--json"]
    outcome: dict[str, Any] = json.loads(verb(arguments, recording.with_suffix(".log")))
    return outcome


def planar_of(pose: npt.NDArray[Any]) -> tuple[float, float, float]:
    """Return x, y and yaw of a pose."""
    return float(pose[0, 3]), float(pose[1, 3]), yaw(pose)


def read_track(path: Path) -> tuple[Track, str]:
    """Read where the robot was, where it believed to be, and whom it touched; and a digest of its beliefs."""
    believed: dict[int, Pose] = {}
    true: dict[int, tuple[float, float, float]] = {}
    truths: list[Truth] = []
    said = hashlib.sha256()
    for entry in Recording(path).messages("localizer/pose", "simulator/odometry", "simulator/truth"):
        if entry.operator == "localizer":
            pose = decode(entry.payload, Pose)
            believed[pose.measured_at] = pose
            said.update(entry.payload)
        elif entry.port == "odometry":
            odometry = decode(entry.payload, Odometry)
            if odometry.true_world_from_base is not None:
                true[odometry.measured_at] = planar_of(odometry.true_world_from_base)
        else:
            truths.append(decode(entry.payload, Truth))
    stamps = sorted(believed.keys() & true.keys())
    if not stamps:
        raise UserError(f"{path} holds no pose of the localizer beside a true one")
    steps = {stamp: index for index, stamp in enumerate(stamps)}
    touched, people = touches(truths, steps)
    return Track(
        true=np.array([true[stamp] for stamp in stamps]),
        believed=np.array([planar_of(believed[stamp].world_from_base) for stamp in stamps]),
        valid=np.array([believed[stamp].valid for stamp in stamps]),
        touched=touched,
        people=people,
    ), said.hexdigest()


def touches(
    truths: Sequence[Truth], steps: dict[int, int]
) -> tuple[list[tuple[int, int]], list[npt.NDArray[np.float64]]]:
    """Return when contact with a person began and with whom, and where that person was."""
    last: dict[int, int] = {}
    found, places = [], []
    for index, truth in enumerate(truths):
        rows = {int(instance): row for row, instance in enumerate(truth.people_instance)}
        for instance in truth.contacts.tolist():
            if instance in rows:
                if index - last.get(instance, -ENCOUNTER - 1) > ENCOUNTER and truth.measured_at in steps:
                    found.append((steps[truth.measured_at], rows[instance]))
                    places.append(truth.people[rows[instance], :2].astype(np.float64))
                last[instance] = index
    return found, places


def record_of(session: Session, outcome: dict[str, Any], recording: Path) -> dict[str, Any]:
    """Return all that the report wants to know of a session."""
    track, digest = read_track(recording)
    away = errors(track)
    return {
        **session._asdict(),
        "name": session.name,
        **{name: outcome.get(name) for name in KEPT},
        "ending": next((name for name, value in outcome.get("ending", {}).items() if value), "?"),
        "driven_into_people": driven_into(track),
        "invalid_poses": int((~track.valid).sum()),
        "wall_seconds": outcome["wall_seconds"],
        "latency_ms": {
            name: {key: state[key] for key in ("p50_ms", "p95_ms") if key in state}
            for name, state in outcome.get("operators", {}).items()
        },
        "errors_mm": np.round(1000.0 * away, 1).tolist(),
        "path": np.round(track.true[::5, :2], 2).tolist(),
        "poses_sha256": digest,
        "recording_bytes": recording.stat().st_size,
    }


def keep_picture(recording: Path, target: Path) -> None:
    """Keep the frame of a recording that shows most people who walk near the robot, whole and with its truth."""
    best: PointCloud | None = None
    most = -1
    for number, entry in enumerate(Recording(recording).messages("simulator/frame")):
        if number % 20:
            continue
        cloud = decode(entry.payload, PointCloud)
        if cloud.truth is None:
            continue
        near = np.hypot(cloud.points[:, 0], cloud.points[:, 1]) < 6.0
        found = int(((cloud.truth == 6) & near).sum()) + 1
        if found > most:
            most, best = found, cloud
    if best is not None:
        assert best.truth is not None
        rings = best.ring if best.ring is not None else np.zeros(0, np.uint8)
        np.savez(target, points=best.points, truth=best.truth, ring=rings, base_from_lidar=best.base_from_lidar)


def bytes_in(folder: Path) -> int:
    """Add up the files below a folder, in bytes, while sessions still write there and delete."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                total += Path(place, name).stat().st_size
    return total


def read_json(path: Path) -> Any:
    """Read what was written whole; None where there is nothing yet."""
    return json.loads(path.read_text()) if path.exists() else None


def write_json(path: Path, record: Any) -> None:
    """Write whole or not at all."""
    partial = path.with_name(f"{path.name}.part")
    partial.write_text(json.dumps(record, indent=1) + "\n")
    partial.replace(path)
