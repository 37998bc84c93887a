"""Rigid transforms as 4x4 float64 matrices, named target_from_source so that names cancel."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Matrix = npt.NDArray[np.float64]


def planar(x: float, y: float, yaw: float, z: float = 0.0) -> Matrix:
    """Build a pose from position (metres) and heading about +z (radians). Returns (4, 4)."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
    pose[:3, 3] = x, y, z
    return pose


def yaw(target_from_source: npt.ArrayLike) -> float:
    """Return the heading about +z in radians, in [-pi, pi]."""
    pose = np.asarray(target_from_source)
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


def wrap(angle: Any) -> Any:
    """Wrap radians into [-pi, pi)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def transform(target_from_source: npt.ArrayLike, points_source: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Move points (n, 3) into the target frame; keeps their dtype."""
    pose = np.asarray(target_from_source, np.float64)
    moved = points_source.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    return moved.astype(points_source.dtype, copy=False)


def inverse(target_from_source: npt.ArrayLike) -> Matrix:
    """Invert a rigid transform: source_from_target."""
    pose = np.asarray(target_from_source, np.float64)
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result


def rotation_angle(target_from_source: npt.ArrayLike) -> float:
    """Return the angle of the rotation in radians, in [0, pi]; exact near zero."""
    r = np.asarray(target_from_source, np.float64)[:3, :3]
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return float(np.arctan2(np.linalg.norm(axis), np.trace(r) - 1.0))


def exponential(rotation_vector: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a rotation vector in radians (Rodrigues)."""
    vector = np.asarray(rotation_vector, np.float64)
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross + 0.5 * cross @ cross
    return np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * cross @ cross


def logarithm(rotation: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the rotation vector (3,) in radians of a rotation matrix (3, 3) of an angle below pi."""
    r = np.asarray(rotation, np.float64)
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, np.trace(r) - 1.0))
    return 0.5 * axis if sine < 1e-8 else angle / sine * axis


def interpolate(target_from_a: npt.ArrayLike, target_from_b: npt.ArrayLike, fraction: float) -> Matrix:
    """Go from pose a (fraction 0) to pose b (fraction 1): straight in translation, constant turn in rotation."""
    a, b = np.asarray(target_from_a, np.float64), np.asarray(target_from_b, np.float64)
    result = np.eye(4)
    result[:3, :3] = a[:3, :3] @ exponential(fraction * logarithm(a[:3, :3].T @ b[:3, :3]))
    result[:3, 3] = (1.0 - fraction) * a[:3, 3] + fraction * b[:3, 3]
    return result
