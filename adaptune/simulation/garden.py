"""A botanic garden: paths under dense trees, hedges, slopes, a riverside and bridges."""

import numpy as np

from adaptune.simulation.mesh import (
    Material,
    Mesh,
    bench,
    box,
    bush,
    foliage,
    fractal_plane,
    grid,
    merge,
    place,
    tree,
    variants,
)
from adaptune.simulation.tiles import TILE, Floats, Scene, Spots, Tile, beyond, paved, strew

_SCENERY = {"wood": 0.035, "avenue": 0.012, "hedges": 0.014, "clearing": 0.002, "bridge": 0.012}
"""Trees on a square metre of each kind of tile."""
_BANK, _RIVER = -13.0, -30.0  # offsets of the river's near and far bank


def _kind(index: int, seed: int) -> str:
    number = np.random.default_rng([seed, 71, index + 1000]).integers(len(_SCENERY))
    return list(_SCENERY)[number]


def _channel(spots: Spots, seed: int) -> Floats:
    """Depth of the brooks under bridges, as a share."""
    depth = np.zeros_like(spots.s)
    index = np.floor(spots.s / TILE)
    for i in np.unique(index).astype(int).tolist():
        if _kind(i, seed) == "bridge":
            across = np.abs(spots.s - (i + 0.5) * TILE)
            bed = np.exp(-((across / 3.5) ** 4))
            depth = np.where(index == i, bed, depth)
    return depth * beyond(spots.d, 1.6, 0.7)


def _garden_relief(spots: Spots, seed: int) -> Floats:
    swell = fractal_plane(spots.x, spots.y, 16.0, seed + 72, 3)
    river = 2.2 * beyond(np.minimum(spots.d - _BANK, 0.0), 0.0, 4.0)
    brook = 2.0 * _channel(spots, seed)
    rise = 3.0 * beyond(np.maximum(spots.d, 0.0), 6.0, 25.0)
    return 0.03 * swell + 0.6 * beyond(spots.d, 1.6, 6.0) * swell + rise - np.maximum(river, brook)


def _trees(tile: Tile, s: Floats, d: Floats, sizes: tuple[float, float]) -> Mesh:
    return strew(tile, variants(tree), s, d, tile.rng.uniform(*sizes, len(s)), sink=0.02)


def _on_land(s: Floats, d: Floats) -> tuple[Floats, Floats]:
    dry = (d > _BANK + 0.5) | (d < _RIVER - 3.0)
    return s[dry], d[dry]


def _garden_build(tile: Tile) -> list[Mesh]:
    rng, kind = tile.rng, _kind(tile.index, tile.seed)
    near = 9.0 if kind == "clearing" else 3.2
    s, d = _on_land(*tile.scatter(_SCENERY[kind], near, 32.0, margin=4.0))
    meshes = [_trees(tile, s, d, (0.7, 1.3))]
    s, d = _on_land(*tile.scatter(0.02, 2.4, 14.0, margin=4.0))
    meshes.append(strew(tile, variants(bush), s, d, rng.uniform(0.4, 1.2, len(s))))
    water_s = np.linspace(tile.start, tile.stop, 6)[:, None]
    water = tile.at(water_s, np.array([[_BANK, _RIVER - 12.0]]))
    water[..., 2] = tile.at(water_s, 0.0)[..., 2] - 1.2
    meshes.append(grid(water, Material.WATER))
    middle = (tile.start + tile.stop) / 2.0
    if kind == "avenue":
        stations = tile.every(5.0)
        for side in (-1.0, 1.0):
            d = side * (2.9 + rng.uniform(-0.2, 0.2, len(stations)))
            meshes.append(_trees(tile, stations + rng.uniform(-0.4, 0.4), d, (0.9, 1.1)))
    elif kind == "hedges":
        meshes.extend(_hedges(tile))
    elif kind == "clearing":
        for side in (-1.0, 1.0):
            at = tile.at(middle + 4.0 * side, 2.6 * side)
            yaw = tile.heading(middle) + (np.pi if side < 0 else 0.0)
            meshes.append(place(bench(), at, yaw))
    elif kind == "bridge":
        meshes.extend(_railings(tile, (tile.index + 0.5) * TILE))
    return meshes


def _hedges(tile: Tile) -> list[Mesh]:
    """Plant clipped hedges along the path, with openings."""
    rng, meshes = tile.rng, []
    for side in (-1.0, 1.0):
        s = tile.start + 1.0
        while s < tile.stop - 3.0:
            length = min(rng.uniform(4.0, 9.0), tile.stop - s - 0.5)
            height, middle = rng.uniform(0.9, 1.8), s + length / 2.0
            heart = box((length, 0.6, height), Material.LEAVES, (0.0, 0.0, -0.2))
            n = int(40 * length)
            spread = rng.uniform(-0.5, 0.5, (n, 3)) * [length, 0.9, height + 0.2]
            spread += np.array([0.0, 0.0, height / 2.0])
            leaves = foliage(spread, 0.15, 0.16, int(rng.integers(2**31)))
            meshes.append(tile.put(merge([heart, leaves]), middle, side * 2.3))
            s += length + rng.uniform(1.2, 3.0)
    return meshes


def _railings(tile: Tile, middle: float) -> list[Mesh]:
    meshes = []
    for side in (-1.0, 1.0):
        posts = np.arange(middle - 5.0, middle + 5.1, 1.25)
        meshes.append(tile.put(box((0.12, 0.12, 1.15), Material.WOOD), posts, side * 1.55))
        for lift in (0.55, 1.05):
            rail = [tile.at(posts, side * 1.55, height) for height in (lift, lift + 0.1)]
            meshes.append(grid(np.stack(rail), Material.WOOD))
    return meshes


GARDEN = Scene(
    build=_garden_build,
    relief=_garden_relief,
    surface=paved((1.6, Material.SOIL), (np.inf, Material.GRASS)),
    winding=0.3,
    bend=22.0,
    slope=0.06,
    shake=1.2,
    pace=0.6,
)
