"""The report of the comparison of localizers: HTML with box plots, and JSON."""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path
from typing import Any

from operators.montecarlo.comparison import LABELS, NAMES, Run, pooled, table

TITLES = {
    "driven": "Each localizer in the loop: the robot drives with it",
    "same": "The same recordings for all: replayed with another localizer",
}
MAPS_TEXT = (
    "<p>Black: occupied by the best particle at the tour's end. Red: the walls as they are, where it has nothing "
    "occupied. A loop that was not closed shows as a wall drawn twice.</p>"
)
COLOURS = {"none": "#b0413e", "network": "#3b6ea5", "truth": "#5b8c5a"}
WORDS = {"none": "whole cloud", "network": "network's labels", "truth": "true labels"}


def write_report(folder: Path, runs: list[Run], settings: dict[str, Any]) -> None:
    """Write report.json and report.html into a folder. Raises OSError."""
    tables = {name: table(runs, name) for name in TITLES if any(run.table == name for run in runs)}
    tours = [run._asdict() | {"errors": len(run.errors), "failed": run.failed} for run in runs]
    record = {"settings": settings, "tables": tables, "tours": tours}
    (folder / "report.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Localizers</title>",
        "<style>body{font:15px sans-serif;max-width:70em;margin:2em auto}",
        "td,th{padding:.2em .8em;text-align:right}",
        ".maps{display:flex;flex-wrap:wrap}figure{margin:0 1em 1em 0}</style>",
        "<h1>Localizers with and without labels</h1>",
        "<p>Error: distance in the plane between estimated and true pose at 10 Hz. Factor: mean error of the whole "
        "cloud over that with labels. Paper: hard scenario, with the network's labels. Over truth: mean error with the "
        "network's labels over that with true ones. Time: wall clock, median of the calls that used a scan.</p>",
    ]
    for name, lines in tables.items():
        picture = base64.b64encode(box_plot(runs, name)).decode()
        parts += [f"<h2>{TITLES[name]}</h2>", f"<img src='data:image/png;base64,{picture}'>", rows(lines)]
    if pictures := maps(folder, runs):
        parts += ["<h2>What Gmapping drew</h2>", MAPS_TEXT, pictures]
    parts.append(f"<pre>{html.escape(json.dumps(settings, indent=1))}</pre>")
    (folder / "report.html").write_text("\n".join(parts) + "\n", encoding="utf-8")


def maps(folder: Path, runs: list[Run]) -> str:
    """Lay out the maps that were drawn, tours/<table>-<scenario>-<tour>-<method>-<labels>.png in a folder."""
    figures = []
    for run in runs:
        file = folder / "tours" / f"{'-'.join(run[:5])}.png"
        if file.exists():
            caption = f"{run.scenario} {run.tour}, {WORDS[run.labels]}{', driven' * (run.table == 'driven')}"
            picture = base64.b64encode(file.read_bytes()).decode()
            figures.append(
                f"<figure><img width='420' src='data:image/png;base64,{picture}'>"
                f"<figcaption>{html.escape(caption)}</figcaption></figure>"
            )
    return f"<div class='maps'>{''.join(figures)}</div>" if figures else ""


def rows(lines: list[dict[str, Any]]) -> str:
    """Lay a table out as HTML."""
    heads = (
        "scenario",
        "localizer",
        "labels",
        "mean cm",
        "median",
        "p95",
        "max",
        "factor",
        "paper",
        "over truth",
        "failed",
        "ms an update",
    )
    cells = ["<tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"]
    for line in lines:
        for labels, known in line["labels"].items():
            factor = line.get(f"factor_{labels}")
            paper = line.get("factor_paper") if labels == "network" else None
            values = [line["scenario"], NAMES[line["method"]], WORDS[labels]]
            values += [f"{100 * known[key]:.1f}" for key in ("mean", "median", "p95", "max")]
            over = line.get("network_over_truth") if labels == "network" else None
            values += ["" if number is None else f"{number:.2f}" for number in (factor, paper, over)]
            values += [f"{known['failed']} of {known['tours']}", f"{known['update_ms']:.1f}"]
            cells.append("<tr>" + "".join(f"<td>{html.escape(str(value))}</td>" for value in values) + "</tr>")
    return f"<table>{''.join(cells)}</table>"


def box_plot(runs: list[Run], name: str) -> bytes:
    """Draw the errors of a table in cm, boxes without fliers, one panel a scenario. Returns a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    mine = [run for run in runs if run.table == name]
    scenarios = list(dict.fromkeys(run.scenario for run in mine))
    methods = [method for method in NAMES if any(run.method == method for run in mine)]
    figure = Figure(figsize=(5.0 * len(scenarios), 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(scenarios), squeeze=False, sharey=True)[0]
    for axes, scenario in zip(panels, scenarios, strict=True):
        for shift, labels in enumerate(LABELS):
            boxes = [
                (place, [100.0 * error for error in pooled(mine, scenario=scenario, method=method, labels=labels)])
                for place, method in enumerate(methods)
            ]
            boxes = [(place, errors) for place, errors in boxes if errors]
            if boxes:
                drawn = axes.boxplot(
                    [errors for _, errors in boxes],
                    positions=[place + 0.25 * (shift - 1) for place, _ in boxes],
                    widths=0.2,
                    showfliers=False,
                    patch_artist=True,
                    medianprops={"color": "black"},
                )
                for box in drawn["boxes"]:
                    box.set_facecolor(COLOURS[labels])
                axes.plot([], [], color=COLOURS[labels], linewidth=6, label=WORDS[labels])
        axes.set_xticks(range(len(methods)), [NAMES[method] for method in methods])
        axes.set(title=scenario, ylabel="error (cm)")
        axes.grid(axis="y", alpha=0.3)
        axes.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=len(LABELS))
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    return stream.getvalue()
