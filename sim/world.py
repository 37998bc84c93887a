"""One session: a building, its furniture and people, and the robot in it.

world = World("sim/buildings/default.yaml", "easy", "A", seed=1)
frame = world.step(linear=0.5, angular=0.0)
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from graph.geometry import interpolate, planar, wrap, yaw
from sim.building import Building, BuildingError
from sim.building_file import load
from sim.crowd import Crowd, spots
from sim.figure import figures, placed, radii, sitting
from sim.furniture import SEAT_HEIGHT
from sim.layout import draw
from sim.lidar import NOTHING, PRESETS, Hits, Lidar, LidarSpec
from sim.odometry import Odometer, OdometryNoise
from sim.physics import SUBSTEP, Physics
from sim.scenario import load_scenario
from sim.solids import Body, Box, Truth, triangles_of

Array = npt.NDArray[np.float64]

GROUND = 0.05  # metres: everything below is ground, as in the paper's simulator
ENCOUNTER = 1.0  # seconds without touch after which a contact counts as a new one
SLICES = 32  # parts of a rolling scan in which people stand still


class Frame(NamedTuple):
    """One scan and all truth about it. Points in the lidar's frame at the beginning of the scan."""

    points: npt.NDArray[np.float32]  # (n, 3) metres
    ring: npt.NDArray[np.uint8]
    time_offset: npt.NDArray[np.float32] | None  # seconds after the beginning; None: all at once
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
    contacts: npt.NDArray[np.int32]  # instances that the robot touches


