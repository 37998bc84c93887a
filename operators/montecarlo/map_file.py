"""Occupancy maps as ROS keeps them: map.yaml and an image beside it (map_server of ROS, and of Nav2)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import yaml

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
SHADES = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}  # as map_saver writes them
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196


class MapError(ValueError):
    """A map that cannot be used: the message says in one sentence what is wrong, and where."""


class GridMap(NamedTuple):
    """A 2-D map; `cells[row, column]` covers origin + resolution * (column .. column + 1, row .. row + 1)."""

    cells: npt.NDArray[np.int8]  # (rows, columns) -1 unknown, 0 free to 100 occupied
    origin: npt.NDArray[np.float64]  # (2,) metres in the world
    resolution: float  # metres a cell


def load_map(path: Path) -> GridMap:
    """Read map.yaml and its image. Raises MapError in one sentence, and OSError for a file that cannot be opened."""
    try:
        fields = yaml.safe_load(path.read_text("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise MapError(f"{path} is no ROS map.yaml: {' '.join(str(error).split())}") from None
    if not isinstance(fields, dict) or (
        missing := [key for key in ("image", "resolution", "origin") if key not in fields]
    ):
        named = " and ".join(missing) if isinstance(fields, dict) else "image, resolution and origin"
        raise MapError(f"{path} is no ROS map.yaml: it has no {named}")
    resolution = _number(path, fields, "resolution")
    if not 0.0 < resolution < math.inf:
        raise MapError(f"{path}: the resolution of a map is above 0 metres a cell; it is {resolution:g}")
    origin = fields["origin"]
    if not (isinstance(origin, list) and len(origin) in (2, 3) and all(_finite(value) for value in origin)):
        raise MapError(f"{path}: the origin of a map is x, y and heading, three numbers; it is {origin!r}")
    if len(origin) == 3 and origin[2] != 0:
        raise MapError(
            f"{path}: a map that is turned, here by {origin[2]:g} rad, is not read; its rows must run along x"
        )
    occupied = _number(path, fields, "occupied_thresh", OCCUPIED_THRESHOLD)
    free = _number(path, fields, "free_thresh", FREE_THRESHOLD)
    mode = fields.get("mode", "trinary")
    if mode not in ("trinary", "scale", "raw"):
        raise MapError(f"{path}: mode is trinary, scale or raw; it is {mode!r}")
    levels = _levels(path.parent / str(fields["image"]))
    if mode == "raw":
        cells = np.where(levels <= OCCUPIED, levels, UNKNOWN)
    else:
        share = levels / 255.0 if fields.get("negate", 0) else (255.0 - levels) / 255.0
        between = (
            np.rint(100.0 * (share - free) / (occupied - free)) if mode == "scale" else np.full(share.shape, UNKNOWN)
        )
        cells = np.where(share > occupied, OCCUPIED, np.where(share < free, FREE, between))
    upright = np.ascontiguousarray(cells[::-1].astype(np.int8))  # an image begins with the row of the largest y
    return GridMap(upright, np.array(origin[:2], np.float64), resolution)


def save_map(path: Path, grid: GridMap) -> None:
    """Write map.yaml at `path` and the image beside it, a binary PGM of the same stem; cells become trinary.

    Raises MapError for a map that has no cells, OSError when it cannot be written.
    """
    if grid.cells.ndim != 2 or not grid.cells.size:
        raise MapError(f"{path}: a map wants cells (rows, columns); there are {grid.cells.shape}")
    image = path.with_suffix(".pgm")
    share = grid.cells.astype(np.float64) / 100.0
    shades = np.where(share > OCCUPIED_THRESHOLD, SHADES[OCCUPIED], SHADES[FREE])
    shades = np.where(
        (grid.cells < 0) | ((share >= FREE_THRESHOLD) & (share <= OCCUPIED_THRESHOLD)), SHADES[UNKNOWN], shades
    )
    rows, columns = grid.cells.shape
    image.write_bytes(b"P5\n%d %d\n255\n" % (columns, rows) + shades[::-1].astype(np.uint8).tobytes())
    fields = {
        "image": image.name,
        "mode": "trinary",
        "resolution": float(grid.resolution),
        "origin": [float(grid.origin[0]), float(grid.origin[1]), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }
    path.write_text(yaml.safe_dump(fields, sort_keys=False), encoding="utf-8")


def _levels(path: Path) -> npt.NDArray[np.float64]:
    """Return the image's grey levels (rows, columns), 0 to 255, the top row first."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            return np.asarray(picture.convert("L"), np.float64)
    except FileNotFoundError:
        raise MapError(f"{path}: the image of the map is not there") from None
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise MapError(f"{path} is no image that can be read: {error}") from None


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _number(path: Path, fields: dict[str, Any], key: str, default: float | None = None) -> float:
    value: Any = fields.get(key, default)
    if not _finite(value):
        raise MapError(f"{path}: {key} is a number; it is {value!r}")
    return float(value)
