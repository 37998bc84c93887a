"""PointRay: movable probabilities of map points by ray tracing, arrays in, arrays out (paper section III-B).

rays = PointRay(voxel_map)
rays.add(points_lidar, world_from_lidar)
p_mov = rays.movable()
"""

from operators.pointray.tracer import PointRay, RaySettings

__all__ = ["PointRay", "RaySettings"]
