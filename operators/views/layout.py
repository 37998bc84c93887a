"""The layout: what the viewer shows where, and from which point of view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import rerun.blueprint as rrb

from operators.views.scene import TIMELINE

BACKGROUND = (14, 16, 20)


class Eye(NamedTuple):
    """Where the camera stands, and what it looks at, in metres of `world`."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]


def eye_over(corner: npt.ArrayLike, opposite: npt.ArrayLike) -> Eye:
    """Look down from the south upon a rectangle of the floor, given by two corners (2,), so that it fills the view."""
    low, high = np.minimum(corner, opposite), np.maximum(corner, opposite)
    x, y = (low + high) / 2
    width, depth = np.maximum(high - low, 4.0)
    reach = max(0.68 * width, 0.8 * depth)
    return Eye((float(x), float(y - 0.5 * reach), float(1.25 * reach)), (float(x), float(y - 0.02 * depth), 0.0))


def robot_layout(
    *,
    eye: Eye | None = None,
    hidden: Sequence[str] = (),
    others: Sequence[str] = (),
    slowest: float | None = None,
) -> rrb.Blueprint:
    """Lay out a robot's run: the world, plots of localization error, latency and speed, the text log.

    eye: None leaves it to the viewer. hidden: entities of the world that are not shown at first. others: further plots,
    in a tab of their own. slowest: milliseconds up to which latencies are shown; None shows even the first, cold call.
    """
    controls = rrb.EyeControls3D(position=eye.position, look_target=eye.target) if eye else None
    world = rrb.Spatial3DView(
        origin="world",
        name="world",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=controls,
        overrides={path: rrb.EntityBehavior(visible=False) for path in hidden},
    )
    bounds = rrb.VisualBounds2D(x_range=(0.0, 1.0), y_range=(-0.005, 0.02))
    legend = rrb.Spatial2DView(origin="legend", visual_bounds=bounds, background=BACKGROUND, titlebar=False)
    side = rrb.Vertical(
        _plot("plots/localization_error", "localization error (cm)"),
        _plot("plots/latency", "latency (ms)", up_to=slowest),
        _plot("plots/speed", "speed (m/s)"),
        _log(),
        row_shares=[4, 4, 4, 3],
        name="robot",
    )
    if others:
        side = rrb.Tabs(
            side,
            rrb.Vertical(*[_plot(plot, plot.removeprefix("fields/")) for plot in others], name="other topics"),
            active_tab=0,
        )
    left = rrb.Vertical(world, legend, row_shares=[16, 1])
    return _blueprint(rrb.Horizontal(left, side, column_shares=[7, 3]))


def numbers_layout(plots: Sequence[str]) -> rrb.Blueprint:
    """Lay out a recording without a robot: its plots, and the text log."""
    curves = [_plot(plot, plot.removeprefix("fields/")) for plot in plots]
    views = [rrb.Grid(*curves)] if curves else []
    return _blueprint(rrb.Vertical(*views, _log(), row_shares=[*[4.0] * len(views), 1.0]))


def _plot(origin: str, name: str, *, up_to: float | None = None) -> rrb.TimeSeriesView:
    legend, time = rrb.PlotLegend(corner="lefttop"), rrb.TimeAxis(link="linktoglobal")
    values = None if up_to is None else rrb.ScalarAxis(range=(0.0, up_to))
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend, axis_x=time, axis_y=values)


def _log() -> rrb.TextLogView:
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin="log", name="log", columns=columns)


def _blueprint(root: rrb.Container) -> rrb.Blueprint:
    panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following")
    return rrb.Blueprint(root, panel, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))
