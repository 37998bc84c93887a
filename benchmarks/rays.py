"""Rays through the populated building: Embree and capsules, beside PyBullet's rayTestBatch, on the same geometry.

python -m benchmarks.rays

Both get the same people, who walk on between the scans, and both times hold their motion and the update of the scene.
Of PyBullet only the call itself is timed, not the making of its lists. Times are of one core (CPU time of this
process). Where the bodies differ, the ray touches a rim: Bullet's capsules reach up to a millimetre further.
"""

from __future__ import annotations

import json
import time
from typing import Any, NamedTuple

import numpy as np

SCANS = 12
OFF_GRID = (0.0137, 0.0071)  # metres: from round coordinates, columns of rays run exactly along edges of walls
BUILDING, TOUR, SEED = "default", "B", 1
PEER = "PyBullet rayTestBatch"


class Race(NamedTuple):
    """Seconds of all scans, and how alike the two answers are."""

    seconds: float
    peer_seconds: float
    rays: int
    same: float  # share of the rays that meet the same body, or both nothing
    gap: float  # metres, median difference of the ranges where they do


def race(scenario: str) -> Race:
    """Scan from places all along a tour, in both engines."""
    from sim import World  # here: the extra `sim` may be absent

    world = World(BUILDING, scenario, TOUR, SEED)
    rays, far = world.lidar.rays, world.spec.farthest
    seconds = peer_seconds = 0.0
    same, gaps = 0, []
    world.step(0.0, 0.0)  # compiles
    for index in range(SCANS):
        pose, share = world.sensor(world.lidar)
        pose[:2, 3] = world.layout.way[index * len(world.layout.way) // SCANS] + OFF_GRID
        begun = time.process_time()
        world.walk(0.1)
        motion = time.process_time() - begun

        begun = time.process_time()
        hits = world.lidar.shoot(pose, share, world.people())
        seconds += motion + time.process_time() - begun

        directions = (world.lidar.directions @ pose[:3, :3].T).astype(np.float32).astype(np.float64)
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        lists = origins.tolist(), (origins + far * directions).tolist()
        world.physics.place_people(world.capsules, world.radii, np.inf)  # makes the bodies of those who are new
        begun = time.process_time()
        world.physics.place_people(world.capsules, world.radii, np.inf)
        world.physics.ray_batches(*lists)
        peer_seconds += motion + time.process_time() - begun

        part, met = world.physics.rays(origins, origins + far * directions)
        body = np.where(hits.distance <= far, hits.body, -1)
        same += int((body == met).sum())
        both = (body == met) & (met >= 0)
        gaps.append(np.abs(far * part - hits.distance)[both])
    return Race(seconds, peer_seconds, SCANS * rays, same / (SCANS * rays), float(np.median(np.concatenate(gaps))))


def row(name: str, value: float, unit: str, peer: str | None = None, peer_value: float | None = None) -> dict[str, Any]:
    """Return one line of the table; the ratio is how many times the peer's value ours is."""
    ratio = value / peer_value if peer_value else None
    return {"name": name, "value": value, "unit": unit, "peer": peer, "peer_value": peer_value, "ratio": ratio}


def rows() -> list[dict[str, Any]]:
    """Measure speed and likeness in the emptiest and in the fullest scenario."""
    found = []
    for scenario in ("easy", "extreme"):
        result = race(scenario)
        speed, peer = result.rays / result.seconds / 1e6, result.rays / result.peer_seconds / 1e6
        found += [
            row(f"rays {scenario}, one core", speed, "Mrays/s", PEER, peer),
            row(f"rays {scenario}, same body", 100.0 * result.same, "%", PEER),
            row(f"rays {scenario}, range difference, median", 1000.0 * result.gap, "mm", PEER),
        ]
    return found


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
