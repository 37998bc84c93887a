"""Turn a recording into a ROS 2 bag, one MCAP file that ROS 2, Foxglove and PlotJuggler open as it is.

retracer export recordings/run.mcap -o run.ros2.mcap
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.writer import CompressionType, Writer

from graph.codec import decode, type_name
from graph.errors import UserError
from graph.geometry import planar
from graph.messages import (
    Drive,
    Goal,
    MapCloud,
    OccupancyGrid,
    Odometry,
    Plan,
    PointCloud,
    Pose,
    Text,
    Truth,
)
from graph.recording import Recording
from graph.status import progress_bar

ARRAYS = (
    "points",
    "normals",
    "ring",
    "time_offset",
    "score",
    "movable",
    "label",
    "scores",
    "truth",
    "moving",
    "instance",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer export`."""
    parser.add_argument("recording", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.mcap")
    parser.add_argument("--topics", metavar="A,B", help="only these, such as simulator/frame,localizer/pose")
    parser.add_argument("--json", action="store_true", help="print the topics written as JSON")


LATCHED = """- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 0, nsec: 0}
  lifespan: {sec: 0, nsec: 0}
  liveliness: 1
  liveliness_lease_duration: {sec: 0, nsec: 0}
  avoid_ros_namespace_conventions: false
"""  # of /tf_static: who comes later gets it too

# what stands for one message: the rest of its topic, or /tf; type; message
Said = Iterator[tuple[str, str, Any]]


class Translator:
    """Says a message of ours in ROS's words. Poses also go to /tf, each operator's under a frame of its own name."""

    def __init__(self) -> None:
        from operators.scans.ros_messages import RosMessages

        self.ros = RosMessages()
        self.words: dict[type, Callable[[Any, str], Said]] = {
            PointCloud: self.cloud,
            MapCloud: self.map,
            Odometry: self.odometry,
            Pose: self.pose,
            Drive: self.drive,
            Goal: self.goal,
            OccupancyGrid: self.grid,
            Plan: self.plan,
            Truth: self.truth,
            Text: self.text,
        }
        self.kinds = {type_name(kind): kind for kind in self.words}
        self.placed: set[str] = set()

    def _arrays(self, message: Any) -> dict[str, np.ndarray[Any, Any]]:
        return {name: values for name in ARRAYS if (values := getattr(message, name, None)) is not None}

    def cloud(self, message: PointCloud, operator: str) -> Said:
        frame = f"{operator}/lidar"
        if frame not in self.placed:
            self.placed.add(frame)
            header = self.ros.header(message.measured_at, "base")
            yield "/tf_static", "tf2_msgs/msg/TFMessage", self.ros.transforms(header, frame, message.base_from_lidar)
        header = self.ros.header(message.measured_at, frame)
        yield "", "sensor_msgs/msg/PointCloud2", self.ros.cloud(header, self._arrays(message))

    def map(self, message: MapCloud, operator: str) -> Said:
        header = self.ros.header(message.measured_at, "world")
        yield "", "sensor_msgs/msg/PointCloud2", self.ros.cloud(header, self._arrays(message))

    def odometry(self, message: Odometry, operator: str) -> Said:
        header = self.ros.header(message.measured_at, "odom")
        twist = self.ros.twist(message.linear, message.angular)
        yield "", "nav_msgs/msg/Odometry", self.ros.odometry(header, "base", message.odom_from_base, twist)

    def pose(self, message: Pose, operator: str) -> Said:
        header = self.ros.header(message.measured_at, "world")
        yield "", "geometry_msgs/msg/PoseStamped", self.ros.pose_stamped(header, message.world_from_base)
        if message.valid:
            yield "/tf", "tf2_msgs/msg/TFMessage", self.ros.transforms(header, "base", message.world_from_base)

    def drive(self, message: Drive, operator: str) -> Said:
        yield "", "geometry_msgs/msg/Twist", self.ros.twist(message.linear, message.angular)

    def goal(self, message: Goal, operator: str) -> Said:
        header = self.ros.header(message.measured_at, "world")
        point = self.ros.vector(np.append(message.target, 0.0), "Point")
        kind = "geometry_msgs/msg/PointStamped"
        yield "", kind, self.ros.make(kind, header=header, point=point)

    def grid(self, message: OccupancyGrid, operator: str) -> Said:
        header = self.ros.header(message.measured_at, "world")
        grid = self.ros.grid(header, message.cells, message.origin, message.resolution)
        yield "", "nav_msgs/msg/OccupancyGrid", grid

    def plan(self, message: Plan, operator: str) -> Said:
        header = self.ros.header(message.measured_at, "world")
        yield "", "nav_msgs/msg/Path", self.ros.path(header, message.path)
        yield "/trajectory", "nav_msgs/msg/Path", self.ros.path(header, message.trajectory[:, :2])

    def truth(self, message: Truth, operator: str) -> Said:
        header = self.ros.header(message.measured_at, "world")
        yield "", "geometry_msgs/msg/PoseStamped", self.ros.pose_stamped(header, message.world_from_base)
        people = [self.ros.pose(planar(x, y, heading)) for x, y, heading in message.people]
        poses = self.ros.make("geometry_msgs/msg/PoseArray", header=header, poses=people)
        yield "/people", "geometry_msgs/msg/PoseArray", poses

    def text(self, message: Text, operator: str) -> Said:
        yield "", "std_msgs/msg/String", self.ros.make("std_msgs/msg/String", data=f"{message.level}: {message.text}")


class Bag:
    """A ROS 2 bag in one MCAP file."""

    def __init__(self, stream: IO[bytes], translator: Translator) -> None:
        self.store = translator.ros.store
        self.writer = Writer(stream, compression=CompressionType.ZSTD)
        self.writer.start(profile="ros2", library="retracer")
        self.schemas: dict[str, int] = {}
        self.channels: dict[str, int] = {}
        self.counts: dict[str, int] = {}

    def write(self, topic: str, kind: str, message: Any, stamp: int) -> None:
        """Append a message, logged at a stamp in nanoseconds."""
        if kind not in self.schemas:
            text, _ = self.store.generate_msgdef(kind, ros_version=2)
            self.schemas[kind] = self.writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self.channels:
            profiles = {"offered_qos_profiles": LATCHED if topic == "/tf_static" else ""}
            self.channels[topic] = self.writer.register_channel(topic, "cdr", self.schemas[kind], profiles)
            self.counts[topic] = 0
        data = bytes(self.store.serialize_cdr(message, kind))
        self.writer.add_message(self.channels[topic], log_time=stamp, publish_time=stamp, data=data)
        self.counts[topic] += 1


def chosen_topics(recording: Recording, wanted: str | None, known: dict[str, type]) -> list[str]:
    """List the topics to export. Raises UserError for one that the recording has not."""
    there = [topic for topic, (name, _) in recording.types.items() if name in known]
    if wanted is None:
        return there
    for topic in wanted.split(","):
        if topic not in there:
            raise UserError(f"--topics names {topic}; {recording.path} can give {', '.join(there) or 'nothing'}")
    return wanted.split(",")


def run(args: argparse.Namespace) -> int:
    """Write the bag beside its final name, then rename it: what is there is whole."""
    try:
        translator = Translator()
    except ModuleNotFoundError as error:
        raise UserError(f'export wants {error.name}: pip install "retracer[ros]"') from error
    recording = Recording(args.recording)
    topics = chosen_topics(recording, args.topics, translator.kinds)
    if not topics:
        raise UserError(f"{args.recording} holds no message that ROS has a word for")
    total = sum(recording.counts.get(topic, 0) for topic in topics)
    part = args.output.with_name(args.output.name + ".part")
    done = 0
    try:
        with part.open("wb") as stream, progress_bar("exporting", quiet=args.json) as progress:
            bag = Bag(stream, translator)
            kinds = {topic: translator.kinds[recording.types[topic][0]] for topic in topics}
            for entry in recording.messages(*topics):
                kind = kinds[entry.topic]
                for below, name, message in translator.words[kind](decode(entry.payload, kind), entry.operator):
                    topic = below if below.startswith("/tf") else f"/{entry.topic}{below}"
                    bag.write(topic, name, message, entry.stamp)
                done += 1
                progress(done / max(1, total))
            bag.writer.finish()  # type: ignore[no-untyped-call]
        part.replace(args.output)
    except OSError as error:
        raise UserError(f"{args.output}: {error.strerror or error}; nothing was kept") from None
    finally:
        part.unlink(missing_ok=True)
    if args.json:
        print(json.dumps({"output": str(args.output), "topics": bag.counts}, indent=2))
    else:
        print(f"{args.output}: {sum(bag.counts.values())} messages on {', '.join(sorted(bag.counts))}")
    return 0
