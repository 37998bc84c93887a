"""A room of boxes and a lidar in it, exact and without a simulator; other tests import it."""

from __future__ import annotations

import numpy as np

from graph.geometry import planar, transform

ROOM = (np.array([-6.0, -4.0, 0.0]), np.array([7.0, 5.0, 2.6]))
BOXES = (
    (np.array([1.0, 1.0, 0.0]), np.array([2.0, 2.5, 0.8])),
    (np.array([-4.0, -3.0, 0.0]), np.array([-3.0, -2.0, 1.5])),
    (np.array([3.0, -4.0, 0.0]), np.array([3.2, 0.0, 2.6])),
    (np.array([-3.0, 2.0, 0.0]), np.array([-2.5, 2.5, 2.6])),
    (np.array([-6.0, 4.0, 0.0]), np.array([-4.0, 5.0, 2.6])),
)
BASE_FROM_LIDAR = planar(0.0, 0.0, 0.0, 0.64)


def rays(rings: int = 32, columns: int = 1024) -> np.ndarray:
    """Return unit directions (rings * columns, 3) of a lidar like the paper's."""
    elevation = np.radians(np.linspace(-30.67, 10.67, rings))[:, None]
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)[None, :] + 0.001
    flat = np.cos(elevation)
    parts = (flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) + 0.0 * azimuth)
    return np.stack(parts, axis=-1).reshape(-1, 3)


def scan(world_from_lidar, directions=None, boxes=BOXES, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Return the points (n, 3) float32, in the lidar's frame, that rays hit on the inside of the room or on boxes."""
    directions = rays() if directions is None else directions
    start, way = world_from_lidar[:3, 3], directions @ world_from_lidar[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = (ROOM[0] - start) / way, (ROOM[1] - start) / way
        distance = np.nanmin(np.maximum(enter, leave), axis=1)
        for low, high in boxes:
            enter, leave = (low - start) / way, (high - start) / way
            near = np.minimum(enter, leave).max(axis=1)
            far = np.maximum(enter, leave).min(axis=1)
            distance = np.where((near < far) & (near > 0.0), np.minimum(distance, near), distance)
    distance = distance + noise * np.random.default_rng(seed).normal(size=len(distance))
    return (directions * distance[:, None])[distance > 0.9].astype(np.float32)


def test_every_ray_of_an_empty_room_ends_on_its_shell():
    pose = planar(0.5, -0.3, 0.7, 0.64)
    points = transform(pose, scan(pose, boxes=()).astype(np.float64))
    shell = np.minimum(np.abs(points - ROOM[0]).min(axis=1), np.abs(points - ROOM[1]).min(axis=1))
    assert shell.max() < 1e-5
    assert len(points) > 30_000


def test_a_box_hides_what_is_behind_it():
    pose = planar(0.0, 1.5, 0.0, 0.64)
    points = transform(pose, scan(pose).astype(np.float64))
    low, high = BOXES[0]
    behind = (points[:, 0] > high[0] + 0.1) & (points[:, 2] < 0.6) & (np.abs(points[:, 1] - 1.5) < 0.3)
    assert not behind.any()
    assert (np.abs(points[:, 0] - low[0]) < 1e-5).sum() > 100
