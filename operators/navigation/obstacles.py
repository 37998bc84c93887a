"""What stands in the way: cells above the floor that the lidar has hit, kept until it looks through them.

Each column of the raster holds eleven voxels, 0.1 m high, from 0.1 to 1.2 m above the floor. A hit fills its voxel and
leaves its height there. A frame's rays, gathered in a panorama of nearest ranges, wear off each voxel that they pass at
that height (a table's edge is thinner than a voxel); after LIFE frames it is empty. What enters the lidar's blind ring,
or hides behind something, stays. But near the robot the lidar looks only through the middle of a column: where a level
ray passes, what was seen overhead wears off too (a person who went), and slowly what was seen below (feet, a low box).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from graph.geometry import inverse
from operators.navigation.lattice import Box, Lattice, moved

LOWEST, HIGHEST = 0.1, 1.2  # metres above the floor: what the robot can hit
LEVEL = 0.1  # metres
LEVELS = 11
LIFE = 5  # frames of looking through a voxel that empty it
SLOWLY = 8  # frames that count as one for what lies below the beams: a low box is remembered for 4 s
OVERHEAD = 0.15  # metres above the lidar: more than a table is
SLOPE = 0.005  # metres a metre: how much the floor may seem to rise with distance, by a tilt of the pose

SECTORS = 1080  # a third of a degree, one cell at 8.6 m
LOOK = 5.0  # metres: how far free floor is entered

AZIMUTHS = 480
FIRST_ELEVATION, ELEVATION_STEP, ELEVATIONS = math.radians(-40.0), math.radians(2.0 / 3.0), 120
NOTHING = np.float32(1e9)  # range of a panorama cell without a return


@njit(cache=True)
def panorama(points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the nearest range (ELEVATIONS, AZIMUTHS) in metres of points (n, 3) in the lidar frame."""
    image = np.full((ELEVATIONS, AZIMUTHS), NOTHING, np.float32)
    for index in range(len(points)):
        x, y, z = np.float64(points[index, 0]), np.float64(points[index, 1]), np.float64(points[index, 2])
        flat = math.sqrt(x * x + y * y)
        row = math.floor((math.atan2(z, flat) - FIRST_ELEVATION) / ELEVATION_STEP)
        column = math.floor(math.atan2(y, x) * (AZIMUTHS / (2.0 * math.pi))) % AZIMUTHS
        if 0 <= row < ELEVATIONS:
            distance = np.float32(math.sqrt(flat * flat + z * z))
            image[row, column] = min(image[row, column], distance)
    return image


@njit(cache=True)
def _glance(image: npt.NDArray[np.float32], x: float, y: float, z: float, margin: float) -> tuple[bool, bool, bool]:
    """Look at a place in the lidar frame. Return: a ray passed through it, one ended there, one ended before it."""
    flat = math.sqrt(x * x + y * y)
    column = math.floor(math.atan2(y, x) * (AZIMUTHS / (2.0 * math.pi))) % AZIMUTHS
    middle = math.floor((math.atan2(z, flat) - FIRST_ELEVATION) / ELEVATION_STEP)
    distance = math.sqrt(flat * flat + z * z)
    passed, ended, covered = False, False, False
    for row in range(max(middle - 1, 0), min(middle + 2, ELEVATIONS)):  # two of the three are as far apart as beams
        # The nearest of three columns: along a wall one ray hits it well behind a voxel, the next one well before.
        seen = min(image[row, column - 1], image[row, column], image[row, (column + 1) % AZIMUTHS])
        if seen < NOTHING:
            if seen > distance + margin:
                passed = True
            elif seen >= distance - margin:
                ended = True
            else:
                covered = True
    return passed, ended, covered


