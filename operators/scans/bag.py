"""ROS 1 and ROS 2 bags, read by rosbags: clouds, odometry and transforms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from graph.geometry import Matrix
from operators.scans.folder import Scans, Sweep
from operators.scans.scan import Columns, Scan, ScanError, scan_of
from operators.scans.stamps import SECOND
from operators.scans.trajectory import Trajectory, pose_of, rotation_of
from operators.scans.transforms import Tree

CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOM_FRAMES, BASE_FRAMES = ("odom", "map", "world"), ("base_footprint", "base_link")

DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField


def bag_files(place: Path) -> list[Path]:
    """List what makes up the bag at a place, a file or a folder; an empty list if there is none."""
    if place.is_file():
        return [place] if place.suffix.lower() in (".bag", ".mcap", ".db3") else []
    if (place / "metadata.yaml").is_file():
        return [place]
    files = [file for suffix in (".bag", ".mcap", ".db3") for file in sorted(place.glob(f"*{suffix}"))]
    return [file for file in files if file.suffix == files[0].suffix]


class BagScans(Scans):
    """The clouds of one topic of a bag, and its odometry: of a topic, or else of /tf.

    Where the tree of transforms places the lidar on the base, base_from_lidar is that. Raises ScanError, by name and
    with what there is, if the bag cannot be read, has no clouds, or several topics could be meant.
    """

    def __init__(
        self,
        files: Sequence[Path],
        *,
        points_topic: str | None = None,
        odometry_topic: str | None = None,
        odom_frame: str | None = None,
        base_frame: str | None = None,
    ) -> None:
        self.files = list(files)
        self.name = str(files[0] if len(files) == 1 else files[0].parent)
        with self._opened() as bag:
            self.points_topic = _choose(bag, self.name, CLOUD, points_topic, "--points-topic")
            assert self.points_topic is not None
            self.odometry_topic = _choose(bag, self.name, ODOMETRY, odometry_topic, "--odometry-topic")
            self._look(bag)
        remarks = []
        self.base_frame, self.odometry = self._find_odometry(odom_frame, base_frame)
        if self.odometry is None:
            remarks.append(f"{self.name} has neither odometry nor transforms that give it")
        if self.base_frame:
            self.base_from_lidar = self.tree.at(self.base_frame, self.lidar_frame, None)
            if self.base_from_lidar is None:
                remarks.append(f"{self.name} does not say where {self.lidar_frame} is on {self.base_frame}")
        self.remarks = tuple(remarks)

    def _opened(self) -> Any:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise ScanError('bags are read by rosbags: pip install "retracer[ros]"') from None
        try:
            return _Closing(AnyReader(self.files, default_typestore=get_typestore(Stores.LATEST)))
        except Exception as error:  # of rosbags, sqlite, zstd, yaml: whatever a broken file makes of itself
            raise ScanError(f"{self.name} cannot be read as a bag: {_said(error)}") from None

    def _messages(self, bag: Any, topics: Sequence[str | None]) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, log time in ns, message). Raises ScanError where the bag is damaged."""
        count = 0
        connections = [connection for connection in bag.connections if connection.topic in topics]
        if not connections:
            return  # rosbags would take no connections for all
        messages = bag.messages(connections)
        while True:
            try:
                connection, logged, raw = next(messages)
                message = bag.deserialize(raw, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:
                raise ScanError(f"{self.name} is damaged after {count} messages: {_said(error)}") from None
            count += 1
            yield connection.topic, logged, message

    def _look(self, bag: Any) -> None:
        """Read all but the points: stamps of the clouds, odometry, transforms."""
        transforms = [connection.topic for connection in bag.connections if connection.msgtype in TRANSFORMS]
        self.tree = Tree()
        self.sweeps, self.lidar_frame = [], ""
        self.told: dict[int, tuple[Matrix, float, float]] = {}  # odometry by stamp
        self.odometry_frames = ("", "")
        for topic, logged, message in self._messages(bag, [self.points_topic, self.odometry_topic, *transforms]):
            if topic == self.points_topic:
                self.lidar_frame = self.lidar_frame or message.header.frame_id
                self.sweeps.append(Sweep(f"{topic} number {len(self.sweeps)}", _stamp(message.header, logged)))
            elif topic == self.odometry_topic:
                self.odometry_frames = (message.header.frame_id, message.child_frame_id)
                twist = message.twist.twist
                pose = self._pose(message.pose.pose.position, message.pose.pose.orientation, topic)
                self.told.setdefault(_stamp(message.header, logged), (pose, twist.linear.x, twist.angular.z))
            else:
                for item in message.transforms:
                    moved = item.transform
                    pose = self._pose(moved.translation, moved.rotation, topic)
                    stamp = None if topic.endswith("static") else _stamp(item.header, logged)
                    self.tree.add(item.header.frame_id, item.child_frame_id, pose, stamp)
        if not self.sweeps:
            raise ScanError(f"{self.name} has no messages on {self.points_topic}")

    def _pose(self, position: Any, orientation: Any, topic: str) -> Matrix:
        try:
            rotation = rotation_of([orientation.x, orientation.y, orientation.z, orientation.w])
            return pose_of(rotation, [position.x, position.y, position.z])
        except ValueError as error:
            raise ScanError(f"{self.name} holds a pose on {topic} that is none: {error}") from None

    def _find_odometry(self, odom_frame: str | None, base_frame: str | None) -> tuple[str, Trajectory | None]:
        """Return the frame of the base, and odom_from_base: as a topic told it, else as the transforms do."""
        frames = self.tree.frames
        for frame in (odom_frame, base_frame):
            known = [*frames, *(name.lstrip("/") for name in self.odometry_frames)]
            if frame is not None and frame.lstrip("/") not in known:
                raise ScanError(f"{self.name} has no frame {frame!r}; it has {', '.join(frames) or 'none'}")
        base = base_frame or next((frame for frame in BASE_FRAMES if frame in frames), "")
        if self.told:
            child = self.odometry_frames[1]
            stamps = sorted(self.told)
            poses = np.array([self.told[stamp][0] for stamp in stamps])
            velocities = np.array([self.told[stamp][1:] for stamp in stamps])
            told = velocities if velocities.any() else None  # many drivers leave the twist empty
            if base_frame is not None and base_frame.lstrip("/") != child.lstrip("/"):
                if (child_from_base := self.tree.at(child, base_frame, None)) is None:
                    raise ScanError(f"{self.name} does not say where {base_frame} is on {child}")
                poses = poses @ child_from_base
            return base_frame or child or base, Trajectory(poses, np.array(stamps, np.int64), told)
        odom = odom_frame or next((frame for frame in ODOM_FRAMES if frame in frames), "")
        return base, self.tree.trajectory(odom, base) if odom and base else None

    def read(self, wanted: Sequence[int]) -> Iterator[Scan]:
        """Yield the clouds at some places in `sweeps`."""
        chosen = set(wanted)
        with self._opened() as bag:
            for place, (_, _, message) in enumerate(self._messages(bag, [self.points_topic])):
                if place in chosen:
                    name, stamp = self.sweeps[place]
                    yield scan_of(cloud_columns(message, f"{self.name} {name}"), f"{self.name} {name}", stamp=stamp)


class _Closing:
    """Opens a reader for a `with` block, with our sentences for its errors."""

    def __init__(self, reader: Any) -> None:
        self.reader = reader

    def __enter__(self) -> Any:
        try:
            self.reader.open()
        except Exception as error:
            raise ScanError(f"{self.reader.paths[0]} cannot be read as a bag: {_said(error)}") from None
        return self.reader

    def __exit__(self, *_: object) -> None:
        self.reader.close()


def cloud_columns(message: Any, name: str) -> Columns:
    """Take the fields of a PointCloud2 apart that hold one number a point. Raises ScanError if the data are short."""
    count, step = int(message.width) * int(message.height), int(message.point_step)
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.count == 1 and field.datatype in DTYPES]
    kinds = [np.dtype(f"{order}{DTYPES[field.datatype]}") for field in fields]
    if count and not step:
        raise ScanError(f"{name} has {count} points of 0 bytes")
    if any(field.offset + kind.itemsize > step for field, kind in zip(fields, kinds, strict=True)):
        raise ScanError(f"{name} has fields that reach beyond its points of {step} bytes")
    row = max(int(message.row_step), int(message.width) * step)
    data = np.asarray(message.data, np.uint8)
    last = (int(message.height) - 1) * row + int(message.width) * step if count else 0
    if len(data) < last:
        raise ScanError(f"{name} has {len(data)} bytes of data; its {count} points take {last}")
    dtype = np.dtype({"names": [field.name for field in fields], "formats": kinds,
                      "offsets": [field.offset for field in fields], "itemsize": step})  # fmt: skip
    if count and row != int(message.width) * step:  # rows are padded
        rows = [data[start : start + int(message.width) * step] for start in range(0, last, row)]
        data = np.concatenate(rows)
    table = data[: count * step].view(dtype) if count else np.empty(0, dtype)
    return {kind: table[kind].astype(table[kind].dtype.newbyteorder("=")) for kind in dtype.names or ()}


def _choose(bag: Any, name: str, kind: str, wanted: str | None, flag: str) -> str | None:
    """Return the topic of a type: the one that was asked for, or the only one; None if there is none but clouds."""
    there = {topic: info.msgtype for topic, info in bag.topics.items()}
    found = [topic for topic, given in there.items() if given == kind]
    short = kind.replace("/msg/", "/")
    listed = ", ".join(f"{topic} ({str(given).replace('/msg/', '/')})" for topic, given in there.items())
    if wanted is not None:
        if wanted not in found:
            raise ScanError(f"{name} has no {short} on {wanted}; it has {listed or 'no topics'}")
        return wanted
    if not found and kind == CLOUD:
        raise ScanError(f"{name} is a bag without clouds ({short}); it has {listed or 'no topics'}")
    if len(found) > 1:
        raise ScanError(f"{name} has {short} on {', '.join(found)}; choose with {flag}")
    return next(iter(found), None)


def _stamp(header: Any, logged: int) -> int:
    """Return the stamp of a header in ns; a driver that leaves it empty is taken at its log time."""
    return int(header.stamp.sec) * SECOND + int(header.stamp.nanosec) or logged


def _said(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
