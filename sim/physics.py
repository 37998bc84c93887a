"""The robot's body in PyBullet: wheels with motors among the very triangles and capsules that the lidar sees."""

from __future__ import annotations

import math
import weakref
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sim.engines import pybullet as p
from sim.solids import Body

Array = npt.NDArray[np.float64]

SUBSTEP = 1.0 / 240.0  # seconds
LENGTH, WIDTH, HEIGHT = 0.42, 0.31, 0.22  # metres, of the chassis
GROUND_CLEARANCE = 0.01  # metres: a skirt, or the robot would climb on people's feet
BALLAST = 0.06  # metres of the centre of mass below the middle of the chassis
WHEEL_RADIUS, WHEEL_WIDTH, TRACK = 0.085, 0.03, 0.26  # metres
MASS, WHEEL_MASS = 14.0, 0.8  # kg
MOTOR = 6.0  # N m, the most a wheel's motor gives
TOP_SPEED, TOP_TURN = 1.3, 1.0  # m/s, rad/s
ACCELERATION, TURN_ACCELERATION = 1.0, 2.5  # m/s^2, rad/s^2
FASTEST, FASTEST_TURN = 1.5, 1.5  # m/s, rad/s: what pushing and being pushed can do to the robot
FASTEST_UP, FASTEST_TIP = 0.1, 0.3  # m/s, rad/s: with its ballast it is neither lifted nor tipped over
MAST = 0.06, 0.68  # metres: width and top of the column that carries the lidar
PERSON_REACH = 1.6  # metres from the robot within which people have bodies
GLIDE = 6  # substeps between two placements of walking people
STILL_GROUP = 2  # Bullet's collision group of what has no mass
BATCH = 8192  # rays at once; PyBullet silently drops those beyond 16383


class Motion(NamedTuple):
    """Where the robot is and how it moves. Angles of the wheels in radians, unwrapped."""

    world_from_base: Array  # (4, 4)
    linear: float  # m/s forward
    angular: float  # rad/s about +z
    wheels: tuple[float, float]  # left, right


