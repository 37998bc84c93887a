"""The floor as the planner sees it: what map and lidar say stands there, how near that is, what driving there costs."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from operators.navigation.distance import distance_to
from operators.navigation.footprint import Footprint, Surroundings, inside
from operators.navigation.lattice import Box, Lattice, lattice_around, moved, resampled, union
from operators.navigation.obstacles import ObstacleLayer
from operators.navigation.search import BLOCKED

CELL = 0.05  # metres, of the map and of the local window
COARSE = 2  # cells of the map along one of the search's
BLOCK = 160  # cells by which the raster grows: 8 m
OCCUPIED = 50  # value of a map's cell from which it counts as occupied
LARGEST = 250.0  # metres from border to border: 25 million cells, 800 MB
MARGIN = 4.0  # metres of unknown floor kept around all that matters, so that a way can lead around

FREE = 8  # weight of open floor: whole numbers with room for an eighth
TIGHT = 48  # added to it at the robot's inscribed radius, falling to nothing with the square of the distance
UNKNOWN = 8  # added where neither map nor lidar have been
DOUBTFUL = 64  # added instead near the robot: so near, it hides where the lidar is blind
DOUBT_RADIUS = 1.0  # metres
ESCAPE = 160  # weight of cells too near to something, around a robot that stands there anyway
ESCAPE_RADIUS = 0.6  # metres


@njit(cache=True)
def weigh(
    weights: npt.NDArray[np.int32],
    distance: npt.NDArray[np.float32],
    cells: npt.NDArray[np.int8],
    seen: npt.NDArray[np.bool_],
    lethal: float,
    inflation: float,
    box: Box,
    robot: tuple[float, float],
) -> None:
    """Fill in the weights of a box of coarse cells: BLOCKED below `lethal` metres, falling to FREE at `inflation`.

    distance, cells, seen (rows, columns) on the fine raster; a coarse cell's distance is the mean of its four. Around
    the robot (row and column on the coarse raster) cells that are not themselves occupied are left open at the weight
    ESCAPE, and floor that nobody has seen is doubtful.
    """
    for row in range(box.top, box.bottom):
        for column in range(box.left, box.right):
            total, least, known = 0.0, 1e9, True
            for down in range(COARSE):
                for right in range(COARSE):
                    place = COARSE * row + down, COARSE * column + right
                    total += distance[place]
                    least = min(least, distance[place])
                    known = known and (cells[place] >= 0 or seen[place])
            mean = total / (COARSE * COARSE)
            away = CELL * COARSE * math.sqrt((row - robot[0]) ** 2 + (column - robot[1]) ** 2)
            if mean < lethal:
                weights[row, column] = ESCAPE if away <= ESCAPE_RADIUS and least > 0.0 else BLOCKED
                continue
            weight = FREE
            if not known:
                weight += DOUBTFUL if away <= DOUBT_RADIUS else UNKNOWN
            if mean < inflation:
                closeness = (inflation - mean) / (inflation - lethal)
                weight += int(TIGHT * closeness * closeness)
            weights[row, column] = weight


@njit(cache=True)
def _changed(old: npt.NDArray[np.int8], new: npt.NDArray[np.int8]) -> tuple[int, int, int, int]:
    """Return the box of cells that became or ceased to be unknown or occupied."""
    top, bottom, left, right = old.shape[0], 0, old.shape[1], 0
    for row in range(old.shape[0]):
        for column in range(old.shape[1]):
            a, b = old[row, column], new[row, column]
            if (a < 0) != (b < 0) or (a >= OCCUPIED) != (b >= OCCUPIED):
                top, bottom = min(top, row), max(bottom, row + 1)
                left, right = min(left, column), max(right, column + 1)
    return top, bottom, left, right


FAR_AWAY = (-1e6, -1e6)  # where no robot is
EMPTY = Box(0, 0, 0, 0)


class Costmap:
    """The map's cells and the obstacles seen, and what they cost, on one raster that grows with the world."""

    def __init__(self, *, lethal: float, inflation: float, reach: float = 8.0) -> None:
        """Start with nothing known. Lengths in metres.

        lethal: distance from a thing below which the robot's centre touches it; inflation: distance from which nearness
        costs nothing; reach: around the lidar, within which obstacles are entered and removed.
        """
        self.lethal, self.inflation = lethal, inflation
        self.lattice = Lattice(CELL, 0, 0, 0, 0)
        self.cells = np.full((0, 0), -1, np.int8)  # of the map: -1 unknown, 0 free to 100 occupied
        self.obstacles = ObstacleLayer(self.lattice, reach=reach)
        self._distance = np.full((0, 0), inflation, np.float32)
        self._weights = np.full((0, 0), FREE + UNKNOWN, np.int32)  # coarse
        self._stale = EMPTY  # cells whose distances and weights are to be computed anew

    def cover(self, *positions: tuple[float, float]) -> None:
        """Grow the raster to reach MARGIN beyond each position (x, y in metres). Raises ValueError when too far."""
        if all(self.lattice.covers(x, y, MARGIN) for x, y in positions):
            return
        places = np.array(positions)
        self._grow(lattice_around(CELL, places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN, block=BLOCK))

    def _grow(self, wanted: Lattice) -> None:
        lattice = union(self.lattice, wanted) if self.lattice.rows else wanted
        if max(lattice.rows, lattice.columns) * CELL > LARGEST:
            sides = f"{lattice.columns * CELL:.0f} x {lattice.rows * CELL:.0f} m"
            raise ValueError(
                f"Robot, goal and map together span {sides}; the planner's raster holds {LARGEST:.0f} m a side"
            )
        if lattice == self.lattice:
            return
        self.cells = moved(self.cells, self.lattice, lattice, -1)
        self._distance = moved(self._distance, self.lattice, lattice, self.inflation)
        coarse = self.lattice.coarse(COARSE), lattice.coarse(COARSE)
        self._weights = moved(self._weights, *coarse, FREE + UNKNOWN)
        down, right = self.lattice.first_row - lattice.first_row, self.lattice.first_column - lattice.first_column
        stale = self._stale
        self._stale = Box(stale.top + down, stale.bottom + down, stale.left + right, stale.right + right)
        self.obstacles.grow(lattice)
        self.lattice = lattice

    def set_map(self, cells: npt.NDArray[np.int8], origin: npt.ArrayLike, resolution: float) -> None:
        """Replace the map: cells (rows, columns) -1 unknown, 0 free to 100 occupied; origin of its corner in metres."""
        lower = np.asarray(origin, np.float64)
        upper = lower + resolution * np.array([cells.shape[1], cells.shape[0]])
        self._grow(lattice_around(CELL, lower - MARGIN, upper + MARGIN, block=BLOCK))
        fresh = resampled(cells, lower, resolution, self.lattice)
        self._stale = self._stale.joined(Box(*_changed(self.cells, fresh)))
        self.cells = fresh

    def observe(self, points: npt.NDArray[np.float32], world_from_lidar: npt.NDArray[np.float64], floor: float) -> None:
        """Enter a frame: points (n, 3) in the lidar frame; floor: its height in the world, metres."""
        self.cover((float(world_from_lidar[0, 3]), float(world_from_lidar[1, 3])))
        self._stale = self._stale.joined(self.obstacles.observe(points, world_from_lidar, floor))

    def stand(self, places: npt.NDArray[np.float64]) -> None:
        """Enter that something stands at places (n, 2; metres), until the lidar looks through them."""
        if len(places) == 0:
            return
        low, high = places.min(axis=0), places.max(axis=0)
        self.cover((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
        row, column = np.floor(places.T[::-1] / CELL).astype(np.int64)
        rows, columns = row - self.lattice.first_row, column - self.lattice.first_column
        self.obstacles.fill(rows, columns)
        changed = Box(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)
        self._stale = self._stale.joined(changed)

    def clear_footprint(self, footprint: Footprint, pose: tuple[float, float, float]) -> None:
        """Empty what seems to stand where the robot (x, y, yaw) itself stands."""
        row, column = self.lattice.cell(pose[0], pose[1])
        reach = math.ceil(footprint.circumscribed / CELL) + 1
        rows, columns = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1]
        x, y = self.lattice.centre(rows, columns)
        taken = inside(footprint, x, y, pose)
        taken &= (rows >= 0) & (rows < self.lattice.rows) & (columns >= 0) & (columns < self.lattice.columns)
        where = rows[taken], columns[taken]
        self.obstacles.erase(*where)
        self.cells[where] = np.minimum(self.cells[where], 0)
        self._touch(row, column, reach)

    def weights(self, robot: tuple[float, float], *, seen: bool = True) -> npt.NDArray[np.int32]:
        """Return the coarse raster's weights, for a search to a robot's position; by the map alone if not `seen`."""
        coarse = self.lattice.coarse(COARSE)
        row, column = coarse.cell(*robot)
        around = Box(row, row + 1, column, column + 1).grown(math.ceil(DOUBT_RADIUS / CELL / COARSE) + 1, coarse)
        costs = self.lethal, self.inflation
        if seen:
            self._refresh()
            weights, distance = self._weights.copy(), self._distance
        else:
            weights, distance = np.empty_like(self._weights), distance_to(self.cells >= OCCUPIED, CELL, self.inflation)
            whole = Box(0, coarse.rows, 0, coarse.columns)
            weigh(weights, distance, self.cells, self.obstacles.seen, *costs, whole, FAR_AWAY)
        weigh(weights, distance, self.cells, self.obstacles.seen, *costs, around, (float(row), float(column)))
        return weights

    def _refresh(self) -> None:
        """Compute distances and weights anew where something changed, and as far around as it can matter."""
        if self._stale.empty:
            return
        reach = math.ceil(self.inflation / CELL) + 1
        inner = self._stale.grown(reach, self.lattice)
        outer = inner.grown(reach, self.lattice)
        part = slice(outer.top, outer.bottom), slice(outer.left, outer.right)
        taken = (self.cells[part] >= OCCUPIED) | self.obstacles.filled[part]
        distance = distance_to(taken, CELL, self.inflation)
        rows, columns = slice(inner.top, inner.bottom), slice(inner.left, inner.right)
        self._distance[rows, columns] = distance[
            inner.top - outer.top : inner.bottom - outer.top, inner.left - outer.left : inner.right - outer.left
        ]
        box = Box(inner.top // COARSE, -(-inner.bottom // COARSE), inner.left // COARSE, -(-inner.right // COARSE))
        costs = self.lethal, self.inflation
        weigh(self._weights, self._distance, self.cells, self.obstacles.seen, *costs, box, FAR_AWAY)
        self._stale = EMPTY

    def trust(self, x: float, y: float, radius: float) -> None:
        """Take for free what nobody has seen within `radius` metres of a position."""
        rows, columns = self._unseen(x, y, radius)
        self.obstacles.seen[rows, columns] = True
        self._touch(*self.lattice.cell(x, y), math.ceil(radius / CELL))

    def distrust(self, x: float, y: float) -> None:
        """Take for occupied what nobody has seen around a position, as far as it may hide in the lidar's blind ring."""
        self.obstacles.fill(*self._unseen(x, y, DOUBT_RADIUS))
        self._touch(*self.lattice.cell(x, y), math.ceil(DOUBT_RADIUS / CELL))

    def _touch(self, row: int, column: int, cells: int) -> None:
        self._stale = self._stale.joined(Box(row, row + 1, column, column + 1).grown(cells, self.lattice))

    def _unseen(self, x: float, y: float, radius: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return rows and columns (n,) of the cells around a position that neither map nor lidar knows."""
        row, column = self.lattice.cell(x, y)
        reach = math.ceil(radius / CELL)
        rows, columns = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1]
        near = (rows - row) ** 2 + (columns - column) ** 2 <= (radius / CELL) ** 2
        near &= (rows >= 0) & (rows < self.lattice.rows) & (columns >= 0) & (columns < self.lattice.columns)
        rows, columns = rows[near], columns[near]
        unknown = (self.cells[rows, columns] < 0) & ~self.obstacles.seen[rows, columns]
        unknown &= ~self.obstacles.filled[rows, columns]
        return rows[unknown], columns[unknown]

    def standing(self, x: float, y: float, radius: float) -> npt.NDArray[np.float64]:
        """Return the centres (n, 2) of the occupied cells within `radius` metres of a position."""
        row, column = self.lattice.cell(x, y)
        reach = math.ceil(radius / CELL)
        top, left = max(row - reach, 0), max(column - reach, 0)
        part = slice(top, max(row + reach + 1, 0)), slice(left, max(column + reach + 1, 0))
        rows, columns = np.nonzero((self.cells[part] >= OCCUPIED) | self.obstacles.filled[part])
        places = np.stack(self.lattice.centre(rows + top, columns + left), axis=1)
        return np.asarray(places[np.hypot(places[:, 0] - x, places[:, 1] - y) <= radius])

    def window(self, x: float, y: float, side: float, limit: float) -> Surroundings:
        """Return how near things are, up to `limit` metres, in a square of `side` metres around a position.

        What neither map nor lidar has seen counts as occupied: the robot stops before it, and mostly sees it by then.
        """
        half = round(side / CELL) // 2
        row, column = self.lattice.cell(x, y)
        top, left = row - half, column - half
        rows = slice(max(top, 0), max(min(row + half, self.lattice.rows), 0))
        columns = slice(max(left, 0), max(min(column + half, self.lattice.columns), 0))
        part = (self.cells[rows, columns] >= OCCUPIED) | self.obstacles.filled[rows, columns]
        part |= (self.cells[rows, columns] < 0) & ~self.obstacles.seen[rows, columns]
        taken = np.ones((2 * half, 2 * half), np.bool_)
        taken[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = part
        corner = (left + self.lattice.first_column) * CELL, (top + self.lattice.first_row) * CELL
        return Surroundings(distance_to(taken, CELL, limit), CELL, *corner)
