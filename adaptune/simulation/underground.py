"""A winding cave with side chambers and dripstones, and a narrow gallery of a mine."""

from collections.abc import Callable

import numpy as np

from adaptune.simulation.mesh import (
    Material,
    Mesh,
    boulder,
    fractal,
    fractal_plane,
    grid,
    place,
    tube,
    variants,
)
from adaptune.simulation.tiles import Floats, Scene, Spots, Tile, beyond, paved, strew

_CHAMBERS, _ROOMS = 13.0, 6.0
"""Metres from one side chamber to the next, and from one narrow to the next."""


def _cave_relief(spots: Spots, seed: int) -> Floats:
    rubble = fractal_plane(spots.x, spots.y, 2.2, seed + 11, 2)
    return 0.010 * rubble + 0.35 * beyond(spots.d, 0.9, 1.6) * rubble


def _chambers(s: Floats, angle: Floats, seed: int) -> Floats:
    depth = np.zeros(np.broadcast_shapes(s.shape, angle.shape))
    for number in np.unique(np.floor(s / _CHAMBERS)).astype(int).tolist():
        for n in (number - 1, number, number + 1):
            rng = np.random.default_rng([seed, 31, n + 1000])
            middle, reach = (n + rng.uniform(0.2, 0.8)) * _CHAMBERS, rng.uniform(2.0, 5.0)
            side, half = (0.0 if rng.random() < 0.5 else np.pi), rng.uniform(1.3, 2.4)
            bump = reach * np.exp(-(((s - middle) / half) ** 4))
            bump = bump * np.exp(-(((angle - side) / 0.75) ** 2))
            depth = np.where(np.floor(s / _CHAMBERS) == number, depth + bump, depth)
    return depth


def _rooms(s: Floats, seed: int) -> Floats:
    """Distance of each station from a narrow: 0 in the middle of one, 1 in a room."""
    share = np.ones_like(s)
    for n in range(int(np.floor(s.min() / _ROOMS)) - 1, int(np.floor(s.max() / _ROOMS)) + 2):
        rng = np.random.default_rng([seed, 32, n + 1000])
        middle, half = (n + rng.uniform(0.3, 0.7)) * _ROOMS, rng.uniform(0.5, 0.8)
        narrow = rng.uniform(0.9, 1.0) * np.exp(-(((s - middle) / half) ** 4))
        share = np.minimum(share, 1.0 - narrow)
    return share


def _section(s: Floats, angle: Floats, seed: int) -> tuple[Floats, Floats]:
    """Offset and height of the rock at stations and angles from the left, over the top."""
    along = np.stack([s.ravel(), np.zeros(s.size), np.zeros(s.size)], axis=1)
    room = _rooms(s, seed)
    half = 1.0 + room * (2.4 + 0.8 * fractal(along, 9.0, seed + 21).reshape(s.shape))
    roof = 1.7 + room * (1.2 + 0.9 * fractal(along, 13.0, seed + 22).reshape(s.shape))
    lean = 0.9 * room * fractal(along, 7.0, seed + 23).reshape(s.shape)
    chamber = room * _chambers(s, angle, seed)
    d, z = (half + chamber) * np.cos(angle), roof * np.sin(angle)
    # Metre-scale bumps make each segment of wall distinct; a robot fits through.
    places = np.stack(np.broadcast_arrays(s, d, z), axis=-1).reshape(-1, 3)
    bumps = fractal(places, 2.6, seed + 24, 2).reshape(d.shape) * (0.12 + 0.68 * room)
    return lean + d + bumps * np.cos(angle), z + bumps * np.sin(angle)


_Section = Callable[[Floats, Floats, int], tuple[Floats, Floats]]


def _tunnel(tile: Tile, section: _Section) -> list[Mesh]:
    """Raise rock of a section over the road, and a rock face at each mouth."""
    s = np.linspace(tile.start, tile.stop, max(int((tile.stop - tile.start) / 0.3), 1) + 1)[:, None]
    angle = np.linspace(-0.35, np.pi + 0.35, 56)[None]
    d, z = section(s, angle, tile.seed)
    rock = tile.at(s, d)
    # Above one line, so that the roof does not follow the rubble below it.
    rock[..., 2] = tile.at(s, 0.0)[..., 2] + z
    return [grid(rock, Material.ROCK), *(_face(tile, end, angle, section) for end in tile.ends)]


def _cave_build(tile: Tile) -> list[Mesh]:
    meshes = [*_tunnel(tile, _section), *_dripstones(tile)]
    s_rocks, d_rocks = tile.scatter(0.05, 1.8, 4.5)
    sizes = tile.rng.uniform(0.2, 0.55, len(s_rocks))
    return [*meshes, strew(tile, variants(boulder), s_rocks, d_rocks, sizes)]


