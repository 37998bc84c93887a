"""PointMap: ICP localization and mapping with lidar frames, arrays in, arrays out (paper section III-A).

pointmap = PointMap(initial=load_map(Path("map.ply")))
track = pointmap.track(points_lidar, world_from_lidar_guess)
"""

from operators.pointmap.deskew import deskew
from operators.pointmap.frame import Frame, prepare
from operators.pointmap.ground import find_ground, height_above
from operators.pointmap.icp import Criteria
from operators.pointmap.mapper import Mapper
from operators.pointmap.occupancy import Occupancy
from operators.pointmap.ply import PlyError, load_map, save_map
from operators.pointmap.slam import PointMap, Settings, Track
from operators.pointmap.trail import Trail
from operators.pointmap.voxel_map import MapPoints, VoxelMap

__all__ = [
    "Criteria",
    "Frame",
    "MapPoints",
    "Mapper",
    "Occupancy",
    "PlyError",
    "PointMap",
    "Settings",
    "Track",
    "Trail",
    "VoxelMap",
    "deskew",
    "find_ground",
    "height_above",
    "load_map",
    "prepare",
    "save_map",
]
