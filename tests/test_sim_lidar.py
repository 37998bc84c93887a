"""What a lidar sees: known distances, truths that agree with the bodies, scans that turn."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from graph.geometry import exponential, inverse, planar, transform
from sim import World
from sim.building import BuildingError, Pillar
from sim.lidar import NOTHING, PRESETS, Lidar, LidarSpec
from sim.scenario import Scenario
from sim.solids import Body, Box, Truth, triangles_of
from sim.sweep import along
from tests.small_rooms import NOBODY, box_room, two_rooms

Array = npt.NDArray[np.float64]

EXACT = LidarSpec(noise=0.0)


@pytest.fixture(scope="module")
def crowded() -> World:
    """The fullest scenario, a moment after its start."""
    world = World("default", "extreme", "A", 4, lidar=EXACT)
    for _ in range(5):
        world.advance(1.0, 0.3)
    return world


def seen(world: World) -> Array:
    """Return the points of a scan in the world."""
    pose = world.motion.world_from_base @ world.base_from_lidar()
    return np.asarray(transform(pose, world.scan().points.astype(np.float64)))


def test_a_ray_through_an_empty_room_meets_the_far_wall_at_the_known_distance() -> None:
    world = World(box_room(10.0, 8.0), NOBODY, "A", 0, lidar=EXACT)
    frame = world.scan()
    level = np.abs(frame.points[:, 1]) < 0.02
    ahead = frame.points[level & (frame.points[:, 0] > 0) & (frame.truth == Truth.WALL)]
    x = world.motion.world_from_base[0, 3]
    np.testing.assert_allclose(ahead[:, 0], 10.0 - x, atol=2e-4)
    walls = seen(world)[frame.truth == Truth.WALL]
    gaps = np.abs([walls[:, 0], walls[:, 0] - 10.0, walls[:, 1], walls[:, 1] - 8.0]).min(0)
    assert gaps.max() < 1e-3
    assert set(frame.truth.tolist()) == {Truth.GROUND, Truth.WALL}
    ground = seen(world)[frame.truth == Truth.GROUND]
    assert ground[:, 2].max() < 0.0501
    assert walls[:, 2].min() > 0.0499
    assert walls[:, 2].max() < 2.51


def test_noise_is_the_presets() -> None:
    exact = World(box_room(), NOBODY, "A", 0, lidar=EXACT).scan()
    noisy = World(box_room(), NOBODY, "A", 0, lidar="paper").scan()
    assert len(exact.points) == len(noisy.points)
    error = np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(exact.points, axis=1)
    assert abs(error.std() - 0.008) < 2e-4
    assert abs(error.mean()) < 3e-4


def test_ranges_are_multiples_of_the_step_and_within_the_limits() -> None:
    spec = LidarSpec(step=0.05, nearest=3.0, farthest=5.0)
    ranges = np.linalg.norm(World(box_room(), NOBODY, "A", 0, lidar=spec).scan().points.astype(np.float64), axis=1)
    np.testing.assert_allclose(ranges / 0.05, np.round(ranges / 0.05), atol=1e-4)
    assert ranges.min() >= 2.999
    assert ranges.max() <= 5.001


def test_turning_the_sensor_turns_the_cloud(crowded: World) -> None:
    world = crowded
    lidar, columns, beams = world.lidar, world.spec.columns, world.spec.beams
    pose, share = world.sensor(world.lidar)
    straight = lidar.shoot(pose, share, world.people())
    turned = lidar.shoot(pose @ planar(0, 0, 2 * np.pi * 100 / columns), share, world.people())
    here = straight.distance.reshape(beams, columns)
    there = np.roll(turned.distance.reshape(beams, columns), 100, axis=1)
    both = np.isfinite(here) & np.isfinite(there)
    assert both.mean() > 0.4
    assert (np.isfinite(here) == np.isfinite(there)).mean() > 0.9999
    assert (np.abs(here[both] - there[both]) < 1e-3).mean() > 0.9995  # rays along an edge may fall to either side


@pytest.mark.parametrize(("angle", "open_"), [("closed", False), (90.0, True)])
def test_a_closed_door_occludes(angle: float | str, open_: bool) -> None:
    world = World(two_rooms(angle), NOBODY, "A", 0, lidar=EXACT)
    points, frame = seen(world), world.scan()
    beyond = (points[:, 0] > 5.2) & (points[:, 2] < 2.0)
    assert beyond.any() == open_
    leaf = frame.truth == Truth.DOOR
    if not open_:
        assert np.abs(points[leaf, 0] - 5.0).max() < 0.08
        assert leaf.sum() > 100


def test_labels_agree_with_the_body_that_was_hit(crowded: World) -> None:
    world = crowded
    frame, points = world.scan(), seen(world)
    truth = world.truth[frame.instance]
    low = points[:, 2] < 0.05
    assert (frame.truth[~low] == truth[~low]).mean() > 0.9999
    assert (frame.truth[low & (points[:, 2] < 0.0499)] == Truth.GROUND).all()
    for instance in np.unique(frame.instance):
        own = points[frame.instance == instance]
        if instance >= len(world.bodies):
            ends, radii = world.capsules[instance - len(world.bodies)], world.radii[instance - len(world.bodies)]
            axis = ends[:, 1] - ends[:, 0]
            along_axis = np.clip(
                np.einsum("nki,ki->nk", own[:, None] - ends[:, 0], axis) / (axis * axis).sum(1), 0.0, 1.0
            )
            middle = ends[:, 0] + along_axis[..., None] * axis
            assert np.abs(np.linalg.norm(own[:, None] - middle, axis=2) - radii).min(1).max() < 2e-3
        elif instance > 0:
            boxes = [part for part in world.bodies[instance].parts if isinstance(part, Box)]
            if len(boxes) == len(world.bodies[instance].parts):
                assert min(outside(boxes, point) for point in own) >= -1e-9
                assert max(outside(boxes, point) for point in own) < 2e-3
    walkers = frame.truth == Truth.MOVING_PERSON
    assert not frame.moving[~walkers & (frame.truth != Truth.GROUND)].any()


def outside(boxes: list[Box], point: Array) -> float:
    """Return how far a point lies outside the nearest of some boxes, 0 within."""
    gaps = []
    for box in boxes:
        x, y = point[0] - box.x, point[1] - box.y
        local = np.array(
            [x * np.cos(box.yaw) + y * np.sin(box.yaw), y * np.cos(box.yaw) - x * np.sin(box.yaw), point[2] - box.z]
        )
        gaps.append(float(np.linalg.norm(np.maximum(np.abs(local) - np.array(box[3:6]) / 2, 0.0))))
    return min(gaps)


def ranges_now(world: World, points: Array) -> tuple[Array, Array]:
    """Return the ranges of points (n, 3) in the lidar's frame, and those that an instantaneous scan has that way."""
    pose = world.motion.world_from_base @ world.base_from_lidar()
    ranges = np.linalg.norm(points, axis=1)
    directions = (points / ranges[:, None]) @ pose[:3, :3].T
    origins = np.tile(pose[:3, 3], (len(points), 1)).astype(np.float32)
    return ranges, world.lidar.scene.run(origins, directions.astype(np.float32), query="DISTANCE")


