"""A spinning lidar: rays on a grid of beams and columns, by Embree to what stands still, by capsules to people."""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numba import njit

Array = npt.NDArray[np.float64]

NOTHING = -1  # body of a ray that hits nothing


class LidarSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The sensor. Angles in degrees, lengths in metres."""

    beams: int = 32
    columns: int = 1024
    lowest: float = -25.0
    highest: float = 15.0
    rate: float = 10.0  # Hz
    nearest: float = 0.9
    farthest: float = 30.0
    noise: float = 0.008  # standard deviation of the range
    step: float = 0.0  # resolution of the range; 0: continuous
    height: float = 0.64  # above the floor
    rolling: bool = False  # columns one after the other over the scan period, else all at once
    dropout: float = 0.0  # share lost at grazing incidence and far away, at most


PRESETS = {
    "paper": LidarSpec(),
    "hdl32e": LidarSpec(columns=2170, lowest=-30.67, highest=10.67, nearest=0.9, farthest=70.0, noise=0.02, step=0.002),
}


class Hits(NamedTuple):
    """What each ray of a scan met, beam by beam: range (metres, inf: nothing), body or NOTHING, cosine of incidence."""

    distance: npt.NDArray[np.float32]  # (beams * columns,)
    body: npt.NDArray[np.int32]
    cosine: npt.NDArray[np.float32]


class Lidar:
    """Shoots the rays of one scan. Bodies are numbered: those that stand still first, then people."""

    def __init__(self, spec: LidarSpec, triangles: Array, owner: npt.NDArray[np.int32]) -> None:
        self.spec = spec
        self.elevation = np.radians(np.linspace(spec.lowest, spec.highest, spec.beams))
        self.azimuth = np.linspace(-np.pi, np.pi, spec.columns, endpoint=False)
        elevation, azimuth = np.meshgrid(self.elevation, self.azimuth, indexing="ij")
        directions = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        self.directions = np.stack(directions, -1).reshape(-1, 3)  # (beams * columns, 3), lidar frame
        self.ring = np.repeat(np.arange(spec.beams, dtype=np.uint8), spec.columns)
        self.column = np.tile(np.arange(spec.columns), spec.beams)
        self.scene = EmbreeScene()
        self.mesh = TriangleMesh(self.scene, np.ascontiguousarray(triangles, np.float32))
        self.owner = owner
        edges = triangles[:, 1:] - triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    def shoot(self, world_from_lidar: Array, capsules: Array, radii: Array, first_person: int) -> Hits:
        """Scan at once from one pose. capsules: ends (n, parts, 2, 3) in the world; radii (n, parts); metres."""
        rotation = world_from_lidar[:3, :3]
        directions = (self.directions @ rotation.T).astype(np.float32)
        origins = np.broadcast_to(world_from_lidar[:3, 3].astype(np.float32), directions.shape).copy()
        hits = self._still(origins, directions)
        self._people(hits, world_from_lidar, capsules, radii, first_person, 0, self.spec.columns)
        return hits

    def sweep(
        self,
        poses: Array,
        slices: list[tuple[int, int]],
        capsules: list[Array],
        radii: Array,
        first_person: int,
    ) -> Hits:
        """Scan column by column. poses: (columns, 4, 4) world_from_lidar; capsules: people at each slice of columns."""
        rotations, places = poses[self.column, :3, :3], poses[self.column, :3, 3]
        directions = np.einsum("nij,nj->ni", rotations, self.directions).astype(np.float32)
        hits = self._still(places.astype(np.float32), directions)
        for (begin, end), people in zip(slices, capsules, strict=True):
            self._people(hits, poses[(begin + end) // 2], people, radii, first_person, begin, end)
        return hits

    def _still(self, origins: npt.NDArray[np.float32], directions: npt.NDArray[np.float32]) -> Hits:
        answer = self.scene.run(origins, directions, output=True)
        triangle = answer["primID"]
        met = triangle >= 0
        distance = np.where(met, answer["tfar"], np.float32(np.inf)).astype(np.float32)
        body = np.where(met, self.owner[triangle], NOTHING).astype(np.int32)
        cosine = np.abs(np.einsum("ni,ni->n", self.normals[triangle].astype(np.float32), directions))
        return Hits(distance, body, cosine.astype(np.float32))

    def _people(
        self, hits: Hits, world_from_lidar: Array, capsules: Array, radii: Array, first: int, begin: int, end: int
    ) -> None:
        if not len(capsules):
            return
        rotation, place = world_from_lidar[:3, :3], world_from_lidar[:3, 3]
        local = (capsules - place) @ rotation
        near = np.hypot(local[:, :, 0, 0].mean(1), local[:, :, 0, 1].mean(1)) < self.spec.farthest + 1.0
        shape = (self.spec.beams, self.spec.columns)
        cast_capsules(
            hits.distance.reshape(shape),
            hits.body.reshape(shape),
            hits.cosine.reshape(shape),
            self.directions.reshape(*shape, 3),
            self.elevation,
            local[near],
            radii[near],
            (first + np.flatnonzero(near)).astype(np.int32),
            begin,
            end,
        )


@njit(cache=True)
def capsule_distance(direction: Array, a: Array, b: Array, radius: float) -> float:
    """Return where a ray from the origin along a unit direction enters a capsule, in metres; inf if it does not."""
    best = np.inf
    axis = b - a
    length2 = axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]
    along = direction[0] * axis[0] + direction[1] * axis[1] + direction[2] * axis[2]
    behind = -(a[0] * axis[0] + a[1] * axis[1] + a[2] * axis[2])
    side = -(a[0] * direction[0] + a[1] * direction[1] + a[2] * direction[2])
    apart = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    qa = length2 - along * along
    qb = length2 * side - behind * along
    qc = length2 * apart - behind * behind - radius * radius * length2
    if qa > 1e-12:
        root = qb * qb - qa * qc
        if root >= 0.0:
            t = (-qb - math.sqrt(root)) / qa
            place = behind + t * along
            if t > 0.0 and 0.0 < place < length2:
                return t
    for end in range(2):
        c = a if end == 0 else b
        middle = direction[0] * c[0] + direction[1] * c[1] + direction[2] * c[2]
        root = middle * middle - (c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) + radius * radius
        if root >= 0.0:
            t = middle - math.sqrt(root)
            if 0.0 < t < best:
                best = t
    return best


@njit(cache=True)
def cast_capsules(
    distance: npt.NDArray[np.float32],
    body: npt.NDArray[np.int32],
    cosine: npt.NDArray[np.float32],
    directions: Array,
    elevation: Array,
    capsules: Array,
    radii: Array,
    number: npt.NDArray[np.int32],
    begin: int,
    end: int,
) -> None:
    """Shorten the rays (beams, columns) of columns begin to end that meet people, in the lidar's frame.

    capsules: (n, parts, 2, 3), radii: (n, parts), number: (n,) body of each person. Only rays within the angles that a
    capsule can cover are tried.
    """
    beams, columns = distance.shape
    beam_step = (elevation[-1] - elevation[0]) / max(beams - 1, 1)
    for person in range(len(capsules)):
        for part in range(capsules.shape[1]):
            a, b, radius = capsules[person, part, 0], capsules[person, part, 1], radii[person, part]
            middle = (a + b) / 2.0
            reach = radius + 0.5 * math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)
            flat = math.hypot(middle[0], middle[1])
            far = math.sqrt(flat * flat + middle[2] * middle[2])
            if flat <= reach or far <= reach:
                first, last, low, high = 0, columns - 1, 0, beams - 1
            else:
                bearing, half = math.atan2(middle[1], middle[0]), math.asin(reach / flat)
                first = math.ceil((bearing - half + math.pi) / (2.0 * math.pi) * columns)
                last = math.floor((bearing + half + math.pi) / (2.0 * math.pi) * columns)
                tilt, half = math.atan2(middle[2], flat), math.asin(reach / far)
                low = max(0, math.ceil((tilt - half - elevation[0]) / beam_step))
                high = min(beams - 1, math.floor((tilt + half - elevation[0]) / beam_step))
            nearest = far - reach
            for beam in range(low, high + 1):
                for turn in range(first, last + 1):
                    column = turn % columns
                    if column < begin or column >= end or distance[beam, column] < nearest:
                        continue
                    ray = directions[beam, column]
                    t = capsule_distance(ray, a, b, radius)
                    if t < distance[beam, column]:
                        distance[beam, column] = t
                        body[beam, column] = number[person]
                        cosine[beam, column] = _facing(ray, t, a, b, radius)


@njit(cache=True)
def _facing(ray: Array, t: float, a: Array, b: Array, radius: float) -> float:
    """Return the cosine of the angle between a ray and the capsule's surface normal where it hits."""
    hit = ray * t
    axis = b - a
    length2 = axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]
    share = 0.0
    if length2 > 0.0:
        share = ((hit[0] - a[0]) * axis[0] + (hit[1] - a[1]) * axis[1] + (hit[2] - a[2]) * axis[2]) / length2
    share = min(1.0, max(0.0, share))
    normal = (hit - (a + share * axis)) / radius
    return abs(normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2])
