"""Buildings of a few walls, for tests of the world."""

from sim.building import Building, Door, Point, Room, TablePosition, Tour
from sim.scenario import Scenario

NOBODY = Scenario(tables=(0.0, 0.0))


def box_room(width: float = 10.0, depth: float = 8.0, **more: object) -> Building:
    """One empty room; inner faces at 0 and at width and depth; the robot starts in its middle, looking along +x."""
    low, x, y = -0.075, width + 0.075, depth + 0.075
    ring: list[Point] = [(low, low), (x, low), (x, y), (low, y), (low, low)]
    parts = {
        "walls": [ring],
        "start": (width / 2, depth / 2, 0.0),
        "rooms": [Room("room", ring[:4], populated=True)],
        "tours": {"A": Tour([(width / 2 + 1.0, depth / 2)])},
    }
    return Building(**(parts | more))  # type: ignore[arg-type]


def two_rooms(angle: float | str) -> Building:
    """Two rooms of 5 x 6 m with a door between them at (5, 2.55) to (5, 3.45); the robot stands in the western one."""
    return box_room(
        10.0,
        6.0,
        walls=[[(0, 0), (10, 0), (10, 6), (0, 6), (0, 0)], [(5, 0), (5, 6)]],
        doors=[Door((5.0, 2.55), 90.0, name="middle", angle=angle)],  # type: ignore[arg-type]
        rooms=[
            Room("west", [(0, 0), (5, 0), (5, 6), (0, 6)], populated=True),
            Room("east", [(5, 0), (10, 0), (10, 6), (5, 6)], populated=True),
        ],
        start=(2.0, 3.0, 0.0),
        tours={"A": Tour([(2.0, 4.5)])},
        tables=[TablePosition((8.5, 4.2), 90.0), TablePosition((3.6, 1.0), 0.0, ["cafe"])],
    )
