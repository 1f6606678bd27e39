"""Triangle meshes with materials, and the solids that scenes consist of."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[np.float64]


def fractal(points: Points, wavelength: float, seed: int, octaves: int = 1) -> NDArray[np.float64]:
    """Smooth noise of shape (n,) at points of shape (n, 3): octaves of ever half the amplitude.

    The first one has its values in -1..1, and `wavelength` metres between lattice points.
    """
    from adaptune.simulation import kernels  # compiled, which takes long to import

    points = np.ascontiguousarray(points, np.float64)
    return np.asarray(kernels.fractal(points, float(wavelength), octaves, seed & 0x7FFFFFFF))


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


# Diffuse reflectivity of each material near 905 nm, indexed by `Material`.
_REFLECTED = [0.25, 0.35, 0.15, 0.35, 0.30, 0.60, 0.40, 0.05, 0.50, 0.25, 0.45, 0.02, 0.45]
REFLECTIVITY = np.array(_REFLECTED, np.float32)


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
    """Put copies of a model at points of shape (3,) or (n, 3), turned by one or n yaws in radians.

    There is one `scale`, or n, or it is of shape (n, 3) for an own factor along each axis.
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
    """Span a sheet over vertices (rows, columns, 3) of one material, or one a column of cells."""
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


def box(size: ArrayLike, material: Material, at: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
    """Make a box of length, width and height `size` whose base is centred on `at`."""
    model = mesh(_BOX * np.asarray(size, np.float64), _BOX_TRIANGLES, material)
    return place(model, at)


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


VARIANTS = 4  # how many different trees, bushes and boulders there are


def variants(model: Callable[[int], Mesh]) -> list[Mesh]:
    """All variants of a tree, a bush or a boulder."""
    return [model(variant) for variant in range(VARIANTS)]


@cache
def tree(variant: int) -> Mesh:
    """Broad-leaved tree of some 8 m, with a trunk free of leaves below 2.2 m."""
    rng = np.random.default_rng([17, variant])
    bend = rng.normal(0.0, 0.12, (4, 2)).cumsum(axis=0)
    heights = np.array([-0.3, 0.6, 2.2, 4.0, 6.5])
    radii = np.array([0.26, 0.19, 0.16, 0.12, 0.02])
    spine = np.concatenate([np.zeros((1, 2)), bend])
    parts = [tube(np.column_stack([spine, heights, radii]), Material.BARK, 8)]
    tips = []
    for angle in rng.uniform(0.0, 2.0 * np.pi, 6):
        foot = np.array([*spine[2], rng.uniform(2.2, 3.6)])
        tip = foot + rng.uniform(1.2, 2.2) * np.array([np.cos(angle), np.sin(angle), 0.7])
        parts.append(tube([[*foot, 0.07], [*tip, 0.02]], Material.BARK, 5))
        tips.append(tip)
    clumps = np.array([*tips, [*spine[4], 5.8], [*spine[3], 4.6]])
    centres = clumps[rng.integers(len(clumps), size=280)]
    parts.append(foliage(centres, (1.2, 1.2, 0.9), 0.28, variant))
    return merge(parts)


@cache
def bush(variant: int) -> Mesh:
    """Bush of a metre's height: leaves about a denser heart."""
    heart = blob(Material.LEAVES, 100 + variant, 0.4, 7)
    centres = np.tile([[0.0, 0.0, 0.45]], (70, 1))
    return merge([place(heart, (0, 0, 0), 0.0, 0.45), foliage(centres, 0.6, 0.2, variant)])


@cache
def boulder(variant: int) -> Mesh:
    """Boulder of a metre's radius."""
    return blob(Material.ROCK, variant, 0.5, 10)


def _extrude(profile: ArrayLike, width: float, material: Material) -> Mesh:
    """Make a body with a convex profile in x and z, `width` metres wide along y."""
    outline = np.asarray(profile, np.float64)
    n = len(outline)
    x, z = outline.T
    sides = [np.column_stack([x, np.full(n, y), z]) for y in (-width / 2.0, width / 2.0)]
    closed = np.stack([np.vstack([side, side[:1]]) for side in sides])
    fan = np.array([[0, i, i + 1] for i in range(1, n - 1)])
    return merge([grid(closed, material), *(mesh(side, fan, material) for side in sides)])


@cache
def car() -> Mesh:
    """Car of 4.3 m, heading along x."""
    rear, front = [(-2.0, 0.92), (-2.15, 0.7)], [(2.15, 0.62), (1.95, 0.75), (1.0, 0.86)]
    body = _extrude([(-2.1, 0.3), (2.15, 0.3), *front, *rear], 1.76, Material.METAL)
    windows = [(-1.9, 0.9), (1.0, 0.85), (0.3, 1.42), (-0.3, 1.48), (-1.3, 1.42)]
    cabin = _extrude(windows, 1.5, Material.GLASS)
    roof = box((1.5, 1.5, 0.04), Material.METAL, (-0.5, 0.0, 1.45))
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rim = np.column_stack([0.31 * np.cos(turn), 0.31 + 0.31 * np.sin(turn)])
    wheels = [[x, y, 0.0] for x in (-1.3, 1.35) for y in (-0.78, 0.78)]
    return merge([body, cabin, roof, place(_extrude(rim, 0.2, Material.METAL), wheels)])


@cache
def lamp() -> Mesh:
    """Street lamp of 6 m whose arm reaches out along y."""
    pole = tube([[0, 0, -0.2, 0.11], [0, 0, 1.0, 0.09], [0, 0, 6.0, 0.06]], Material.METAL, 8)
    arm = box((0.08, 1.4, 0.06), Material.METAL, (0.0, 0.7, 5.9))
    return merge([pole, arm, box((0.2, 0.6, 0.1), Material.METAL, (0.0, 1.3, 5.85))])


@cache
def sign() -> Mesh:
    """Road sign at 2.2 m, facing along x."""
    pole = tube([[0, 0, -0.2, 0.04], [0, 0, 2.7, 0.04]], Material.METAL, 6)
    return merge([pole, box((0.03, 0.6, 0.6), Material.METAL, (0.05, 0.0, 2.1))])


@cache
def bench() -> Mesh:
    """Bench of 1.8 m along x, facing -y."""
    seat = box((1.8, 0.45, 0.06), Material.WOOD, (0.0, 0.0, 0.42))
    back = box((1.8, 0.06, 0.4), Material.WOOD, (0.0, 0.22, 0.5))
    feet = [box((0.1, 0.45, 0.45), Material.METAL, (x, 0.0, 0.0)) for x in (-0.75, 0.75)]
    return merge([seat, back, *feet])
