"""A dashboard: shows a run live in Rerun, and the same messages of a recording to `retracer view`.

dashboard:
  run: operators.dashboard:Dashboard
  inputs: {frame: simulator/frame, pose: localizer/pose, truth: simulator/truth}
  config: {web: true}
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.check import same_type
from graph.contract import Operator, Ports, Sink, ports_of
from graph.errors import UserError
from graph.geometry import Matrix, transform
from graph.graphfile import Edge, Graph, OperatorEntry
from graph.ledger import Step
from graph.loading import load_class
from graph.messages import Drive, Goal, MapCloud, OccupancyGrid, Odometry, Plan, PointCloud, Pose, Text, Tracks, Truth
from graph.transport import free_port
from operators.views.layout import Eye, eye_over, robot_layout
from operators.views.palette import ESTIMATE, OTHERS, TRUE_POSE, Colour
from operators.views.scene import Scene
from operators.views.tracks import Track, localization_error
from operators.views.viewer import Viewer, ViewerError, finish, has_display, open_stream, send_to

LEVELS = {"debug": "DEBUG", "info": "INFO", "warning": "WARN", "error": "ERROR"}
WAITING = 100  # poses that wait for their truth at most


class Display:
    """Shows messages in a scene, each type its own way; the names are topics, or a dashboard's ports."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.ways: dict[type, Callable[[str, Any], None]] = {
            PointCloud: self._cloud,
            Odometry: self._odometry,
            Pose: self._pose,
            Truth: self._truth,
            MapCloud: self._map,
            OccupancyGrid: self._grid,
            Plan: self._plan,
            Goal: self._goal,
            Drive: self._drive,
            Tracks: self._tracks,
            Text: self._text,
        }
        self.stamp = 0
        self.carrier = (0, "")  # rank and name of what moves the robot: odometry, truth, an estimated pose
        self.world_from_base: Matrix | None = None
        self.scans: dict[str, PointCloud] = {}  # that wait to be drawn
        self.truth = Track()
        self.waiting: list[tuple[str, int, Pose]] = []  # name, stamp
        self.poses: dict[str, Colour] = {}
        self.said: dict[tuple[str, str], Any] = {}
        self.busy: dict[str, tuple[int, int]] = {}  # operator: stamp, nanoseconds
        self.latencies: list[float] = []  # milliseconds
        self.floor: tuple[Any, Any] | None = None  # corners (2,) of the rectangle on which things have been drawn

    def show(self, name: str, message: msgspec.Struct, stamp: int) -> None:
        """Show a message of a type that it knows, at a stamp in nanoseconds."""
        self.stamp = stamp
        self.scene.at(stamp)
        self.ways[type(message)](name, message)

    def finish(self) -> None:
        """Draw what still waits."""
        for name, cloud in self.scans.items():
            self._draw(name, cloud)
        self.scans.clear()

    def step(self, operator: str, step: Step) -> None:
        """Plot how long an operator's calls of one stamp took together."""
        stamp, spent = self.busy.get(operator, (step.stamp, 0))
        if step.port in ("start", "end") or stamp != step.stamp:
            self.scene.at(stamp)
            if spent:
                self.scene.number("plots/latency", operator, spent / 1e6)
                self.latencies.append(spent / 1e6)
            spent = 0
        own = 0 if step.port in ("start", "end") else step.wall_duration
        self.busy[operator] = (step.stamp, spent + own)

    def eye(self) -> Eye | None:
        """Return a point of view from which all that has been drawn on the floor is seen."""
        return None if self.floor is None else eye_over(*self.floor)

    def _cloud(self, name: str, cloud: PointCloud) -> None:
        """Keep a scan until it is known where it was taken; a second one waits for nothing."""
        if (older := self.scans.pop(name, None)) is not None:
            self._draw(name, older)
        self.scans[name] = cloud

    def _draw(self, name: str, cloud: PointCloud) -> None:
        world_from_base = np.eye(4) if self.world_from_base is None else self.world_from_base
        world_from_sensor = world_from_base @ cloud.base_from_lidar
        self.scene.cloud(name, cloud.points, world_from_sensor, label=cloud.label, truth=cloud.truth)
        if len(cloud.points) and self.news(name, "seen", True):
            points = transform(world_from_sensor, cloud.points)
            self._cover(*np.percentile(points[:, :2], (5, 95), axis=0))

    def _odometry(self, name: str, odometry: Odometry) -> None:
        self.scene.number("plots/speed", name, odometry.linear)
        true = odometry.true_world_from_base
        self._move(1, name, odometry.measured_at, odometry.odom_from_base if true is None else true)
        if true is not None:
            self._known(odometry.measured_at, true)

    def _pose(self, name: str, pose: Pose) -> None:
        number = len(self.poses)
        colour = self.poses.setdefault(name, OTHERS[(number - 1) % len(OTHERS)] if number else ESTIMATE)
        if not self._move(3, name, pose.measured_at, pose.world_from_base, valid=pose.valid):
            self.scene.ghost(name, pose.world_from_base, colour)
        self.scene.trail(name, pose.world_from_base, colour)
        if self.news(name, "valid", pose.valid, usual=True):
            text = "the pose is valid again" if pose.valid else f"the pose is not valid: {pose.reason}"
            self.scene.say(name, text, "INFO" if pose.valid else "WARN")
        self.waiting = [*self.waiting, (name, self.stamp, pose)][-WAITING:]
        self._judge()

    def _truth(self, name: str, truth: Truth) -> None:
        self._move(2, name, truth.measured_at, truth.world_from_base)
        self.scene.ghost(name, truth.world_from_base, TRUE_POSE)
        self.scene.trail(name, truth.world_from_base, TRUE_POSE, height=0.03)
        self.scene.people(name, truth.people, truth.people_moving)
        if self.news(name, "contacts", truth.contacts.tolist(), usual=[]) and truth.contacts.size:
            self.scene.say(name, f"the robot touches {', '.join(map(str, truth.contacts))}", "WARN")
        self._known(truth.measured_at, truth.world_from_base)

    def _map(self, name: str, cloud: MapCloud) -> None:
        self.scene.map(name, cloud.points, incremental=cloud.incremental, movable=cloud.movable, label=cloud.label)
        if len(cloud.points):
            self._cover(*np.percentile(cloud.points[:, :2], (2, 98), axis=0))

    def _grid(self, name: str, grid: OccupancyGrid) -> None:
        self.scene.grid(name, grid.cells, grid.origin, grid.resolution)

    def _plan(self, name: str, plan: Plan) -> None:
        self.scene.plan(name, plan.path, plan.trajectory)
        if self.news(name, "status", plan.status):
            self.scene.say(name, plan.status, "WARN" if plan.status in ("unreachable", "recover") else "INFO")

    def _tracks(self, name: str, tracks: Tracks) -> None:
        self.scene.tracks(name, tracks.position, tracks.velocity, tracks.identity)

    def _goal(self, name: str, goal: Goal) -> None:
        text = f"target {goal.index + 1} of {goal.count}"
        self.scene.goal(name, goal.target, text)
        self._cover(goal.target - 2.0, goal.target + 2.0)
        if self.news(name, "target", goal.index):
            self.scene.say(name, f"{text}: x {goal.target[0]:.2f} m, y {goal.target[1]:.2f} m")

    def _drive(self, name: str, drive: Drive) -> None:
        self.scene.number("plots/speed", name, drive.linear)

    def _text(self, name: str, text: Text) -> None:
        self.scene.say(name, text.text, LEVELS.get(text.level, "INFO"))

    def _move(self, rank: int, name: str, measured_at: int, world_from_base: Matrix, *, valid: bool = True) -> bool:
        """Move the robot, and draw the scans taken there, if nothing that knows better does. Returns whether it has."""
        if rank < self.carrier[0] or (rank == self.carrier[0] and name != self.carrier[1]):
            return False
        self.carrier, self.world_from_base = (rank, name), world_from_base
        self.scene.robot(world_from_base, valid=valid)
        self._cover(world_from_base[:2, 3] - 3.0, world_from_base[:2, 3] + 3.0)
        for scan in [scan for scan, cloud in self.scans.items() if cloud.measured_at <= measured_at]:
            self._draw(scan, self.scans.pop(scan))
        return True

    def _known(self, measured_at: int, world_from_base: Matrix) -> None:
        self.truth.add(measured_at, world_from_base)
        self._judge()

    def _judge(self) -> None:
        """Plot the error of each pose whose true counterpart is known by now."""
        left = []
        for name, stamp, pose in self.waiting:
            true = self.truth.at(pose.measured_at)
            if true is None:
                left.append((name, stamp, pose))
                continue
            self.scene.at(stamp)
            error = 100.0 * localization_error(pose.world_from_base, true)  # cm
            self.scene.number("plots/localization_error", name, error, self.poses[name])
        self.waiting = left
        self.scene.at(self.stamp)

    def _cover(self, low: Any, high: Any) -> None:
        """Note that a rectangle of the floor, given by two corners (2,), has something on it."""
        known = (low, high) if self.floor is None else self.floor
        self.floor = np.minimum(known[0], low), np.maximum(known[1], high)

    def news(self, name: str, what: str, value: Any, usual: Any = None) -> bool:
        """Say whether a value is another than the last time (the first time: than usual), and remember it."""
        known = self.said.get((name, what), usual)
        self.said[name, what] = value
        return bool(known != value)


