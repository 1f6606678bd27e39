"""A rough field with almost nothing on it."""

import numpy as np

from adaptune.simulation.mesh import Material, Mesh, box, merge
from adaptune.simulation.noise import fractal_plane
from adaptune.simulation.scenes import parts
from adaptune.simulation.scenes.base import Floats, Scene, Spots, Tile, beyond, paved


def _relief(spots: Spots, seed: int) -> Floats:
    clods = fractal_plane(spots.x, spots.y, 6.0, seed + 51, 4)
    swell = fractal_plane(spots.x, spots.y, 28.0, seed + 52, 2)
    return 0.04 * clods + beyond(spots.d, 1.2, 3.0) * (0.55 * clods + 1.2 * swell)


def _build(tile: Tile) -> list[Mesh]:
    rng = tile.rng
    boulders = [parts.boulder(v) for v in range(parts.VARIANTS)]
    s, d = tile.scatter(0.002, 4.0, 50.0, margin=3.0)
    meshes = [parts.strew(tile, boulders, s, d, rng.uniform(0.25, 0.6, len(s)))]
    tip = box((0.05, 0.05, 0.3), Material.METAL, (0, 0, 1.3))
    post = merge([box((0.12, 0.12, 1.5), Material.WOOD), tip])
    # An old fence on one side, some of its posts missing.
    stations = np.arange(np.ceil(tile.start / 4.0), tile.stop / 4.0) * 4.0
    stations = stations[rng.random(len(stations)) < 0.75]
    meshes.append(parts.strew(tile, [post], stations, np.full(len(stations), 17.0), 1.0, sink=0.3))
    return meshes


FIELD = Scene(
    summary="rough terrain and almost nothing else",
    build=_build,
    relief=_relief,
    surface=paved((np.inf, Material.GRASS)),
    winding=0.15,
    bend=30.0,
    slope=0.04,
    shake=1.6,
    pace=0.7,
)
