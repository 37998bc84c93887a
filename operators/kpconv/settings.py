"""What a segmenter is: the architecture and its few numbers, by name."""

from __future__ import annotations

from typing import Literal

import msgspec

from operators.kpconv.pyramid import Geometry

CLASSES = ("ground", "permanent", "longT", "shortT")  # labels 1 to 4; 0 is uncertain and never predicted


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An architecture. Lengths in metres."""

    network: Literal["kpconv", "rangenet"] = "kpconv"
    voxel: float = 0.08  # of the finest level, and of the cloud that is handed on
    width: int = 32  # channels, see KPFCNN and RangeNet
    levels: int = 5
    kernel_points: int = 15
    sphere: float = 4.0  # radius of a training sphere
    beams: int = 32  # rows of the range image
    columns: int = 1024  # of the range image
    window: int = 512  # columns of a training window

    @property
    def geometry(self) -> Geometry:
        """Return what decides the pyramid."""
        return Geometry(self.voxel, self.levels, self.kernel_points)


PRESETS = {
    "paper": Settings(voxel=0.04, width=128),
    "realtime": Settings(voxel=0.08, width=32),
    "rangenet": Settings(network="rangenet", voxel=0.08, width=32),
}
