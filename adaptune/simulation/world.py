"""The world around a road, in tiles that are built and dropped along the drive."""

import numpy as np
from numpy.typing import NDArray

from adaptune.simulation.mesh import Mesh, grid, merge
from adaptune.simulation.road import APRON, Road
from adaptune.simulation.scenes.base import TILE, Tile

_CELL = 0.7
"""Metres between vertices of the ground near the road."""

_GROUND = 115.0
"""Metres of ground on either side of the road."""


def _offsets() -> NDArray[np.float64]:
    """Lay the ground's vertices across the road: dense near it, ever sparser beyond."""
    offsets = list(np.arange(0.0, 9.0, _CELL))
    while offsets[-1] < _GROUND:
        offsets.append(offsets[-1] + max(_CELL, 0.09 * offsets[-1]))
    return np.array([*(-x for x in reversed(offsets[1:])), *offsets])


class World:
    """All static objects along a road that rays can hit.

    Every tile has its own random numbers and is always built the same. Only tiles in reach are
    kept: `tiles` holds their meshes by index.
    """

    def __init__(self, road: Road) -> None:
        self._road = road
        self.tiles: dict[int, Mesh] = {}
        self._last = int(np.floor((road.length + APRON) / TILE))

    def around(self, station: float, reach: float) -> Mesh:
        """Build the world within `reach` metres of a station, and drop the rest."""
        first = max(int(np.floor((station - reach) / TILE)), int(-APRON // TILE))
        last = min(int(np.floor((station + reach) / TILE)), self._last)
        wanted = range(first, last + 1)
        self.tiles = {i: self.tiles[i] if i in self.tiles else self.tile(i) for i in wanted}
        return merge(list(self.tiles.values()))

    def tile(self, index: int) -> Mesh:
        """Build the tile that begins at station ``index * TILE``."""
        road = self._road
        start, stop = index * TILE, (index + 1) * TILE
        meshes = [self._ground(start, stop)]
        for number, leg in enumerate(road.legs):
            first, last = max(start, leg.start), min(stop, leg.stop)
            # A sliver of a tile has no room for a scene's things.
            if last - first < 1e-6:
                continue
            tile = Tile(
                line=road,
                index=index,
                start=first,
                stop=last,
                opens=first == leg.start and number > 0,
                closes=last == leg.stop and number < len(road.legs) - 1,
                rng=np.random.default_rng([road.seed, 3, number, index + 1000]),
                seed=road.seed,
            )
            meshes.extend(leg.scene.build(tile))
        return merge(meshes)

    def _ground(self, start: float, stop: float) -> Mesh:
        road = self._road
        ends, _ = road.plane(np.array([start, stop]), np.zeros(2))
        x = np.linspace(ends[0], ends[1], max(int((ends[1] - ends[0]) / _CELL), 1) + 1)
        s = road.station(x)
        _, middle = road.plane(s, np.zeros_like(s))
        # Sheared along y, not swept along the road: that would fold in bends.
        y = middle[:, None] + _offsets()
        x_grid = np.broadcast_to(x[:, None], y.shape)
        vertices = np.stack([x_grid, y, road.ground(x_grid, y)], axis=-1)
        cells = (s[1:] + s[:-1]) / 2.0
        d = (_offsets()[1:] + _offsets()[:-1]) / 2.0 * np.cos(road.heading(cells))[:, None]
        materials = np.empty(d.shape, np.uint8)
        for leg in road.legs:
            inside = (cells >= leg.start) & (cells <= leg.stop)
            materials[inside] = leg.scene.surface(d[inside])
        return grid(vertices, materials)
