"""The robot's body in PyBullet: wheels with motors among the very triangles and capsules that the lidar sees."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sim.quiet import pybullet as p
from sim.solids import Body

Array = npt.NDArray[np.float64]

SUBSTEP = 1.0 / 240.0  # seconds
LENGTH, WIDTH, HEIGHT = 0.42, 0.31, 0.18  # metres, of the chassis
GROUND_CLEARANCE = 0.05
WHEEL_RADIUS, WHEEL_WIDTH, TRACK = 0.085, 0.03, 0.26  # metres
MASS, WHEEL_MASS = 14.0, 0.8  # kg
MOTOR = 6.0  # N m, the most a wheel's motor gives
TOP_SPEED, TOP_TURN = 1.3, 1.0  # m/s, rad/s
ACCELERATION, TURN_ACCELERATION = 1.0, 2.5  # m/s^2, rad/s^2
PERSON_REACH = 1.6  # metres from the robot within which people have bodies


class Motion(NamedTuple):
    """Where the robot is and how it moves. Angles of the wheels in radians, unwrapped."""

    world_from_base: Array  # (4, 4)
    linear: float  # m/s forward
    angular: float  # rad/s about +z
    wheels: tuple[float, float]  # left, right


class Physics:
    """One PyBullet world without a window. Everything is added in a fixed order, so that runs are equal to the bit."""

    def __init__(self, bodies: list[Body], start: tuple[float, float, float]) -> None:
        self.client = p.connect(p.DIRECT)
        p.setGravity(0, 0, -9.81, physicsClientId=self.client)
        p.setPhysicsEngineParameter(fixedTimeStep=SUBSTEP, deterministicOverlappingPairs=1, physicsClientId=self.client)
        self.floor = p.createMultiBody(
            0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.client), physicsClientId=self.client
        )
        self.still = {self._still(body): index for index, body in enumerate(bodies)}  # PyBullet's number: body
        self.robot = self._robot(start)
        self.command = (0.0, 0.0)
        self.target = [0.0, 0.0]  # linear, angular, after the acceleration limits
        self.people: dict[int, list[int]] = {}  # person: capsule bodies
        self.owner: dict[int, int] = {}  # capsule body: person
        self._settle()

    def close(self) -> None:
        """Let PyBullet forget this world."""
        if p.isConnected(self.client):
            p.disconnect(self.client)

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
        chassis = p.createCollisionShape(
            p.GEOM_BOX, halfExtents=[LENGTH / 2, WIDTH / 2, HEIGHT / 2], physicsClientId=client
        )
        wheel = p.createCollisionShape(p.GEOM_CYLINDER, radius=WHEEL_RADIUS, height=WHEEL_WIDTH, physicsClientId=client)
        ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.03, physicsClientId=client)
        middle = GROUND_CLEARANCE + HEIGHT / 2
        x, y, yaw = start
        sideways = p.getQuaternionFromEuler([math.pi / 2, 0, 0])
        robot = p.createMultiBody(
            MASS,
            chassis,
            basePosition=[x, y, middle],
            baseOrientation=p.getQuaternionFromEuler([0, 0, yaw]),
            baseInertialFramePosition=[0, 0, -0.05],
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
        for index, limit in enumerate((ACCELERATION * SUBSTEP, TURN_ACCELERATION * SUBSTEP)):
            gap = self.command[index] - self.target[index]
            self.target[index] += min(max(gap, -limit), limit)
        self._motors()
        p.stepSimulation(physicsClientId=self.client)

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
        pose[:3, 3] = np.array(place) + pose[:3, :3] @ [0.0, 0.0, 0.05 - GROUND_CLEARANCE - HEIGHT / 2]
        states = p.getJointStates(self.robot, [0, 1], physicsClientId=self.client)
        forward = float(np.dot(velocity, pose[:3, 0]))
        return Motion(pose, forward, float(spin[2]), (states[0][0], states[1][0]))

    def place_people(self, capsules: Array, radii: Array, robot: tuple[float, float]) -> None:
        """Give the people near the robot bodies of capsules: ends (n, parts, 2, 3) and radii (n, parts) in metres."""
        if not len(capsules):
            return
        middle = capsules.mean((1, 2))[:, :2]
        near = np.hypot(*(middle - robot).T) < PERSON_REACH
        for person in np.flatnonzero(near):
            self._place(int(person), capsules[person], radii[person])
        for person in [person for person in self.people if not near[person]]:
            for body in self.people.pop(person):
                del self.owner[body]
                p.removeBody(body, physicsClientId=self.client)

    def _place(self, person: int, capsules: Array, radii: Array) -> None:
        middles = capsules.mean(1)
        turns = [_turn(ends[1] - ends[0]) for ends in capsules]
        if person not in self.people:
            lengths = np.linalg.norm(capsules[:, 1] - capsules[:, 0], axis=1)
            made = []
            for middle, turn, length, radius in zip(middles, turns, lengths, radii, strict=True):
                shape = p.createCollisionShape(
                    p.GEOM_CAPSULE, radius=float(radius), height=float(length), physicsClientId=self.client
                )
                made.append(int(p.createMultiBody(0, shape, -1, middle.tolist(), turn, physicsClientId=self.client)))
            self.people[person] = made
            self.owner |= dict.fromkeys(made, person)
            return
        for body, middle, turn in zip(self.people[person], middles, turns, strict=True):
            p.resetBasePositionAndOrientation(body, middle.tolist(), turn, physicsClientId=self.client)

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


def _turn(axis: Array) -> list[float]:
    """Return the quaternion x, y, z, w that turns +z into an axis."""
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        return [0.0, 0.0, 0.0, 1.0]
    x, y, z = axis / length
    if z < -0.999999:
        return [1.0, 0.0, 0.0, 0.0]
    scale = math.sqrt(2.0 * (1.0 + z))
    return [-y / scale, x / scale, 0.0, scale / 2.0]
