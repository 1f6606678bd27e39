"""Triangle meshes with materials, and the solids that scenes consist of."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Fractal noise: the same value at the same place in every tile.


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


class Material(IntEnum):
    """Material of a triangle."""

    SOIL = 0
    GRASS = 1
    ASPHALT = 2
    PAVING = 3
    ROCK = 4
    PLASTER = 5
    BRICK = 6
    GLASS = 7
    METAL = 8
    BARK = 9
    LEAVES = 10
    WATER = 11
    WOOD = 12
    CLOTH = 13


# Diffuse reflectivity of each material near 905 nm, indexed by `Material`.
_SHARES = [0.25, 0.35, 0.15, 0.35, 0.30, 0.60, 0.40, 0.05, 0.50, 0.25, 0.45, 0.02, 0.45, 0.40]
REFLECTIVITY = np.array(_SHARES, np.float32)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in space."""

    vertices: NDArray[np.float64]  # float64 metres, of shape (n, 3)
    triangles: NDArray[np.uint32]  # uint32 indices of vertices, of shape (m, 3)
    materials: NDArray[np.uint8]  # uint8 codes of `Material`, of shape (m,)


def mesh(vertices: ArrayLike, triangles: ArrayLike, material: ArrayLike) -> Mesh:
    """Make a mesh of one material, or of one given for every triangle."""
    corners = np.asarray(triangles, np.uint32).reshape(-1, 3)
    return Mesh(
        np.asarray(vertices, np.float64).reshape(-1, 3),
        corners,
        np.broadcast_to(np.asarray(material, np.uint8), len(corners)),
    )


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Gather meshes in one."""
    if not meshes:
        return mesh(np.empty((0, 3)), np.empty((0, 3)), Material.SOIL)
    firsts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + np.uint32(f) for m, f in zip(meshes, firsts, strict=True)]),
        np.concatenate([m.materials for m in meshes]),
    )


def place(model: Mesh, at: ArrayLike, yaw: ArrayLike = 0.0, scale: ArrayLike = 1.0) -> Mesh:
    """Put copies of a model, whose origin is on the ground, in the world.

    Parameters
    ----------
    at
        Metres, of shape (3,) or (n, 3).
    yaw
        Radians, one or n.
    scale
        One, n, or of shape (n, 3) for an own factor along each axis.
    """
    at = np.atleast_2d(np.asarray(at, np.float64))
    n = len(at)
    yaw = np.broadcast_to(np.asarray(yaw, np.float64), n)
    scale = np.asarray(scale, np.float64)
    scale = np.broadcast_to(scale[:, None] if scale.ndim == 1 else scale, (n, 3))
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    local = model.vertices[None] * scale[:, None]
    vertices = np.empty((n, len(model.vertices), 3))
    vertices[..., 0] = cos * local[..., 0] - sin * local[..., 1]
    vertices[..., 1] = sin * local[..., 0] + cos * local[..., 1]
    vertices[..., 2] = local[..., 2]
    vertices += at[:, None]
    firsts = (np.arange(n) * len(model.vertices)).astype(np.uint32)
    return Mesh(
        vertices.reshape(-1, 3),
        (model.triangles[None] + firsts[:, None, None]).reshape(-1, 3),
        np.tile(model.materials, n),
    )


def grid(vertices: NDArray[np.float64], material: ArrayLike) -> Mesh:
    """Span a sheet over vertices of shape (rows, columns, 3).

    `material` is one, or one for each column of cells, of shape (columns - 1,).
    """
    rows, columns = vertices.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([b, d, c], -1)], axis=-2)
    codes = np.asarray(material, np.uint8)[..., None]
    materials = np.broadcast_to(codes, (rows - 1, columns - 1, 2))
    return mesh(vertices.reshape(-1, 3), triangles.reshape(-1, 3), materials.reshape(-1))


_BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_BOX_TRIANGLES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]),
        *([0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]),
        *([0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def box(
    size: ArrayLike, material: Material, at: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0
) -> Mesh:
    """Make a box of length, width and height `size` whose base is centred on `at`."""
    model = mesh(_BOX * np.asarray(size, np.float64), _BOX_TRIANGLES, material)
    return place(model, at, yaw)


def tube(rings: ArrayLike, material: Material, sides: int = 8) -> Mesh:
    """Make a round body through rings of some corners (`sides`), from one end to the other.

    `rings` are centre and radius x, y, z, r of each, of shape (n, 4). A radius of zero closes the
    end in a point.
    """
    rings = np.asarray(rings, np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return grid(rings[:, None, :3] + rings[:, None, 3:] * circle[None], material)


def blob(material: Material, seed: int, roughness: float = 0.35, detail: int = 10) -> Mesh:
    """Make a lump of unit radius that sits on the ground, uneven by `roughness`."""
    polar = np.linspace(0.0, np.pi, detail)[:, None]
    angle = np.linspace(0.0, 2.0 * np.pi, 2 * detail)[None]
    x, y = np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle)
    unit = np.stack(np.broadcast_arrays(x, y, np.cos(polar)), axis=-1)
    # Noise over positions, not angles: the seam and the poles close.
    radius = 1.0 + roughness * fractal(unit.reshape(-1, 3), 0.8, seed, 2).reshape(unit.shape[:2])
    lump = unit * radius[..., None]
    lump[..., 2] = np.maximum(lump[..., 2] * 0.8 + 0.35, -0.2)
    return grid(lump, material)


def foliage(centres: NDArray[np.float64], radii: ArrayLike, leaf: float, seed: int) -> Mesh:
    """Make loose leaves: triangles turned at random, which let some rays through.

    Leaves of `leaf` metres lie up to `radii` metres, along each axis, from centres of shape (n, 3).
    """
    rng = np.random.default_rng(seed)
    n = len(centres)
    offset = rng.normal(size=(n, 3))
    offset *= (rng.random(n) ** (1 / 3) / np.linalg.norm(offset, axis=1))[:, None]
    corners = rng.normal(size=(n, 3, 3)) * (0.6 * leaf)
    vertices = (centres + offset * np.asarray(radii))[:, None] + corners
    return mesh(vertices.reshape(-1, 3), np.arange(3 * n), Material.LEAVES)
