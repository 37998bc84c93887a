"""One page about the rounds, with the paper's numbers beside ours; all of it stands in report.json as well."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from operators.rounds import figures
from operators.rounds.schedule import LIDAR, PREDICT
from operators.rounds.tally import PAPER, boxes, driving, success_table

Record = dict[str, Any]

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1150px; margin: 2em auto; padding: 0 1em; color: #1c2430; }
h1 { font-size: 1.6em; } h2 { margin-top: 2em; border-bottom: 1px solid #d5dae2; font-size: 1.2em; }
table { border-collapse: collapse; margin: .8em 0; } td, th { padding: .25em .7em; text-align: right; }
th { border-bottom: 1px solid #8a94a3; font-weight: 600; } td:first-child, th:first-child { text-align: left; }
tr:nth-child(even) td { background: #f4f6f9; } img { max-width: 100%; } .paper { color: #7b8797; }
code { background: #f4f6f9; padding: .1em .3em; }
"""


def summarize(told: Record) -> Record:
    """Add to what was driven and learned (`settings`, `sessions`, ...) everything that is counted from it."""
    records: list[Record] = told["sessions"]
    groups = list(dict.fromkeys(item["group"] for item in records))
    scenarios = told["settings"]["scenarios"]
    main = [group for group in groups if group not in (PREDICT, LIDAR)]
    others = {
        group: success_table(records, [group], scenarios) if group in groups else [] for group in (PREDICT, LIDAR)
    }
    compared: list[Record] = told.get("comparison", [])
    labels = list(dict.fromkeys(item["group"] for item in compared))
    hours = sum(item["seconds"] for item in told["stages"]) / 3600.0
    return {
        **told,
        "success": success_table(records, main, scenarios),
        "success_predict": others[PREDICT],
        "success_lidar": others[LIDAR],
        "paper": {
            name: dict(zip(("easy", "medium", "hard", "extreme"), row, strict=True)) for name, row in PAPER.items()
        },
        "errors_cm": boxes(records, [*main, *(group for group in (LIDAR,) if group in groups)], scenarios),
        "comparison_cm": boxes(compared, labels, scenarios),
        "driving": driving(records, groups, scenarios),
        "failed": [
            {key: item.get(key, 0) for key in ("name", "seed", "ending", "reached", "skipped", "targets")}
            for item in records
            if item["reached"] < item["targets"]
        ],
        "hours": hours,
    }


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Lay out a table whose cells are HTML already."""
    lines = ["<table><tr>", *(f"<th>{name}</th>" for name in head), "</tr>"]
    for row in rows:
        lines += ["<tr>", *(f"<td>{cell}</td>" for cell in row), "</tr>"]
    return "".join([*lines, "</table>"])


def percent(value: float | None, *, completed: bool = False) -> str:
    """Write a share in %, underlined where all tours were completed."""
    if value is None:
        return "-"
    return f"<u>{value:.0f} %</u>" if completed else f"{value:.0f} %"


def success_rows(told: Record, rows: Sequence[Record], *, paper: bool) -> Iterable[list[str]]:
    """Yield the rows of Table II, the paper's numbers behind ours."""
    for row in rows:
        cells = [row["group"]]
        for scenario, cell in row["cells"].items():
            text = percent(cell["success"], completed=cell["completed"])
            theirs = told["paper"].get(row["group"], {}).get(scenario) if paper else None
            cells.append(text + (f' <span class="paper">({theirs} %)</span>' if theirs is not None else ""))
        yield [*cells, percent(row["mean"])]


def driving_rows(told: Record) -> Iterable[list[str]]:
    """Yield collisions, times and speeds."""
    for row in told["driving"]:
        cells = [f"{row['group']}, {row['scenario']}", f"{row['km']:.2f}"]
        for name in ("collisions_with_people", "driven_into_people", "collisions_with_things"):
            item = row[name]
            low, high = item["interval"]
            rate = "-" if item["per_km"] is None else f"{item['per_km']:.1f}"
            cells.append(f"{rate} <small>[{low:.1f}, {high:.1f}], {item['count']}</small>")
        yield [*cells, f"{row['seconds_a_tour']:.0f}", f"{row['times_real_time']:.2f}"]


def box_rows(found: Sequence[Record]) -> Iterable[list[str]]:
    """Yield the numbers of box plots, in cm."""
    for item in found:
        if item["n"]:
            numbers = [f"{item[key]:.2f}" for key in ("med", "mean", "p95", "max")]
            yield [f"{item['group']}, {item['scenario']}", *numbers, str(item["n"])]


def label_rows(told: Record) -> Iterable[list[str]]:
    """Yield the recall of the labels of each round by truth class."""
    classes = list(dict.fromkeys(name for item in told["labels"] for name in item.get("recall", {})))
    yield ["", "frames", "sessions", "coverage", *classes]
    for item in told["labels"]:
        recalls = [f"{100 * item['recall'][name]:.1f}" if name in item.get("recall", {}) else "-" for name in classes]
        coverage = f"{100 * item['coverage']:.1f}" if item.get("coverage") is not None else "-"
        yield [item["group"], str(item["frames"]), str(item["sessions_accepted"]), coverage, *recalls]


