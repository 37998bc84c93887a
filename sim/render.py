"""Pictures of a populated world by ray tracing: the triangles that the lidar hits, and people's capsules as meshes.

Surfaces are matt and coloured by class; light comes from a bright sky and a sun that throws soft-edged contact shadows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sim.engines import EmbreeScene, TriangleMesh
from sim.solids import Body, triangles_of

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

SIDES, RINGS = 12, 4  # of a capsule's mesh: around the axis, and from the equator to the pole
SKY = np.array([0.80, 0.87, 0.95], np.float32)
SUN = np.array([0.42, -0.28, 0.86]) / np.linalg.norm([0.42, -0.28, 0.86])
AMBIENT, DIFFUSE = 0.78, 0.42
NOOKS, NOOK = 4, 0.7  # rays for ambient occlusion, and their length in metres
LIFT = 1e-3  # metres above a surface at which secondary rays begin
SLAB = 2_000_000  # rays at once

# Colours by Truth; the robot comes after the last.
PALETTE = np.array(
    [
        (128, 128, 128),
        (206, 200, 190),
        (240, 237, 230),
        (176, 116, 64),
        (92, 160, 104),
        (74, 122, 196),
        (214, 62, 58),
        (240, 168, 52),
        (40, 40, 46),
    ],
    np.float32,
) / np.float32(255)
ROBOT = len(PALETTE) - 1
NAMES = ("unknown", "ground", "wall", "door", "table", "chair", "moving person", "still person", "robot")


class Camera(NamedTuple):
    """A view: rays of a picture, row by row from the upper left."""

    origins: Singles  # (height, width, 3) or (1, 1, 3)
    directions: Singles


def overhead(bounds: tuple[float, float, float, float], width: int, *, height: float = 20.0) -> Camera:
    """Look straight down on a rectangle (x_min, y_min, x_max, y_max), every ray parallel."""
    x0, y0, x1, y1 = bounds
    rows = 2 * round(width * (y1 - y0) / (x1 - x0) / 2)
    x = x0 + (np.arange(width) + 0.5) / width * (x1 - x0)
    y = y1 - (np.arange(rows) + 0.5) / rows * (y1 - y0)
    origins = np.empty((rows, width, 3), np.float32)
    origins[..., 0], origins[..., 1], origins[..., 2] = x, y[:, None], height
    return Camera(origins, np.array([[[0.0, 0.0, -1.0]]], np.float32))


def perspective(
    eye: npt.ArrayLike, heading: float, tilt: float, size: tuple[int, int], *, angle: float = math.radians(75)
) -> Camera:
    """Look from a point along a heading and a tilt (up positive), radians. size: width, height; angle: horizontal."""
    width, height = size
    half = math.tan(angle / 2)
    across = (1.0 - 2.0 * (np.arange(width) + 0.5) / width) * half
    up = (1.0 - 2.0 * (np.arange(height) + 0.5) / height) * half * height / width
    forward = np.array([math.cos(heading) * math.cos(tilt), math.sin(heading) * math.cos(tilt), math.sin(tilt)])
    left = np.array([-math.sin(heading), math.cos(heading), 0.0])
    directions = forward + across[None, :, None] * left + up[:, None, None] * np.cross(forward, left)
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    return Camera(np.array([[eye]], np.float32), directions.astype(np.float32))


class Renderer:
    """A scene of bodies and people, ready to be looked at.

    capsules: ends (p, parts, 2, 3) in metres; radii: (p, parts); people: class of each (p,); robot: boxes of its body.
    """

    def __init__(
        self, bodies: list[Body], robot: Body, capsules: Array, radii: Array, people: npt.NDArray[np.uint8]
    ) -> None:
        still, owner = triangles_of([*bodies, robot])
        kinds = np.array([*(body.truth for body in bodies), ROBOT])
        self.ends, self.radii = capsules.reshape(-1, 2, 3), radii.reshape(-1)
        meshes = capsule_triangles(self.ends, self.radii)
        per_capsule = meshes.shape[1]
        triangles = np.concatenate([still, meshes.reshape(-1, 3, 3)]).astype(np.float32)
        self.kind = np.concatenate([kinds[owner], np.repeat(people, radii.shape[1] * per_capsule)])
        nobody = np.full(len(still), -1)
        self.capsule = np.concatenate([nobody, np.repeat(np.arange(len(self.radii)), per_capsule)])
        edges = triangles[:, 1:] - triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        self.scene = EmbreeScene()
        self.mesh = TriangleMesh(self.scene, np.ascontiguousarray(triangles))

    def picture(self, camera: Camera, *, seed: int = 0) -> Bytes:
        """Return the picture, half as large as the camera (height / 2, width / 2, 3): a pixel is four rays."""
        shape = np.broadcast_shapes(camera.origins.shape, camera.directions.shape)
        origins = np.ascontiguousarray(np.broadcast_to(camera.origins, shape)).reshape(-1, 3)
        directions = np.ascontiguousarray(np.broadcast_to(camera.directions, shape)).reshape(-1, 3)
        rng = np.random.default_rng(seed)
        parts = [
            self._shade(origins[first : first + SLAB], directions[first : first + SLAB], rng)
            for first in range(0, len(origins), SLAB)
        ]
        light = np.clip(np.concatenate(parts), 0.0, 1.0).reshape(shape[0] // 2, 2, shape[1] // 2, 2, 3).mean((1, 3))
        return np.round(255 * light).astype(np.uint8)

    def kinds(self, camera: Camera) -> npt.NDArray[np.int64]:
        """Return the class that each ray of a camera meets (height, width); -1: nothing."""
        shape = np.broadcast_shapes(camera.origins.shape, camera.directions.shape)
        origins, directions = (np.ascontiguousarray(np.broadcast_to(rays, shape)).reshape(-1, 3) for rays in camera)
        triangle = self.scene.run(origins, directions, output=True)["primID"]
        return np.where(triangle >= 0, self.kind[triangle], -1).reshape(shape[:2])

    def _shade(self, origins: Singles, directions: Singles, rng: np.random.Generator) -> Singles:
        met = self.scene.run(origins, directions, output=True)
        hit = np.flatnonzero(met["primID"] >= 0)
        triangle = met["primID"][hit]
        points = origins[hit] + directions[hit] * met["tfar"][hit, None]
        normals = self._normals(triangle, points, directions[hit])
        start = points + normals * np.float32(LIFT)
        facing = normals @ SUN.astype(np.float32)
        sun = np.broadcast_to(SUN.astype(np.float32), start.shape)
        lit = np.where(self._free(start, sun, 30.0), np.maximum(facing, 0.0), 0.0)
        openness = np.zeros(len(hit), np.float32)
        for _ in range(NOOKS):
            ball = rng.standard_normal(start.shape, np.float32)
            around = normals + ball / np.maximum(np.linalg.norm(ball, axis=1, keepdims=True), 1e-6) * np.float32(0.98)
            around /= np.linalg.norm(around, axis=1, keepdims=True)
            openness += self._free(start, around, NOOK) / np.float32(NOOKS)
        sky = 0.75 + 0.25 * normals[:, 2]
        light = AMBIENT * sky * (0.35 + 0.65 * openness) + DIFFUSE * lit
        colour = np.broadcast_to(SKY, directions.shape).copy()
        colour[hit] = PALETTE[self.kind[triangle]] * light[:, None].astype(np.float32)
        return colour

    def _free(self, start: Singles, directions: Singles, reach: float) -> npt.NDArray[np.bool_]:
        """Say from where nothing lies within `reach` metres along a direction."""
        far = self.scene.run(np.ascontiguousarray(start), np.ascontiguousarray(directions), query="DISTANCE")
        return np.asarray(far) > reach

    def _normals(self, triangle: npt.NDArray[np.int32], points: Singles, directions: Singles) -> Singles:
        """Return unit normals towards the eye; those of people as round as capsules are."""
        normals = self.normals[triangle].astype(np.float32)
        capsule = self.capsule[triangle]
        round_ = np.flatnonzero(capsule >= 0)
        a, b = self.ends[capsule[round_], 0], self.ends[capsule[round_], 1]
        axis = b - a
        along = ((points[round_] - a) * axis).sum(1) / np.maximum((axis * axis).sum(1), 1e-12)
        outward = points[round_] - (a + np.clip(along, 0.0, 1.0)[:, None] * axis)
        normals[round_] = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-6)
        return np.where((normals * directions).sum(1, keepdims=True) > 0, -normals, normals)


def capsule_triangles(ends: Array, radii: Array) -> Array:
    """Return the triangles (n, m, 3, 3) of capsules with ends (n, 2, 3) and radii (n,)."""
    rises = np.linspace(-np.pi / 2, 0.0, RINGS + 1)[1:]
    rises = np.concatenate([rises, -rises[::-1]])  # of the rings, from one pole to the other
    turns = np.arange(SIDES) * (2 * np.pi / SIDES)
    ring = np.stack([np.cos(turns), np.sin(turns), np.zeros(SIDES)], 1)
    unit = np.cos(rises)[:, None, None] * ring + np.sin(rises)[:, None, None] * np.array([0.0, 0.0, 1.0])
    unit = np.concatenate([[[0.0, 0.0, -1.0]], unit.reshape(-1, 3), [[0.0, 0.0, 1.0]]])  # poles first and last
    second = np.arange(len(unit)) > RINGS * SIDES  # belongs to the second end

    axis = ends[:, 1] - ends[:, 0]
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    aside = np.where(np.abs(axis[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(axis, aside)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-9)
    frame = np.stack([u, np.cross(axis, u), axis], 1)  # (n, 3, 3), rows
    points = np.einsum("vk,nkj->nvj", unit, frame) * radii[:, None, None]
    points += np.where(second[:, None], ends[:, None, 1], ends[:, None, 0])

    faces = []
    for level in range(2 * RINGS - 1):
        low = 1 + level * SIDES + np.arange(SIDES)
        right = 1 + level * SIDES + (np.arange(SIDES) + 1) % SIDES
        faces += [np.stack([low, right, right + SIDES], 1), np.stack([low, right + SIDES, low + SIDES], 1)]
    first, last = 1 + np.arange(SIDES), len(unit) - 1 - SIDES + np.arange(SIDES)
    faces.append(np.stack([np.zeros(SIDES, int), np.roll(first, -1), first], 1))
    faces.append(np.stack([np.full(SIDES, len(unit) - 1), last, np.roll(last, -1)], 1))
    return points[:, np.concatenate(faces)]
