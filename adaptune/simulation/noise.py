"""Fractal noise: the same value at the same place in every tile."""

import numba
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]


@numba.njit(cache=True)
def _corner(i: int, j: int, k: int, seed: int) -> float:
    """Give a lattice point its value in -1..1, by an integer hash."""
    h = np.uint32(i) * np.uint32(0x9E3779B1) ^ np.uint32(j) * np.uint32(0x85EBCA77)
    h ^= np.uint32(k) * np.uint32(0xC2B2AE3D) ^ np.uint32(seed) * np.uint32(0x27D4EB2F)
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    return h / 2147483647.5 - 1.0


@numba.njit(cache=True)
def _value(x: float, y: float, z: float, seed: int) -> float:
    """Interpolate the lattice, with a quintic fade so that slopes are continuous."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    u, v, w = x - i, y - j, z - k
    u = u * u * u * (u * (6.0 * u - 15.0) + 10.0)
    v = v * v * v * (v * (6.0 * v - 15.0) + 10.0)
    w = w * w * w * (w * (6.0 * w - 15.0) + 10.0)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
                total += weight * _corner(i + a, j + b, k + c, seed)
    return total


@numba.njit(cache=True)
def _fractal(points: Points, wavelength: float, octaves: int, seed: int) -> NDArray[np.float64]:
    values = np.zeros(len(points))
    for n in range(len(points)):
        scale, weight = 1.0 / wavelength, 1.0
        for octave in range(octaves):
            values[n] += weight * _value(
                points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale, seed + octave
            )
            scale *= 2.0
            weight *= 0.5
    return values


def fractal(points: Points, wavelength: float, seed: int, octaves: int = 1) -> NDArray[np.float64]:
    """Sum octaves of smooth noise, each of half the wavelength and amplitude of the one before.

    The first octave has its values in -1..1, and `wavelength` metres between lattice points.
    `points` in metres are of shape (n, 3), the noise of shape (n,).
    """
    points = np.ascontiguousarray(points, np.float64)
    return np.asarray(_fractal(points, float(wavelength), octaves, seed & 0x7FFFFFFF))


def fractal_plane(
    x: NDArray[np.float64], y: NDArray[np.float64], wavelength: float, seed: int, octaves: int = 1
) -> NDArray[np.float64]:
    """`fractal` over the horizontal plane, for coordinates of any one shape."""
    points = np.stack([np.ravel(x), np.ravel(y), np.full(np.size(x), 0.5)], axis=1)
    return fractal(points, wavelength, seed, octaves).reshape(np.shape(x))
