"""A corridor between smooth parallel walls, with doors."""

import numpy as np

from adaptune.simulation.mesh import Material, Mesh, box, grid, merge
from adaptune.simulation.tiles import Scene, Tile, paved, wall

_HALF, _HEIGHT = 1.5, 2.8
_DOOR, _RECESS = 1.0, 0.35


def _corridor_build(tile: Tile) -> list[Mesh]:
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
        meshes.append(wall(tile, s, d, _HEIGHT, Material.PLASTER))
        for door in doors:
            lintel = box((_DOOR, _RECESS, _HEIGHT - 2.1), Material.PLASTER, (0.0, 0.0, 2.1))
            spot = (0.38, side * (_RECESS / 2 - 0.04), 1.05)
            handle = box((0.12, 0.08, 0.04), Material.METAL, spot)
            middle = door + _DOOR / 2
            door_case = merge([lintel, handle])
            meshes.append(tile.put(door_case, middle, side * (_HALF + _RECESS / 2)))
        # Pilasters between the doors, not quite evenly.
        for station in tile.every(4.5):
            pilaster = box((rng.uniform(0.3, 0.6), 0.25, _HEIGHT), Material.PLASTER)
            s_pilaster = station + rng.uniform(-0.8, 0.8)
            meshes.append(tile.put(pilaster, s_pilaster, side * (_HALF - 0.12)))
    # Beams under the ceiling, extinguishers, and a cupboard now and then.
    beam = box((0.25, 2 * _HALF, 0.22), Material.PLASTER, (0.0, 0.0, _HEIGHT - 0.22))
    meshes.extend(tile.put(beam, station, 0.0) for station in tile.every(5.0))
    for size, chance in (((0.18, 0.18, 0.6), 0.6), ((0.9, 0.4, 1.9), 0.8), ((0.4, 0.35, 0.7), 0.8)):
        if rng.random() < chance:
            station, side = rng.uniform(tile.start, tile.stop), rng.choice([-1.0, 1.0])
            cupboard = box(size, Material.METAL)
            meshes.append(tile.put(cupboard, station, side * (_HALF - size[1] / 2)))
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
        wall(tile, [end, end], [side * _HALF, side * 18.0], 7.0, Material.BRICK)
        for side in (-1.0, 1.0)
    ]
    above = tile.at(np.full((2, 2), end), np.array([[-_HALF, _HALF]] * 2))
    above[..., 2] += np.array([[_HEIGHT], [7.0]])
    return [*front, grid(above, Material.BRICK)]


CORRIDOR = Scene(
    build=_corridor_build,
    relief=lambda spots, _seed: np.zeros_like(spots.x),
    surface=paved((np.inf, Material.PAVING)),
    winding=0.0,
    bend=30.0,
    slope=0.0,
    shake=0.4,
    pace=0.5,
)
