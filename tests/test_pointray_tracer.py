"""PointRay: what is there, what is seen through, and what a frame leaves alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_pointmap_room import BASE_FROM_LIDAR, BOXES, ROOM, scan

from graph.geometry import inverse, planar, transform
from operators.pointmap import MapPoints, PointMap, VoxelMap
from operators.pointmap.store import local_of
from operators.pointmap.voxels import unpack
from operators.pointray import PointRay, RaySettings
from operators.pointray.frustums import behind, frustum_grid, hidden
from operators.pointray.occupied import blocks_of_points, with_neighbours

PERSON = (np.array([-1.0, -1.0, 0.0]), np.array([-0.6, -0.6, 1.7]))


def mapped(boxes=BOXES, poses=((-2.0, 0.0, 0.0), (0.0, -2.0, 1.0), (0.5, 3.0, 2.0))):
    """A map of the room with these boxes, from a few places."""
    pointmap = PointMap()
    for n, place in enumerate(poses):
        pose = planar(*place) @ BASE_FROM_LIDAR
        pointmap.enter(pointmap.prepare(scan(pose, boxes=boxes, seed=n)), pose)
    return pointmap.map


def twin(voxels, points, pose, settings):
    """Looks and free looks of one frame, by the definition."""
    size = voxels.voxel_size
    world = transform(pose, points.astype(np.float64))
    taken = {tuple(v) for v in np.floor(world / size).astype(int)}
    places = np.floor(voxels.points.astype(np.float64) / size).astype(int)
    steps = [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)]
    occupied = np.array([any((x + a, y + b, z + c) in taken for a, b, c in steps) for x, y, z in places])

    def angles(p):
        return np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])), np.arctan2(p[:, 1], p[:, 0])

    theta, phi = angles(points.astype(np.float64))
    rho = np.linalg.norm(points.astype(np.float64), axis=1)
    columns = round(2 * np.pi / settings.width)
    low = theta.min() - settings.height / 2
    rows = int((theta.max() - low) / settings.height) + 1
    depth = np.full((rows, columns), np.inf)
    row = np.minimum(rows - 1, ((theta - low) / settings.height).astype(int))
    np.minimum.at(depth, (row, np.minimum(columns - 1, ((phi + np.pi) / (2 * np.pi / columns)).astype(int))), rho)
    depth[np.isinf(depth)] = 0.0
    depth -= np.maximum(0.03, depth * settings.height / 2)
    local = transform(inverse(pose), voxels.points.astype(np.float64))
    theta, phi = angles(local)
    rho = np.linalg.norm(local, axis=1)
    row = np.floor((theta - low) / settings.height).astype(int)
    column = np.clip(((phi + np.pi) / (2 * np.pi / columns)).astype(int), 0, columns - 1)
    inside = (row >= 0) & (row < rows)
    limit = np.where(inside, depth[np.clip(row, 0, rows - 1), column], 0.0)
    box = (voxels.points >= world.min(axis=0)).all(axis=1) & (voxels.points <= world.max(axis=0)).all(axis=1)
    normals = voxels.normals.astype(np.float64)
    along = np.abs((local * (normals @ pose[:3, :3])).sum(axis=1)) / rho
    facing = (np.abs(normals[:, 2]) > 0.5) | (along > math.cos(math.radians(75)))
    free = ~occupied & box & (rho > 0.06) & (rho < limit) & facing
    return (occupied | free).astype(int), free.astype(int)


@pytest.mark.parametrize("width", [0.1, 0.35])
def test_the_kernels_do_what_the_definition_says(width):
    settings = RaySettings(width=math.radians(width))
    voxels = mapped((*BOXES, PERSON))
    rays = PointRay(voxels, settings)
    looks, free = np.zeros(len(voxels), int), np.zeros(len(voxels), int)
    for n, place in enumerate([(-2.5, 0.5, 0.3), (1.5, -1.0, -2.0)]):
        pose = planar(*place) @ BASE_FROM_LIDAR
        points = scan(pose, noise=0.008, seed=n)
        rays.add(points, pose)
        looked, through = twin(voxels, points, pose, settings)
        looks, free = looks + looked, free + through
    assert free.sum() > 100
    assert (rays.looks() != looks).mean() < 2e-4  # a few points lie on the edge of a frustum, in single precision
    assert (rays.counts[: len(voxels), 1] != free).mean() < 2e-4


def traced(boxes_of_map, boxes_of_frames, count=16):
    """The map with its movable probabilities after a drive through the room."""
    voxels = mapped(boxes_of_map)
    rays = PointRay(voxels, RaySettings(width=2 * math.pi / 1024))  # as wide as the columns of these scans
    for n in range(count):
        pose = planar(-2.5 + 0.2 * n, 0.3 * np.sin(n), 0.2 * n) @ BASE_FROM_LIDAR
        rays.add(scan(pose, boxes=boxes_of_frames, noise=0.008, seed=n), pose)
    return voxels, rays


def within(points, box, margin=0.02):
    return (points > box[0] - margin).all(axis=1) & (points < box[1] + margin).all(axis=1)


def test_nothing_upright_that_stands_still_is_movable():
    voxels, rays = traced(BOXES, BOXES)
    seen = rays.looks() >= 10
    upright = np.abs(voxels.normals[:, 2]) < 0.5  # the floor may be seen through: it is a class of its own
    assert (seen & upright).sum() > 5000
    assert (rays.movable()[seen & upright] > 0.4).mean() < 0.005
    assert (rays.movable()[~seen] == 0.5).all()


def test_who_has_left_is_movable_and_the_walls_are_not():
    voxels, rays = traced((*BOXES, PERSON), BOXES)
    person = within(voxels.points, PERSON) & (voxels.points[:, 2] > 0.1)
    seen = rays.looks() >= 10
    assert (person & seen).sum() > 100
    assert (rays.movable()[person & seen] > 0.9).mean() > 0.9
    shell = (voxels.points > ROOM[1] - 0.02).any(axis=1) | (voxels.points[:, :2] < ROOM[0][:2] + 0.02).any(axis=1)
    assert (rays.movable()[shell & seen] > 0.4).mean() < 0.005


def test_a_table_top_that_has_left_is_movable_though_seen_at_a_grazing_angle():
    table = (np.array([-2.0, 1.0, 0.50]), np.array([-1.2, 1.8, 0.53]))
    voxels, rays = traced((*BOXES, table), BOXES, count=24)
    top = within(voxels.points, table, 0.005) & (np.abs(voxels.normals[:, 2]) > 0.9) & (rays.looks() >= 10)
    assert top.sum() > 10
    assert (rays.movable()[top] > 0.9).mean() > 0.9


def test_frames_may_come_in_any_order_and_the_map_may_grow_between():
    frames = []
    for n in range(4):
        pose = planar(-2.0 + 0.3 * n, 0.0, 0.3 * n) @ BASE_FROM_LIDAR
        frames.append((scan(pose, noise=0.008, seed=n), pose))
    voxels = mapped((*BOXES, PERSON))
    forward, backward = PointRay(voxels), PointRay(voxels)
    for frame in frames:
        forward.add(*frame)
    for frame in frames[::-1]:
        backward.add(*frame)
    assert np.array_equal(forward.movable(), backward.movable())
    assert np.array_equal(forward.looks(), backward.looks())
    before = forward.looks()
    more = mapped((*BOXES, PERSON), poses=((-3.0, 1.0, 0.0),)).cloud()
    voxels.insert(more.points, more.normals, more.scores, 9)
    assert np.array_equal(forward.looks()[: len(before)], before)
    assert (forward.looks()[len(before) :] == 0).all()
    forward.add(*frames[0])
    assert forward.looks()[len(before) :].max() == 1


def test_a_frame_without_points_and_a_map_without_points_change_nothing():
    voxels = mapped()
    rays = PointRay(voxels)
    for points in (np.empty((0, 3)), np.full((5, 3), np.nan), np.zeros((3, 3))):
        assert rays.add(points, BASE_FROM_LIDAR) == 0
    assert rays.looks().sum() == 0
    assert (rays.movable() == 0.5).all()
    empty = PointRay(VoxelMap())
    empty.add(scan(BASE_FROM_LIDAR), BASE_FROM_LIDAR)
    assert len(empty.movable()) == 0


def test_only_the_points_within_reach_are_tried():
    voxels = mapped()
    far = voxels.cloud()
    for shift in (100.0, 200.0, 300.0):
        moved = far.points + np.float32([shift, 0, 0])
        voxels.insert_map(MapPoints(moved.astype(np.float32), far.normals, far.scores))
    pose = planar(-2.0, 0.0, 0.0) @ BASE_FROM_LIDAR
    assert PointRay(voxels).add(scan(pose), pose) <= len(far.points)


def test_the_frustum_grid_keeps_the_nearest_and_an_empty_cell_frees_nothing():
    rho = np.array([5.0, 3.0, 8.0], np.float32)
    theta, phi = np.zeros(3, np.float32), np.array([0.001, 0.001, 1.0], np.float32)
    grid = frustum_grid(rho, theta, phi, math.radians(1.33), math.radians(0.1))
    filled = grid.free[grid.free > 0]
    assert sorted(filled.tolist()) == pytest.approx(
        [3.0 - 3.0 * math.radians(1.33) / 2, 8 - 8 * math.radians(1.33) / 2]
    )
    assert grid.freest.max() == filled.max()
    assert grid.farthest.max() == 8.0
    near = frustum_grid(np.array([0.5], np.float32), theta[:1], phi[:1], math.radians(1.33), math.radians(0.1))
    assert near.free.max() == pytest.approx(0.47)


def test_a_ball_is_hidden_exactly_when_all_of_it_is_behind():
    points = scan(planar(0.0, 0.0, 0.0, 0.64), boxes=())
    x, y, z = points.T.astype(np.float64)
    rho = np.sqrt(x**2 + y**2 + z**2).astype(np.float32)
    theta, phi = np.arctan2(z, np.hypot(x, y)).astype(np.float32), np.arctan2(y, x).astype(np.float32)
    grid = frustum_grid(rho, theta, phi, math.radians(1.33), math.radians(0.35))
    assert not hidden(grid, 3.0, 0.0, 0.0, 0.5)
    assert not hidden(grid, 7.2, 0.0, 0.0, 0.5)
    assert hidden(grid, 9.0, 0.0, 0.0, 0.5)
    assert hidden(grid, 0.0, 0.0, 5.0, 0.5)
    assert not hidden(grid, 0.1, 0.0, 0.0, 0.5)


def voxels_of(blocks):
    """The taken voxels of a table of blocks."""
    found = set()
    for key, mask in zip(blocks.keys, blocks.masks, strict=True):
        if key != -1:
            corner = 4 * np.array(unpack(key))
            for i, j, k in np.ndindex(4, 4, 4):
                if (int(mask) >> local_of(i, j, k)) & 1:
                    found.add(tuple((corner + np.array([i, j, k])).tolist()))
    return found


@pytest.mark.parametrize("count", [0, 1, 40, 30_000])
def test_occupied_are_the_voxels_of_the_points_and_their_26_neighbours(count):
    points = np.random.default_rng(count).normal(size=(count, 3)) * 0.4
    taken = {tuple(voxel) for voxel in np.floor(points / 0.1).astype(int).tolist()}
    blocks = blocks_of_points(points, 0.1)
    assert voxels_of(blocks) == taken
    steps = [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)]
    assert voxels_of(with_neighbours(blocks)) == {(i + a, j + b, k + c) for i, j, k in taken for a, b, c in steps}


def test_points_beyond_all_voxels_occupy_none():
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0], [0.05, 0.05, 0.05]])
    assert voxels_of(blocks_of_points(points, 0.1)) == {(0, 0, 0)}


def test_nothing_that_is_free_is_called_behind():
    points = scan(planar(0.0, 0.0, 0.3, 0.64))
    x, y, z = points.T.astype(np.float64)
    rho, level = np.sqrt(x**2 + y**2 + z**2), np.hypot(x, y)
    theta, phi = np.arctan2(z, level), np.arctan2(y, x)
    grid = frustum_grid(*(a.astype(np.float32) for a in (rho, theta, phi)), math.radians(1.33), math.radians(0.35))
    random = np.random.default_rng(0)
    tried = 0
    for n in random.choice(len(points), 400):
        centre = points[n] * random.uniform(0.3, 1.2) + random.normal(size=3) * 0.1
        distance, flat = np.linalg.norm(centre), np.hypot(*centre[:2])
        if not behind(grid, distance, np.arctan2(centre[2], flat), np.arctan2(centre[1], centre[0]), flat, 0.1):
            continue
        offsets = random.normal(size=(200, 3))
        ball = centre + 0.0999 * offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
        row = np.floor((np.arctan2(ball[:, 2], np.hypot(*ball.T[:2])) - grid.lowest) / grid.height).astype(int)
        column = np.floor((np.arctan2(ball[:, 1], ball[:, 0]) + np.pi) / grid.width).astype(int) % grid.free.shape[1]
        inside = (row >= 0) & (row < grid.free.shape[0])
        assert (np.linalg.norm(ball, axis=1)[inside] >= grid.free[row[inside], column[inside]]).all()
        tried += 1
    assert tried > 50
