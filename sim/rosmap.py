"""ROS maps (map.yaml and an image): as blocks of wall, merged from their occupied cells; and of a building's walls."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt
import yaml
from scipy.ndimage import label

from sim.building import Block, Building, BuildingError
from sim.masonry import door_leaf, wall_bodies
from sim.solids import Body

Cells = npt.NDArray[np.bool_]


class RosMap(msgspec.Struct, frozen=True):
    """The fields of a map.yaml that say which cells are occupied (map_server of ROS and ROS 2)."""

    image: str
    resolution: float  # metres a cell
    origin: tuple[float, float, float]  # x, y (metres), heading (radians) of the lower left corner
    negate: bool | Literal[0, 1] = 0
    occupied_thresh: float = 0.65
    free_thresh: float = 0.196
    mode: Literal["trinary", "scale", "raw"] = "trinary"


def read_map(path: Path, height: float) -> list[Block]:
    """Read map.yaml and its image; return the occupied cells as blocks of a height in metres.

    Cells that touch are one body. Raises BuildingError with the file if YAML or image cannot be used.
    """
    try:
        info = msgspec.convert(yaml.safe_load(path.read_text(encoding="utf-8")), RosMap)
    except (yaml.YAMLError, UnicodeDecodeError, msgspec.ValidationError) as error:
        raise BuildingError(f"{path}: not a ROS map: {error}") from error
    if not info.resolution > 0:
        raise BuildingError(f"{path}: a resolution of {info.resolution} m a cell")
    occupied = _occupied(path.parent / info.image, info)
    things, _ = label(occupied, np.ones((3, 3)))
    x0, y0, turn = info.origin
    cosine, sine = math.cos(turn), math.sin(turn)
    blocks = []
    for row, column, rows, columns in rectangles(occupied):
        size = np.array([columns, rows]) * info.resolution
        x, y = np.array([column, row]) * info.resolution + size / 2
        middle = x0 + cosine * x - sine * y, y0 + sine * x + cosine * y
        blocks.append(
            Block(
                low=(middle[0] - size[0] / 2, middle[1] - size[1] / 2, 0.0),
                high=(middle[0] + size[0] / 2, middle[1] + size[1] / 2, height),
                heading=math.degrees(turn),
                part_of=f"map {things[row, column]}",
            )
        )
    return blocks


def _occupied(path: Path, info: RosMap) -> Cells:
    """Return the occupied cells [row, column] with the lowest row first."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            levels = np.asarray(picture.convert("RGBA" if "A" in picture.getbands() else "RGB"), np.float64) / 255
    except FileNotFoundError:
        raise BuildingError(f"{path}: the map's image is not there") from None
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise BuildingError(f"{path}: not an image that can be read: {error}") from error
    shade = levels[..., :3].mean(2)
    if info.mode == "raw":
        chance = shade * 2.55  # raw cells are percent, 255 unknown
        chance[chance > 1.0] = 0.0
    else:
        chance = shade if info.negate else 1.0 - shade
    if info.mode == "scale" and levels.shape[2] == 4:
        chance[levels[..., 3] < 1.0] = 0.0  # translucent cells are unknown
    return np.ascontiguousarray(chance[::-1] > info.occupied_thresh)


def rectangles(cells: Cells) -> list[tuple[int, int, int, int]]:
    """Cover the true cells [row, column] by disjoint rectangles (row, column, rows, columns).

    Runs of a row are joined with equal runs of the rows above.
    """
    found: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], tuple[int, int]] = {}  # (first column, columns): (first row, rows)
    for row in range(cells.shape[0] + 1):
        padded = np.zeros(cells.shape[1] + 2, np.int8)
        if row < cells.shape[0]:
            padded[1:-1] = cells[row]
        edges = np.diff(padded)
        firsts, ends = np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist()
        runs = {(first, end - first) for first, end in zip(firsts, ends, strict=True)}
        for run in [run for run in growing if run not in runs]:
            start, rows = growing.pop(run)
            found.append((start, run[0], rows, run[1]))
        for run in sorted(runs):
            start, rows = growing.get(run, (row, 0))
            growing[run] = start, rows + 1
    return sorted(found)


def write_map(building: Building, path: Path, resolution: float = 0.05, height: float = 1.0) -> None:
    """Write map.yaml and a PGM beside it: a building's walls at a height in metres, doors open, no furniture.

    Cells that walls and closed doors shut off from the border are free, others unknown. Raises BuildingError.
    """
    x0, y0, x1, y1 = building.bounds()
    margin = 10 * resolution
    low = np.array([x0, y0]) - margin
    columns, rows = (math.ceil(round(side / resolution, 6)) + 20 for side in (x1 - x0, y1 - y0))
    walls = _drawn(wall_bodies(building), low, (rows, columns), resolution, height)
    leaves = [door_leaf(building, index, 0.0) for index in range(len(building.doors))]
    shut = walls | _drawn(leaves, low, (rows, columns), resolution, height)
    parts, _ = label(~shut)
    outer = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    unknown = ~walls & ~shut & np.isin(parts, outer)
    if not (~walls & ~unknown).any():
        raise BuildingError(f"building {building.name}: its walls enclose no free floor, so no map can be drawn")
    shades = np.where(walls, 0, np.where(unknown, 205, 254)).astype(np.uint8)  # as map_saver of ROS
    image = path.with_suffix(".pgm")
    image.write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + shades[::-1].tobytes())
    info = RosMap(image.name, resolution, (round(float(low[0]), 6), round(float(low[1]), 6), 0.0), negate=0)
    path.write_text(yaml.safe_dump(msgspec.to_builtins(info) | {"origin": list(info.origin)}, sort_keys=False), "utf-8")


def _drawn(
    bodies: list[Body], low: npt.NDArray[np.float64], shape: tuple[int, int], cell: float, height: float
) -> Cells:
    """Return the cells whose centre lies in the ground plan of a part that reaches a height."""
    taken = np.zeros(shape, np.bool_)
    for part in (part for body in bodies for part in body.parts):
        if abs(part.z - height) > part.dz / 2:
            continue
        corners = (part.footprint() - low) / cell - 0.5  # in cells, from the centre of cell 0
        first = np.maximum(np.ceil(corners.min(0) - 1e-6).astype(int), 0)
        last = np.minimum(np.floor(corners.max(0) + 1e-6).astype(int), np.array(shape[::-1]) - 1)
        x, y = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1))
        inside = np.ones(x.shape, np.bool_)
        for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= -1e-6
        taken[first[1] : last[1] + 1, first[0] : last[0] + 1] |= inside
    return taken
