"""Six tables and six chairs as bodies of boxes and prisms, and where chairs stand around a table.

Sizes follow the simulated world of the paper: conference tables about 3.1 x 1.1 m, cafe tables 0.92 m square with the
top at 0.755 m on one column, chairs 0.38 to 0.65 m wide with the seat at 0.45 m. A chair looks along its +x.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.solids import Body, Box, Prism, Solid, Truth

SEAT_HEIGHT = 0.45  # metres


class Slot(NamedTuple):
    """Where a chair may stand: x, y of the seat's centre and its heading, in the table's frame."""

    x: float
    y: float
    yaw: float


class Table(NamedTuple):
    """A table model: its parts around the centre of its top, and the places for chairs."""

    parts: tuple[Solid, ...]
    slots: tuple[Slot, ...]


def _top(width: float, depth: float, height: float, thickness: float = 0.035) -> Box:
    return Box(0.0, 0.0, height - thickness / 2, width, depth, thickness)


def _legs(width: float, depth: float, height: float, size: float) -> tuple[Solid, ...]:
    return tuple(Box(x * width, y * depth, height / 2, size, size, height) for x in (-0.5, 0.5) for y in (-0.5, 0.5))


def _rows(spacing: float, columns: int, depth: float) -> tuple[Slot, ...]:
    """Places along both long sides, seats 0.30 m from the edge."""
    reach = depth / 2 + 0.30
    xs = [(index - (columns - 1) / 2) * spacing for index in range(columns)]
    return tuple(Slot(x, side * reach, -side * math.pi / 2) for x in xs for side in (-1.0, 1.0))


def _around(reach: float) -> tuple[Slot, ...]:
    """Places on the four sides."""
    turns = [quarter * math.pi / 2 for quarter in range(4)]
    return tuple(Slot(reach * math.cos(turn), reach * math.sin(turn), turn + math.pi) for turn in turns)


TABLES: dict[str, Table] = {
    "conference": Table(
        (
            _top(3.10, 1.10, 0.74, 0.04),
            Box(-1.05, 0, 0.375, 0.08, 0.60, 0.65),
            Box(1.05, 0, 0.375, 0.08, 0.60, 0.65),
            Box(-1.05, 0, 0.025, 0.12, 0.80, 0.05),
            Box(1.05, 0, 0.025, 0.12, 0.80, 0.05),
            Box(0, 0, 0.40, 2.02, 0.03, 0.30),
        ),
        _rows(0.95, 3, 1.10),
    ),
    "conference legs": Table(
        (_top(2.40, 1.00, 0.73), *_legs(2.24, 0.84, 0.70, 0.07), Box(0, 0.44, 0.65, 2.2, 0.03, 0.09)),
        _rows(0.90, 2, 1.00),
    ),
    "cafe": Table(
        (_top(0.92, 0.92, 0.755), Prism(0, 0, 0.38, 0.04, 0.68, 10), Box(0, 0, 0.02, 0.50, 0.50, 0.04)),
        _around(0.72),
    ),
    "cafe round": Table(
        (Prism(0, 0, 0.735, 0.45, 0.03, 20), Prism(0, 0, 0.37, 0.05, 0.70, 10), Prism(0, 0, 0.015, 0.27, 0.03, 16)),
        _around(0.72),
    ),
    "coffee": Table((_top(1.10, 0.60, 0.46), *_legs(0.98, 0.48, 0.43, 0.05)), _rows(0.70, 2, 0.70)),
    "coffee round": Table(
        (Prism(0, 0, 0.505, 0.40, 0.03, 20), *_legs(0.44, 0.44, 0.49, 0.045), Prism(0, 0, 0.22, 0.26, 0.02, 16)),
        _around(0.70),
    ),
}


def _chair(width: float, depth: float, back: float, leg: float, *extra: Solid) -> tuple[Solid, ...]:
    """Seat, four legs and a back of the given height above the seat."""
    return (
        Box(0, 0, SEAT_HEIGHT - 0.025, depth, width, 0.05),
        *_legs(depth - leg, width - leg, SEAT_HEIGHT - 0.05, leg),
        Box(-depth / 2 + 0.02, 0, SEAT_HEIGHT + back / 2, 0.04, width, back),
        *extra,
    )


CHAIRS: dict[str, tuple[Solid, ...]] = {
    "school": _chair(0.38, 0.38, 0.34, 0.03),
    "dining": _chair(0.44, 0.42, 0.50, 0.04),
    "slatted": (
        Box(0, 0, 0.43, 0.42, 0.42, 0.04),
        *_legs(0.38, 0.38, 0.41, 0.035),
        Box(-0.20, -0.19, 0.66, 0.035, 0.035, 0.43),
        Box(-0.20, 0.19, 0.66, 0.035, 0.035, 0.43),
        Box(-0.20, 0, 0.62, 0.025, 0.36, 0.07),
        Box(-0.20, 0, 0.82, 0.025, 0.36, 0.10),
    ),
    "shell": (
        Box(0, 0, 0.43, 0.44, 0.46, 0.04),
        Prism(0, 0, 0.24, 0.03, 0.36, 8),
        Box(0, 0, 0.04, 0.56, 0.06, 0.05, math.pi / 4),
        Box(0, 0, 0.04, 0.56, 0.06, 0.05, -math.pi / 4),
        Box(-0.21, 0, 0.66, 0.03, 0.44, 0.44),
    ),
    "armchair": _chair(
        0.65,
        0.55,
        0.45,
        0.06,
        Box(0, -0.295, 0.56, 0.50, 0.06, 0.22),
        Box(0, 0.295, 0.56, 0.50, 0.06, 0.22),
    ),
    "sled": (
        Box(0, 0, 0.43, 0.45, 0.48, 0.04),
        Box(0, -0.23, 0.02, 0.46, 0.03, 0.03),
        Box(0, 0.23, 0.02, 0.46, 0.03, 0.03),
        Box(0.21, -0.23, 0.22, 0.03, 0.03, 0.40),
        Box(0.21, 0.23, 0.22, 0.03, 0.03, 0.40),
        Box(-0.21, -0.23, 0.45, 0.03, 0.03, 0.88),
        Box(-0.21, 0.23, 0.45, 0.03, 0.03, 0.88),
        Box(-0.21, 0, 0.73, 0.03, 0.46, 0.32),
    ),
}


def table_body(model: str, x: float, y: float, yaw: float) -> Body:
    """Place a table with its centre at x, y (metres), its long side along yaw (radians)."""
    return Body(f"table {model}", Truth.TABLE, tuple(part.moved(x, y, yaw) for part in TABLES[model].parts))


def chair_body(model: str, x: float, y: float, yaw: float) -> Body:
    """Place a chair with its seat's centre at x, y (metres), looking along yaw (radians)."""
    return Body(f"chair {model}", Truth.CHAIR, tuple(part.moved(x, y, yaw) for part in CHAIRS[model]))
