"""PointMap: ICP localization on a point map that grows with every aligned frame (paper section III-A)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graph.geometry import interpolate, inverse, planar, rotation_angle, yaw
from operators.pointmap.draw import State, generator
from operators.pointmap.frame import Frame, prepare
from operators.pointmap.icp import Alignment, Criteria, align
from operators.pointmap.voxel_map import MapPoints, VoxelMap

Pose = npt.NDArray[np.float64]


class Settings(NamedTuple):
    """The parameters of PointMap; the defaults are the authors'."""

    map_voxel: float = 0.03  # metres
    frame_voxel: float = 0.10  # metres
    vertical_resolution: float = math.radians(1.33)  # of the lidar; sets the size of the neighbourhoods
    criteria: Criteria = Criteria()
    least_points: int = 100  # a frame with fewer usable points is not aligned
    largest_jump: float = 0.5  # metres between odometry's word and the alignment's
    largest_turn: float = math.radians(15.0)
    doubtful: float = 0.03  # metres between odometry's word and the alignment's, beyond which wheels may have slipped
    doubtful_turn: float = math.radians(0.5)
    watch: int = 20  # frames after a doubtful alignment for which the next are doubted, too
    grow: bool = True  # whether aligned frames enter a map that has points
    upright: float = 0.2  # share of its height and tilt that each pose of a level robot gives up
    seed: int = 0


class Track(NamedTuple):
    """What became of one frame."""

    world_from_lidar: Pose  # (4, 4)
    valid: bool
    reason: str  # why it is not valid
    inliers: float  # share of the samples that found their plane in the map
    iterations: int
    residual: float  # metres, root mean square distance of the inliers from their planes
    added: int  # new points of the map


def misfit(result: Alignment, reach: float) -> float:
    """Return the mean squared distance of the samples from their planes, m^2; `reach` metres for those that have none.

    On the wrong face of a wall what lies on walls fits as well as on the right one; what else there is has no plane.
    """
    return result.inliers * result.residual**2 + (1.0 - result.inliers) * reach**2


def leveled(world_from_base: Pose, share: float) -> Pose:
    """Return a pose (4, 4) that has given up a share (0 to 1) of its height and of its tilt; x, y and yaw stay."""
    flat = planar(world_from_base[0, 3], world_from_base[1, 3], yaw(world_from_base))
    return flat @ interpolate(inverse(flat) @ world_from_base, np.eye(4), share)


