"""A rehearsal in one small room: everything that numba compiles runs once, before a session begins."""

from __future__ import annotations

import tempfile
from pathlib import Path

from sim.world import World

ROOM = """
walls: [[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]]
start: [2, 2, 45]
rooms: [{name: room, populated: true, polygon: [[0, 0], [9, 0], [9, 9], [0, 9]]}]
tables: [{at: [6, 3]}]
tours: {A: {targets: [[7, 7]]}}
"""


def rehearse() -> None:
    """Drive two steps among a few people and throw the session away."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.yaml"
        path.write_text(ROOM, encoding="utf-8")
        world = World(path, "hard", "A", 0)
        for _ in range(2):
            world.step(0.5, 0.1)
