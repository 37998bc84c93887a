"""Made-up scans of a box-shaped room, for those who must run once before a run begins."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

HALF = np.array([4.0, 3.0, 1.2])  # metres: the room around the lidar


def room_scan(beams: int = 32, columns: int = 512, turn: float = 0.0) -> npt.NDArray[np.float32]:
    """Scan the inside of a box from its middle. turn: heading in radians. Returns (beams * columns, 3), lidar frame."""
    elevation = np.radians(np.linspace(-25.0, 15.0, beams))
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    tilt, bearing = np.meshgrid(elevation, azimuth, indexing="ij")
    rays = np.stack([np.cos(tilt) * np.cos(bearing), np.cos(tilt) * np.sin(bearing), np.sin(tilt)], -1).reshape(-1, 3)
    cosine, sine = np.cos(turn), np.sin(turn)
    world = rays @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    reach = np.min(HALF / np.maximum(np.abs(world), 1e-9), axis=1)
    return (rays * reach[:, None]).astype(np.float32)
