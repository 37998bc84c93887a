"""A populated world on one sheet: from above, from eye level, and one lidar frame coloured by truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from graph.geometry import planar, transform
from sim.physics import GROUND_CLEARANCE, HEIGHT, LENGTH, MAST, WIDTH
from sim.render import NAMES, PALETTE, ROBOT, Camera, Renderer, overhead, perspective
from sim.solids import Body, Box, Truth
from sim.world import Frame, World

Array = npt.NDArray[np.float64]

SETTLE = 4.0  # seconds that people walk before the picture is taken
EYES = 1.65  # metres above the floor
APART = 1.5  # metres between two places that are tried
AHEAD = 3.2  # metres at which the robot stands before the eye, at most
TILT = -0.22  # radians, of the eye-level view
SIZE = (1600, 900)  # rays of the eye-level view
ABOVE = 2800  # rays across the view from above
RADIUS = 9.0  # metres of the lidar frame that are shown from above
DPI = 90
BACKDROP = "#15181d"
FRAME_COLOURS = np.where(np.arange(len(PALETTE))[:, None] == Truth.GROUND, np.float32(0.42), PALETTE)


class Spot(NamedTuple):
    """Where the eye stands, metres and radians, and how far before it the robot."""

    x: float
    y: float
    heading: float
    ahead: float


def draw_snapshot(world: World, path: Path, title: str, *, progress: Callable[[float], None]) -> None:
    """Let people walk for a while, put the robot where most is to be seen on its tour, and draw the sheet.

    progress: called with the share that is done.
    """
    for _ in range(round(SETTLE * world.spec.rate)):
        world.advance(0.0, 0.0, 1.0 / world.spec.rate)
    progress(0.1)
    spot = liveliest(world)
    pose = planar(
        spot.x + spot.ahead * math.cos(spot.heading), spot.y + spot.ahead * math.sin(spot.heading), spot.heading
    )
    renderer = renderer_of(world, pose)
    camera = perspective((spot.x, spot.y, EYES), spot.heading, TILT, SIZE)
    progress(0.3)
    eye = renderer.picture(camera)
    progress(0.4)
    bounds = world.building.bounds()
    above = renderer.picture(overhead(bounds, ABOVE))
    frame = scan_from(world, pose)
    progress(0.9)
    _sheet(world, path, title, above, eye, frame, pose, spot)


def renderer_of(world: World, world_from_base: Array) -> Renderer:
    """Build the scene of a world, with the robot at a pose."""
    x, y, yaw = world_from_base[0, 3], world_from_base[1, 3], math.atan2(world_from_base[1, 0], world_from_base[0, 0])
    chassis = Box(0, 0, GROUND_CLEARANCE + HEIGHT / 2, LENGTH, WIDTH, HEIGHT)
    mast = Box(0, 0, MAST[1] / 2, MAST[0], MAST[0], MAST[1] - 0.1)
    head = Box(0, 0, world.spec.height, 0.09, 0.09, 0.09)
    robot = Body("robot", Truth.UNKNOWN, tuple(part.moved(x, y, yaw) for part in (chassis, mast, head)))
    return Renderer(world.bodies, robot, world.capsules, world.radii, world.truth[len(world.bodies) :])


def liveliest(world: World) -> Spot:
    """Return the place on the tour's way where people and things fill most of the view, with room for the robot."""
    renderer = renderer_of(world, planar(0.0, 0.0, 0.0, -10.0))
    way = world.layout.way
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    places = way[np.unique(np.searchsorted(walked, np.arange(0.0, walked[-1], APART)))]
    people = world.state().people[:, :2]
    best, found = -1.0, Spot(*world.start, 0.0)
    for place in places:
        if len(people) and np.linalg.norm(people - place, axis=1).min() < 1.2:
            continue
        for heading in np.arange(12) * (math.pi / 6):
            seen = renderer.kinds(perspective((*place, EYES), heading, TILT, (48, 27)))
            persons = np.isin(seen, (Truth.MOVING_PERSON, Truth.STILL_PERSON)).mean()
            things = np.isin(seen, (Truth.TABLE, Truth.CHAIR, Truth.DOOR)).mean()
            score = min(persons, 0.25) + min(things, 0.15) + 0.02 * len(np.unique(seen))
            ahead = _room_ahead(world, place, heading, people)
            if score > best and ahead > 0:
                best, found = score, Spot(float(place[0]), float(place[1]), float(heading), ahead)
    return found


