"""Where something was over time: poses with or without stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import Matrix, interpolate, inverse, planar, yaw

ROUNDING = 1_000_000  # ns: stamps of one moment that went through two texts
LONGEST_GAP = 1_000_000_000  # ns between two poses that are still interpolated


class Motion(NamedTuple):
    """A pose with its velocity."""

    pose: Matrix  # (4, 4) target_from_body
    linear: float = 0.0  # m/s, forward
    angular: float = 0.0  # rad/s, about the body's z


class Trajectory(NamedTuple):
    """Poses (n, 4, 4), target_from_body; stamps (n,) in ns increase strictly, or are None where nobody knows them."""

    poses: npt.NDArray[np.float64]
    stamps: npt.NDArray[np.int64] | None = None
    velocities: npt.NDArray[np.float64] | None = None  # (n, 2) m/s forward and rad/s, where they were measured

    def at(self, stamp: int) -> Motion | None:
        """Return the motion at a stamp (ns), between the poses around it; None if they are too far apart, or one-sided.

        The velocity is zero where none was measured. Raises ValueError if the poses have no stamps.
        """
        if self.stamps is None:
            raise ValueError("poses without stamps cannot be asked for one at a stamp")
        after = int(np.searchsorted(self.stamps, stamp))
        distances = {place: abs(int(self.stamps[place]) - stamp) for place in (after, after - 1) if self._has(place)}
        if len(distances) < 2 or sum(distances.values()) > LONGEST_GAP or not distances[after]:
            nearest = min(distances, key=distances.__getitem__, default=0)
            return self._known(nearest) if distances.get(nearest, LONGEST_GAP) <= ROUNDING else None
        first, last = int(self.stamps[after - 1]), int(self.stamps[after])
        fraction = (stamp - first) / (last - first)
        pose = interpolate(self.poses[after - 1], self.poses[after], fraction)
        if self.velocities is None:
            return Motion(pose)
        linear, angular = (1.0 - fraction) * self.velocities[after - 1] + fraction * self.velocities[after]
        return Motion(pose, float(linear), float(angular))

    def _has(self, place: int) -> bool:
        return 0 <= place < len(self.poses)

    def _known(self, place: int) -> Motion:
        linear, angular = (0.0, 0.0) if self.velocities is None else self.velocities[place]
        return Motion(np.array(self.poses[place]), float(linear), float(angular))


def derived(stamps: Sequence[int], poses: Sequence[Matrix | None]) -> list[Motion | None]:
    """Return the motion at each pose: how fast the body drove and turned from its neighbours' stamps (ns) and poses.

    None stays None. At the ends the difference is one-sided; a single pose, or one far from all others, stands still.
    """
    known = [place for place, pose in enumerate(poses) if pose is not None]
    motions: list[Motion | None] = [None] * len(poses)
    for order, place in enumerate(known):
        before, after = known[max(order - 1, 0)], known[min(order + 1, len(known) - 1)]
        before = before if stamps[place] - stamps[before] <= LONGEST_GAP else place
        after = after if stamps[after] - stamps[place] <= LONGEST_GAP else place
        here, first, last = poses[place], poses[before], poses[after]
        assert here is not None
        assert first is not None
        assert last is not None
        motions[place] = Motion(here, *_velocity(inverse(first) @ last, (stamps[after] - stamps[before]) * 1e-9))
    return motions


def _velocity(first_from_last: Matrix, seconds: float) -> tuple[float, float]:
    """Return m/s forward and rad/s of steady driving along an arc."""
    if not seconds > 0.0:
        return 0.0, 0.0
    turn = yaw(first_from_last)
    chord = (planar(0.0, 0.0, -0.5 * turn) @ first_from_last)[0, 3]  # an arc's chord points along the mean heading
    return float(chord / np.sinc(0.5 * turn / np.pi) / seconds), turn / seconds


def rotation_of(quaternion: Sequence[float] | npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a quaternion x, y, z, w. Raises ValueError unless its norm is near 1."""
    values = np.asarray(quaternion, np.float64)
    norm = float(np.linalg.norm(values))
    if not abs(norm - 1.0) < 0.1:
        raise ValueError(f"a quaternion of a rotation has norm 1; this one has {norm:.3g}")
    x, y, z, w = values / norm
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def pose_of(rotation: npt.NDArray[Any], translation: Sequence[float] | npt.NDArray[Any]) -> Matrix:
    """Build a pose (4, 4) of a rotation (3, 3), brought to exact orthogonality, and a translation (3,) in metres.

    Raises ValueError if the rotation is none by more than rounding, or a number is not finite.
    """
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise ValueError("a pose holds finite numbers only")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.01 or np.linalg.det(rotation) < 0.0:
        raise ValueError("its rotation part is no rotation: the columns are not orthonormal and right-handed")
    left, _, right = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = left @ right
    pose[:3, 3] = translation
    return pose
