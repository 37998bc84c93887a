"""What stands in the way: cells above the floor that the lidar has hit, kept until it looks through them.

Each column of the raster holds eleven voxels, 0.1 m high, from 0.1 to 1.2 m above the floor. A hit fills its voxel. A frame's
rays, gathered in a panorama of nearest ranges, wear off every voxel that they pass through; after LIFE frames it is empty.
Nothing is forgotten for not being seen: what enters the lidar's blind ring, or hides behind something, stays.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from graph.geometry import inverse
from operators.navigation.lattice import Lattice, moved

LOWEST, HIGHEST = 0.1, 1.2  # metres above the floor: what the robot can hit
LEVEL = 0.1  # metres
LEVELS = 11
LIFE = 5  # frames of looking through a voxel that empty it
SLOPE = 0.005  # metres a metre: how much the floor may seem to rise with distance, by a tilt of the pose
BLIND = 0.95  # metres from the lidar: nearer things send no echo
LOWEST_BEAM = math.radians(-30.0)
SILENCE = 20  # frames after which a voxel in plain sight is dropped though no ray came back from behind it

AZIMUTHS = 720
FIRST_ELEVATION, ELEVATION_STEP, ELEVATIONS = math.radians(-40.0), math.radians(2.0 / 3.0), 120
NOTHING = np.float32(1e9)  # range of a panorama cell without a return


@njit(cache=True)
def panorama(points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the nearest range by elevation and azimuth, (ELEVATIONS, AZIMUTHS) metres, of points (n, 3) in the lidar frame."""
    image = np.full((ELEVATIONS, AZIMUTHS), NOTHING, np.float32)
    for index in range(len(points)):
        x, y, z = float(points[index, 0]), float(points[index, 1]), float(points[index, 2])
        flat = math.sqrt(x * x + y * y)
        row = math.floor((math.atan2(z, flat) - FIRST_ELEVATION) / ELEVATION_STEP)
        column = math.floor(math.atan2(y, x) * (AZIMUTHS / (2.0 * math.pi))) % AZIMUTHS
        if 0 <= row < ELEVATIONS:
            distance = np.float32(math.sqrt(flat * flat + z * z))
            image[row, column] = min(image[row, column], distance)
    return image


@njit(cache=True)
def _glance(
    image: npt.NDArray[np.float32], x: float, y: float, z: float, half_height: float, margin: float
) -> tuple[bool, bool, bool]:
    """Look at a voxel in the lidar frame. Return: a ray passed through it, one ended in it, one ended before it."""
    flat = math.sqrt(x * x + y * y)
    column = math.floor(math.atan2(y, x) * (AZIMUTHS / (2.0 * math.pi))) % AZIMUTHS
    lower = math.floor((math.atan2(z - half_height, flat) - FIRST_ELEVATION) / ELEVATION_STEP)
    upper = math.floor((math.atan2(z + half_height, flat) - FIRST_ELEVATION) / ELEVATION_STEP)
    distance = math.sqrt(flat * flat + z * z)
    passed, ended, covered = False, False, False
    for row in range(max(lower, 0), min(upper, ELEVATIONS - 1) + 1):
        seen = image[row, column]
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
    hit_frame: npt.NDArray[np.int32],
    filled: npt.NDArray[np.bool_],
    image: npt.NDArray[np.float32],
    lidar_from_world: npt.NDArray[np.float64],
    floor: float,
    frame: int,
    corner: tuple[float, float],
    resolution: float,
    box: tuple[int, int, int, int],
) -> None:
    """Take life from the voxels within a box of cells (rows, columns: from, to) that this frame's rays passed through."""
    margin = 2.0 * resolution
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            if not filled[row, column]:
                continue
            world_x, world_y = corner[0] + (column + 0.5) * resolution, corner[1] + (row + 0.5) * resolution
            remaining = False
            for level in range(LEVELS):
                if life[row, column, level] == 0:
                    continue
                world_z = floor + LOWEST + (level + 0.5) * LEVEL
                x, y, z = _moved(lidar_from_world, world_x, world_y, world_z)
                passed, ended, covered = _glance(image, x, y, z, 0.5 * LEVEL, margin)
                if ended:
                    pass
                elif passed:
                    life[row, column, level] -= 1
                elif not covered and frame - hit_frame[row, column] > SILENCE:
                    flat = math.sqrt(x * x + y * y)
                    if flat * flat + z * z > BLIND * BLIND and math.atan2(z - 0.5 * LEVEL, flat) > LOWEST_BEAM:
                        life[row, column, level] = 0
                remaining = remaining or life[row, column, level] > 0
            filled[row, column] = remaining


