"""Trajectories out: TUM files, which evo and most SLAM tools read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from operators.scans.stamps import SECOND


def write_tum(path: Path, stamps_ns: Sequence[int], world_from_base: npt.ArrayLike) -> None:
    """Write poses (n, 4, 4) at stamps (n,) in ns as lines `t x y z qx qy qz qw`, seconds and metres.

    The file appears whole or not at all. Raises ValueError if the lengths differ, OSError when it cannot be written.
    """
    poses = np.asarray(world_from_base, np.float64).reshape(-1, 4, 4)
    if len(poses) != len(stamps_ns):
        raise ValueError(f"a trajectory has one stamp a pose; there are {len(stamps_ns)} stamps and {len(poses)} poses")
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True) if len(poses) else np.empty((0, 4))
    values = np.concatenate([poses[:, :3, 3], quaternions], axis=1) + 0.0  # no -0.0
    lines = [
        f"{_seconds(int(stamp))} {' '.join(f'{value:.9f}' for value in row)}\n"
        for stamp, row in zip(stamps_ns, values, strict=True)
    ]
    partial = path.with_name(f"{path.name}.part")
    try:
        with partial.open("w", encoding="ascii") as file:
            file.write("".join(lines))
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def _seconds(stamp: int) -> str:
    whole, rest = divmod(abs(stamp), SECOND)
    return f"{'-' if stamp < 0 else ''}{whole}.{rest:09d}"
