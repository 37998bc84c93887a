"""A recorded session as the annotation reads it: frames, the poses that the robot had online, its targets.

session = RecordedSession(Path("recordings/run.mcap"))
for scan in session: ...
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graph.codec import CodecError, decode, type_name
from graph.errors import UserError
from graph.geometry import Matrix
from graph.messages import Goal, Odometry, PointCloud, Pose
from graph.recording import Recording
from operators.annotation.session import Scan
from operators.pointmap import Trail

PREFERRED: dict[type[Any], tuple[str, ...]] = {  # of several topics of one type
    PointCloud: ("simulator/frame", "sensor/frame"),
    Pose: ("localizer/pose",),
    Odometry: ("simulator/odometry", "sensor/odometry"),
    Goal: ("simulator/goal",),
}


class Known(NamedTuple):
    """What a localizer said of one frame."""

    world_from_base: Matrix
    valid: bool
    inliers: float


class RecordedSession:
    """A recording, read anew at each iteration. Frames without a pose of their stamp are not valid.

    Raises UserError for a file that is no recording, or has no point clouds.
    """

    def __init__(
        self,
        path: Path,
        *,
        frames: str | None = None,
        poses: str | None = None,
        known: dict[int, Known] | None = None,
        progress: Callable[[float], None] = lambda share: None,
    ) -> None:
        self.path = path
        self.name = path.name.removesuffix(".mcap")
        self.progress = progress
        self.recording = Recording(path)
        topics = {kind: self._topic(kind) for kind in (PointCloud, Pose, Odometry, Goal)}
        self.frame_topic = self._named(frames, PointCloud) or topics[PointCloud]
        self.pose_topic = self._named(poses, Pose) or topics[Pose]
        if self.frame_topic is None:
            raise UserError(f"{path} has no point clouds; it has {', '.join(self.recording.counts) or 'nothing'}")
        self.known: dict[int, Known] = {}  # by the stamp of the frame
        self.odometry: dict[int, Odometry] = {}
        self.targets: npt.NDArray[np.float64] | None = None
        self._read_poses(topics[Odometry], topics[Goal])
        if known is not None:
            self.known = known
        self.base_from_lidar: Matrix = np.eye(4)  # of the last frame read
        self.without_pose = 0  # frames of the last iteration
        self.stamps: list[int] = []  # of the frames of the last iteration
        self.frames = int(self.recording.counts[self.frame_topic])

    def __len__(self) -> int:
        return self.frames

    @property
    def located(self) -> bool:
        """Whether a localizer said where the frames were taken."""
        return bool(self.known)

    def _topic(self, kind: type[Any]) -> str | None:
        found = [
            topic
            for topic, (name, _) in self.recording.types.items()
            if name == type_name(kind) and self.recording.counts.get(topic)
        ]
        preferred = [topic for topic in PREFERRED[kind] if topic in found]
        return next(iter(preferred + sorted(found)), None)

    def _named(self, topic: str | None, kind: type[Any]) -> str | None:
        if topic is not None and self.recording.types.get(topic, ("",))[0] != type_name(kind):
            there = [name for name, (of, _) in self.recording.types.items() if of == type_name(kind)]
            raise UserError(f"{self.path} has no {kind.__name__} {topic}; it has {', '.join(there) or 'none'}")
        return topic

    def _decode(self, payload: bytes, kind: type[Any]) -> Any:
        try:
            return decode(payload, kind)
        except CodecError as error:
            raise UserError(f"{self.path} is of another version of retracer: {error}") from None

    def _read_poses(self, odometry_topic: str | None, goal_topic: str | None) -> None:
        targets: dict[int, npt.NDArray[np.float64]] = {}
        count = 0
        topics = [topic for topic in (self.pose_topic, odometry_topic, goal_topic) if topic is not None]
        for entry in self.recording.messages(*topics) if topics else ():
            if entry.topic == self.pose_topic:
                pose = self._decode(entry.payload, Pose)
                self.known[pose.measured_at] = Known(pose.world_from_base, pose.valid, pose.inliers)
            elif entry.topic == odometry_topic:
                odometry = self._decode(entry.payload, Odometry)
                self.odometry[odometry.measured_at] = odometry
            else:
                goal = self._decode(entry.payload, Goal)
                targets[goal.index], count = goal.target, goal.count
        if targets:
            self.targets = np.full((count, 2), np.nan)
            for index, target in targets.items():
                self.targets[index] = target

    def clouds(self, every: int = 1) -> Iterator[tuple[PointCloud, Scan]]:
        """Iterate over every n-th frame as it was recorded, each with what the annotation makes of it."""
        stamp, self.stamps, self.without_pose = -1, [], 0
        for number, cloud in enumerate(self._ahead(every)):
            self.progress(every * number / self.frames)
            if cloud.measured_at <= stamp:
                continue  # of frames of one stamp the first counts
            stamp = cloud.measured_at
            self.stamps.append(stamp)
            self.base_from_lidar = cloud.base_from_lidar
            self.without_pose += stamp not in self.known
            yield cloud, self._scan(cloud)

    def _ahead(self, every: int) -> Iterator[PointCloud]:
        """Decode one chunk ahead in a thread: unpacking leaves the interpreter free."""
        shelf: queue.Queue[PointCloud | BaseException | None] = queue.Queue(4)
        over = threading.Event()

        def put(item: PointCloud | BaseException | None) -> None:
            while not over.is_set():
                try:
                    shelf.put(item, timeout=0.1)
                    return
                except queue.Full:
                    continue

        def read() -> None:
            try:
                for number, entry in enumerate(self.recording.messages(str(self.frame_topic))):
                    if number % every:
                        continue
                    put(self._decode(entry.payload, PointCloud))
                    if over.is_set():
                        return
                put(None)
            except BaseException as error:
                put(error)

        threading.Thread(target=read, daemon=True).start()
        try:
            while (item := shelf.get()) is not None:
                if isinstance(item, BaseException):
                    raise item
                yield item
        finally:
            over.set()

    def _scan(self, cloud: PointCloud) -> Scan:
        odometry = self.odometry.get(cloud.measured_at)
        points = cloud.points
        if cloud.time_offset is not None and odometry is not None:
            trail = Trail()
            trail.add(cloud.measured_at, odometry.odom_from_base, odometry.linear, odometry.angular)
            points = trail.steady(points, cloud.time_offset, cloud.base_from_lidar)
        known = self.known.get(cloud.measured_at)
        odom_from_base = None if odometry is None else np.array(odometry.odom_from_base)
        if known is None:
            return Scan(points, np.array(cloud.base_from_lidar), False, 0.0, odom_from_base, cloud.base_from_lidar)
        return Scan(
            points,
            known.world_from_base @ cloud.base_from_lidar,
            known.valid,
            known.inliers,
            odom_from_base,
            cloud.base_from_lidar,
        )

    def __iter__(self) -> Iterator[Scan]:
        for _, scan in self.clouds():
            yield scan


def save_poses(path: Path, known: dict[int, Known]) -> None:
    """Write the poses of frames by stamp, for those who align a session once and read it often."""
    stamps = sorted(known)
    poses = np.array([known[stamp].world_from_base for stamp in stamps]).reshape(-1, 4, 4)
    valid = np.array([known[stamp].valid for stamp in stamps], np.bool_)
    inliers = np.array([known[stamp].inliers for stamp in stamps], np.float64)
    partial = path.with_name(f"{path.name}.part")
    with partial.open("wb") as file:
        np.savez(file, stamps=np.array(stamps, np.int64), poses=poses, valid=valid, inliers=inliers)
    partial.replace(path)


def load_poses(path: Path) -> dict[int, Known]:
    """Read what `save_poses` wrote."""
    with np.load(path) as file:
        rows = zip(
            file["stamps"].tolist(), file["poses"], file["valid"].tolist(), file["inliers"].tolist(), strict=True
        )
        return {stamp: Known(pose, valid, inliers) for stamp, pose, valid, inliers in rows}
