"""A picture of an occupancy map over the walls as they are."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt

from operators.montecarlo.map_file import FREE_THRESHOLD, OCCUPIED_THRESHOLD, GridMap

UNSEEN, SEEN, FOUND, WALL = (205, 205, 205), (254, 254, 254), (0, 0, 0), (235, 150, 140)
MARGIN = 20  # cells around what was seen


def map_picture(grid: GridMap, walls: GridMap | None = None) -> bytes:
    """Draw a map as a PNG, a pixel a cell, y upwards: occupied cells black, over the occupied ones of `walls` in red.

    Only what was seen is shown, with a margin. Where a wall is drawn twice, the map was not closed.
    """
    from PIL import Image

    colours = np.full((*grid.cells.shape, 3), UNSEEN, np.uint8)
    colours[(grid.cells >= 0) & (grid.cells < 100 * FREE_THRESHOLD)] = SEEN
    if walls is not None:
        rows, columns = np.nonzero(walls.cells > 100 * OCCUPIED_THRESHOLD)
        centres = walls.origin + walls.resolution * (np.stack([columns, rows], axis=1) + 0.5)
        cells = np.floor((centres - grid.origin) / grid.resolution).astype(np.int64)
        inside = ((cells >= 0) & (cells < grid.cells.shape[::-1])).all(axis=1)
        colours[cells[inside, 1], cells[inside, 0]] = WALL
    colours[grid.cells > 100 * OCCUPIED_THRESHOLD] = FOUND
    stream = io.BytesIO()
    Image.fromarray(colours[_seen(grid)][::-1]).quantize(8).save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def _seen(grid: GridMap) -> tuple[slice, slice]:
    return _span(grid.cells.max(axis=1) >= 0), _span(grid.cells.max(axis=0) >= 0)


def _span(known: npt.NDArray[np.bool_]) -> slice:
    places = np.nonzero(known)[0]
    return slice(max(0, int(places[0]) - MARGIN), int(places[-1]) + 1 + MARGIN) if len(places) else slice(None)
