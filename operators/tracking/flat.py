"""What is flat and upright: a wall, or the leaf of a door, of which a sensor near to it sees long straight lines.

People are round: of two who stand side by side, a strip as thin as a door's leaf holds but a part.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

DIRECTIONS = 72  # of the lines that are tried: 2.5 degrees apart, a metre and a half strays by 1.6 cm from the next
STRIP = 0.03  # metres: two such strips beside each other hold a flat surface, its noise and that straying
SPAN = 0.1  # metres along the line within which FEW points are wanted
FEW = 3
LONG = 7  # spans in a row that make a surface: half a metre at the least, longer than anybody is broad
BESIDE = 0.3  # metres to each side of the line within which a surface is alone
ALONE = 0.85  # share of the points there that lie on it


@njit(cache=True)
def flat(points: Floats) -> Flags:
    """Say which (n,) of the points (n, 2; metres), put down on the floor, lie on straight upright surfaces."""
    count = len(points)
    result = np.zeros(count, np.bool_)
    if count < LONG * FEW:
        return result
    off, along = np.empty(count, np.int64), np.empty(count, np.int64)
    for direction in range(DIRECTIONS):
        angle = math.pi * direction / DIRECTIONS
        cosine, sine = math.cos(angle), math.sin(angle)
        for i in range(count):
            x, y = points[i, 0] - points[0, 0], points[i, 1] - points[0, 1]
            off[i] = math.floor((cosine * y - sine * x) / STRIP)
            along[i] = math.floor((cosine * x + sine * y) / SPAN)
        first, low = off.min(), along.min()
        strips, spans = off.max() - first + 2, along.max() - low + 1
        number = np.zeros((strips, spans), np.int64)
        for i in range(count):
            number[off[i] - first, along[i] - low] += 1
        reach = math.ceil(BESIDE / STRIP)
        for strip in range(strips - 1):
            begin = 0
            for span in range(spans + 1):
                if span < spans and number[strip, span] + number[strip + 1, span] >= FEW:
                    continue
                if span - begin >= LONG:
                    on = number[strip : strip + 2, begin:span].sum()
                    around = number[max(strip - reach, 0) : strip + 2 + reach, begin:span].sum()
                    if on >= ALONE * around:
                        for i in range(count):
                            inside = begin <= along[i] - low < span and 0 <= off[i] - first - strip < 2
                            result[i] = result[i] or inside
                begin = span + 1
    return result
