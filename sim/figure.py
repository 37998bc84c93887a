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

from graph.geometry import exponential, logarithm

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


# A pose is the rotations (13, 3, 3) of these joints of the captured figure, each in its parent's frame.
_ROOT, _CHEST_JOINT, _NECK_JOINT = 0, 1, 2
_RIGHT, _LEFT = 3, 8  # first of hip, knee, ankle, shoulder, elbow
_SHARES = 9  # steps between standing and walking in the table of poses


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


def _capsules(pose: Array) -> Array:
    """Return the ends (16, 2, 3) of the capsules by forward kinematics, the lowest point of the feet on the floor."""
    root, chest = pose[_ROOT], pose[_ROOT] @ pose[_CHEST_JOINT]
    chest_at = root @ np.array(_CHEST)
    neck_at = chest_at + chest @ np.array(_NECK)
    neck = chest @ pose[_NECK_JOINT]
    hip_line = root @ np.array([0.0, 0.0, 0.075])
    shoulder_line = chest @ np.array([0.0, 0.0, 0.13])
    shoulder_at = chest_at + chest @ np.array([-0.01, 0.205, 0.0])
    side, rise = chest @ np.array([0.0, 0.0, 0.07]), chest @ np.array([0.0, 0.14, 0.0])
    ends = [
        (hip_line, -hip_line),
        (root @ np.array([0.0, 0.06, 0.0]), root @ np.array([0.0, 0.25, 0.0])),
        (chest_at + side, chest_at + rise + side),
        (chest_at - side, chest_at + rise - side),
        (shoulder_at + shoulder_line, shoulder_at - shoulder_line),
        (neck_at + neck @ np.array([0.01, 0.10, 0.0]), neck_at + neck @ np.array([0.02, 0.19, 0.0])),
    ]
    for mirror, first in ((1.0, _RIGHT), (-1.0, _LEFT)):
        hip, knee, ankle, shoulder, elbow = pose[first : first + 5]
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
    """Return a pose with both sides alike, arms a little off the body; angles in radians, forward positive."""
    pose = np.broadcast_to(np.eye(3), (13, 3, 3)).copy()
    pose[_CHEST_JOINT] = _about_z(lean)
    for first, spread in ((_RIGHT, -0.06), (_LEFT, 0.06)):
        arm = exponential([spread, 0.0, 0.0]) @ _about_z(shoulder)
        pose[first : first + 5] = _about_z(hip), _about_z(knee), _about_z(-hip - knee), arm, _about_z(elbow)
    return pose


def _between(a: Array, b: Array, share: float) -> Array:
    """Turn every joint by a share of the way from pose a to pose b, so that limbs keep their lengths."""
    return np.array([one @ exponential(share * logarithm(one.T @ other)) for one, other in zip(a, b, strict=True)])


class Gait(NamedTuple):
    """One stride as capsules, from standing (first) to walking (last), and how far it goes; all for stature 1."""

    capsules: Array  # (shares, phases, 16, 2, 3), the first phase again at the end
    stride: float


@functools.cache
def walking() -> Gait:
    """Load the captured stride. Raises FileNotFoundError if PyBullet's data is not installed."""
    import pybullet_data

    source = Path(pybullet_data.getDataPath()) / "data" / "motions" / "humanoid3d_walk.txt"
    frames = np.array(json.loads(source.read_text(encoding="utf-8"))["Frames"], np.float64)
    # a frame: duration, 3 of position, then the joints in our order: knees and elbows one angle, else a quaternion
    stances = []
    for frame in frames[:-1]:
        pose, at = np.empty((13, 3, 3)), 4
        for joint in range(13):
            hinge = joint in (_RIGHT + 1, _RIGHT + 4, _LEFT + 1, _LEFT + 4)
            pose[joint] = _about_z(frame[at]) if hinge else _quaternion(frame[at : at + 4])
            at += 1 if hinge else 4
        stances.append(pose)
    upright = _limp(elbow=0.2)
    table = []
    for share in np.linspace(0.0, 1.0, _SHARES):
        phases = [_capsules(_between(upright, stance, float(share))) for stance in stances]
        table.append([*phases, phases[0]])
    return Gait(np.array(table), float(frames[-1, 1] - frames[0, 1]) / _STATURE)


@functools.cache
def standing() -> Array:
    """Return the capsules (16, 2, 3) of a standing figure of stature 1."""
    return np.asarray(walking().capsules[0, 0])


@functools.cache
def sitting() -> Array:
    """Return the capsules (16, 2, 3) of a figure of stature 1 that sits; its hips are above the origin."""
    return _capsules(_limp(hip=np.pi / 2 - 0.05, knee=-np.pi / 2 + 0.05, shoulder=0.55, elbow=1.0, lean=-0.05))


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
    position = (phase % 1.0) * (table.shape[1] - 1)
    index = np.minimum(position.astype(np.int64), table.shape[1] - 2)
    level = np.clip(stride_share, 0.0, 1.0) * (_SHARES - 1)
    row = np.minimum(level.astype(np.int64), _SHARES - 2)
    u, v = (position - index)[:, None, None, None], (level - row)[:, None, None, None]
    low = table[row, index] * (1.0 - u) + table[row, index + 1] * u
    high = table[row + 1, index] * (1.0 - u) + table[row + 1, index + 1] * u
    return (low * (1.0 - v) + high * v) * height[:, None, None, None]


def placed(capsules: Array, x: Array, y: Array, heading: Array) -> Array:
    """Move capsules (n, 16, 2, 3) from the figures' frames to places (metres) and headings (radians) in the world."""
    cosine, sine = np.cos(heading)[:, None, None], np.sin(heading)[:, None, None]
    world = np.empty_like(capsules)
    world[..., 0] = cosine * capsules[..., 0] - sine * capsules[..., 1] + x[:, None, None]
    world[..., 1] = sine * capsules[..., 0] + cosine * capsules[..., 1] + y[:, None, None]
    world[..., 2] = capsules[..., 2]
    return world
