"""How far an estimated trajectory is from a reference, by evo."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from operators.scans.scan import ScanError
from operators.scans.trajectory import Trajectory

Doubles = npt.NDArray[np.float64]


class Accuracy(NamedTuple):
    """Errors of a trajectory, pose by pose and stretch by stretch."""

    translation: Doubles  # (n,) metres, absolute pose error
    rotation: Doubles  # (n,) radians
    drift: Doubles  # (m,) metres, relative pose error over each stretch of `delta` metres
    turn: Doubles  # (m,) radians

    def statistics(self) -> dict[str, dict[str, float]]:
        """Return rmse, mean, median, p95 and max of each, by name; what has no entries is left out."""
        return {name: _statistics(errors) for name, errors in self._asdict().items() if len(errors)}


def _statistics(errors: Doubles) -> dict[str, float]:
    return {
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "mean": float(np.mean(errors)),
        "median": float(np.median(errors)),
        "p95": float(np.percentile(errors, 95)),
        "max": float(np.max(errors)),
    }


def accuracy(
    reference: Trajectory, estimate: Trajectory, *, align: bool = False, tolerance: float = 0.01, delta: float = 1.0
) -> Accuracy:
    """Compute absolute and relative pose errors with evo, at stamps that agree within a tolerance in seconds.

    align: first bring the estimate onto the reference by the best rigid transform (Umeyama). delta: metres of driving
    over which drift is measured; a shorter trajectory has none. Raises ScanError without stamps in common, or evo.
    """
    try:
        from evo.core import metrics, sync
        from evo.core.filters import FilterException
        from evo.core.trajectory import PoseTrajectory3D
        from evo.core.units import Unit
    except ImportError:
        raise ScanError('errors of trajectories are computed by evo: pip install "retracer[evo]"') from None

    if reference.stamps is None or estimate.stamps is None:
        raise ScanError("errors of trajectories want stamps; without them nobody knows which poses belong together")
    if not (len(reference.stamps) and len(estimate.stamps)):
        raise ScanError("errors of trajectories want poses; one of the two has none")
    start = int(reference.stamps[0])  # evo keeps seconds as float64
    both = []
    for known in (reference, estimate):
        assert known.stamps is not None
        seconds = (known.stamps - start) * 1e-9
        both.append(PoseTrajectory3D(poses_se3=list(known.poses), timestamps=seconds))
    try:
        true, guessed = sync.associate_trajectories(*both, max_diff=tolerance)
    except sync.SyncException:
        raise ScanError(f"the two trajectories have no stamps in common, within {tolerance:g} s") from None
    if align:
        guessed.align(true)
    found = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad):
        metric = metrics.APE(relation)
        metric.process_data((true, guessed))
        found.append(np.asarray(metric.error, np.float64))
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad):
        metric = metrics.RPE(relation, delta=delta, delta_unit=Unit.meters, pairs_from_reference=True)
        try:
            metric.process_data((true, guessed))
            found.append(np.asarray(metric.error, np.float64))
        except FilterException:  # the way is shorter than delta
            found.append(np.empty(0))
    return Accuracy(*found)