def _room_ahead(world: World, place: Array, heading: float, people: Array) -> float:
    """Return how far before the eye the robot can stand in full view, in metres; 0: nowhere."""
    forward = np.array([math.cos(heading), math.sin(heading)])
    for ahead in np.arange(AHEAD, 2.2, -0.2):
        line = place + np.linspace(0.0, ahead + 0.3, 30)[:, None] * forward
        alone = not len(people) or np.linalg.norm(people[:, None] - line, axis=2).min() > 0.6
        if alone and world.layout.free.at(line).min() > 0.35:
            return float(ahead)
    return 0.0


def scan_from(world: World, world_from_base: Array) -> Frame:
    """Scan as if the robot stood at a pose."""
    world.motion = world.motion._replace(world_from_base=world_from_base)
    world.trail = [world_from_base] * 2
    return world.scan()


def _sheet(
    world: World, path: Path, title: str, above: npt.NDArray[np.uint8], eye: npt.NDArray[np.uint8], frame: Frame,
    pose: Array, spot: Spot,
) -> None:  # fmt: skip
    figure = Figure(figsize=(24, 14.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, width_ratios=(14, 9.2))
    left, upper, middle, lower = (figure.add_subplot(cell) for cell in (grid[:, 0], grid[0, 1], grid[1, 1], grid[2, 1]))
    x0, y0, x1, y1 = world.building.bounds()
    left.imshow(above, extent=(x0, x1, y0, y1), interpolation="lanczos")
    left.plot(*world.layout.way.T, color="#d62728", linewidth=0.8, alpha=0.45)
    left.plot(*world.targets.T, "o", color="#d62728", markersize=4, alpha=0.6)
    tip = spot.x + 1.4 * math.cos(spot.heading), spot.y + 1.4 * math.sin(spot.heading)
    left.annotate("", tip, (spot.x, spot.y), arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 2})
    left.set(title=title, xlabel="x (m)", ylabel="y (m)")
    handles = [Patch(color=PALETTE[kind], label=NAMES[kind]) for kind in range(1, ROBOT + 1)]
    figure.legend(handles=handles, loc="outside lower center", ncols=ROBOT, frameon=False)
    upper.imshow(eye)
    upper.set(title=f"eye level, from the arrow at ({spot.x:.1f}, {spot.y:.1f})", xticks=[], yticks=[])
    points = transform(pose @ world.base_from_lidar(), frame.points.astype(np.float64))
    camera = perspective((spot.x, spot.y, EYES), spot.heading, TILT, SIZE)
    _in_view(middle, camera, points, frame.truth, spot)
    middle.set(title=f"one lidar frame of {len(points)} points in the same view, coloured by truth")
    _from_above(lower, points, frame.truth, pose)
    lower.set(title="the same frame from above, around the robot (m)")
    figure.savefig(path, dpi=DPI)


def _in_view(axes: Axes, camera: Camera, points: Array, truth: npt.NDArray[np.uint8], spot: Spot) -> None:
    """Draw points as the eye sees them, the nearest on top."""
    forward, right = camera.directions[SIZE[1] // 2, SIZE[0] // 2], camera.directions[SIZE[1] // 2, -1]
    forward = forward.astype(np.float64)
    left = np.array([-math.sin(spot.heading), math.cos(spot.heading), 0.0])
    half = math.tan(math.acos(float(np.clip(forward @ right, -1, 1))))
    away = points - camera.origins[0, 0]
    depth = away @ forward
    seen = np.flatnonzero(depth > 0.3)
    seen = seen[np.argsort(-depth[seen], kind="stable")]
    across = -(away[seen] @ left) / depth[seen] / half
    up = (away[seen] @ np.cross(forward, left)) / depth[seen] / half
    size = np.clip(14.0 / depth[seen], 0.8, 14.0)
    axes.scatter(across, up, s=size, c=FRAME_COLOURS[truth[seen]], linewidths=0)
    aspect = SIZE[1] / SIZE[0]
    axes.set(aspect="equal", xlim=(-1, 1), ylim=(-aspect, aspect), xticks=[], yticks=[], facecolor=BACKDROP)


def _from_above(axes: Axes, points: Array, truth: npt.NDArray[np.uint8], pose: Array) -> None:
    """Draw points on the floor plan, the highest on top."""
    order = np.argsort(points[:, 2], kind="stable")
    local = points[order, :2] - pose[:2, 3]
    axes.scatter(local[:, 0], local[:, 1], s=2.2, c=FRAME_COLOURS[truth[order]], linewidths=0)
    tip = float(pose[0, 0] * 0.8), float(pose[1, 0] * 0.8)
    axes.annotate("", tip, (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": "white"})
    axes.set(aspect="equal", xlim=(-16 / 9 * RADIUS, 16 / 9 * RADIUS), ylim=(-RADIUS, RADIUS), facecolor=BACKDROP)
