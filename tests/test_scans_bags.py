"""ROS bags, ROS 1 and ROS 2: clouds, odometry and transforms, chosen or found; and bags that will not do."""

from __future__ import annotations

import functools
import types

import numpy as np
import pytest

from graph.geometry import inverse, planar
from operators.scans import ScanError
from operators.scans.bag import BagScans, bag_files, cloud_columns
from operators.scans.scan import scan_of
from operators.scans.transforms import Tree

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START = 1_700_000_000_000_000_000
PERIOD = 100_000_000
BASE_FROM_LIDAR = planar(0.1, -0.2, 0.3, 0.64)
SECOND = 1_000_000_000


@functools.cache
def types_of(kind):
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if kind == "ros1":
        listed = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(listed, "tf2_msgs/msg/TFMessage"))
    return store


class Bag:
    """Writes a bag of one kind, message by message."""

    def __init__(self, folder, kind, name="drive"):
        self.kind = kind
        self.path = folder / (f"{name}.bag" if kind == "ros1" else name)
        self.store = types_of(kind)
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer1(self.path) if kind == "ros1" else Writer2(self.path, version=9, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def type(self, name):
        return self.store.types[name]

    def put(self, topic, kind, message, stamp):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        self.writer.write(self.connections[topic], stamp, serialize(message, kind))

    def header(self, stamp, frame):
        time = self.type("builtin_interfaces/msg/Time")(sec=stamp // SECOND, nanosec=stamp % SECOND)
        more = {"seq": 0} if self.kind == "ros1" else {}
        return self.type("std_msgs/msg/Header")(stamp=time, frame_id=frame, **more)

    def cloud(self, stamp, points, *, topic="/points", frame="velodyne", order="<", pad=0, logged=None, **fields):
        kinds = {"f4": 7, "f8": 8, "u1": 2, "u2": 4, "u4": 6, "i8": 0}
        columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], **fields}
        dtype = np.dtype([("pad", "V4"), *((n, f"{order}{c.dtype.str[1:]}") for n, c in columns.items())])
        table = np.zeros(len(points), dtype)
        for name, column in columns.items():
            table[name] = column
        field = self.type("sensor_msgs/msg/PointField")
        message = self.type("sensor_msgs/msg/PointCloud2")(
            header=self.header(stamp, frame),
            height=1,
            width=len(points),
            fields=[field(n, dtype.fields[n][1], kinds[c.dtype.str[1:]], 1) for n, c in columns.items()],
            is_bigendian=order == ">",
            point_step=dtype.itemsize,
            row_step=dtype.itemsize * len(points) + pad,
            data=np.frombuffer(table.tobytes() + bytes(pad), np.uint8),
            is_dense=False,
        )
        self.put(topic, "sensor_msgs/msg/PointCloud2", message, logged or stamp)

    def moved(self, pose):
        vector, quaternion = self.type("geometry_msgs/msg/Vector3"), self.type("geometry_msgs/msg/Quaternion")
        half = np.arctan2(pose[1, 0], pose[0, 0]) / 2
        return vector(*pose[:3, 3]), quaternion(0.0, 0.0, np.sin(half), np.cos(half))

    def odometry(self, stamp, pose, *, topic="/odom", child="base_link", speed=(0.0, 0.0)):
        place, turn = self.moved(pose)
        vector, point = self.type("geometry_msgs/msg/Vector3"), self.type("geometry_msgs/msg/Point")
        twist = self.type("geometry_msgs/msg/Twist")(vector(speed[0], 0.0, 0.0), vector(0.0, 0.0, speed[1]))
        with_covariance = self.type("geometry_msgs/msg/PoseWithCovariance")
        message = self.type("nav_msgs/msg/Odometry")(
            header=self.header(stamp, "odom"),
            child_frame_id=child,
            pose=with_covariance(
                self.type("geometry_msgs/msg/Pose")(point(place.x, place.y, place.z), turn), np.zeros(36)
            ),
            twist=self.type("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36)),
        )
        self.put(topic, "nav_msgs/msg/Odometry", message, stamp)

    def transform(self, stamp, parent, child, pose, *, static=False):
        transform = self.type("geometry_msgs/msg/Transform")(*self.moved(pose))
        stamped = self.type("geometry_msgs/msg/TransformStamped")(self.header(stamp, parent), child, transform)
        message = self.type("tf2_msgs/msg/TFMessage")([stamped])
        self.put("/tf_static" if static else "/tf", "tf2_msgs/msg/TFMessage", message, stamp)


def points_of(number, count=20):
    return np.random.default_rng(number).normal(0, 5, (count, 3)).astype(np.float32)


def robot(bag, *, odometry=True, transforms=True, count=5):
    """Scans at 10 Hz, odometry at 50 Hz of a robot that drives at 1 m/s and turns at 0.5 rad/s, the lidar on it."""
    if transforms:
        bag.transform(START, "base_link", "velodyne", BASE_FROM_LIDAR, static=True)
    for step in range(-1, 5 * count + 1):
        stamp = START + step * PERIOD // 5
        pose = way(step * 0.02)
        if odometry:
            bag.odometry(stamp, pose, speed=(1.0, 0.5))
        elif transforms:
            bag.transform(stamp, "odom", "base_link", pose)
        if step % 5 == 0 and 0 <= step < 5 * count:
            ring = np.arange(20, dtype=np.uint16)
            bag.cloud(stamp, points_of(step // 5), ring=ring, time=np.linspace(0, 0.09, 20, dtype=np.float32))


def way(seconds):
    angle = 0.5 * seconds
    return planar(2.0 * np.sin(angle), 2.0 * (1.0 - np.cos(angle)), angle)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
@pytest.mark.parametrize("odometry", [True, False])
def test_clouds_odometry_and_the_lidars_place_come_out_of_a_bag(tmp_path, kind, odometry):
    with Bag(tmp_path, kind) as bag:
        robot(bag, odometry=odometry)
    scans = BagScans(bag_files(bag.path))
    assert [sweep.stamp for sweep in scans.sweeps] == [START + n * PERIOD for n in range(5)]
    assert np.allclose(scans.base_from_lidar, BASE_FROM_LIDAR)
    assert scans.remarks == ()
    for n, scan in zip([0, 3], scans.read([0, 3]), strict=True):
        assert np.array_equal(scan.points, points_of(n))
        assert scan.ring.tolist() == list(range(20))
        assert np.allclose(scan.time_offset, np.linspace(0, 0.09, 20))
    motion = scans.odometry.at(START + 2 * PERIOD)
    assert np.allclose(motion.pose, way(0.2))
    assert motion[1:] == pytest.approx((1.0, 0.5) if odometry else (0.0, 0.0))
    assert (scans.odometry.velocities is None) == (not odometry)


def test_a_bag_is_found_in_its_folder_or_file(tmp_path):
    with Bag(tmp_path, "mcap") as bag:
        robot(bag, count=2)
    assert bag_files(bag.path) == [bag.path]
    (file,) = bag.path.glob("*.mcap")
    assert len(BagScans(bag_files(file)).sweeps) == 2
    (bag.path / "metadata.yaml").unlink()
    assert len(BagScans(bag_files(bag.path)).sweeps) == 2
    (tmp_path / "split").mkdir()
    for number, name in enumerate(("one", "two")):  # a ROS 1 bag that was split
        with Bag(tmp_path / "split", "ros1", name) as part:
            part.cloud(START + number * PERIOD, points_of(number))
    assert [sweep.stamp for sweep in BagScans(bag_files(tmp_path / "split")).sweeps] == [START, START + PERIOD]
    assert bag_files(tmp_path / "empty") == []


def test_topics_are_chosen_by_flag_where_several_could_be_meant(tmp_path):
    with Bag(tmp_path, "sqlite3") as bag:
        bag.cloud(START, points_of(0), topic="/front")
        bag.cloud(START, points_of(1), topic="/rear")
        bag.odometry(START, way(0), topic="/wheels")
        bag.odometry(START, way(1), topic="/fused")
    files = [bag.path]
    with pytest.raises(ScanError, match="PointCloud2 on /front, /rear; choose with --points-topic"):
        BagScans(files)
    with pytest.raises(ScanError, match="Odometry on /fused, /wheels; choose with --odometry-topic"):
        BagScans(files, points_topic="/rear")
    with pytest.raises(ScanError, match=r"no sensor_msgs/PointCloud2 on /wheels; it has /front \(sensor_msgs/PointCl"):
        BagScans(files, points_topic="/wheels")
    scans = BagScans(files, points_topic="/rear", odometry_topic="/fused")
    assert np.array_equal(next(iter(scans.read([0]))).points, points_of(1))
    assert np.allclose(scans.odometry.poses[0], way(1))
    assert "does not say where velodyne is on base_link" in scans.remarks[0]


def test_frames_are_chosen_by_flag_and_unknown_ones_named(tmp_path):
    base_from_mast = planar(0.0, 0.0, 0.0, 1.0)
    with Bag(tmp_path, "sqlite3") as bag:
        robot(bag)
        bag.transform(START, "base_link", "mast", base_from_mast, static=True)
    scans = BagScans([bag.path], base_frame="mast")
    assert np.allclose(scans.base_from_lidar, inverse(base_from_mast) @ BASE_FROM_LIDAR)
    assert np.allclose(scans.odometry.at(START).pose, base_from_mast)
    with pytest.raises(ScanError, match=r"no frame 'wheel'; it has base_link, velodyne, mast"):
        BagScans([bag.path], base_frame="wheel")


def test_odometry_without_a_twist_has_no_velocity(tmp_path):
    with Bag(tmp_path, "ros1") as bag:
        for n in range(3):
            bag.cloud(START + n * PERIOD, points_of(n))
            bag.odometry(START + n * PERIOD, way(0.1 * n))
    assert BagScans([bag.path]).odometry.velocities is None


def test_a_bag_without_odometry_says_so(tmp_path):
    with Bag(tmp_path, "sqlite3") as bag:
        bag.cloud(0, points_of(0), logged=START)  # a driver that leaves the stamp empty
    scans = BagScans([bag.path])
    assert scans.odometry is None
    assert scans.sweeps[0].stamp == START
    assert "neither odometry nor transforms" in scans.remarks[0]


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_bags_that_will_not_do_are_named_in_one_sentence(tmp_path, kind):
    with Bag(tmp_path, kind, "blind") as bag:
        bag.odometry(START, way(0))
    with pytest.raises(ScanError, match=r"a bag without clouds .*; it has /odom \(nav_msgs/Odometry\)"):
        BagScans(bag_files(bag.path))
    with Bag(tmp_path, kind, "cut") as bag:
        for n in range(20):
            bag.cloud(START + n * PERIOD, points_of(n, 1000))
    file = bag.path if kind == "ros1" else next(file for file in bag.path.iterdir() if file.suffix != ".yaml")
    raw = file.read_bytes()
    file.write_bytes(raw[: len(raw) // 2])
    with pytest.raises(ScanError, match=r"cannot be read as a bag|is damaged after \d+ messages") as caught:
        list(BagScans(bag_files(bag.path)).read(range(20)))
    assert "cut" in str(caught.value)
    assert "\n" not in str(caught.value)
    file.write_bytes(b"hello")
    with pytest.raises(ScanError, match=r"cannot be read as a bag|is damaged"):
        BagScans(bag_files(bag.path))


def test_a_cloud_of_padded_rows_and_the_other_byte_order_is_read(tmp_path):
    points = points_of(0)
    with Bag(tmp_path, "sqlite3") as bag:
        bag.cloud(START, points, order=">", pad=12, t=np.arange(20, dtype=np.uint32))
        bag.cloud(START + PERIOD, points[:0])
    scans = list(BagScans([bag.path]).read([0, 1]))
    assert np.array_equal(scans[0].points, points)
    assert np.allclose(scans[0].time_offset, np.arange(20) * 1e-9)
    assert scans[1].points.shape == (0, 3)

    def message(**more):
        fields = [types.SimpleNamespace(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")]
        table = np.zeros((2, 5, 4), np.float32)  # 2 rows of 4 points and 16 bytes of padding
        table[:, :4, :3] = points[:8].reshape(2, 4, 3)
        usual = {"fields": fields, "width": 4, "height": 2, "point_step": 16, "row_step": 80, "is_bigendian": False}
        return types.SimpleNamespace(**(usual | {"data": table.reshape(-1).view(np.uint8)} | more))

    assert np.array_equal(scan_of(cloud_columns(message(), "cloud"), "cloud").points, points[:8])
    for more, sentence in (
        ({"data": np.zeros(100, np.uint8)}, "has 100 bytes of data; its 8 points take 144"),
        ({"point_step": 8}, "reach beyond its points of 8 bytes"),
        ({"point_step": 0}, "8 points of 0 bytes"),
    ):
        with pytest.raises(ScanError, match=sentence):
            cloud_columns(message(**more), "cloud")


def test_a_tree_of_frames_joins_what_is_joined():
    tree = Tree()
    tree.add("map", "odom", planar(1, 0, 0), None)
    tree.add("odom", "/base", planar(0, 0, 0), 0)
    tree.add("odom", "base", planar(0, 2, 1.0), SECOND)
    tree.add("base", "lidar", planar(0, 0, 0, 1.0), None)
    assert np.allclose(tree.at("map", "lidar", SECOND // 2), planar(1, 1, 0.5, 1.0))
    assert np.allclose(tree.at("lidar", "map", SECOND // 2), inverse(planar(1, 1, 0.5, 1.0)))
    assert np.allclose(tree.at("base", "base", 5), np.eye(4))
    assert tree.at("map", "lidar", 9 * SECOND) is None
    assert tree.at("map", "camera", 0) is None
    assert tree.frames == ["map", "odom", "base", "lidar"]
    assert len(tree.trajectory("map", "lidar").poses) == 2
    assert tree.trajectory("base", "lidar") is None
