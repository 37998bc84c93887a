"""What sessions show, counted: success, errors of localization, collisions for each kilometre, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

Floats = npt.NDArray[np.float64]
Record = dict[str, Any]  # of a session: its keys stand in `recorded`

DRIVING = 0.05  # m/s towards what is touched, above which the robot drives into it
PAPER = {  # success of each round in %, easy to extreme; its Table II
    "round 1": (100, 81, 7, 3),
    "round 2": (100, 96, 100, 79),
    "round 3": (100, 100, 100, 100),
    "round 4": (100, 100, 100, 100),
}


class Track(NamedTuple):
    """A session as its recording tells it, at 10 Hz."""

    true: Floats  # (n, 3) x, y, yaw
    believed: Floats  # (n, 3)
    valid: npt.NDArray[np.bool_]  # (n,)
    touched: list[tuple[int, int]]  # step, index of a person with whom contact begins
    people: list[Floats]  # for each of them: (2,) where that person is


def errors(track: Track) -> Floats:
    """Return the distance in metres between believed and true place (n,), on the floor, in the building's frame."""
    return np.asarray(np.hypot(*(track.believed - track.true)[:, :2].T))


def driven_into(track: Track, period: float = 0.1) -> int:
    """Count the people into whom the robot drove; the others walked into it."""
    count = 0
    for (step, _), person in zip(track.touched, track.people, strict=True):
        before = max(step - 2, 0)
        moved = track.true[step, :2] - track.true[before, :2]
        towards = person - track.true[before, :2]
        speed = float(moved @ towards) / max(float(np.hypot(*towards)), 1e-9) / (max(step - before, 1) * period)
        count += speed > DRIVING
    return count


def poisson_interval(count: int, exposure: float, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a rate by the number of events in an exposure (Garwood 1936)."""
    if exposure <= 0.0:
        return 0.0, float("inf")
    tail = (1.0 - confidence) / 2.0
    low = chi2.ppf(tail, 2 * count) / 2.0 if count else 0.0
    return float(low) / exposure, float(chi2.ppf(1.0 - tail, 2 * count + 2) / 2.0) / exposure


def success(records: Sequence[Record]) -> float | None:
    """Return the mean share of targets reached, in %, as in the paper's Table II; None where nothing was driven."""
    shares = [100.0 * item["reached"] / item["targets"] for item in records]
    return float(np.mean(shares)) if shares else None


def success_table(records: Iterable[Record], groups: Sequence[str], scenarios: Sequence[str]) -> list[Record]:
    """Return a row for each group: per scenario the success in % and whether every tour was completed; the mean."""
    records = list(records)
    rows = []
    for group in groups:
        cells: dict[str, Any] = {}
        for scenario in scenarios:
            found = [item for item in records if (item["group"], item["scenario"]) == (group, scenario)]
            done = bool(found) and all(item["reached"] == item["targets"] for item in found)
            cells[scenario] = {"success": success(found), "completed": done, "sessions": len(found)}
        known = [cell["success"] for cell in cells.values() if cell["success"] is not None]
        rows.append({"group": group, "cells": cells, "mean": float(np.mean(known)) if known else None})
    return rows


def box(values: Floats) -> Record:
    """Return what a box plot without fliers shows: quartiles, whiskers (1.5 of their distance), mean and p95."""
    if not len(values):
        return {"n": 0}
    low, median, high = np.percentile(values, (25, 50, 75))
    reach = 1.5 * (high - low)
    inside = values[(values >= low - reach) & (values <= high + reach)]
    return {
        "n": len(values),
        "whislo": float(inside.min()),
        "q1": float(low),
        "med": float(median),
        "q3": float(high),
        "whishi": float(inside.max()),
        "mean": float(values.mean()),
        "p95": float(np.percentile(values, 95)),
        "max": float(values.max()),
    }


def boxes(records: Iterable[Record], groups: Sequence[str], scenarios: Sequence[str]) -> list[Record]:
    """Return a box of the localization error in cm for each group and scenario, its tours together."""
    records = list(records)
    found = []
    for group in groups:
        for scenario in scenarios:
            parts = [item["errors_mm"] for item in records if (item["group"], item["scenario"]) == (group, scenario)]
            values = np.concatenate([np.asarray(part, np.float64) for part in parts]) / 10.0 if parts else np.zeros(0)
            found.append({"group": group, "scenario": scenario, **box(values)})
    return found


def driving(records: Iterable[Record], groups: Sequence[str], scenarios: Sequence[str]) -> list[Record]:
    """Return for each group and scenario: way, time a tour, speed against real time, and collisions a kilometre."""
    records = list(records)
    rows = []
    for group in groups:
        for scenario in scenarios:
            found = [item for item in records if (item["group"], item["scenario"]) == (group, scenario)]
            if not found:
                continue
            way = sum(item["driven_m"] for item in found) / 1000.0
            row: Record = {"group": group, "scenario": scenario, "sessions": len(found), "km": way}
            row["seconds_a_tour"] = float(np.mean([item["time_s"] for item in found]))
            row["times_real_time"] = sum(item["time_s"] for item in found) / max(
                sum(item["wall_seconds"] for item in found), 1e-9
            )
            for name in ("collisions_with_people", "driven_into_people", "collisions_with_things"):
                count = sum(item[name] for item in found)
                row[name] = {
                    "count": count,
                    "per_km": count / way if way else None,
                    "interval": poisson_interval(count, way),
                }
            rows.append(row)
    return rows