@njit(cache=True)
def strike(
    life: npt.NDArray[np.uint8],
    hit_frame: npt.NDArray[np.int32],
    filled: npt.NDArray[np.bool_],
    points: npt.NDArray[np.float32],
    world_from_lidar: npt.NDArray[np.float64],
    floor: float,
    frame: int,
    corner: tuple[float, float],
    resolution: float,
    reach: float,
) -> None:
    """Fill the voxels that points (n, 3) in the lidar frame lie in, within `reach` metres of the lidar on the floor."""
    rows, columns = filled.shape
    pose = world_from_lidar
    for index in range(len(points)):
        x, y, z = float(points[index, 0]), float(points[index, 1]), float(points[index, 2])
        world_x, world_y, world_z = _moved(pose, x, y, z)
        away = math.sqrt((world_x - pose[0, 3]) ** 2 + (world_y - pose[1, 3]) ** 2)
        if away > reach:
            continue
        height = world_z - floor
        if height < LOWEST + SLOPE * away or height >= HIGHEST:
            continue
        row = math.floor((world_y - corner[1]) / resolution)
        column = math.floor((world_x - corner[0]) / resolution)
        if 0 <= row < rows and 0 <= column < columns:
            life[row, column, min(int((height - LOWEST) / LEVEL), LEVELS - 1)] = LIFE
            hit_frame[row, column] = frame
            filled[row, column] = True


class ObstacleLayer:
    """The columns that hold something, on a raster that grows with the world. 16 bytes a cell."""

    def __init__(self, lattice: Lattice, *, reach: float = 8.0) -> None:
        """Start empty. reach: metres around the lidar within which things are entered and removed."""
        self.lattice = lattice
        self.reach = reach
        self.frame = 0
        shape = lattice.rows, lattice.columns
        self._life = np.zeros((*shape, LEVELS), np.uint8)
        self._hit_frame = np.zeros(shape, np.int32)
        self.filled = np.zeros(shape, np.bool_)  # (rows, columns): something stands here

    def grow(self, lattice: Lattice) -> None:
        """Move onto a larger raster."""
        self._life = moved(self._life, self.lattice, lattice, 0)
        self._hit_frame = moved(self._hit_frame, self.lattice, lattice, 0)
        self.filled = moved(self.filled, self.lattice, lattice, False)
        self.lattice = lattice

    def observe(
        self, points: npt.NDArray[np.float32], world_from_lidar: npt.NDArray[np.float64], floor: float = 0.0
    ) -> None:
        """Enter a frame: points (n, 3) in the lidar frame; floor: its height in the world, metres."""
        self.frame += 1
        pose = np.array(world_from_lidar, np.float64)  # a copy: messages are read-only, which is another type to numba
        points = np.array(points, np.float32)
        cells = math.ceil(self.reach / self.lattice.resolution)
        row, column = self.lattice.cell(pose[0, 3], pose[1, 3])
        box = (
            max(row - cells, 0),
            min(row + cells + 1, self.lattice.rows),
            max(column - cells, 0),
            min(column + cells + 1, self.lattice.columns),
        )
        layers = self._life, self._hit_frame, self.filled
        place = self.lattice.origin, self.lattice.resolution
        wear(*layers, panorama(points), inverse(pose), floor, self.frame, *place, box)
        strike(*layers, points, pose, floor, self.frame, *place, self.reach)

    def erase(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> None:
        """Empty columns of the raster by their indices (n,)."""
        self._life[rows, columns] = 0
        self.filled[rows, columns] = False