def test_a_rolling_scan_of_a_turning_robot_deskews_to_the_instantaneous_one() -> None:
    pillars = [Pillar((3.0, 2.0)), Pillar((9.0, 8.0)), Pillar((4.0, 7.0), (1.0, 0.3), 30.0)]
    world = World(box_room(12.0, 10.0, pillars=pillars), NOBODY, "A", 2, rolling=True)
    for _ in range(12):
        world.advance(0.0, 1.0)
    swept = world.scan()
    assert swept.time_offset is not None
    assert -0.1 < swept.time_offset.min() < -0.099
    assert swept.time_offset.max() == 0.0
    poses = along(np.array(world.trail), 1.0 + swept.time_offset / 0.1) @ world.base_from_lidar()
    fixed = np.einsum("nij,nj->ni", poses[:, :3, :3], swept.points) + poses[:, :3, 3]
    steady = transform(inverse(world.motion.world_from_base @ world.base_from_lidar()), fixed)
    still = swept.instance < len(world.bodies)
    ranges, now = ranges_now(world, steady[still])
    error = np.abs(ranges - now)
    assert np.percentile(error, 99) < 4 * 0.008  # what is left are rays along edges
    assert abs(np.median(error) - 0.6745 * 0.008) < 5e-4  # a normal distribution's
    walls = (swept.truth == Truth.WALL)[still]
    ranges, now = ranges_now(world, swept.points[still][walls].astype(np.float64))
    assert np.percentile(np.abs(ranges - now), 90) > 0.05  # without it, walls are smeared


