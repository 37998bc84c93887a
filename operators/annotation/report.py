"""One page about an annotation: maps from above, classes, and where the truth is known, how right they are."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from operators.annotation.session import LABELS, Floats
from operators.pointmap import MapPoints, PlyError
from operators.pointmap.ply import read_ply

PIXEL = 0.05  # metres of the pictures from above
FLOOR = 0.10  # metres: what lies below is drawn under everything
CEILING = 2.4  # metres: what lies above is not drawn, so that one looks into the rooms
MOST_BUFFERS = 12  # drawn
COLOURS = np.array([(150, 150, 150), (222, 211, 196), (52, 78, 112), (46, 160, 84), (226, 40, 40)], np.uint8)
GONE = np.array((226, 40, 40), np.uint8)
Picture = npt.NDArray[np.uint8]  # (rows, columns, 3)

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #1c2430; }
h1 { font-size: 1.6em; } h2 { margin-top: 2em; border-bottom: 1px solid #d5dae2; font-size: 1.2em; }
table { border-collapse: collapse; margin: .8em 0; } td, th { padding: .25em .7em; text-align: right; }
th { border-bottom: 1px solid #8a94a3; font-weight: 600; } td:first-child, th:first-child { text-align: left; }
tr:nth-child(even) td { background: #f4f6f9; } img { max-width: 100%; }
.pair { display: flex; flex-wrap: wrap; gap: 1em; } .pair figure { flex: 1 1 30em; margin: 0; }
figcaption { color: #5a6575; font-size: .9em; } .no { color: #b3261e; }
.key span { display: inline-block; margin-right: 1.2em; } .key i { display: inline-block; width: .9em; height: .9em;
  margin-right: .35em; vertical-align: -.1em; border: 1px solid #8a94a3; }
"""


class Canvas:
    """A floor plan on which points are drawn from above, all pictures of a page at one scale."""

    def __init__(self, points: Floats) -> None:
        """Span the points (n, 3) of a map, but for the outermost thousandth."""
        low, high = np.percentile(points[:, :2], (0.1, 99.9), axis=0) if len(points) else (np.zeros(2), np.ones(2))
        self.low = low - 0.5
        self.columns, self.rows = (int(size) for size in np.ceil((high - low + 1.0) / PIXEL))

    def draw(
        self, points: Floats, colours: Picture, rank: npt.NDArray[Any] | None = None, under: Picture | None = None
    ) -> Picture:
        """Draw points (n, 3) with colours (n, 3): of those on one pixel the one of the highest rank, then height.

        rank: (n,) in [0, 1]. under: a picture to draw on.
        """
        image = np.full((self.rows, self.columns, 3), 255, np.uint8) if under is None else under.copy()
        cells = np.floor((points[:, :2] - self.low) / PIXEL).astype(np.int32)
        inside = (cells >= 0).all(axis=1) & (cells < (self.columns, self.rows)).all(axis=1)
        chosen = np.flatnonzero(inside & (points[:, 2] < CEILING))
        height = np.clip(points[chosen, 2] / CEILING * 255.0, 0.0, 255.0).astype(np.uint16)
        first = 0 if rank is None else np.clip(rank[chosen] * 255.0, 0.0, 255.0).astype(np.uint16) << 8
        chosen = chosen[np.argsort(height + first, kind="stable")]  # painters paint the foremost last
        image[self.rows - 1 - cells[chosen, 1], cells[chosen, 0]] = colours[chosen]
        return image


def height_colours(heights: Floats) -> Picture:
    """Colour points by their height above the floor (n,): the floor light, walls dark. Returns (n, 3)."""
    stops = [FLOOR, 0.3, 1.2, CEILING]
    tints = np.array([(226, 219, 208), (150, 168, 190), (84, 112, 148), (38, 56, 84)], np.float64)
    return np.stack([np.interp(heights, stops, tints[:, axis]) for axis in range(3)], axis=1).astype(np.uint8)


def movable_colours(movable: Floats) -> Picture:
    """Colour points by movable probability (n,): blue stays, grey is not known, red moves. Returns (n, 3)."""
    tints = np.array([(52, 78, 112), (190, 190, 190), (226, 40, 40)], np.float64)
    return np.stack([np.interp(movable, [0.0, 0.5, 1.0], tints[:, axis]) for axis in range(3)], axis=1).astype(np.uint8)