class Physics:
    """One PyBullet world without a window. Everything is added in a fixed order, so that runs are equal to the bit."""

    def __init__(self, bodies: list[Body], start: tuple[float, float, float], *, braking: float = ACCELERATION) -> None:
        self.client = p.connect(p.DIRECT)
        weakref.finalize(self, _disconnect, self.client)
        p.setGravity(0, 0, -9.81, physicsClientId=self.client)
        p.setPhysicsEngineParameter(fixedTimeStep=SUBSTEP, deterministicOverlappingPairs=1, physicsClientId=self.client)
        self.floor = p.createMultiBody(
            0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.client), physicsClientId=self.client
        )
        self.still = {self._still(body): index for index, body in enumerate(bodies)}  # PyBullet's number: body
        self.robot = self._robot(start)
        self.command = (0.0, 0.0)
        self.braking = braking  # m/s^2
        self.target = [0.0, 0.0]  # linear, angular, after the acceleration limits
        self.people: dict[int, list[int]] = {}  # person: capsule bodies
        self.owner: dict[int, int] = {}  # capsule body: person
        self._settle()

    def _still(self, body: Body) -> int:
        triangles = np.concatenate([part.triangles() for part in body.parts])
        shape = p.createCollisionShape(
            p.GEOM_MESH,
            vertices=triangles.reshape(-1, 3).tolist(),
            indices=list(range(3 * len(triangles))),
            flags=p.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=self.client,
        )
        return int(p.createMultiBody(0, shape, physicsClientId=self.client))

    def _robot(self, start: tuple[float, float, float]) -> int:
        """Build chassis, two driven wheels and two casters that slide. Returns PyBullet's number."""
        client = self.client
        middle = GROUND_CLEARANCE + HEIGHT / 2
        chassis = p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_BOX, p.GEOM_BOX],
            halfExtents=[[LENGTH / 2, WIDTH / 2, HEIGHT / 2], [MAST[0] / 2, MAST[0] / 2, (MAST[1] - middle) / 2]],
            collisionFramePositions=[[0, 0, 0], [0, 0, (MAST[1] - middle) / 2]],
            physicsClientId=client,
        )
        wheel = p.createCollisionShape(p.GEOM_CYLINDER, radius=WHEEL_RADIUS, height=WHEEL_WIDTH, physicsClientId=client)
        ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.03, physicsClientId=client)
        x, y, yaw = start
        sideways = p.getQuaternionFromEuler([math.pi / 2, 0, 0])
        robot = p.createMultiBody(
            MASS,
            chassis,
            basePosition=[x, y, middle],
            baseOrientation=p.getQuaternionFromEuler([0, 0, yaw]),
            baseInertialFramePosition=[0, 0, -BALLAST],
            linkMasses=[WHEEL_MASS, WHEEL_MASS, 0.1, 0.1],
            linkCollisionShapeIndices=[wheel, wheel, ball, ball],
            linkVisualShapeIndices=[-1] * 4,
            linkPositions=[
                [0, TRACK / 2, WHEEL_RADIUS - middle],
                [0, -TRACK / 2, WHEEL_RADIUS - middle],
                [0.15, 0, 0.03 - middle],
                [-0.15, 0, 0.03 - middle],
            ],
            linkOrientations=[sideways, sideways, [0, 0, 0, 1], [0, 0, 0, 1]],
            linkInertialFramePositions=[[0, 0, 0]] * 4,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 4,
            linkParentIndices=[0] * 4,
            linkJointTypes=[p.JOINT_REVOLUTE, p.JOINT_REVOLUTE, p.JOINT_FIXED, p.JOINT_FIXED],
            linkJointAxis=[[0, 0, -1], [0, 0, -1], [0, 0, 1], [0, 0, 1]],
            physicsClientId=client,
        )
        for link, friction in ((-1, 0.3), (0, 1.2), (1, 1.2), (2, 0.0), (3, 0.0)):
            p.changeDynamics(
                robot, link, lateralFriction=friction, linearDamping=0, angularDamping=0, physicsClientId=client
            )
        for link in (0, 1):
            p.changeDynamics(robot, link, jointDamping=0.0, physicsClientId=client)
            p.setCollisionFilterPair(robot, robot, -1, link, 0, physicsClientId=client)
        return int(robot)

    def _settle(self) -> None:
        for _ in range(60):
            self._motors()
            p.stepSimulation(physicsClientId=self.client)

    def drive(self, linear: float, angular: float) -> None:
        """Set the velocity command, m/s and rad/s; what the robot cannot do is clipped."""
        self.command = (
            min(max(linear, -TOP_SPEED), TOP_SPEED),
            min(max(angular, -TOP_TURN), TOP_TURN),
        )

    def step(self) -> None:
        """Advance by SUBSTEP."""
        for index, most in enumerate((ACCELERATION, TURN_ACCELERATION)):
            gap = self.command[index] - self.target[index]
            limit = (self.braking if index == 0 and gap * self.target[index] < 0.0 else most) * SUBSTEP
            self.target[index] += min(max(gap, -limit), limit)
        self._motors()
        p.stepSimulation(physicsClientId=self.client)
        self._hold()

    def _hold(self) -> None:
        """Take the speed that no robot on wheels has: Bullet parts bodies that overlap by throwing the lighter one."""
        velocity, spin = p.getBaseVelocity(self.robot, physicsClientId=self.client)
        fast, tipping = math.hypot(velocity[0], velocity[1]), math.hypot(spin[0], spin[1])
        turning, rising = abs(spin[2]), velocity[2]
        if fast > FASTEST or turning > FASTEST_TURN or tipping > FASTEST_TIP or rising > FASTEST_UP:
            slower, calmer = min(1.0, FASTEST / max(fast, 1e-9)), min(1.0, FASTEST_TURN / max(turning, 1e-9))
            steadier = min(1.0, FASTEST_TIP / max(tipping, 1e-9))
            p.resetBaseVelocity(
                self.robot,
                [slower * velocity[0], slower * velocity[1], min(rising, FASTEST_UP)],
                [steadier * spin[0], steadier * spin[1], calmer * spin[2]],
                physicsClientId=self.client,
            )

    def _motors(self) -> None:
        linear, angular = getattr(self, "target", [0.0, 0.0])
        speeds = [(linear - angular * TRACK / 2) / WHEEL_RADIUS, (linear + angular * TRACK / 2) / WHEEL_RADIUS]
        p.setJointMotorControlArray(
            self.robot,
            [0, 1],
            p.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=[MOTOR, MOTOR],
            physicsClientId=self.client,
        )

    def motion(self) -> Motion:
        """Read where the robot is: its base is the point on the floor below its centre."""
        place, turn = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        velocity, spin = p.getBaseVelocity(self.robot, physicsClientId=self.client)
        pose = np.eye(4)
        pose[:3, :3] = np.array(p.getMatrixFromQuaternion(turn)).reshape(3, 3)
        pose[:3, 3] = np.array(place) + pose[:3, :3] @ [0.0, 0.0, BALLAST - GROUND_CLEARANCE - HEIGHT / 2]
        states = p.getJointStates(self.robot, [0, 1], physicsClientId=self.client)
        forward = float(np.dot(velocity, pose[:3, 0]))
        return Motion(pose, forward, float(spin[2]), (states[0][0], states[1][0]))

    def place_people(self, capsules: Array, radii: Array, reach: float = PERSON_REACH) -> None:
        """Give the people within `reach` metres of the robot bodies of capsules, and take away those of the others.

        capsules: ends (n, parts, 2, 3) and radii (n, parts) in metres.
        """
        if not len(capsules):
            return
        robot, _ = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        middles = capsules[:, :, :, :2].mean((1, 2))
        near = np.hypot(middles[:, 0] - robot[0], middles[:, 1] - robot[1]) < reach
        for index in np.flatnonzero(near).tolist():
            self._place(index, capsules[index], radii[index])
        for person in [person for person in self.people if not near[person]]:
            for body in self.people.pop(person):
                del self.owner[body]
                p.removeBody(body, physicsClientId=self.client)

    def _place(self, person: int, capsules: Array, radii: Array) -> None:
        middles = capsules.mean(1).tolist()
        axes = capsules[:, 1] - capsules[:, 0]
        turns = _turns(axes).tolist()
        if person in self.people:
            for body, middle, turn in zip(self.people[person], middles, turns, strict=True):
                p.resetBasePositionAndOrientation(body, middle, turn, physicsClientId=self.client)
            return
        lengths = np.linalg.norm(axes, axis=1).tolist()
        made = []
        for middle, turn, length, radius in zip(middles, turns, lengths, radii.tolist(), strict=True):
            shape = p.createCollisionShape(p.GEOM_CAPSULE, radius=radius, height=length, physicsClientId=self.client)
            made.append(int(p.createMultiBody(0, shape, -1, middle, turn, physicsClientId=self.client)))
        self.people[person] = made
        self.owner |= dict.fromkeys(made, person)

    def rays(self, origins: Array, ends: Array) -> tuple[Array, npt.NDArray[np.int32]]:
        """Cast rays (n, 3) to (n, 3), in metres, by PyBullet's rayTestBatch in one thread; they pass through the robot.

        Returns the share of the way at which each hits (1: nothing), and what: -1 nothing, 0 the floor, then the bodies
        that stand still, then people.
        """
        names = {-1: -1, self.floor: 0} | {number: 1 + index for number, index in self.still.items()}
        names |= {number: 1 + len(self.still) + person for number, person in self.owner.items()}
        hits = self.ray_batches(origins.tolist(), ends.tolist())
        return np.array([hit[2] for hit in hits]), np.array([names[hit[0]] for hit in hits], np.int32)

    def ray_batches(self, origins: list[list[float]], ends: list[list[float]]) -> list[tuple[Any, ...]]:
        """Cast rays and return PyBullet's own tuples: number of the body, link, share of the way, and so on."""
        hits: list[tuple[Any, ...]] = []
        for first in range(0, len(origins), BATCH):
            part = slice(first, first + BATCH)
            hits += p.rayTestBatch(
                origins[part],
                ends[part],
                numThreads=1,
                collisionFilterMask=STILL_GROUP,
                physicsClientId=self.client,
            )
        return hits

    def contacts(self) -> tuple[set[int], set[int]]:
        """Return the bodies that stand still, and the people, that the robot touches."""
        still: set[int] = set()
        people: set[int] = set()
        for contact in p.getContactPoints(bodyA=self.robot, physicsClientId=self.client):
            other, gap = contact[2], contact[8]
            if other in (self.floor, self.robot) or gap > 0.002:
                continue
            if other in self.owner:
                people.add(self.owner[other])
            elif other in self.still:
                still.add(self.still[other])
        return still, people


def _disconnect(client: int) -> None:
    if p.isConnected(client):
        p.disconnect(client)


def _turns(axes: Array) -> Array:
    """Return the quaternions x, y, z, w (n, 4) that turn +z into axes (n, 3) of any length."""
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    x, y, z = (np.where(lengths > 1e-9, axes, [0.0, 0.0, 1.0]) / np.maximum(lengths, 1e-9)).T
    z = np.where(lengths[:, 0] > 1e-9, z, 1.0)
    scale = np.sqrt(np.maximum(2.0 * (1.0 + z), 1e-12))
    turns = np.stack([-y / scale, x / scale, np.zeros(len(axes)), scale / 2.0], 1)
    turns[z < -0.999999] = [1.0, 0.0, 0.0, 0.0]
    return turns