def pictures(told: Record, picture: dict[str, Any] | None) -> str:
    """Draw the confusion of the networks and the frame that they classify."""
    parts = []
    if told["networks"]:
        matrices = [(item["name"], item["evaluation"]["confusion"]) for item in told["networks"]]
        parts.append(f'<img src="{figures.confusion(matrices)}" alt="confusion matrices">')
    if picture is not None:
        image = figures.frames(picture["points"], picture["labellings"])
        parts.append(f'<img src="{image}" alt="a frame, classified">')
    return "".join(parts)


def page(told: Record, picture: dict[str, Any] | None = None) -> str:
    """Return the HTML of the report; told: of `summarize`; picture: a frame's points and labellings."""
    settings, records = told["settings"], told["sessions"]
    scenarios = settings["scenarios"]
    groups = [row["group"] for row in told["success"]]
    head = ["", *scenarios, "mean"]
    box_head = ["cm", "median", "mean", "p95", "largest", "frames"]
    parts = [
        f"<!doctype html><meta charset=utf-8><title>Rounds</title><style>{STYLE}</style>"
        f"<h1>{settings['rounds']} rounds: {html.escape(Path(settings['building']).stem)}</h1>",
        f"<p>{len(records)} sessions, seed {settings['seed']}, {told['hours']:.2f} hours, at most "
        f"{told['disk_gb']:.1f} GB of disk. The paper's numbers in brackets.</p>",
        "<h2>Targets reached</h2><p>Underlined: every tour was completed.</p>",
        table(head, success_rows(told, told["success"], paper=True)),
    ]
    if told["success_predict"]:
        parts += [
            "<p>Keeping clear of where people will be (<code>people: predict</code>):</p>",
            table(head, success_rows(told, told["success_predict"], paper=False)),
        ]
    if told["success_lidar"]:
        parts += [
            "<p>One tour each with another lidar, an HDL-32E: columns one after the other, up to a fifth of the "
            "returns lost at grazing incidence and far away:</p>",
            table(head, success_rows(told, told["success_lidar"], paper=False)),
        ]
    if told["failed"]:
        lines = [
            [
                item["name"],
                str(item["seed"]),
                item["ending"].replace("_", " "),
                f"{item['reached']} of {item['targets']}",
                str(item["skipped"]),
            ]
            for item in told["failed"]
        ]
        parts += ["<p>Tours that failed:</p>", table(["session", "seed", "ending", "reached", "given up"], lines)]
    parts += [
        "<h2>Localization error</h2><p>Distance on the floor between believed and true place, at 10 Hz, without "
        "alignment; each session's own drive, aborted ones included.</p>",
        f'<img src="{figures.error_boxes(told["errors_cm"], groups, scenarios)}" alt="box plots">',
        table(box_head, box_rows(told["errors_cm"])),
    ]
    if any(item["n"] for item in told["comparison_cm"]):
        labels = list(dict.fromkeys(item["group"] for item in told["comparison_cm"]))
        parts += [
            "<p>On the same recordings, with other labels:</p>",
            f'<img src="{figures.error_boxes(told["comparison_cm"], labels, scenarios)}" alt="box plots">',
            table(box_head, box_rows(told["comparison_cm"])),
        ]
    parts += ["<h2>What the networks see</h2>", pictures(told, picture)]
    if told["labels"]:
        rows = list(label_rows(told))
        parts += ["<h2>Labels against truth, recall in %</h2>", table(rows[0], rows[1:])]
    parts += [
        "<h2>Collisions and times</h2><p>For each km, with the 95 % Poisson interval and the count; 'driven into' "
        "counts only people into whom the robot drove.</p>",
        table(["", "km", "with people", "driven into", "with things", "s a tour", "x real time"], driving_rows(told)),
        "<h2>Ways</h2>",
        *(
            f"<h3>{group}</h3>"
            f'<img src="{figures.paths([item for item in records if item["group"] == group], scenarios)}" alt="ways">'
            for group in dict.fromkeys(item["group"] for item in records)
        ),
        "<h2>Where the time went</h2>",
        table(["stage", "minutes"], time_rows(told)),
        "<h2>To drive any session again</h2><p>Every session's graph lies in its group's folder and fixes its bits: "
        f"<code>retracer launch {html.escape(records[0]['graph']) if records else 'GRAPH.yaml'}</code>. "
        "Poses of the new recording hash to the session's <code>poses_sha256</code> in report.json on a machine of "
        f"the same kind ({html.escape(settings['cpu'])}) with the same versions.</p>",
    ]
    return "\n".join(parts)


def time_rows(told: Record) -> Iterable[list[str]]:
    """Yield the minutes of each kind of stage, over all interruptions."""
    kinds: dict[str, float] = {}
    for item in told["stages"]:
        kinds[item["stage"]] = kinds.get(item["stage"], 0.0) + item["seconds"]
    for name, seconds in kinds.items():
        yield [name, f"{seconds / 60.0:.1f}"]
    yield ["<b>all</b>", f"<b>{sum(kinds.values()) / 60.0:.1f}</b>"]