class World:
    """A session, fixed to the bit by building, scenario, tour and seed. Raises BuildingError for bad input, by name."""

    def __init__(
        self,
        building: Path | str,
        scenario: Path | str,
        tour: str,
        seed: int,
        *,
        lidar: str | LidarSpec = "paper",
        rolling: bool | None = None,
        odometry: OdometryNoise | None = None,
    ) -> None:
        self.building: Building = load(building)
        self.scenario = load_scenario(scenario)
        if isinstance(lidar, str):
            if lidar not in PRESETS:
                raise BuildingError(f"there is no lidar {lidar!r}; there are {', '.join(PRESETS)}")
            lidar = PRESETS[lidar]
        self.spec = lidar if rolling is None else msgspec.structs.replace(lidar, rolling=rolling)
        self.start = self.building.start_pose(tour)
        self.targets = np.array(self.building.tours[tour].targets, np.float64).reshape(-1, 2)
        self.layout = draw(self.building, self.scenario, tour, seed)
        self.bodies = [self._floor(), *self.layout.bodies]
        triangles, owner = triangles_of(self.bodies)
        self.lidar = Lidar(self.spec, triangles, owner)
        self.physics = Physics(self.layout.bodies, self.start)
        self.noise = np.random.default_rng([seed, 3])
        self.odometer = Odometer(self.start, odometry or OdometryNoise(), np.random.default_rng([seed, 4]))
        self._people(np.random.default_rng([seed, 2]))
        self.truth = np.array([body.truth for body in self.bodies] + self.person_truth, np.uint8)
        self.time = 0.0
        self.touched: dict[int, float] = {}  # instance: when it was last touched
        self.collisions = {"people": 0, "things": 0}
        self.before = self.motion = self.physics.motion()
        self.odometer.advance(self.motion, 0.0, 1.0)
        self.bodies_before = self.capsules = self._capsules()
        self.touching = np.zeros(0, np.int32)

    def _floor(self) -> Body:
        x0, y0, x1, y1 = self.building.bounds()
        slab = Box((x0 + x1) / 2, (y0 + y1) / 2, -0.05, x1 - x0 + 2.0, y1 - y0 + 2.0, 0.1)
        return Body("floor", Truth.GROUND, (slab,))

    def _people(self, rng: np.random.Generator) -> None:
        """Draw walkers by density, and sitters on the seats that are taken."""
        area = self.building.populated_area()
        wanderers, followers = (round(density * area) for density in (self.scenario.wanderers, self.scenario.followers))
        rooms = [np.array(room.polygon) for room in self.building.rooms if room.populated]
        boxes = [np.array([*room.min(0), *room.max(0)]) for room in rooms]
        places = spots(self.layout.free, boxes, wanderers + followers, np.array(self.start[:2]), rng)
        self.wanted_people = wanderers + followers
        following = np.arange(len(places)) >= len(places) - min(followers, len(places))
        self.crowd = Crowd(places, following, self.scenario.attentive, rng)
        seats = np.array(self.layout.seats, np.float64).reshape(-1, 3)
        heights = np.clip(rng.normal(1.71, 0.09, len(seats)), 1.50, 1.95)
        builds = np.clip(rng.normal(1.0, 0.08, len(seats)), 0.85, 1.25)
        figure = sitting() * heights[:, None, None, None]
        sitters = placed(figure, *seats.T) if len(seats) else np.zeros((0, *sitting().shape))
        self.radii = np.concatenate([radii(self.crowd.height, self.crowd.build), radii(heights, builds)])
        if len(seats):
            lift = SEAT_HEIGHT + 0.02 - (sitters[:, 0, :, 2].min(1) - self.radii[len(self.crowd.height) :, 0])
            sitters[..., 2] += np.minimum(lift, 0.05)[:, None, None]
        self.sitters, self.seats = sitters, seats
        self.person_truth = [int(Truth.MOVING_PERSON)] * len(places) + [int(Truth.STILL_PERSON)] * len(seats)

    def _capsules(self) -> Array:
        """Return the capsules (p, 16, 2, 3) of all people as they stand now."""
        crowd = self.crowd
        walkers = figures(crowd.phase(), crowd.stride_share(), crowd.height)
        return np.concatenate([placed(walkers, *crowd.position.T, crowd.facing), self.sitters])

    def step(self, linear: float, angular: float, seconds: float = 0.1) -> Frame:
        """Drive for a while, then scan. linear: m/s, angular: rad/s."""
        self.advance(linear, angular, seconds)
        return self.scan()

    def advance(self, linear: float, angular: float, seconds: float = 0.1) -> None:
        """Let people walk and the robot drive for a while."""
        self.before, self.bodies_before = self.motion, self.capsules
        base = self.motion.world_from_base
        self.crowd.advance(seconds, self.layout.free, (float(base[0, 3]), float(base[1, 3]), yaw(base)))
        self.capsules = self._capsules()
        self.physics.place_people(self.capsules, self.radii, (float(base[0, 3]), float(base[1, 3])))
        self.physics.drive(linear, angular)
        touched: set[int] = set()
        for _ in range(round(seconds / SUBSTEP)):
            self.physics.step()
            still, people = self.physics.contacts()
            touched |= {1 + body for body in still} | {len(self.bodies) + person for person in people}
        self.time += seconds
        self._count(touched)
        self.motion = self.physics.motion()
        turned = float(wrap(yaw(self.motion.world_from_base) - yaw(self.before.world_from_base)))
        self.odometer.advance(self.motion, turned, seconds)

    def _count(self, touched: set[int]) -> None:
        """Count contacts, each once per encounter."""
        for instance in sorted(touched):
            if self.time - self.touched.get(instance, -math.inf) > ENCOUNTER:
                self.collisions["people" if instance >= len(self.bodies) else "things"] += 1
            self.touched[instance] = self.time
        self.touching = np.array(sorted(touched), np.int32)

    def base_from_lidar(self) -> Array:
        """Return the sensor's place on the robot (4, 4)."""
        return planar(0.0, 0.0, 0.0, self.spec.height)

    def scan(self) -> Frame:
        """Scan from where the robot is; a rolling scan began one period ago and ends now."""
        spec = self.spec
        mount = self.base_from_lidar()
        first = len(self.bodies)
        offsets = None
        if spec.rolling:
            share = np.arange(spec.columns) / spec.columns
            poses = np.array(
                [interpolate(self.before.world_from_base, self.motion.world_from_base, float(s)) @ mount for s in share]
            )
            bounds = np.linspace(0, spec.columns, SLICES + 1).astype(int)
            slices = list(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True))
            middles = [(begin + end) / 2 / spec.columns for begin, end in slices]
            people = [self.bodies_before * (1 - s) + self.capsules * s for s in middles]
            hits = self.lidar.sweep(poses, slices, people, self.radii, first)
            offsets = (share[self.lidar.column] / spec.rate).astype(np.float32)
            places = poses[self.lidar.column]
            heights = np.einsum("ni,ni->n", places[:, 2, :3], self.lidar.directions) * hits.distance + places[:, 2, 3]
        else:
            pose = self.motion.world_from_base @ mount
            hits = self.lidar.shoot(pose, self.capsules, self.radii, first)
            heights = (self.lidar.directions @ pose[2, :3]) * hits.distance + pose[2, 3]
        return self._frame(hits, heights, offsets)

    def _frame(self, hits: Hits, heights: Array, offsets: npt.NDArray[np.float32] | None) -> Frame:
        """Add noise, drop what the sensor does not see, and label what is left."""
        spec = self.spec
        measured = hits.distance + (spec.noise * self.noise.standard_normal(len(hits.distance), np.float32))
        if spec.step > 0:
            measured = np.round(measured / spec.step) * spec.step
        keep = (hits.body != NOTHING) & (measured >= spec.nearest) & (measured <= spec.farthest)
        if spec.dropout > 0:
            grazing = np.clip(1.0 - hits.cosine / 0.26, 0.0, 1.0)  # beyond 75 degrees of incidence
            far = np.clip(hits.distance / spec.farthest - 0.5, 0.0, 0.5) * 2.0
            keep &= self.noise.random(len(keep), np.float32) >= spec.dropout * np.maximum(grazing, far)
        body = hits.body[keep]
        truth = self.truth[body]
        truth[heights[keep] < GROUND] = Truth.GROUND
        moves = np.concatenate(
            [np.zeros(len(self.bodies), np.bool_), self.crowd.moving(), np.zeros(len(self.seats), np.bool_)]
        )
        return Frame(
            points=(self.lidar.directions[keep] * measured[keep, None]).astype(np.float32),
            ring=self.lidar.ring[keep],
            time_offset=None if offsets is None else offsets[keep],
            truth=truth,
            moving=moves[body],
            instance=body.astype(np.int32),
        )

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
