"""A spinning lidar: rays on a grid of beams and columns, by Embree to what stands still, by capsules to people."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from graph.geometry import inverse
from sim import capsules
from sim.building import BuildingError
from sim.engines import EmbreeScene, TriangleMesh

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


# blindspot: a sparse sensor that looks steeply up and down, of the kind sold for what stands close around a robot.
# hdl32e: angles, columns at 10 Hz, range and its step are the data sheet's. The noise is a real sensor's: in a capture,
# nine firings of one beam in a row scatter by 4.5 mm (median, 3 to 10 m away) about a smooth curve.
PRESETS = {
    "paper": LidarSpec(),
    "hdl32e": LidarSpec(
        columns=2170, lowest=-30.67, highest=10.67, nearest=0.9, farthest=70.0, noise=0.005, step=0.002
    ),
    "blindspot": LidarSpec(beams=16, columns=180, lowest=-50.0, highest=30.0, nearest=0.1, farthest=2.0, noise=0.01),
}


def lidar_named(lidar: str | LidarSpec) -> LidarSpec:
    """Return a preset by its name, or the measures given. Raises BuildingError for a name that there is not."""
    if isinstance(lidar, LidarSpec):
        return lidar
    if lidar not in PRESETS:
        raise BuildingError(f"there is no lidar {lidar!r}; there are {', '.join(PRESETS)}")
    return PRESETS[lidar]


class People(NamedTuple):
    """The capsules of all people during a scan; their body numbers follow those of what stands still."""

    before: Array  # (p, parts, 2, 3) ends in the world at the scan's beginning
    after: Array  # (p, parts, 2, 3) at its end
    radii: Array  # (p, parts) metres
    first: int  # body number of the first person


class Hits(NamedTuple):
    """What each ray of a scan met, beam by beam: range in metres (inf: nothing), body or NOTHING, cosine of incidence.

    The cosine is worked out only for a sensor that drops returns; else it is 1.
    """

    distance: npt.NDArray[np.float32]  # (beams * columns,)
    body: npt.NDArray[np.int32]
    cosine: npt.NDArray[np.float32]


class Lidar:
    """Shoots the rays of one scan. Bodies are numbered: those that stand still first, then people."""

    def __init__(self, spec: LidarSpec, triangles: Array, owner: npt.NDArray[np.int32]) -> None:
        """Build the scene. triangles: (m, 3, 3) metres in the world; owner: (m,) body of each."""
        self.spec = spec
        self.elevation = np.radians(np.linspace(spec.lowest, spec.highest, spec.beams))
        self.azimuth = np.linspace(-np.pi, np.pi, spec.columns, endpoint=False)
        elevation, azimuth = np.meshgrid(self.elevation, self.azimuth, indexing="ij")
        directions = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        self.directions = np.stack(directions, -1).reshape(-1, 3)  # (beams * columns, 3), lidar frame
        self.ring = np.repeat(np.arange(spec.beams, dtype=np.uint8), spec.columns)
        self.column = np.tile(np.arange(spec.columns), spec.beams)
        self.share = np.arange(1, spec.columns + 1) / spec.columns  # of the scan period, when a column is measured
        self.scene = EmbreeScene()
        self.mesh = TriangleMesh(self.scene, np.ascontiguousarray(triangles, np.float32))
        self.owner = np.append(owner, NOTHING).astype(np.int32)  # a miss, -1, reads the last
        self.rays = spec.beams * spec.columns

    def shoot(self, world_from_lidar: Array, share: Array, people: People | None) -> Hits:
        """Scan at once from one pose (4, 4), or column by column from as many poses (columns, 4, 4).

        share: time of each column (columns,) between the people's two poses, 0 to 1.
        """
        moving = world_from_lidar.ndim == 3
        if moving:
            poses = world_from_lidar[self.column]
            directions = np.matmul(poses[:, :3, :3], self.directions[..., None])[..., 0].astype(np.float32)
            origins = poses[:, :3, 3].astype(np.float32)
        else:
            directions = (self.directions @ world_from_lidar[:3, :3].T).astype(np.float32)
            origins = np.empty((self.rays, 3), np.float32)
            origins[:] = world_from_lidar[:3, 3]
        answer = self.scene.run(origins, directions, output=True)
        triangle, distance = answer["primID"], answer["tfar"]
        distance[triangle < 0] = np.inf
        hits = Hits(distance, self.owner[triangle], np.ones(self.rays, np.float32))
        if self.spec.dropout > 0:
            normals = answer["Ng"]
            size = np.maximum(np.sqrt((normals * normals).sum(1)), np.float32(1e-12))
            hits.cosine[:] = np.abs((normals * directions).sum(1)) / size
        if people is not None and len(people.radii):
            self._people(hits, world_from_lidar, share, people)
        return hits

    def _people(self, hits: Hits, world_from_lidar: Array, share: Array, people: People) -> None:
        parts = people.radii.shape[1]
        columns, shape = self.spec.columns, (self.spec.beams, self.spec.columns)
        if world_from_lidar.ndim == 3:
            turns = world_from_lidar[:, :3, :3].transpose(0, 2, 1)
            poses = np.concatenate([turns, -np.matmul(turns, world_from_lidar[:, :3, 3:])], 2)
        else:
            poses = np.broadcast_to(inverse(world_from_lidar)[:3], (columns, 3, 4))
        capsules.cast(
            people.before.reshape(-1, 2, 3),
            people.after.reshape(-1, 2, 3),
            people.radii.reshape(-1),
            np.repeat(np.arange(people.first, people.first + len(people.radii), dtype=np.int32), parts),
            np.ascontiguousarray(poses),
            share,
            self.elevation,
            self.directions.reshape(*shape, 3),
            self.spec.farthest,
            hits.distance.reshape(shape),
            hits.body.reshape(shape),
            hits.cosine.reshape(shape),
        )
