"""What the annotation knows of a session: its frames and where the robot believed to be."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from graph.geometry import Matrix

UNCERTAIN, GROUND, PERMANENT, LONG_TERM, SHORT_TERM = range(5)
LABELS = ("uncertain", "ground", "permanent", "longT", "shortT")

Floats = npt.NDArray[np.float32]
Labels = npt.NDArray[np.uint8]


class Scan(NamedTuple):
    """One frame of a session, at the pose that the robot had online."""

    points: npt.NDArray[Any]  # (n, 3) metres in the sensor's frame, as if measured at once
    world_from_lidar: Matrix  # (4, 4)
    valid: bool = True  # whether the localizer believed its pose
    inliers: float = 1.0  # share of its samples that found their plane in the map
    odom_from_base: Matrix | None = None  # (4, 4), for those who align anew
    base_from_lidar: Matrix | None = None  # (4, 4)


class Session(Protocol):
    """Frames in their order; they may be read from a file each time they are iterated over."""

    @property
    def name(self) -> str: ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Scan]: ...
