"""Our messages as ROS 2 ones: plain arrays in, rosbags' message objects out."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from operators.scans.bag import DTYPES
from operators.scans.stamps import SECOND

DATATYPES = {name: number for number, name in DTYPES.items()}
COORDINATES = {"points": ("x", "y", "z"), "normals": ("normal_x", "normal_y", "normal_z")}
SCORES = ("p_ground", "p_permanent", "p_longT", "p_shortT")


class RosMessages:
    """Makes messages of a ROS 2 distribution's types."""

    def __init__(self, store: Stores = Stores.ROS2_HUMBLE) -> None:
        self.store: Typestore = get_typestore(store)

    def make(self, kind: str, **fields: Any) -> Any:
        """Make a message of a type such as `std_msgs/msg/Header`."""
        return self.store.types[kind](**fields)

    def header(self, time: int, frame: str) -> Any:
        """time: nanoseconds."""
        stamp = self.make("builtin_interfaces/msg/Time", sec=time // SECOND, nanosec=time % SECOND)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def vector(self, values: npt.NDArray[Any], kind: str = "Vector3") -> Any:
        """values: (3,)."""
        x, y, z = map(float, values)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def rotation(self, matrix: npt.NDArray[np.float64]) -> Any:
        """matrix: (4, 4) or (3, 3)."""
        x, y, z, w = map(float, Rotation.from_matrix(matrix[:3, :3]).as_quat())
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, matrix: npt.NDArray[np.float64]) -> Any:
        """matrix: (4, 4)."""
        position = self.vector(matrix[:3, 3], "Point")
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=self.rotation(matrix))

    def pose_stamped(self, header: Any, matrix: npt.NDArray[np.float64]) -> Any:
        """matrix: header's frame from body (4, 4)."""
        return self.make("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose(matrix))

    def transforms(self, header: Any, child: str, matrix: npt.NDArray[np.float64]) -> Any:
        """matrix: header's frame from child (4, 4)."""
        transform = self.make(
            "geometry_msgs/msg/Transform", translation=self.vector(matrix[:3, 3]), rotation=self.rotation(matrix)
        )
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
        )
        return self.make("tf2_msgs/msg/TFMessage", transforms=[stamped])

    def twist(self, linear: float, angular: float) -> Any:
        """Metres and radians a second, forwards and about z."""
        forwards, about = np.array([linear, 0.0, 0.0]), np.array([0.0, 0.0, angular])
        return self.make("geometry_msgs/msg/Twist", linear=self.vector(forwards), angular=self.vector(about))

    def odometry(self, header: Any, child: str, matrix: npt.NDArray[np.float64], twist: Any) -> Any:
        """matrix: odom from base (4, 4)."""
        unknown = np.zeros(36)
        pose = self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(matrix), covariance=unknown)
        speed = self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown)
        return self.make("nav_msgs/msg/Odometry", header=header, child_frame_id=child, pose=pose, twist=speed)

    def path(self, header: Any, points: npt.NDArray[np.float64]) -> Any:
        """points: (n, 2) metres."""
        poses = []
        for x, y in points:
            matrix = np.eye(4)
            matrix[:2, 3] = x, y
            poses.append(self.pose_stamped(header, matrix))
        return self.make("nav_msgs/msg/Path", header=header, poses=poses)

    def grid(self, header: Any, cells: npt.NDArray[np.int8], origin: npt.NDArray[np.float64], resolution: float) -> Any:
        """cells: (rows, columns) -1 unknown, 0 free to 100 occupied. origin: (2,) metres."""
        corner = np.eye(4)
        corner[:2, 3] = origin
        rows, columns = cells.shape
        info = self.make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=header.stamp,
            resolution=resolution,
            width=columns,
            height=rows,
            origin=self.pose(corner),
        )
        return self.make("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=cells.ravel())

    def cloud(self, header: Any, arrays: dict[str, npt.NDArray[Any]]) -> Any:
        """arrays: by field, (n,) or `points` and `normals` (n, 3), `scores` (n, 4)."""
        columns: dict[str, npt.NDArray[Any]] = {}
        for name, values in arrays.items():
            if values.ndim == 1:
                columns[name] = values.astype(np.uint8) if values.dtype == bool else values
            else:
                names = COORDINATES.get(name, SCORES)
                columns |= {name: values[:, number] for number, name in enumerate(names)}
        table = np.zeros(len(arrays["points"]), [(name, values.dtype) for name, values in columns.items()])
        for name, values in columns.items():
            table[name] = values
        offsets = {name: place for name, (_, place, *_) in (table.dtype.fields or {}).items()}
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offsets[name],
                datatype=DATATYPES[values.dtype.str[1:]],
                count=1,
            )
            for name, values in columns.items()
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=header,
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=table.itemsize,
            row_step=table.nbytes,
            data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=bool(np.isfinite(arrays["points"]).all()),
        )
