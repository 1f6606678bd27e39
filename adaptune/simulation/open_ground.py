"""Open ground with sparse boulders and bushes under far hills and trees."""

import numpy as np

from adaptune.simulation.mesh import (
    Material,
    Mesh,
    boulder,
    box,
    bush,
    fractal_plane,
    merge,
    tree,
    variants,
)
from adaptune.simulation.tiles import Floats, Scene, Spots, Tile, beyond, paved, strew


def _open_ground_relief(spots: Spots, seed: int) -> Floats:
    swell = fractal_plane(spots.x, spots.y, 22.0, seed + 41, 3)
    hills = 7.0 + 6.0 * fractal_plane(spots.x, spots.y, 40.0, seed + 42, 3)
    rise = 0.05 * swell + 0.9 * beyond(spots.d, 3.0, 15.0) * swell
    return rise + beyond(spots.d, 45.0, 40.0) * hills


def _open_ground_build(tile: Tile) -> list[Mesh]:
    rng = tile.rng
    meshes = []
    for model, density, near, far, sizes in (
        (boulder, 0.010, 4.0, 60.0, (0.3, 1.3)),
        (bush, 0.010, 4.0, 60.0, (0.6, 1.6)),
        (tree, 0.0020, 12.0, 50.0, (0.7, 1.2)),
        (tree, 0.004, 50.0, 75.0, (0.8, 1.4)),
    ):
        s, d = tile.scatter(density, near, far, margin=4.0)
        meshes.append(strew(tile, variants(model), s, d, rng.uniform(*sizes, len(s))))
    if rng.random() < 0.45:
        s = rng.uniform(tile.start, tile.stop, 1)
        d = rng.choice([-1.0, 1.0], 1) * rng.uniform(22.0, 40.0)
        roof = box((12.8, 3.0, 1.2), Material.WOOD, (0.0, 0.0, 3.5))
        shed = merge([box((12.0, 7.0, 3.6), Material.WOOD), roof])
        meshes.append(strew(tile, [shed], s, d, 1.0, sink=0.3))
    return meshes


OPEN = Scene(
    build=_open_ground_build,
    relief=_open_ground_relief,
    surface=paved((np.inf, Material.SOIL)),
    winding=0.18,
    bend=30.0,
    slope=0.03,
    shake=1.2,
)
