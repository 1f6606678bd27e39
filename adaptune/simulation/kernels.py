"""Compiled loops: noise over all points of a tile, and from rays to echoes over all of a scan."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.compiled import compiled

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@compiled
def _corner(i: int, j: int, k: int, seed: int) -> float:
    """Give a lattice point its value in -1..1, by an integer hash."""
    h = np.uint32(i) * np.uint32(0x9E3779B1) ^ np.uint32(j) * np.uint32(0x85EBCA77)
    h ^= np.uint32(k) * np.uint32(0xC2B2AE3D) ^ np.uint32(seed) * np.uint32(0x27D4EB2F)
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    return h / 2147483647.5 - 1.0


@compiled
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


@compiled
def fractal(points: F64, wavelength: float, octaves: int, seed: int) -> NDArray[np.float64]:
    """See `adaptune.simulation.mesh.fractal`."""
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


class Cast(NamedTuple):
    """Rays, and what they hit."""

    rays: F32  # origins and directions, of shape (n, 6)
    hits: F32  # metres to what each ray hit, infinite where nothing, of shape (n,)
    normals: F32  # of shape (n, 3)
    reflectivity: F32  # of shape (n,)


@compiled
def aim(directions: F32, T_world_sensor: F64, origin: F64) -> F32:
    """Send every ray from its own column's pose: (n_columns * n_rings, 6), origin and direction.

    Directions, of shape (n_columns, n_rings, 3), are those of `course.directions`. The rays'
    coordinates count from `origin`: near it, single precision is exact enough.
    """
    columns, rings = directions.shape[:2]
    rays = np.empty((columns * rings, 6), np.float32)
    n = 0
    for c in range(columns):
        T = T_world_sensor[c]
        x, y, z = T[0, 3] - origin[0], T[1, 3] - origin[1], T[2, 3] - origin[2]
        for r in range(rings):
            u, v, w = directions[c, r]
            rays[n, 0], rays[n, 1], rays[n, 2] = x, y, z
            for i in range(3):
                rays[n, 3 + i] = T[i, 0] * u + T[i, 1] * v + T[i, 2] * w
            n += 1
    return rays


@compiled
def receive(
    directions: F32,
    cast: Cast,
    sensor: tuple[float, float, float, float],
    chance: F32,
    normal: F32,
) -> tuple[F32, F32, NDArray[np.int64]]:
    """Points (m, 3), intensities from 0 to 255 (m,) and numbers (m,) of the rays that come back.

    Directions, of shape (n, 3), and points are in the sensor's frame at the time of each ray. Of
    the `sensor`: least and greatest range in metres, their deviation, and the share of echoes lost.
    `chance` and `normal` are uniform and normal random numbers, of shape (n,).
    """
    rays, hits, normals, reflectivity = cast
    nearest, farthest, noise, dropout = sensor
    n = len(rays)
    points, intensities = np.empty((n, 3), np.float32), np.empty(n, np.float32)
    kept = np.empty(n, np.int64)
    m = 0
    for i in range(n):
        distance = float(hits[i])
        if not nearest <= distance <= farthest or chance[i] < dropout:
            continue
        cosine = abs(
            normals[i, 0] * rays[i, 3] + normals[i, 1] * rays[i, 4] + normals[i, 2] * rays[i, 5]
        )
        power = reflectivity[i] * cosine
        # The echo weakens with the square of the distance; a tenth is seen to the full range.
        if distance * distance > farthest * farthest * power * 10.0:
            continue
        distance += noise * normal[i]
        for j in range(3):
            points[m, j] = distance * directions[i, j]
        intensities[m] = np.rint(255.0 * min(power, 1.0))
        kept[m] = i
        m += 1
    return points[:m], intensities[:m], kept[:m]