class PointMap:
    """Localize frames on a map and add them to it.

    Without an initial map the first frame enters at its guess and starts the map (PointMap*). A frame with too few
    points, without convergence, or that ends too far from its guess is not valid: its pose is the guess, and it leaves
    the map alone. So does one that corrects its guess by more than odometry drifts. Frames are numbered from 0; the
    number and the seed fix all random choices.
    """

    def __init__(self, settings: Settings | None = None, *, initial: MapPoints | None = None) -> None:
        self.settings = Settings() if settings is None else settings
        self.map = VoxelMap(self.settings.map_voxel)
        self.frames = 0
        self.last: Pose | None = None  # of the frame before
        self.step = np.eye(4)  # from the frame before that to it
        self.watching = 0  # frames left for which alignments are doubted
        if initial is not None:
            self.map.insert_map(initial)

    def prepare(self, points: npt.NDArray[Any]) -> Frame:
        """Subsample a frame (n, 3) in the sensor's frame and estimate its normals."""
        radius = 1.5 * self.settings.vertical_resolution
        return prepare(points, voxel_size=self.settings.frame_voxel, angular_radius=radius)

    def track(self, points: npt.NDArray[Any], guess: Pose, base_from_lidar: Pose | None = None) -> Track:
        """Align a frame (n, 3) in the sensor's frame, starting at the guess world_from_lidar, and map it.

        base_from_lidar: (4, 4), for a robot that drives on one level floor at height 0, else None. Without it the map
        of a long tour bends: a tilt of a tenth of a degree lifts the floor that is first seen at 10 m by 2 cm.
        """
        return self.track_frame(self.prepare(points), guess, base_from_lidar)

    def track_frame(self, frame: Frame, guess: Pose, base_from_lidar: Pose | None = None) -> Track:
        """Do what `track` does, for a frame from `prepare`."""
        guess = np.ascontiguousarray(guess, np.float64)
        count = len(frame.points)
        if count < self.settings.least_points:
            return self._refuse(guess, f"{count} usable points, {self.settings.least_points} are needed")
        if len(self.map) == 0:
            return self.enter(frame, guess)
        state = generator(self.settings.seed, self.frames)
        result = align(self.map.store, self.map.voxel_size, frame, guess, self.settings.criteria, state)
        if self.last is not None and (self.watching or self._apart(guess, result.world_from_lidar)):
            for start in self._without_slip(guess, self.last):
                result = self._better(result, frame, start, state)
        calm = not self._apart(guess, result.world_from_lidar)
        self.watching = max(self.watching - 1, 0) if calm else self.settings.watch
        pose = result.world_from_lidar
        if base_from_lidar is not None:
            pose = leveled(pose @ inverse(base_from_lidar), self.settings.upright) @ base_from_lidar
        jump = inverse(guess) @ pose
        distance, turn = float(np.linalg.norm(jump[:3, 3])), rotation_angle(jump)
        reason = ""
        if not result.converged:
            reason = f"no convergence in {result.iterations} iterations, {100 * result.inliers:.0f} % inliers"
        elif distance > self.settings.largest_jump or turn > self.settings.largest_turn:
            reason = f"a jump of {distance:.2f} m and {math.degrees(turn):.1f} deg against odometry"
        if reason:
            return self._refuse(guess, reason, result.inliers, result.iterations, result.residual)
        added = self._add(frame, pose, grow=calm)
        return Track(pose, True, "", result.inliers, result.iterations, result.residual, added)

    def _apart(self, one: Pose, other: Pose) -> bool:
        """Say whether an alignment corrects odometry by more than odometry drifts in a frame."""
        step = inverse(one) @ other
        far = float(np.linalg.norm(step[:3, 3])) > self.settings.doubtful
        return far or rotation_angle(step) > self.settings.doubtful_turn

    def _without_slip(self, guess: Pose, last: Pose) -> tuple[Pose, Pose]:
        """Return poses (4, 4) of a robot whose wheels only turned: where it was, or as far on as the frame before.

        A robot that somebody blocks slips 0.1 m a frame, and a wall of 0.15 m has a face on either side.
        """
        still = guess.copy()
        still[:3, 3] = last[:3, 3]
        gone = guess.copy()
        gone[:3, 3] = (last @ self.step)[:3, 3]
        return still, gone

    def _better(self, found: Alignment, frame: Frame, start: Pose, state: State) -> Alignment:
        """Align once more from another start (4, 4), world_from_lidar; return what fits better."""
        other = align(self.map.store, self.map.voxel_size, frame, start, self.settings.criteria, state)
        reach = self.settings.criteria.final_reach
        if other.converged and (not found.converged or misfit(other, reach) < misfit(found, reach)):
            return other
        return found

    def enter(self, frame: Frame, world_from_lidar: Pose) -> Track:
        """Add a prepared frame to the map at a pose that is known."""
        return Track(world_from_lidar, True, "", 1.0, 0, 0.0, self._add(frame, world_from_lidar, grow=True))

    def _add(self, frame: Frame, world_from_lidar: Pose, *, grow: bool) -> int:
        """Add a frame to the map, if that shall grow; returns how many points are new."""
        added = (
            self.map.insert(*frame.moved(world_from_lidar), frame.scores, self.frames)
            if (self.settings.grow and grow) or not len(self.map)
            else 0
        )
        self._go_on(world_from_lidar)
        return added

    def _go_on(self, world_from_lidar: Pose) -> None:
        """Count a frame, and remember its pose (4, 4) and the step to it."""
        self.frames += 1
        if self.last is not None:
            self.step = inverse(self.last) @ world_from_lidar
        self.last = world_from_lidar

    def _refuse(
        self, guess: Pose, reason: str, inliers: float = 0.0, iterations: int = 0, residual: float = 0.0
    ) -> Track:
        self._go_on(guess)
        return Track(guess, False, reason, inliers, iterations, residual, 0)
