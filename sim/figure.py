"""The human figure: sixteen capsules whose pose follows a recorded gait, or stands, or sits.

Joint angles of the gait are the motion capture that comes with PyBullet (humanoid3d_walk); the phase is the distance
walked over the length of a stride, so that feet do not slide. Body frame: x forward, y left, z up, origin on the floor
below the hips. Lengths are of a figure of stature 1 and scale with the person's height.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Measures of the captured figure in metres, in its frame: x forward, y up, z right.
_STATURE = 1.62
_HIP, _KNEE, _ANKLE = (0.0, 0.0, 0.085), (0.0, -0.4215, 0.0), (0.0, -0.4099, 0.0)
_CHEST, _NECK = (0.0, 0.2362, 0.0), (0.0, 0.2239, 0.0)
_SHOULDER, _ELBOW, _WRIST = (-0.024, 0.2435, 0.183), (0.0, -0.2748, 0.0), (0.0, -0.2589, 0.0)

PARTS = (
    "pelvis", "belly", "chest right", "chest left", "shoulders", "head",
    "right thigh", "right shank", "right foot", "right upper arm", "right lower arm",
    "left thigh", "left shank", "left foot", "left upper arm", "left lower arm",
)  # fmt: skip
RADII = np.array(
    [0.105, 0.115, 0.095, 0.095, 0.06, 0.095, 0.075, 0.055, 0.04, 0.045, 0.04, 0.075, 0.055, 0.04, 0.045, 0.04]
)  # of the captured figure, metres
_HEAD_WIDTH = PARTS.index("head")


class Pose(NamedTuple):
    """Joint rotations (3, 3) of the captured figure, and its hips' sway about the straight line."""

    root: Array
    chest: Array
    neck: Array
    right: tuple[Array, Array, Array, Array, Array]  # hip, knee, ankle, shoulder, elbow
    left: tuple[Array, Array, Array, Array, Array]


