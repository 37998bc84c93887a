"""Colours and names of everything that is drawn, chosen for a dark background."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Colour = tuple[int, int, int]
Bytes = npt.NDArray[np.uint8]


class Class(NamedTuple):
    """An entry of the legend: a name and its colour."""

    name: str
    colour: Colour


TRUTH = (
    Class("unknown", (128, 128, 128)),
    Class("ground", (128, 106, 82)),
    Class("wall", (150, 200, 255)),
    Class("door", (188, 120, 52)),
    Class("table", (76, 190, 96)),
    Class("chair", (58, 130, 255)),
    Class("moving person", (255, 64, 64)),
    Class("still person", (255, 176, 48)),
)
LABELS = (
    Class("uncertain", (128, 128, 128)),
    Class("ground", (128, 106, 82)),
    Class("permanent", (150, 200, 255)),
    Class("long-term movable", (76, 190, 96)),
    Class("short-term movable", (255, 64, 64)),
)
FIRST_LABEL = 16  # labels follow the truth classes in one numbering, so that one legend serves both

ESTIMATE: Colour = (0, 214, 255)
TRUE_POSE: Colour = (240, 240, 240)
PLAN: Colour = (255, 84, 220)
TRAJECTORY: Colour = (190, 255, 60)
GOAL: Colour = (255, 226, 40)
OTHERS: tuple[Colour, ...] = ((150, 120, 255), (255, 150, 90), (90, 220, 170), (230, 110, 160))

THINGS = (
    Class("estimate", ESTIMATE),
    Class("truth", TRUE_POSE),
    Class("path", PLAN),
    Class("motion", TRAJECTORY),
    Class("target", GOAL),
)

_HEIGHTS = np.array([0.02, 0.15, 1.0, 2.5])  # metres above the floor
_TINTS = np.array([(40, 44, 54), (48, 58, 76), (64, 82, 114), (100, 122, 160)], np.float64)
_DOUBTS = np.array([0.0, 0.4, 0.7, 1.0])  # movable probability: permanent, uncertain, long-term, short-term
_DOUBT_TINTS = np.array([(64, 82, 114), (128, 128, 128), (76, 190, 96), (255, 64, 64)], np.float64)
_FREE, _OCCUPIED = np.array((38, 48, 60), np.float64), np.array((255, 138, 60), np.float64)


def height_colours(heights: npt.NDArray[Any]) -> Bytes:
    """Colour points by their height above the floor in metres (n,): floor dark, ceiling light. Returns (n, 3)."""
    return _ramp(heights, _HEIGHTS, _TINTS)


def movable_colours(movable: npt.NDArray[Any]) -> Bytes:
    """Colour points by their movable probability (n,): blue stays, green may move, red moves. Returns (n, 3)."""
    return _ramp(movable, _DOUBTS, _DOUBT_TINTS)


def class_colours(classes: npt.NDArray[Any], legend: tuple[Class, ...]) -> Bytes:
    """Colour points by class (n,); classes that the legend does not know are grey. Returns (n, 3)."""
    table = np.full((256, 3), 128, np.uint8)
    table[: len(legend)] = [entry.colour for entry in legend]
    return table[classes]


def occupancy_colours(cells: npt.NDArray[np.int8]) -> Bytes:
    """Colour a grid (rows, columns): unknown is transparent, free dark, occupied orange. Returns (rows, columns, 4)."""
    share = np.arange(101)[:, None] / 100.0
    table = np.zeros((256, 4), np.uint8)  # a negative int8 read as uint8 is above 127: transparent
    table[:101, :3] = _FREE + share * (_OCCUPIED - _FREE)
    table[:101, 3] = 255
    return table[cells.view(np.uint8)]


def _ramp(values: npt.NDArray[Any], stops: npt.NDArray[np.float64], tints: npt.NDArray[np.float64]) -> Bytes:
    return np.stack([np.interp(values, stops, tints[:, channel]) for channel in range(3)], axis=-1).astype(np.uint8)
