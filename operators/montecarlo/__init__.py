"""Monte Carlo localization and grid mapping with 2-D scans: the algorithms behind amcl and gmapping of ROS.

scan = flatten(points_lidar, base_from_lidar)
amcl = Amcl(load_map(Path("map.yaml")), start=(1.0, 2.0, 0.0))
belief = amcl.step(odometry, scan.returns())
"""

from operators.montecarlo.amcl import Amcl, Belief, Parameters
from operators.montecarlo.gmapping import Gmapping, Settings, Slam
from operators.montecarlo.map_file import GridMap, MapError, load_map, save_map
from operators.montecarlo.scan import Scan2D, flatten

__all__ = [
    "Amcl",
    "Belief",
    "Gmapping",
    "GridMap",
    "MapError",
    "Parameters",
    "Scan2D",
    "Settings",
    "Slam",
    "flatten",
    "load_map",
    "save_map",
]