class Dashboard(Sink):
    """Show the latest message of each topic live. As a Sink it holds back nobody, and misses what comes too fast."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """Where to show it; by default in a window, or as a web page where there is no display."""

        address: str = ""  # of a running viewer: rerun+http://127.0.0.1:9876/proxy
        web: bool = False  # serve a web page on this machine and print its address
        save: Path | None = None  # an .rrd file; without `web` or `address` instead of a viewer
        frames: float = 5.0  # point clouds a second of the wall clock, at most, of each port

    config: Config

    viewer: Viewer | None = None
    display: Display | None = None  # None while there is nothing to show on

    def on_start(self) -> None:
        """Open the viewer; a run that cannot be seen goes on all the same."""
        c = self.config
        self.stream = open_stream("live")
        self.aimed = False
        self.drawn: dict[str, float] = {}  # port: when its last cloud was drawn, in seconds of the wall clock
        self.seen: dict[int, float] = {}  # measured_at of a frame: when it came here
        url = c.address
        try:
            if not url and (c.web or c.save is None):
                self.viewer = Viewer(free_port(), page=free_port() if c.web or not has_display() else None)
                url = self.viewer.url
            send_to(self.stream, url=url, file=c.save)
        except ViewerError as error:
            print(f"the dashboard shows nothing: {error}", flush=True)
            return
        if self.viewer is not None and self.viewer.address:
            print(f"the dashboard is at {self.viewer.address}", flush=True)
        self.stream.send_blueprint(robot_layout())
        self.display = Display(Scene(self.stream))

    def on_odometry(self, odometry: Odometry | None) -> None:
        """Plot the speed."""
        self.show("odometry", odometry)

    def on_truth(self, truth: Truth | None) -> None:
        """Show where the robot and the people really are."""
        self.show("truth", truth)

    def on_goal(self, goal: Goal | None) -> None:
        """Show the target."""
        self.show("goal", goal)

    def on_frame(self, frame: PointCloud | None) -> None:
        """Show a scan, and note when it came."""
        if frame is not None:
            self.seen = dict([*self.seen.items(), (frame.measured_at, time.perf_counter())][-WAITING:])
        self.show("frame", frame)

    def on_classified(self, classified: PointCloud | None) -> None:
        """Show a scan coloured by label."""
        self.show("classified", classified)

    def on_pose(self, pose: Pose | None) -> None:
        """Show where the robot believes to be, and how far off that is."""
        self.show("pose", pose)

    def on_map(self, map: MapCloud | None) -> None:
        """Add to the map what arrives of it; increments that are missed stay missed."""
        self.show("map", map)

    def on_annotated(self, annotated: MapCloud | None) -> None:
        """Show the map with what moves in it."""
        self.show("annotated", annotated)

    def on_tracks(self, tracks: Tracks | None) -> None:
        """Show who is followed, and where they go."""
        self.show("tracks", tracks)

    def on_occupancy(self, occupancy: OccupancyGrid | None) -> None:
        """Show the grid."""
        self.show("occupancy", occupancy)

    def on_plan(self, plan: Plan | None) -> None:
        """Show the path and the next motion."""
        self.show("plan", plan)

    def on_drive(self, drive: Drive | None) -> None:
        """Plot the commanded speed."""
        self.show("drive", drive)

    def on_text(self, text: Text | None) -> None:
        """Add a line to the log."""
        self.show("text", text)

    def on_end(self) -> None:
        """Send what is still on its way; a web page goes with the run, a window stays."""
        if self.display is not None:
            self.display.finish()
            try:
                finish(self.stream, patience=3.0)
            except ViewerError as error:
                print(f"the dashboard: {error}", flush=True)
        if self.viewer is not None and self.viewer.address:
            self.viewer.close()

    def show(self, port: str, message: Any) -> None:
        """Show a message at the time that it is about: the runtime's stamps are not told to operators."""
        if message is None or self.display is None:
            return
        now = time.perf_counter()
        if isinstance(message, PointCloud):
            if now - self.drawn.get(port, -1e9) < 1.0 / self.config.frames:
                return
            self.drawn[port] = now
        self.display.show(port, message, message.measured_at)
        if port in ("pose", "drive") and message.measured_at in self.seen:
            age = 1e3 * (now - self.seen[message.measured_at])  # milliseconds of the wall clock, as seen from here
            self.display.scene.number("plots/latency", f"frame_to_{port}", age)
        if isinstance(message, PointCloud) and not self.aimed and (eye := self.display.eye()) is not None:
            self.aimed = True  # once: from now on the camera is the user's
            self.stream.send_blueprint(robot_layout(eye=eye, hidden=list(self.display.scene.hidden)))


