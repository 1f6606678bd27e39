"""A corridor between smooth parallel walls, with doors."""

import numpy as np

from adaptune.simulation.mesh import Material, Mesh, box, grid, merge, place
from adaptune.simulation.scenes import parts
from adaptune.simulation.scenes.base import Floats, Scene, Spots, Tile, paved

_HALF, _HEIGHT = 1.5, 2.8
_DOOR, _RECESS = 1.0, 0.35


def _relief(spots: Spots, seed: int) -> Floats:  # noqa: ARG001 - a floor is flat, whatever the seed
    return np.zeros_like(spots.x)


def _build(tile: Tile) -> list[Mesh]:
    rng = tile.rng
    ceiling_s = np.linspace(tile.start, tile.stop, 11)
    edges = np.array([-1.0, 1.0]) * (_HALF + 1.0)
    meshes = [grid(tile.at(ceiling_s[:, None], edges[None], _HEIGHT), Material.PLASTER)]
    for side in (-1.0, 1.0):
        doors = _doors(tile)
        s, d = [tile.start], [side * _HALF]
        for door in doors:
            s += [door, door, door + _DOOR, door + _DOOR]
            d += [side * x for x in (_HALF, _HALF + _RECESS, _HALF + _RECESS, _HALF)]
        s.append(tile.stop)
        d.append(side * _HALF)
        meshes.append(parts.wall(tile, s, d, _HEIGHT, Material.PLASTER))
        for door in doors:
            lintel = box((_DOOR, _RECESS, _HEIGHT - 2.1), Material.PLASTER, (0.0, 0.0, 2.1))
            spot = (0.38, side * (_RECESS / 2 - 0.04), 1.05)
            handle = box((0.12, 0.08, 0.04), Material.METAL, spot)
            middle = door + _DOOR / 2
            at = tile.at(middle, side * (_HALF + _RECESS / 2))
            meshes.append(place(merge([lintel, handle]), at, tile.heading(middle)))
        # Pilasters between the doors, not quite evenly.
        for station in np.arange(np.ceil(tile.start / 4.5), tile.stop / 4.5) * 4.5:
            pilaster = box((rng.uniform(0.3, 0.6), 0.25, _HEIGHT), Material.PLASTER)
            s_pilaster = station + rng.uniform(-0.8, 0.8)
            at = tile.at(s_pilaster, side * (_HALF - 0.12))
            meshes.append(place(pilaster, at, tile.heading(s_pilaster)))
    # Beams under the ceiling, extinguishers, and a cupboard now and then.
    for station in np.arange(np.ceil(tile.start / 5.0), tile.stop / 5.0) * 5.0:
        beam = box((0.25, 2 * _HALF, 0.22), Material.PLASTER, (0.0, 0.0, _HEIGHT - 0.22))
        meshes.append(place(beam, tile.at(station, 0.0), tile.heading(station)))
    for size, chance in (((0.18, 0.18, 0.6), 0.6), ((0.9, 0.4, 1.9), 0.8), ((0.4, 0.35, 0.7), 0.8)):
        if rng.random() < chance:
            station, side = rng.uniform(tile.start, tile.stop), rng.choice([-1.0, 1.0])
            at = tile.at(station, side * (_HALF - size[1] / 2))
            meshes.append(place(box(size, Material.METAL), at, tile.heading(station)))
    for end in tile.ends:
        meshes.extend(_front(tile, end))
    return meshes


def _doors(tile: Tile) -> list[float]:
    """Stations of the doors' nearer jambs, apart from one another and from the tile's ends."""
    slots = np.arange(tile.start + 0.6, tile.stop - 4.0, 4.5)
    slots = slots[tile.rng.random(len(slots)) < 0.75]
    doors: list[float] = (slots + tile.rng.uniform(0.0, 2.4, len(slots))).tolist()
    return doors


def _front(tile: Tile, end: float) -> list[Mesh]:
    """Build the front of the building, open where the corridor ends."""
    front = [
        parts.wall(tile, [end, end], [side * _HALF, side * 18.0], 7.0, Material.BRICK)
        for side in (-1.0, 1.0)
    ]
    above = tile.at(np.full((2, 2), end), np.array([[-_HALF, _HALF]] * 2))
    above[..., 2] += np.array([[_HEIGHT], [7.0]])
    return [*front, grid(above, Material.BRICK)]


CORRIDOR = Scene(
    summary="smooth parallel walls with doors, degenerate along its axis",
    build=_build,
    relief=_relief,
    surface=paved((np.inf, Material.PAVING)),
    winding=0.0,
    bend=30.0,
    slope=0.0,
    shake=0.4,
    pace=0.5,
    movers=(("walker", 0.9),),
)