def _face(tile: Tile, end: float, angle: Floats, section: _Section) -> Mesh:
    d, z = section(np.full((1, 1), end), angle, tile.seed)
    foot = tile.at(np.full(1, end), np.zeros(1))[0, 2]
    growth = np.linspace(0.0, 1.0, 14)[:, None]
    far_d = 26.0 * np.cos(angle)
    far_z = 11.0 * np.abs(np.sin(angle)) ** 0.5 * np.sign(np.sin(angle))
    d, z = d + growth * (far_d - d), z + growth * (far_z - z)
    places = np.stack([np.full(d.size, end), d.ravel(), z.ravel()], axis=1)
    out = fractal(places, 5.0, tile.seed + 25, 3).reshape(d.shape) * np.minimum(growth * 4.0, 1.0)
    face = tile.at(np.full(d.shape, end) + out, d)
    face[..., 2] = foot + z
    return grid(face, Material.ROCK)


def _dripstones(tile: Tile) -> list[Mesh]:
    s, d = tile.scatter(0.10, 1.5, 3.2, margin=2.0)
    n = len(s)
    radius, height = tile.rng.uniform(0.12, 0.35, n), tile.rng.uniform(0.4, 2.2, n)
    rings = [[0, 0, -0.4, 1.3], [0, 0, 0.1, 1.0], [0.08, 0, 0.5, 0.55], [0, 0.1, 1.0, 0.1]]
    cone = tube(rings, Material.ROCK, 9)
    scale = np.column_stack([radius, radius, height])
    standing = place(cone, tile.at(s, d), tile.rng.uniform(0.0, 6.28, n), scale)
    s, d = tile.scatter(0.06, 0.0, 2.5, margin=2.0)
    n = len(s)
    if not n:
        return [standing]
    _, roof = _section(s[:, None], np.arccos(np.clip(d / 3.0, -0.9, 0.9))[:, None], tile.seed)
    radius, height = tile.rng.uniform(0.1, 0.3, n), tile.rng.uniform(0.3, 1.1, n)
    at = tile.at(s, d)
    at[:, 2] = tile.at(s, 0.0)[:, 2] + np.maximum(roof[:, 0], 1.9 + height) + 0.2
    hanging = place(cone, at, 0.0, np.column_stack([radius, radius, -height - 0.2]))
    return [standing, hanging, *_columns(tile, cone)]


def _columns(tile: Tile, cone: Mesh) -> list[Mesh]:
    """Let dripstones grow together to columns, which hide what lies behind."""
    s, d = tile.scatter(0.12, 1.6, 3.8, margin=2.0)
    at, n = tile.at(s, d), len(s)
    radius = tile.rng.uniform(0.25, 0.6, n)
    size = np.column_stack([radius, radius, np.full(n, 2.6)])
    hanging = place(cone, at + np.array([0.0, 0.0, 3.6]), 1.0, size * np.array([1.0, 1.0, -1.0]))
    return [place(cone, at, 0.0, size), hanging]


CAVE = Scene(
    build=_cave_build,
    relief=_cave_relief,
    surface=paved((np.inf, Material.ROCK)),
    winding=0.4,
    bend=7.0,
    slope=0.03,
    shake=1.2,
    pace=0.35,
)


def _gallery(s: Floats, angle: Floats, seed: int) -> tuple[Floats, Floats]:
    along = np.stack([s.ravel(), np.zeros(s.size), np.zeros(s.size)], axis=1)
    half = 2.5 + 0.5 * fractal(along, 11.0, seed + 41).reshape(s.shape)
    roof = 2.3 + 0.4 * fractal(along, 9.0, seed + 42).reshape(s.shape)
    d, z = half * np.cos(angle), roof * np.sin(angle)
    places = np.stack(np.broadcast_arrays(s, d, z), axis=-1).reshape(-1, 3)
    bumps = 0.35 * fractal(places, 1.8, seed + 43, 2).reshape(d.shape)
    return d + bumps * np.cos(angle), z + bumps * np.sin(angle)


def _mine_build(tile: Tile) -> list[Mesh]:
    s_rocks, d_rocks = tile.scatter(0.04, 1.5, 2.4)
    sizes = tile.rng.uniform(0.15, 0.35, len(s_rocks))
    return [*_tunnel(tile, _gallery), strew(tile, variants(boulder), s_rocks, d_rocks, sizes)]


MINE = Scene(
    build=_mine_build,
    relief=_cave_relief,
    surface=paved((np.inf, Material.ROCK)),
    winding=1.2,
    bend=6.0,
    slope=0.02,
    shake=1.0,
    winds_at_once=True,
)
