"""One session: a building, its furniture and people, and the robot in it.

world = World("default", "easy", "A", seed=1)
frame = world.step(linear=0.5, angular=0.0)  # or world.step(drive) with a Drive
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from graph.geometry import planar, wrap, yaw
from sim.building import Building
from sim.building_file import load
from sim.clearance import clearance, length_of
from sim.crowd import Crowd, spots, stature
from sim.figure import figures, placed, radii, sitting
from sim.furniture import SEAT_HEIGHT
from sim.inspection import require
from sim.layout import RESOLUTION, Seat, draw
from sim.lidar import NOTHING, Hits, Lidar, LidarSpec, People, lidar_named
from sim.odometry import Odometer, OdometryNoise
from sim.physics import ACCELERATION, GLIDE, SUBSTEP, Physics
from sim.scenario import Scenario, load_scenario
from sim.solids import Body, Box, Prism, Truth, triangles_of
from sim.sweep import along

Array = npt.NDArray[np.float64]

GROUND = 0.05  # metres: everything below is ground, as in the paper's simulator
ENCOUNTER = 1.0  # seconds without touch after which a contact counts as a new one
FLOOR = 100.0  # metres of floor around the building
ROOM_CELL = 0.2  # metres, of the grid that tells who is in which room


class Drive(Protocol):
    """A velocity command: m/s forward, rad/s to the left."""

    @property
    def linear(self) -> float: ...

    @property
    def angular(self) -> float: ...


class Frame(NamedTuple):
    """One scan and all truth about it, ring by ring.

    Points in the lidar's frame; those of a rolling scan in its frame at their own moment.
    """

    points: npt.NDArray[np.float32]  # (n, 3) metres
    ring: npt.NDArray[np.uint8]
    time_offset: npt.NDArray[np.float32] | None  # seconds, negative: before the end of the sweep; None: all at once
    truth: npt.NDArray[np.uint8]
    moving: npt.NDArray[np.bool_]
    instance: npt.NDArray[np.int32]


class State(NamedTuple):
    """What a simulator knows after a step."""

    world_from_base: Array  # (4, 4)
    odom_from_base: Array  # (4, 4); odom and world agree at the start, since the start pose is known
    linear: float  # m/s, by the odometry
    angular: float  # rad/s, by the odometry
    people: Array  # (p, 3): x, y, heading; walkers, then sitters
    people_moving: npt.NDArray[np.bool_]
    people_instance: npt.NDArray[np.int32]
    contacts: npt.NDArray[np.int32]  # instances that the robot touched during the step


class World:
    """A session, fixed to the bit by building, scenario, tour and seed. Raises BuildingError for bad input, by name.

    near: a second lidar for the ring in which the first is blind, if there is one. braking: m/s^2, towards rest.
    Instances are the indices of `bodies` (0 is the floor), then the walkers, then the sitters.
    """

    def __init__(
        self,
        building: Path | str | Building,
        scenario: Path | str | Scenario,
        tour: str,
        seed: int,
        *,
        lidar: str | LidarSpec = "paper",
        near: str | LidarSpec | None = None,
        rolling: bool | None = None,
        dropout: float | None = None,
        odometry: OdometryNoise | None = None,
        braking: float = ACCELERATION,
    ) -> None:
        self.building: Building = building if isinstance(building, Building) else load(building)
        self.scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        changes = {"rolling": rolling, "dropout": dropout}
        changes = {name: value for name, value in changes.items() if value is not None}
        self.spec = msgspec.structs.replace(lidar_named(lidar), **changes)
        self.start = self.building.start_pose(tour)
        require(self.building, [tour])
        self.targets = np.array(self.building.tours[tour].targets, np.float64).reshape(-1, 2)
        self.layout = draw(self.building, self.scenario, tour, seed)
        self.length = length_of(self.layout.way)  # metres, through all targets
        self.bodies = [self._floor(), *self.layout.bodies]
        triangles, owner = triangles_of(self.bodies)
        self.lidar = Lidar(self.spec, triangles, owner)
        self.near = None if near is None else Lidar(lidar_named(near), triangles, owner)
        self.physics = Physics(self.layout.bodies, self.start, braking=braking)
        self.noise = np.random.default_rng([seed, 3])
        self.noise_near = np.random.default_rng([seed, 5])
        shadows = [_shadow(seat) for seat in self.layout.seats]
        self.free = clearance(self.layout.bodies + shadows, self.building.bounds(), RESOLUTION)
        self._rooms()
        self._people(np.random.default_rng([seed, 2]))
        self.truth = np.array([body.truth for body in self.bodies] + self.person_truth, np.uint8)
        self.time = 0.0
        self.touched: dict[int, float] = {}  # instance: when it was last touched
        self.collisions = {"people": 0, "things": 0}
        self.motion = self.physics.motion()
        rng = np.random.default_rng([seed, 4])
        self.odometer = Odometer(self.motion, odometry or OdometryNoise(), rng)
        self.capsules = self._capsules()
        self.bodies_before = self.capsules
        self.trail = [self.motion.world_from_base] * 2  # evenly over the last advance
        self.elapsed = 0.0  # seconds of the last advance
        self.touching = np.zeros(0, np.int32)

    def _floor(self) -> Body:
        x0, y0, x1, y1 = self.building.bounds()
        slab = Box((x0 + x1) / 2, (y0 + y1) / 2, -0.05, x1 - x0 + 2 * FLOOR, y1 - y0 + 2 * FLOOR, 0.1)
        return Body("floor", Truth.GROUND, (slab,))

    def _rooms(self) -> None:
        """Rasterize which room every place is in; -1: none."""
        x0, y0, x1, y1 = self.building.bounds()
        x, y = np.meshgrid(np.arange(x0, x1, ROOM_CELL), np.arange(y0, y1, ROOM_CELL))
        self.room = np.full(x.shape, -1, np.int16)
        cells = np.stack([x.ravel(), y.ravel()], 1) + ROOM_CELL / 2
        for index, room in reversed(list(enumerate(self.building.rooms))):
            self.room[room.contains(cells).reshape(x.shape)] = index

    def rooms_of(self, places: Array) -> npt.NDArray[np.int16]:
        """Return the index of the room that each place (n, 2) is in, or -1."""
        x0, y0, _, _ = self.building.bounds()
        cells = ((places - (x0, y0)) / ROOM_CELL).astype(np.int64)
        rows, columns = self.room.shape
        return self.room[np.clip(cells[:, 1], 0, rows - 1), np.clip(cells[:, 0], 0, columns - 1)]

    def _people(self, rng: np.random.Generator) -> None:
        """Draw walkers by density, room by room, and sitters on the seats that are taken."""
        rooms = [room for room in self.building.rooms if room.populated]
        areas = np.array([room.area(self.building.wall) for room in rooms])
        total = float(areas.sum())
        wanted = [round(density * total) for density in (self.scenario.wanderers, self.scenario.followers)]
        keep = np.array([[*self.start[:2], 1.5]])
        places, following = [np.zeros((0, 2))], [np.zeros(0, np.bool_)]
        for follows, count in zip((False, True), wanted, strict=True):
            for room, share in zip(rooms, _apportion(count, areas), strict=True):
                ring = np.array(room.polygon)
                found = spots(self.free, np.array([*ring.min(0), *ring.max(0)]), int(share), keep, rng)
                keep = np.concatenate([keep, np.column_stack([found, np.full(len(found), 0.7)])])
                places.append(found)
                following.append(np.full(len(found), follows))
        self.wanted_people = sum(wanted)
        self.crowd = Crowd(np.concatenate(places), np.concatenate(following), self.scenario.attentive, rng)
        self.seats = np.array(self.layout.seats, np.float64).reshape(-1, 3)
        heights, builds = stature(len(self.seats), rng)
        sitters = placed(sitting() * heights[:, None, None, None], self.seats[:, 0], self.seats[:, 1], self.seats[:, 2])
        breadth = radii(heights, builds)
        lift = SEAT_HEIGHT + 0.02 - (sitters[:, 0, :, 2].min(1) - breadth[:, 0])
        lift = np.clip(lift, 0.0, 0.05)  # feet rather leave the floor than hips enter the seat
        sitters[..., 2] += lift[:, None, None]
        self.sitters = sitters
        self.radii = np.concatenate([radii(self.crowd.height, self.crowd.build), breadth])
        self.person_truth = [int(Truth.MOVING_PERSON)] * len(self.crowd.position)
        self.person_truth += [int(Truth.STILL_PERSON)] * len(self.seats)

    def _capsules(self) -> Array:
        """Return the capsules (p, 16, 2, 3) of all people as they are now."""
        crowd = self.crowd
        walkers = figures(crowd.phase(), crowd.stride_share(), crowd.height)
        walkers = placed(walkers, crowd.position[:, 0], crowd.position[:, 1], crowd.facing)
        return np.concatenate([walkers, self.sitters])

    def step(self, linear: float | Drive, angular: float = 0.0, seconds: float = 0.1) -> Frame:
        """Drive for a while, then scan. linear: m/s, or a command of both; angular: rad/s."""
        if isinstance(linear, (int, float)):
            self.advance(linear, angular, seconds)
        else:
            self.advance(linear.linear, linear.angular, seconds)
        return self.scan()

    def walk(self, seconds: float) -> None:
        """Let people walk for a while; the robot stands where it was at the last step."""
        base = self.motion.world_from_base
        robot = float(base[0, 3]), float(base[1, 3]), yaw(base)
        here = int(self.rooms_of(np.array([robot[:2]]))[0])
        with_robot = (self.rooms_of(self.crowd.position) == here) & (here >= 0)
        self.bodies_before = self.capsules
        self.crowd.advance(seconds, self.free, robot, with_robot)
        self.capsules = self._capsules()

    def advance(
        self,
        linear: float,
        angular: float,
        seconds: float = 0.1,
        orders: Sequence[tuple[float, float, float]] = (),
    ) -> None:
        """Let people walk and the robot drive for a while.

        orders: commands that come meanwhile, in their order: seconds from now, m/s, rad/s.
        """
        base = self.motion.world_from_base
        self.walk(seconds)
        self.physics.drive(linear, angular)
        self.trail = [base]
        touched: set[int] = set()
        given = 0
        substeps = round((self.time + seconds) / SUBSTEP) - round(self.time / SUBSTEP)
        glides = max(1, round(substeps / GLIDE))
        for glide in range(glides):
            share = (glide + 1) / glides
            self.physics.place_people(self.bodies_before * (1.0 - share) + self.capsules * share, self.radii)
            for substep in range(glide * substeps // glides, (glide + 1) * substeps // glides):
                while given < len(orders) and orders[given][0] * substeps <= substep * seconds:
                    self.physics.drive(*orders[given][1:])
                    given += 1
                self.physics.step()
                still, people = self.physics.contacts()
                touched |= {1 + body for body in still} | {len(self.bodies) + person for person in people}
            if self.spec.rolling or (self.near is not None and self.near.spec.rolling):
                self.trail.append(self.physics.motion().world_from_base)
        self.time += seconds
        self.elapsed = seconds
        self._count(touched)
        self.motion = self.physics.motion()
        turned = float(wrap(yaw(self.motion.world_from_base) - yaw(base)))
        self.odometer.advance(self.motion, turned, seconds)

    def _count(self, touched: set[int]) -> None:
        """Count contacts, each once per encounter."""
        for instance in sorted(touched):
            if self.time - self.touched.get(instance, -math.inf) > ENCOUNTER:
                self.collisions["people" if instance >= len(self.bodies) else "things"] += 1
            self.touched[instance] = self.time
        self.touching = np.array(sorted(touched), np.int32)

    def base_from_lidar(self, lidar: Lidar | None = None) -> Array:
        """Return the place of the lidar, or of `near`, on the robot (4, 4)."""
        return planar(0.0, 0.0, 0.0, (lidar or self.lidar).spec.height)

    def sensor(self, lidar: Lidar) -> tuple[Array, Array]:
        """Return world_from_lidar (4, 4), or (columns, 4, 4), and each column's share of the last step."""
        mount = self.base_from_lidar(lidar)
        if not lidar.spec.rolling or self.elapsed == 0.0:
            return self.motion.world_from_base @ mount, np.ones(lidar.spec.columns)
        share = 1.0 - (1.0 - lidar.share) * min(1.0, 1.0 / lidar.spec.rate / self.elapsed)
        return along(np.array(self.trail), share) @ mount, share

    def scan(self, lidar: Lidar | None = None) -> Frame:
        """Scan with the lidar, or with `near`, from where the robot is; a rolling scan began a period ago, ends now."""
        lidar = lidar or self.lidar
        noise = self.noise if lidar is self.lidar else self.noise_near
        pose, share = self.sensor(lidar)
        hits = lidar.shoot(pose, share, self.people())
        if pose.ndim == 3:
            pose = pose[lidar.column]
            heights = np.einsum("ni,ni->n", pose[:, 2, :3], lidar.directions) * hits.distance + pose[:, 2, 3]
        else:
            heights = (lidar.directions @ pose[2, :3]) * hits.distance + pose[2, 3]
        return self._frame(lidar, noise, hits, heights)

    def people(self) -> People:
        """Return everybody's capsules before and after the last step."""
        return People(self.bodies_before, self.capsules, self.radii, len(self.bodies))

    def _frame(self, lidar: Lidar, noise: np.random.Generator, hits: Hits, heights: Array) -> Frame:
        """Add noise, drop what the sensor does not see, and label what is left."""
        spec = lidar.spec
        measured = hits.distance + np.float32(spec.noise) * noise.standard_normal(len(hits.distance), np.float32)
        if spec.step > 0:
            measured = np.round(measured / np.float32(spec.step)) * np.float32(spec.step)
        keep = (hits.body != NOTHING) & (measured >= spec.nearest) & (measured <= spec.farthest)
        if spec.dropout > 0:
            grazing = np.clip(1.0 - hits.cosine / 0.26, 0.0, 1.0)  # beyond 75 degrees of incidence
            far = np.clip(hits.distance / spec.farthest - 0.5, 0.0, 0.5) * 2.0
            keep &= noise.random(len(keep), np.float32) >= spec.dropout * np.maximum(grazing, far)
        kept = np.flatnonzero(keep)
        body = hits.body[kept]
        truth = self.truth[body]
        truth[heights[kept] < GROUND] = Truth.GROUND
        moves = np.zeros(len(self.truth), np.bool_)
        moves[len(self.bodies) : len(self.bodies) + len(self.crowd.position)] = self.crowd.moving()
        offset = None
        if spec.rolling:
            offset = ((lidar.share[lidar.column[kept]] - 1.0) / spec.rate).astype(np.float32)
        return Frame(
            points=(lidar.directions[kept] * measured[kept, None]).astype(np.float32),
            ring=lidar.ring[kept],
            time_offset=offset,
            truth=truth,
            moving=moves[body],
            instance=body,
        )

    def still_there(self) -> float:
        """Return the share of the walkers that is in one of the populated rooms, where all of them began."""
        populated = [index for index, room in enumerate(self.building.rooms) if room.populated]
        here = np.isin(self.rooms_of(self.crowd.position), populated)
        return float(here.mean()) if len(here) else 1.0

    def state(self) -> State:
        """Say what is true now, and what the odometry says."""
        walkers = np.column_stack([self.crowd.position, self.crowd.facing])
        people = np.concatenate([walkers, self.seats])
        moving = np.concatenate([self.crowd.moving(), np.zeros(len(self.seats), np.bool_)])
        odometer = self.odometer
        return State(
            self.motion.world_from_base,
            planar(odometer.x, odometer.y, odometer.yaw),
            odometer.linear,
            odometer.angular,
            people,
            moving,
            (len(self.bodies) + np.arange(len(people))).astype(np.int32),
            self.touching,
        )


def _shadow(seat: Seat) -> Body:
    """Return the floor that a sitter takes, trunk and legs, for others to walk around."""
    ahead = Prism(seat.x + 0.35 * math.cos(seat.yaw), seat.y + 0.35 * math.sin(seat.yaw), 0.3, 0.16, 0.6, 8)
    return Body("sitter", Truth.STILL_PERSON, (Prism(seat.x, seat.y, 0.6, 0.2, 1.2, 8), ahead))


def _apportion(count: int, areas: Array) -> npt.NDArray[np.int64]:
    """Divide a count in proportion to areas, so that the parts sum to it (largest remainders)."""
    exact = count * areas / max(float(areas.sum()), 1e-9)
    parts = np.floor(exact).astype(np.int64)
    rest = count - int(parts.sum())
    if len(areas):
        parts[np.argsort(-(exact - parts), kind="stable")[:rest]] += 1
    return parts
