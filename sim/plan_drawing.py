"""The plan of a building: walls, doors, rooms, table positions and tours, seen from above."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Arc

from sim.building import Building
from sim.clearance import length_of
from sim.furniture import TABLES
from sim.layout import tour_way
from sim.masonry import wall_bodies

WALL, LINTEL, DOOR = "#3b3b3b", "#c9c9c9", "#a0522d"
ROOM, POPULATED = "#f4f4f0", "#e3ecd9"
TABLE = "#8a8f98"
TOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b", "#e377c2")


def draw_plan(building: Building, path: Path, *, only: str | None = None) -> None:
    """Draw whatever of a plan the building has to an image file. only: the one tour to draw; absent: all.

    The building may have mistakes; a tour that cannot be driven is drawn as straight lines between its targets.
    """
    x0, y0, x1, y1 = building.bounds()
    scale = 16.0 / max(x1 - x0, y1 - y0)
    figure = Figure(figsize=((x1 - x0) * scale + 1.0, (y1 - y0) * scale + 1.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _rooms(axes, building)
    _walls(axes, building)
    _doors(axes, building)
    _tables(axes, building)
    names = [name for name in building.tours if only in (None, name)]
    _tours(axes, building, names)
    axes.set(aspect="equal", xlim=(x0 - 0.6, x1 + 0.6), ylim=(y0 - 0.6, y1 + 0.6), xlabel="x (m)", ylabel="y (m)")
    axes.set_title(_title(building))
    if names:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.04), ncols=4, frameon=False)
    figure.savefig(path, dpi=100, bbox_inches="tight")


def _title(building: Building) -> str:
    x0, y0, x1, y1 = building.bounds()
    counts = ((len(building.rooms), "rooms"), (len(building.doors), "doors"), (len(building.tables), "table positions"))
    populated = [f"{building.populated_area():.0f} m² populated"] if building.populated_area() else []
    parts = [f"{x1 - x0:.1f} x {y1 - y0:.1f} m", *(f"{n} {what}" for n, what in counts if n), *populated]
    return f"{building.name}: {', '.join(parts)}"


def _rooms(axes: Axes, building: Building) -> None:
    for room in building.rooms:
        if len(room.polygon) < 3:
            continue
        axes.fill(*np.array(room.polygon).T, color=POPULATED if room.populated else ROOM, zorder=0)
        corner = min(room.polygon, key=lambda point: point[0] - point[1])  # the upper left one
        text = f"{room.name}, {room.area(building.wall):.0f} m²"
        axes.annotate(
            text,
            corner,
            (6, -6),
            textcoords="offset points",
            ha="left",
            va="top",
            fontsize=8,
            color="#555555",
            zorder=8,
        )


def _walls(axes: Axes, building: Building) -> None:
    standing: list[npt.NDArray[np.float64]] = []
    hanging: list[npt.NDArray[np.float64]] = []
    for body in wall_bodies(building):
        for part in body.parts:
            (standing if part.z - part.dz / 2 < 0.5 else hanging).append(part.footprint())
    axes.add_collection(PolyCollection(hanging, facecolor=LINTEL, edgecolor="none", zorder=2))
    axes.add_collection(PolyCollection(standing, facecolor=WALL, edgecolor=WALL, linewidth=0.3, zorder=3))


def _doors(axes: Axes, building: Building) -> None:
    """Draw each leaf at its angle, or at a right angle where sessions draw it, with the arc that it sweeps."""
    for door in building.doors:
        side = 1.0 if door.swing == "left" else -1.0
        angle = 90.0 if door.angle is None else 0.0 if door.angle == "closed" else float(door.angle)
        turn = math.radians(door.heading + side * angle)
        x, y = door.hinge
        end = x + door.width * math.cos(turn), y + door.width * math.sin(turn)
        axes.plot([x, end[0]], [y, end[1]], color=DOOR, linewidth=1.8, zorder=4)
        first, last = sorted((door.heading, door.heading + side * max(angle, 1e-3)))
        axes.add_patch(
            Arc(door.hinge, 2 * door.width, 2 * door.width, theta1=first, theta2=last, color=DOOR, lw=0.7, zorder=4)
        )


def _tables(axes: Axes, building: Building) -> None:
    """Draw the outlines of the largest and the smallest model that may stand at each position."""
    for place in building.tables:
        tops = [TABLES[name].parts[0] for name in place.models or TABLES if name in TABLES]
        tops.sort(key=lambda part: float(np.prod(np.ptp(part.footprint(), axis=0))))
        for top, style in zip(tops[-1:] + tops[:1], ("--", "-"), strict=False):
            ring = top.moved(*place.at, math.radians(place.heading)).footprint()
            axes.fill(*ring.T, facecolor="none", edgecolor=TABLE, linestyle=style, linewidth=0.9, zorder=2)


def _tours(axes: Axes, building: Building, names: list[str]) -> None:
    for order, name in enumerate(names):
        tour, colour = building.tours[name], TOURS[order % len(TOURS)]
        targets = np.array(tour.targets, np.float64).reshape(-1, 2)
        try:
            way = tour_way(building, name)
            label = f"tour {name}: {len(targets)} targets, {length_of(way):.0f} m"
        except ValueError as error:
            start = (tour.start or building.start or ())[:2]
            way = np.array([point for point in (start, *tour.targets) if len(point)]).reshape(-1, 2)
            label = f"tour {name}: {len(targets)} targets, {str(error).rpartition(': ')[2]}"
        shift = 0.09 * (order - (len(names) - 1) / 2)  # so that tours that share a way stay apart
        line = way + shift
        axes.add_collection(LineCollection([line], color=colour, linewidth=1.4, alpha=0.8, label=label, zorder=5))
        axes.plot(*(targets + shift).T, "o", color=colour, markersize=5, zorder=6)
        for index, (x, y) in enumerate(targets):
            spot = 7 * math.cos(1.3 * order + 0.6), 7 * math.sin(1.3 * order + 0.6)
            axes.annotate(
                str(index), (x, y), spot, textcoords="offset points", color=colour, fontsize=7, ha="center", va="center"
            )
    starts = {building.tours[name].start or building.start for name in names} - {None}
    for pose in starts or ({building.start} - {None}):
        assert pose is not None
        turn = math.radians(pose[2])
        arrow = {"arrowstyle": "-|>", "color": "black", "linewidth": 1.5}
        tip = pose[0] + 0.9 * math.cos(turn), pose[1] + 0.9 * math.sin(turn)
        axes.annotate("", tip, pose[:2], arrowprops=arrow, zorder=7)
        axes.plot(*pose[:2], "s", color="black", markersize=6, zorder=7)