@njit(cache=True)
def _moved(pose: npt.NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@njit(cache=True)
def wear(
    life: npt.NDArray[np.uint8],
    height: npt.NDArray[np.uint8],
    filled: npt.NDArray[np.bool_],
    image: npt.NDArray[np.float32],
    lidar_from_world: npt.NDArray[np.float64],
    floor: float,
    corner: tuple[float, float],
    resolution: float,
    box: Box,
    slowly: bool,
) -> None:
    """Take life from the voxels within a box of cells that this frame's rays passed through."""
    margin = 2.0 * resolution
    for row in range(box.top, box.bottom):
        for column in range(box.left, box.right):
            if not filled[row, column]:
                continue
            world_x, world_y = corner[0] + (column + 0.5) * resolution, corner[1] + (row + 0.5) * resolution
            lidar_x, lidar_y, _ = _moved(lidar_from_world, world_x, world_y, floor + 0.5 * (LOWEST + HIGHEST))
            level_ray, _, _ = _glance(image, lidar_x, lidar_y, 0.0, margin)
            emptied, seen, remaining = False, False, False
            for level in range(LEVELS):
                if life[row, column, level] == 0:
                    continue
                world_z = floor + LOWEST + (level + height[row, column, level] / 255.0) * LEVEL
                x, y, z = _moved(lidar_from_world, world_x, world_y, world_z)
                passed, ended, covered = _glance(image, x, y, z, margin)
                if passed and not ended:
                    life[row, column, level] -= 1
                    emptied = emptied or life[row, column, level] == 0
                elif level_ray and not (ended or covered) and (z > OVERHEAD or (z < 0.0 and slowly)):
                    life[row, column, level] -= 1
                if life[row, column, level] > 0:
                    seen = seen or passed or ended or covered
                    remaining = True
            if emptied and remaining and not seen:
                # Its upper part has gone; the lower, of which no ray tells (below all beams, or rays to the floor are
                # left out of the frame), went with it.
                life[row, column] = 0
                remaining = False
            filled[row, column] = remaining


@njit(cache=True)
def strike(
    life: npt.NDArray[np.uint8],
    height: npt.NDArray[np.uint8],
    filled: npt.NDArray[np.bool_],
    points: npt.NDArray[np.float32],
    world_from_lidar: npt.NDArray[np.float64],
    floor: float,
    corner: tuple[float, float],
    resolution: float,
    reach: float,
) -> None:
    """Fill the voxels that points (n, 3) in the lidar frame lie in, within `reach` metres of the lidar on the floor."""
    rows, columns = filled.shape
    pose = world_from_lidar
    for index in range(len(points)):
        x, y, z = np.float64(points[index, 0]), np.float64(points[index, 1]), np.float64(points[index, 2])
        world_x, world_y, world_z = _moved(pose, x, y, z)
        away = math.sqrt((world_x - pose[0, 3]) ** 2 + (world_y - pose[1, 3]) ** 2)
        if away > reach:
            continue
        above = world_z - floor
        if above < LOWEST + SLOPE * away or above >= HIGHEST:
            continue
        row = math.floor((world_y - corner[1]) / resolution)
        column = math.floor((world_x - corner[0]) / resolution)
        if 0 <= row < rows and 0 <= column < columns:
            part = (above - LOWEST) / LEVEL
            level = min(int(part), LEVELS - 1)
            life[row, column, level] = LIFE
            height[row, column, level] = int(255.0 * min(part - level, 1.0))
            filled[row, column] = True


@njit(cache=True)
def look(
    seen: npt.NDArray[np.bool_],
    points: npt.NDArray[np.float32],
    world_from_lidar: npt.NDArray[np.float64],
    floor: float,
    corner: tuple[float, float],
    resolution: float,
    reach: float,
) -> None:
    """Mark the columns that rays passed through: in each sector up to its nearest hit, or to its farthest floor.

    A sector without a return proves nothing: what stands in the blind ring swallows its rays.
    """
    pose = world_from_lidar
    nearest, farthest = np.full(SECTORS, np.inf), np.zeros(SECTORS)
    for index in range(len(points)):
        x, y, z = np.float64(points[index, 0]), np.float64(points[index, 1]), np.float64(points[index, 2])
        world_x, world_y, world_z = _moved(pose, x, y, z)
        across, along = world_x - pose[0, 3], world_y - pose[1, 3]
        away = math.sqrt(across * across + along * along)
        sector = math.floor(math.atan2(along, across) * (SECTORS / (2.0 * math.pi))) % SECTORS
        if LOWEST + SLOPE * away <= world_z - floor < HIGHEST:
            nearest[sector] = min(nearest[sector], away)
        farthest[sector] = max(farthest[sector], away)
    rows, columns = seen.shape
    for sector in range(SECTORS):
        end = min(reach, nearest[sector] if nearest[sector] < np.inf else farthest[sector])
        angle = (sector + 0.5) * (2.0 * math.pi / SECTORS)
        across, along = math.cos(angle), math.sin(angle)
        for step in range(int(end / resolution)):
            away = (step + 0.5) * resolution
            row = math.floor((pose[1, 3] + away * along - corner[1]) / resolution)
            column = math.floor((pose[0, 3] + away * across - corner[0]) / resolution)
            if 0 <= row < rows and 0 <= column < columns:
                seen[row, column] = True


class ObstacleLayer:
    """The columns that hold something, on a raster that grows with the world. 24 bytes a cell."""

    def __init__(self, lattice: Lattice, *, reach: float = 8.0) -> None:
        """Start empty. reach: metres around the lidar within which things are entered and removed."""
        self.lattice = lattice
        self.reach = reach
        self.frame = 0
        shape = lattice.rows, lattice.columns
        self._life = np.zeros((*shape, LEVELS), np.uint8)
        self._height = np.zeros((*shape, LEVELS), np.uint8)  # of the last hit, in 255ths of a level
        self.filled = np.zeros(shape, np.bool_)  # (rows, columns): something stands here
        self.seen = np.zeros(shape, np.bool_)  # (rows, columns): a ray has passed here

    def grow(self, lattice: Lattice) -> None:
        """Move onto a larger raster."""
        self._life = moved(self._life, self.lattice, lattice, 0)
        self._height = moved(self._height, self.lattice, lattice, 0)
        self.filled = moved(self.filled, self.lattice, lattice, False)
        self.seen = moved(self.seen, self.lattice, lattice, False)
        self.lattice = lattice

    def observe(
        self, points: npt.NDArray[np.float32], world_from_lidar: npt.NDArray[np.float64], floor: float = 0.0
    ) -> Box:
        """Enter a frame: points (n, 3) in the lidar frame; floor: its height in the world, metres.

        Returns the cells among which something may have changed.
        """
        self.frame += 1
        pose = np.array(world_from_lidar, np.float64)  # a copy: messages are read-only, which is another type to numba
        points = np.array(points, np.float32)
        row, column = self.lattice.cell(pose[0, 3], pose[1, 3])
        box = Box(row, row + 1, column, column + 1).grown(math.ceil(self.reach / self.lattice.resolution), self.lattice)
        layers = self._life, self._height, self.filled
        place = self.lattice.origin, self.lattice.resolution
        wear(*layers, panorama(points), inverse(pose), floor, *place, box, self.frame % SLOWLY == 0)
        strike(*layers, points, pose, floor, *place, self.reach)
        look(self.seen, points, pose, floor, *place, LOOK)
        return box

    def erase(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> None:
        """Empty columns of the raster by their indices (n,): they are known to be free."""
        self._life[rows, columns] = 0
        self.filled[rows, columns] = False
        self.seen[rows, columns] = True

    def fill(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> None:
        """Fill columns of the raster by their indices (n,), at the height of the lidar's level beams."""
        self._life[rows, columns, LEVELS // 2], self._height[rows, columns, LEVELS // 2] = LIFE, 0
        self.filled[rows, columns] = True