def write_report(
    path: Path, told: dict[str, Any], cloud: MapPoints, stays: npt.NDArray[np.bool_], buffers: Path
) -> None:
    """Write the page, pictures inside; it appears whole or not at all. stays: points (n,) of the map that are left."""
    canvas = Canvas(cloud.points)
    colours = height_colours(cloud.points[:, 2])
    after = canvas.draw(cloud.points[stays], colours[stays])
    colours[~stays] = GONE
    faint = (255 - (255 - after.astype(np.int64)) // 2).astype(np.uint8)
    parts = [
        "<h1>Annotation</h1>",
        f"<p>{told['frames']} labelled frames of {told['sessions_accepted']} sessions; "
        f"{100 * told['coverage']:.1f} % of their points carry a label. "
        f"{told['refinement']['gone']} of {told['refinement']['points']} points left the map.</p>",
        *truth_parts(told),
        "<h2>The map, before and after refinement</h2>",
        '<div class="pair">',
        figure(canvas.draw(cloud.points, colours, (~stays).astype(np.float32)), "before: what leaves it is red"),
        figure(after, "after"),
        "</div>",
        "<h2>Sessions</h2>",
        session_table(told),
        "<h2>What sessions saw</h2>",
        key_of(LABELS, COLOURS),
    ]
    accepted = [name for name, one in told["sessions"].items() if one["accepted"]]
    for name in accepted[:MOST_BUFFERS]:
        parts += buffer_parts(name, buffers / f"{name}.ply", canvas, faint)
    if len(accepted) > MOST_BUFFERS:
        parts.append(f"<p>{len(accepted) - MOST_BUFFERS} more buffers are in {html.escape(str(buffers))}.</p>")
    page = f"<!doctype html><html><head><meta charset='utf-8'><title>Annotation</title><style>{STYLE}</style></head>"
    partial = path.with_name(f"{path.name}.part")
    partial.write_text(page + "<body>" + "\n".join(parts) + "</body></html>\n", encoding="utf-8")
    partial.replace(path)


def buffer_parts(name: str, path: Path, canvas: Canvas, known: Picture) -> list[str]:
    """Draw the classes and the movable probabilities of what one session saw, on the map, and count its points."""
    try:
        columns = read_ply(path)
    except (OSError, PlyError) as error:
        return [f"<h3>{html.escape(name)}</h3><p class=no>{html.escape(str(error))}</p>"]
    points = np.stack([columns[axis] for axis in ("x", "y", "z")], axis=1)
    label, movable = columns["class"], columns["p_mov"]
    rank = np.array([0.2, 0.0, 0.4, 0.6, 0.8])[label]  # what moves is drawn over what stays
    counts = np.bincount(label, minlength=len(LABELS)).tolist()
    told = ", ".join(f"{label} {count}" for label, count in zip(LABELS, counts, strict=True))
    return [
        f"<h3>{html.escape(name)}</h3><p>Points besides the map: {told}.</p>",
        '<div class="pair">',
        figure(canvas.draw(points, COLOURS[label], rank, known), "classes"),
        figure(canvas.draw(points, movable_colours(movable), movable, known), "movable probability: red moves"),
        "</div>",
    ]


def truth_parts(told: dict[str, Any]) -> list[str]:
    """Show the confusion of labels against truth classes, where there is truth."""
    if "confusion" not in told:
        return ["<p>The recordings hold no truth to compare with.</p>"]
    rows = []
    for name, row in told["confusion"].items():
        total = sum(row)
        if total:
            shares = [f"{100 * count / total:.2f} %" for count in row]
            right = [f"{100 * told[what][name]:.2f} %" for what in ("recall", "recall_labelled")]
            rows.append([name, *shares, *right, f"{total}"])
    head = ["truth", *LABELS, "right of all", "right of labelled", "points"]
    precision = ", ".join(f"{label} {100 * value:.2f} %" for label, value in told["precision"].items())
    wrong = 100 * told["ground_and_wall_called_shortT"]
    return [
        "<h2>Labels against the truth</h2>",
        table(head, rows),
        f"<p>Precision: {precision}. Of ground and walls {wrong:.3f} % are called shortT.</p>",
        figure(confusion_picture(told["confusion"]), "share of each truth class by label"),
    ]


def confusion_picture(confusion: dict[str, Sequence[int]]) -> Figure:
    """Draw the confusion matrix, rows normalized."""
    names = [name for name, row in confusion.items() if sum(row)]
    shares = np.array([np.array(confusion[name]) / sum(confusion[name]) for name in names])
    drawing = Figure(figsize=(7.0, 0.8 + 0.42 * len(names)), layout="constrained")
    axes = drawing.add_subplot()
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(LABELS)), LABELS)
    axes.set_yticks(range(len(names)), names)
    for (row, column), value in np.ndenumerate(shares):
        colour = "white" if value > 0.5 else "#1c2430"
        axes.text(column, row, f"{100 * value:.1f}", ha="center", va="center", color=colour)
    return drawing


def session_table(told: dict[str, Any]) -> str:
    """List the sessions: what each showed, and whether it was accepted."""
    rows = []
    for name, one in told["sessions"].items():
        targets = f"{one['reached']} of {one['targets']}" if one["targets"] else "none given"
        verdict = "accepted" if one["accepted"] else "; ".join(one["reasons"])
        coverage = f"{100 * one['coverage']:.1f} %" if "coverage" in one else ""
        numbers = [f"{100 * one['inliers']:.0f} %", f"{100 * one['overlap']:.0f} %"]
        rows.append([name, str(one["frames"]), targets, str(one["invalid"]), *numbers, coverage, verdict])
    head = ["session", "frames", "targets", "invalid poses", "inliers", "overlap with the map", "labelled", ""]
    return table(head, rows)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain text."""
    lines = ["".join(f"<th>{html.escape(cell)}</th>" for cell in head)]
    lines += ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def key_of(names: Sequence[str], colours: Picture) -> str:
    """Return the legend of the classes."""
    entries = [
        f"<span><i style='background:rgb({red},{green},{blue})'></i>{html.escape(name)}</span>"
        for name, (red, green, blue) in zip(names, colours.tolist(), strict=True)
    ]
    return f"<p class=key>{''.join(entries)}</p>"


def figure(picture: Picture | Figure, caption: str) -> str:
    """Return a picture with its caption."""
    file = io.BytesIO()
    if isinstance(picture, Figure):
        picture.savefig(file, format="png", dpi=110)
    else:
        from matplotlib.image import imsave

        imsave(file, picture, format="png")
    data = base64.b64encode(file.getvalue()).decode()
    return f"<figure><img src='data:image/png;base64,{data}'><figcaption>{html.escape(caption)}</figcaption></figure>"