def attach(graph: Graph, config: dict[str, Any] | None = None) -> Graph:
    """Return a copy of a graph with an operator `dashboard` that listens to all it can show.

    Each port takes the output of its name and type, else the first of its type that no other port takes. A graph that
    has a dashboard stays as it is. Raises UserError if nothing of the graph can be shown.
    """
    given = copy.deepcopy(graph)
    kinds = {name: load_class(entry.run, graph.root) for name, entry in graph.operators.items()}
    if any(issubclass(kind, Dashboard) for kind in kinds.values()):
        return given
    inputs = _feeds(kinds)
    if not inputs:
        wanted = dict.fromkeys(kind.__name__ for kind in ports_of(Dashboard).inputs.values())
        raise UserError(f"graph '{graph.name}' has nothing to show: none of its operators gives {', '.join(wanted)}")
    name = next(
        name for name in ("dashboard", *(f"dashboard_{n}" for n in range(2, 99))) if name not in given.operators
    )
    given.operators[name] = OperatorEntry("operators.dashboard:Dashboard", inputs, config or {})
    return given


def _feeds(kinds: dict[str, type[Operator]]) -> dict[str, Edge]:
    outputs = [
        (Edge(name, port), message) for name, kind in kinds.items() for port, message in ports_of(kind).outputs.items()
    ]
    ports: Ports = ports_of(Dashboard)
    feeds: dict[str, Edge] = {}
    for by_name in (True, False):
        for port, wanted in ports.inputs.items():
            fits = (
                edge
                for edge, message in outputs
                if same_type(message, wanted) and edge not in feeds.values() and (edge.port == port or not by_name)
            )
            if port not in feeds and (edge := next(fits, None)) is not None:
                feeds[port] = edge
    return feeds
