"""Things that grow while a robot drives: a map, a trail. A viewer keeps every version it is sent, so send little."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

_OFFSET, _SPAN = 1 << 20, 1 << 21  # voxel indices from -2^20 to 2^20 along each axis, packed into one integer


class Layer(NamedTuple):
    """A part of a growing cloud: points (n, 3), colours (n, 3). Empty where it has gone into another part."""

    level: int
    points: Points
    colours: Colours


class LayeredCloud:
    """Keep a growing cloud in layers, each as large as all before it: n increments send a point log2(n) times.

    voxel: metres; of the points of one voxel the first is kept.
    """

    def __init__(self, voxel: float = 0.08) -> None:
        self.voxel = voxel
        self._seen: set[int] = set()
        self._layers: list[Layer | None] = []

    def __len__(self) -> int:
        return len(self._seen)

    def clear(self) -> list[Layer]:
        """Forget all points. Returns the layers that are empty now."""
        gone = [_empty(layer.level) for layer in self._layers if layer is not None]
        self._seen.clear()
        self._layers.clear()
        return gone

    def add(self, points: npt.NDArray[Any], colours: Colours) -> list[Layer]:
        """Add points (n, 3) with colours (n, 3). Returns the layers that have changed, the emptied ones first."""
        fresh = self._fresh(points)
        if not fresh.size:
            return []
        grown = Layer(0, points[fresh].astype(np.float32), colours[fresh])
        changed = []
        for level, layer in enumerate(self._layers):
            if layer is None:
                break
            changed.append(_empty(level))
            both = np.concatenate([layer.points, grown.points]), np.concatenate([layer.colours, grown.colours])
            grown = Layer(level + 1, *both)
            self._layers[level] = None
        if grown.level == len(self._layers):
            self._layers.append(None)
        self._layers[grown.level] = grown
        return [*changed, grown]

    def _fresh(self, points: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return the indices of the points that are the first of their voxel, and remember the voxels."""
        cells = np.floor(points.astype(np.float64) / self.voxel).astype(np.int64) + _OFFSET
        keys, first = np.unique((cells[:, 0] * _SPAN + cells[:, 1]) * _SPAN + cells[:, 2], return_index=True)
        new = [place for place, key in enumerate(keys.tolist()) if key not in self._seen]
        self._seen.update(keys[new].tolist())
        return np.sort(first[new])


def _empty(level: int) -> Layer:
    return Layer(level, np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))


class Trail:
    """Keep the way that a body has come: a point every `spacing` metres, and never more than `limit`.

    Where there would be more, every other point goes and the spacing doubles.
    """

    def __init__(self, spacing: float = 0.1, limit: int = 1000) -> None:
        self.spacing, self.limit = spacing, limit
        self.points: list[npt.NDArray[np.float64]] = []

    def extend(self, position: npt.NDArray[np.float64]) -> bool:
        """Go to a position (3,). Returns whether the trail has grown."""
        if self.points and np.linalg.norm(position - self.points[-1]) < self.spacing:
            return False
        self.points.append(np.array(position))
        if len(self.points) > self.limit:
            self.points = self.points[::2]
            self.spacing *= 2
        return True