def test_people_walk_on_during_a_sweep() -> None:
    world = World(two_rooms(90.0), Scenario(wanderers=0.2), "A", 2, lidar=EXACT, rolling=True)
    for _ in range(8):
        world.advance(0.0, 0.0)
    frame = world.scan()
    first = len(world.bodies)
    person = np.flatnonzero((frame.instance >= first) & frame.moving)
    assert len(person) > 20
    pose = world.motion.world_from_base @ world.base_from_lidar()
    points = transform(pose, frame.points[person].astype(np.float64))
    assert frame.time_offset is not None
    share = 1.0 + frame.time_offset[person] / 0.1
    for point, part, s in zip(points, frame.instance[person] - first, share, strict=True):
        ends = world.bodies_before[part] * (1 - s) + world.capsules[part] * s
        axis = ends[:, 1] - ends[:, 0]
        place = np.clip(((point - ends[:, 0]) * axis).sum(1) / (axis * axis).sum(1), 0.0, 1.0)
        surface = np.linalg.norm(point - ends[:, 0] - place[:, None] * axis, axis=1) - world.radii[part]
        assert np.abs(surface).min() < 1e-3


def test_columns_of_a_sweep_lie_on_the_way() -> None:
    a, b = planar(1.0, 2.0, 0.3), planar(1.1, 2.05, 0.4)
    b[:3, :3] = b[:3, :3] @ exponential([0.01, 0.02, 0.0])
    poses = along(np.array([a, b]), np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(poses[0], a, atol=1e-12)
    np.testing.assert_allclose(poses[2], b, atol=1e-9)
    np.testing.assert_allclose(poses[1, :3, :3] @ poses[1, :3, :3].T, np.eye(3), atol=1e-12)
    half = a[:3, :3].T @ poses[1, :3, :3]
    np.testing.assert_allclose(half @ half, a[:3, :3].T @ b[:3, :3], atol=1e-9)


def test_returns_are_dropped_at_grazing_incidence_and_far_away_only() -> None:
    hall = box_room(50.0, 40.0)
    whole, holed = World(hall, NOBODY, "A", 1, lidar=EXACT), World(hall, NOBODY, "A", 1, lidar=EXACT, dropout=0.8)
    few, all_ = holed.scan(), whole.scan()
    assert 0.3 * len(all_.points) < len(few.points) < 0.98 * len(all_.points)
    near = lambda frame: (np.linalg.norm(frame.points, axis=1) < 2.3) & (frame.truth == Truth.GROUND)  # noqa: E731
    assert near(few).sum() == near(all_).sum()  # steep rays onto the floor beside the robot all return


def test_presets_are_the_sensors_of_the_paper() -> None:
    paper, real = PRESETS["paper"], PRESETS["hdl32e"]
    assert (paper.beams, paper.columns, paper.nearest, paper.farthest, paper.noise) == (32, 1024, 0.9, 30.0, 0.008)
    assert (real.beams, real.columns, real.step, real.farthest) == (32, 2170, 0.002, 70.0)
    lidar = Lidar(real, *triangles_of([Body("floor", Truth.GROUND, (Box(0, 0, -0.5, 9, 9, 1),))]))
    np.testing.assert_allclose(np.degrees(lidar.elevation[[0, -1]]), [-30.67, 10.67])
    with pytest.raises(BuildingError, match="no lidar 'velodyne'; there are paper, hdl32e"):
        World(box_room(), NOBODY, "A", 0, lidar="velodyne")


def test_rays_into_the_sky_meet_nothing() -> None:
    world = World(box_room(), NOBODY, "A", 0, lidar=msgspec.structs.replace(EXACT, lowest=80.0, highest=89.0))
    pose, share = world.sensor(world.lidar)
    assert (world.lidar.shoot(pose, share, None).body == NOTHING).all()
    assert len(world.scan().points) == 0