def _about_z(angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _quaternion(values: npt.ArrayLike) -> Array:
    w, x, y, z = np.asarray(values, np.float64) / np.linalg.norm(values)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _capsules(pose: Pose) -> Array:
    """Return the ends (16, 2, 3) of the capsules by forward kinematics, the lowest point of the feet on the floor."""
    root, chest = pose.root, pose.root @ pose.chest
    chest_at = root @ np.array(_CHEST)
    neck_at = chest_at + chest @ np.array(_NECK)
    neck = chest @ pose.neck
    hip_line = root @ np.array([0.0, 0.0, 0.075])
    shoulder_line = chest @ np.array([0.0, 0.0, 0.13])
    shoulder_at = chest_at + chest @ np.array([-0.01, 0.205, 0.0])
    side = chest @ np.array([0.0, 0.0, 0.07])
    ends = [
        (hip_line, -hip_line),
        (root @ np.array([0.0, 0.06, 0.0]), chest_at + chest @ np.array([0.0, 0.02, 0.0])),
        (chest_at + side, chest_at + chest @ np.array([0.0, 0.14, 0.0]) + side),
        (chest_at - side, chest_at + chest @ np.array([0.0, 0.14, 0.0]) - side),
        (shoulder_at + shoulder_line, shoulder_at - shoulder_line),
        (neck_at + neck @ np.array([0.01, 0.10, 0.0]), neck_at + neck @ np.array([0.02, 0.19, 0.0])),
    ]
    for mirror, (hip, knee, ankle, shoulder, elbow) in ((1.0, pose.right), (-1.0, pose.left)):
        flip = np.array([1.0, 1.0, mirror])
        hip_at, thigh = root @ (np.array(_HIP) * flip), root @ hip
        knee_at, shank = hip_at + thigh @ np.array(_KNEE), thigh @ knee
        ankle_at, foot = knee_at + shank @ np.array(_ANKLE), shank @ ankle
        shoulder_joint, upper = chest_at + chest @ (np.array(_SHOULDER) * flip), chest @ shoulder
        elbow_at, lower = shoulder_joint + upper @ np.array(_ELBOW), upper @ elbow
        ends += [
            (hip_at, knee_at),
            (knee_at, ankle_at),
            (ankle_at + foot @ np.array([-0.03, 0.0, 0.0]), ankle_at + foot @ np.array([0.14, -0.01, 0.0])),
            (shoulder_joint, elbow_at),
            (elbow_at, elbow_at + lower @ np.array(_WRIST)),
        ]
    capsules = np.array(ends)[:, :, [0, 2, 1]] * (1.0, -1.0, 1.0)  # x forward, y left, z up
    capsules[:, :, 2] -= (capsules[:, :, 2] - RADII[:, None]).min()
    return capsules / _STATURE


def _limp(hip: float = 0.0, knee: float = 0.0, shoulder: float = 0.0, elbow: float = 0.15, lean: float = 0.0) -> Array:
    joints = (_about_z(hip), _about_z(knee), _about_z(-hip - knee), _about_z(shoulder), _about_z(elbow))
    return _capsules(Pose(np.eye(3), _about_z(lean), np.eye(3), joints, joints))


def _relaxed(capsules: Array, names: tuple[str, ...], outward: float) -> Array:
    """Move the arms' ends outward (fractions of the stature), so that they hang beside the body."""
    for name in names:
        capsules[PARTS.index(f"right {name}"), :, 1] -= outward
        capsules[PARTS.index(f"left {name}"), :, 1] += outward
    return capsules


class Gait(NamedTuple):
    """One stride as capsules, and how far it goes; all for stature 1."""

    capsules: Array  # (phases, 16, 2, 3), the first phase again at the end
    stride: float


@functools.cache
def walking() -> Gait:
    """Load the captured stride. Raises FileNotFoundError if PyBullet's data is not installed."""
    import pybullet_data

    source = Path(pybullet_data.getDataPath()) / "data" / "motions" / "humanoid3d_walk.txt"
    frames = np.array(json.loads(source.read_text(encoding="utf-8"))["Frames"], np.float64)
    poses = []
    for frame in frames:
        values = frame[1:]  # without the duration
        right = (_quaternion(values[15:19]), _about_z(values[19]), _quaternion(values[20:24]))
        right_arm = (_quaternion(values[24:28]), _about_z(values[28]))
        left = (_quaternion(values[29:33]), _about_z(values[33]), _quaternion(values[34:38]))
        left_arm = (_quaternion(values[38:42]), _about_z(values[42]))
        root = _quaternion(values[3:7])
        poses.append(
            _capsules(
                Pose(
                    root,
                    _quaternion(values[7:11]),
                    _quaternion(values[11:15]),
                    (*right, *right_arm),
                    (*left, *left_arm),
                )
            )
        )
    stride = float(frames[-1, 1] - frames[0, 1]) / _STATURE
    return Gait(np.array([*poses[:-1], poses[0]]), stride)


@functools.cache
def standing() -> Array:
    """Return the capsules (16, 2, 3) of a standing figure of stature 1."""
    return _relaxed(_limp(elbow=0.2), ("upper arm", "lower arm"), 0.01)


@functools.cache
def sitting() -> Array:
    """Return the capsules (16, 2, 3) of a figure of stature 1 that sits; its hips are above the origin."""
    return _limp(hip=np.pi / 2 - 0.05, knee=-np.pi / 2 + 0.05, shoulder=0.55, elbow=1.0, lean=-0.05)


def radii(height: npt.ArrayLike, build: npt.ArrayLike) -> Array:
    """Return the capsule radii (n, 16) in metres of people of that height (metres) and build (1: as captured)."""
    width = np.repeat(np.asarray(build, np.float64)[:, None], len(PARTS), 1)
    width[:, _HEAD_WIDTH] = 1.0
    return RADII / _STATURE * np.asarray(height, np.float64)[:, None] * width


def figures(phase: Array, stride_share: Array, height: Array) -> Array:
    """Return the capsule ends (n, 16, 2, 3) of walkers in their own frames.

    phase: distance walked over the stride's length, any number; stride_share: 1 walks as captured, 0 stands.
    height: metres.
    """
    table = walking().capsules
    position = (phase % 1.0) * (len(table) - 1)
    index = np.minimum(position.astype(np.int64), len(table) - 2)
    fraction = (position - index)[:, None, None, None]
    walk = table[index] * (1.0 - fraction) + table[index + 1] * fraction
    share = stride_share[:, None, None, None]
    return (walk * share + standing() * (1.0 - share)) * height[:, None, None, None]


def placed(capsules: Array, x: Array, y: Array, heading: Array) -> Array:
    """Move capsules (n, 16, 2, 3) from the figures' frames to places (metres) and headings (radians) in the world."""
    cosine, sine = np.cos(heading)[:, None, None], np.sin(heading)[:, None, None]
    world = np.empty_like(capsules)
    world[..., 0] = cosine * capsules[..., 0] - sine * capsules[..., 1] + x[:, None, None]
    world[..., 1] = sine * capsules[..., 0] + cosine * capsules[..., 1] + y[:, None, None]
    world[..., 2] = capsules[..., 2]
    return world
