"""The simulated world: a building full of furniture and people, a robot, its lidar, and the truth about it all."""

from sim.building import Building, BuildingError
from sim.building_file import load
from sim.world import Frame, State, World

__all__ = ["Building", "BuildingError", "Frame", "State", "World", "load"]
