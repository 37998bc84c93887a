"""The scene: everything of a robot that can be drawn, as entities of one Rerun stream.

world/robot            the robot where it believes to be
world/<name>           scans, maps, grids, plans, people, trails, other poses
plots/<quantity>/...   numbers over time
log/<name>             lines of text
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from graph.geometry import Matrix
from operators.views import palette
from operators.views.accumulation import LayeredCloud, Trail
from operators.views.palette import Colour

TIMELINE = "stamp"
BODY = (0.42, 0.31, 0.30)  # metres: length, width, height of the drawn robot
PERSON_HEIGHT, PERSON_RADIUS = 1.75, 0.25  # metres

_POINT, _MAP_POINT, _LINE, _THIN = (rr.Radius.ui_points(size) for size in (1.8, 1.0, 2.4, 1.0))

Points = npt.NDArray[Any]


class Scene:
    """Draws into a Rerun stream. All calls after `at(stamp)` are about that time; positions are metres in `world`."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.stream = stream
        self._maps: dict[str, LayeredCloud] = {}
        self._trails: dict[str, Trail] = {}
        self._named: set[str] = set()
        self.hidden: dict[str, None] = {}  # entities that a layout does well not to show at first
        rr.set_log_time_enabled(False, recording=stream)
        rr.set_log_tick_enabled(False, recording=stream)
        classes = [*enumerate(palette.TRUTH), *enumerate(palette.LABELS, palette.FIRST_LABEL)]
        infos = [rr.AnnotationInfo(number, entry.name, entry.colour) for number, entry in classes]
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.AnnotationContext(infos), static=True)
        self._legend(palette.TRUTH)

    def at(self, stamp: int) -> None:
        """Set the time, in nanoseconds, of what is drawn next."""
        self.stream.set_time(TIMELINE, duration=np.timedelta64(stamp, "ns"))

    # the robot and its senses

    def robot(self, world_from_base: Matrix, *, valid: bool = True) -> None:
        """Put the robot at a pose (4, 4); red where the pose is not valid."""
        if "robot" not in self._named:
            self._named.add("robot")
            length, _, height = BODY
            nose = rr.Arrows3D(
                origins=(0, 0, height), vectors=(2.0 * length, 0, 0), radii=0.06, colors=palette.ESTIMATE
            )
            self.stream.log("world/robot/heading", nose, static=True)
        colour = palette.ESTIMATE if valid else palette.TRUTH[6].colour
        body = rr.Boxes3D(sizes=[BODY], centers=[(0, 0, BODY[2] / 2)], colors=colour, fill_mode="solid")
        self.stream.log("world/robot", _transform(world_from_base))
        self.stream.log("world/robot/body", body)

    def cloud(
        self,
        name: str,
        points: Points,
        world_from_sensor: Matrix,
        *,
        label: Points | None = None,
        truth: Points | None = None,
    ) -> None:
        """Draw a scan (n, 3) where its sensor was (4, 4), coloured by label, else by true class, else by height."""
        options: dict[str, Any] = {}
        if label is not None:
            self._legend(palette.LABELS)
            options["class_ids"] = label.astype(np.uint16) + np.uint16(palette.FIRST_LABEL)
        elif truth is not None:
            options["class_ids"] = truth.astype(np.uint16)
        else:
            options["colors"] = palette.height_colours(points @ world_from_sensor[2, :3] + world_from_sensor[2, 3])
        cloud = rr.Points3D(points, radii=_POINT, point_shading="flat", **options)
        self.stream.log(f"world/{name}", _transform(world_from_sensor), cloud)

    def ghost(self, name: str, world_from_base: Matrix, colour: Colour) -> None:
        """Draw the outline of the robot at a pose (4, 4): the true one, or another localizer's."""
        body = rr.Boxes3D(sizes=[BODY], centers=[(0, 0, BODY[2] / 2)], colors=colour, radii=_THIN)
        self.stream.log(f"world/{name}/body", _transform(world_from_base), body)

    def trail(self, name: str, world_from_base: Matrix, colour: Colour, *, height: float = 0.06) -> None:
        """Draw the way that a body has come, up to a pose (4, 4); height: metres above the floor."""
        trail = self._trails.setdefault(name, Trail())
        if trail.extend(world_from_base[:3, 3]) and len(trail.points) > 1:
            strip = np.add(trail.points, (0.0, 0.0, height))
            self.stream.log(f"world/{name}/trail", rr.LineStrips3D([strip], colors=colour, radii=_LINE))

    # the world around it

    def people(self, name: str, people: Points, moving: Points) -> None:
        """Draw people (p, 3) of x, y, heading; moving (p,): who walks right now."""
        colours = np.where(moving[:, None], palette.TRUTH[6].colour, palette.TRUTH[7].colour).astype(np.uint8)
        feet = np.column_stack([people[:, :2], np.full(len(people), PERSON_RADIUS)])
        bodies = rr.Capsules3D(
            lengths=np.full(len(people), PERSON_HEIGHT - 2 * PERSON_RADIUS),
            radii=np.full(len(people), PERSON_RADIUS),
            translations=feet,
            colors=colours,
            line_radii=_THIN,
        )
        self.stream.log(f"world/{name}/people", bodies)

    def tracks(self, name: str, position: Points, velocity: Points, identity: Points) -> None:
        """Draw the people that are followed: position (k, 2), velocity (k, 2) in m/s, number (k,)."""
        high = np.full(len(position), 1.0)
        arrows = rr.Arrows3D(
            origins=np.column_stack([position, high]),
            vectors=np.column_stack([velocity, 0.0 * high]),
            colors=palette.TRAJECTORY,
            radii=0.04,
            labels=[str(number) for number in identity],
        )
        self.stream.log(f"world/{name}", arrows)

    def map(
        self,
        name: str,
        points: Points,
        *,
        incremental: bool,
        movable: Points | None = None,
        label: Points | None = None,
    ) -> None:
        """Draw the points (n, 3) of a map, or add them to it; coloured by label, else movable (n,), else by height.

        Where both are known, movable is an entity of its own, `world/<name>/movable`, to be shown at first or not.
        """
        if label is not None and movable is not None:
            self.hidden[f"world/{name}/movable"] = None
            self._layer(f"{name}/movable", points, palette.movable_colours(movable), incremental=incremental)
        if label is not None:
            colours = palette.class_colours(label, palette.LABELS)
        elif movable is not None:
            colours = palette.movable_colours(movable)
        else:
            colours = palette.height_colours(points[:, 2])
        self._layer(name, points, colours, incremental=incremental)

    def _layer(self, name: str, points: Points, colours: palette.Bytes, *, incremental: bool) -> None:
        """Draw coloured points as layers of an entity, or add them to it."""
        cloud = self._maps.setdefault(name, LayeredCloud())
        changed = [] if incremental else cloud.clear()
        changed += cloud.add(points, colours)
        for layer in {layer.level: layer for layer in changed}.values():
            drawn = rr.Points3D(layer.points, colors=layer.colours, radii=_MAP_POINT, point_shading="flat")
            self.stream.log(f"world/{name}/{layer.level}", drawn)

    def grid(self, name: str, cells: npt.NDArray[np.int8], origin: Points, resolution: float) -> None:
        """Draw an occupancy grid (rows, columns) on the floor; origin (2,): the corner of cell (0, 0), in metres."""
        known = cells >= 0
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        if not rows.size:
            return
        part = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        height, width = part.shape
        corner = origin + resolution * np.array([columns[0], rows[0]])
        image = palette.occupancy_colours(np.ascontiguousarray(part[::-1]))  # an image begins with its top row
        drawn = rr.GridMap(
            data=image.tobytes(),
            format=rr.components.ImageFormat(width, height, channel_datatype="U8", color_model="RGBA"),
            cell_size=resolution,
            opacity=0.99,  # of an opaque image even transparent cells would be drawn, in black
            translation=(*corner, -0.02),  # below the floor's points, so that neither flickers
        )
        self.stream.log(f"world/{name}", drawn)

    # what it intends

    def plan(self, name: str, path: Points, trajectory: Points) -> None:
        """Draw a path (n, 2) to the goal and the next seconds of motion, (k, 3) of x, y, yaw."""
        for part, line, colour, height in (
            ("path", path, palette.PLAN, 0.08),
            ("trajectory", trajectory[:, :2], palette.TRAJECTORY, 0.12),
        ):
            strips = [np.column_stack([line, np.full(len(line), height)])] if len(line) > 1 else []
            self.stream.log(f"world/{name}/{part}", rr.LineStrips3D(strips, colors=colour, radii=_LINE))

    def goal(self, name: str, target: Points, text: str) -> None:
        """Draw the target (2,) that the robot shall reach, with a text beside it."""
        pole = rr.Arrows3D(origins=(*target, 1.2), vectors=(0, 0, -1.2), radii=0.05, colors=palette.GOAL, labels=text)
        self.stream.log(f"world/{name}", pole)

    # numbers and words

    def number(self, plot: str, name: str, value: float, colour: Colour | None = None) -> None:
        """Add a value to the curve `name` of a plot (`plots/speed`, or another folder of entities)."""
        path = "/".join((plot, *map(rr.escape_entity_path_part, name.split("/"))))
        if path not in self._named:
            self._named.add(path)
            self.stream.log(path, rr.SeriesLines(names=name, colors=colour, widths=1.5), static=True)
        self.stream.log(path, rr.Scalars(value))

    def say(self, name: str, text: str, level: str = "INFO") -> None:
        """Add a line to the text log, with the name of who says it; levels: DEBUG, INFO, WARN, ERROR."""
        self.stream.log(f"log/{name}", rr.TextLog(f"{name}: {text}", level=level))

    def _legend(self, classes: tuple[palette.Class, ...]) -> None:
        """Draw the legend, once: a row of named dots for the layout's strip below the world."""
        if (name := f"legend of {classes[0].name}") in self._named:
            return
        self._named.add(name)
        entries = [*classes[1:], *palette.THINGS]
        widths = np.array([len(entry.name) + 4.0 for entry in entries])  # letters, about as wide as the label is drawn
        places = (np.cumsum(widths) - widths / 2) / widths.sum()
        row = rr.Points2D(
            np.column_stack([places, np.zeros(len(entries))]),
            radii=rr.Radius.ui_points(5.0),
            colors=[entry.colour for entry in entries],
            labels=[entry.name for entry in entries],
            show_labels=True,
        )
        self.stream.log("legend", row, static=True)


def _transform(target_from_source: Matrix) -> rr.Transform3D:
    return rr.Transform3D(translation=target_from_source[:3, 3], mat3x3=target_from_source[:3, :3])
