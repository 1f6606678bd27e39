"""A street of a town: fronts with gaps, poles, parked cars, trees and crossings."""

import numpy as np

from adaptune.simulation.mesh import (
    VARIANTS,
    Material,
    Mesh,
    box,
    car,
    fractal_plane,
    grid,
    lamp,
    merge,
    place,
    sign,
    tree,
)
from adaptune.simulation.tiles import Floats, Scene, Spots, Tile, beyond, paved

_KERB, _CROSSING = 9.0, 4
"""Metres from the road's middle to the kerb, and tiles from one crossing to the next."""


def _street_relief(spots: Spots, seed: int) -> Floats:
    uneven = 0.01 * fractal_plane(spots.x, spots.y, 5.0, seed + 61, 2)
    return uneven + 0.13 * beyond(spots.d, _KERB, 0.3)


def _house(width: float, depth: float, floors: int, rng: np.random.Generator) -> Mesh:
    """Make a house with its front on the x axis, reaching back along y."""
    storey, inset = rng.uniform(2.8, 3.3), 0.15
    height = floors * storey + 0.8
    bays = max(int(width / rng.uniform(2.2, 3.2)), 1)
    pitch, opening = width / bays, rng.uniform(1.0, 1.3)
    middle = (np.arange(bays) + 0.5) * pitch - width / 2.0
    x = np.concatenate([m + opening / 2.0 * np.array([-1.02, -1.0, 1.0, 1.02]) for m in middle])
    x = np.concatenate([[-width / 2.0], x, [width / 2.0]])
    sill = np.arange(floors) * storey + 1.0
    z = np.concatenate([b + np.array([-0.02, 0.0, 1.4, 1.42]) for b in sill])
    z = np.concatenate([[-0.5], z, [height]])
    inside_x, inside_z = np.zeros(len(x), bool), np.zeros(len(z), bool)
    inside_x[2:-1:4] = inside_x[3:-1:4] = True
    inside_z[2:-1:4] = inside_z[3:-1:4] = True
    hole = inside_z[:, None] & inside_x[None]
    # The door: one bay of the ground floor, open down to the street.
    door = rng.integers(bays)
    hole[1, 2 + 4 * door : 4 + 4 * door] = True
    front = np.stack(np.broadcast_arrays(x[None], inset * hole, z[:, None]), axis=-1)
    pane = hole[:-1, :-1] & hole[1:, 1:] & hole[:-1, 1:] & hole[1:, :-1]
    plain = Material.PLASTER if rng.random() < 0.6 else Material.BRICK
    parts_ = [
        grid(front, np.where(pane, Material.GLASS, plain)),
        box((width, depth, height + 0.5), plain, (0.0, 0.3 + depth / 2.0, -0.5)),
        box((width + 0.3, 0.5, 0.25), plain, (0.0, 0.1, height)),
    ]
    if rng.random() < 0.4:
        size = (opening + 0.8, 1.0, 1.0)
        parts_.extend(box(size, Material.METAL, (m, -0.5, storey)) for m in middle[1::2])
    return merge(parts_)


def _street_build(tile: Tile) -> list[Mesh]:
    rng, crossing = tile.rng, tile.index % _CROSSING == 2
    meshes = []
    for side in (-1.0, 1.0):
        turn = 0.0 if side > 0 else np.pi
        s = tile.start + 3.0 * tile.opens
        while s < tile.stop - 5.0:
            width = min(rng.uniform(7.0, 13.0), tile.stop - 0.4 - s)
            middle = s + width / 2.0
            gap = rng.uniform(3.0, 8.0) if rng.random() < 0.75 else 0.3
            away = abs(middle - (tile.index + 0.5) * 20.0)
            if width >= 4.0 and not (crossing and away < width / 2.0 + 6.0):
                house = _house(width, rng.uniform(8.0, 12.0), int(rng.integers(2, 6)), rng)
                d = side * (_KERB + rng.uniform(4.0, 10.0))
                meshes.append(tile.put(house, middle, d, turn))
            elif width >= 4.0 and rng.random() < 0.5 and not crossing:
                hedge = box((width, 0.8, 1.6), Material.LEAVES)
                meshes.append(tile.put(hedge, middle, side * (_KERB + 4.0)))
            s += width + gap
        if crossing:
            meshes.extend(_side_street(tile, side))
        meshes.extend(_kerbside(tile, side, turn, crossing))
    return meshes


def _side_street(tile: Tile, side: float) -> list[Mesh]:
    """Build the houses along the street that crosses, and a sign at its corner."""
    rng, middle = tile.rng, (tile.index + 0.5) * 20.0
    if not tile.start + 6.0 < middle < tile.stop - 6.0:
        return []
    meshes = []
    heading = float(tile.heading(middle))
    for hand in (-1.0, 1.0):
        for d in (24.0, 37.0, 50.0):
            house = _house(rng.uniform(9.0, 12.0), 8.0, int(rng.integers(2, 5)), rng)
            at = tile.at(middle + hand * (7.0 + rng.uniform(0.0, 1.0)), side * d)
            yaw = heading + (-np.pi / 2.0 if hand > 0 else np.pi / 2.0)
            meshes.append(place(house, at, yaw))
    at = tile.at(middle + 6.5, side * (_KERB + 0.6))
    return [*meshes, place(sign(), at, heading + np.pi)]


def _kerbside(tile: Tile, side: float, turn: float, crossing: bool) -> list[Mesh]:
    """Park cars, plant trees and raise lamps along one kerb."""
    rng, meshes = tile.rng, []
    slots = np.arange(tile.start + 3.0, tile.stop - 2.0, 5.6)
    if crossing:
        slots = slots[np.abs(slots - (tile.index + 0.5) * 20.0) > 9.0]
    slots = slots[rng.random(len(slots)) < 0.35] + rng.uniform(-0.3, 0.3)
    if len(slots):
        d = side * (_KERB - 1.05 + rng.uniform(-0.1, 0.1, len(slots)))
        scale = rng.uniform(0.9, 1.12, (len(slots), 3)) * [1.0, 1.0, rng.choice([1.0, 1.25])]
        meshes.append(tile.put(car(), slots, d, turn, scale))
    stations = tile.every(10.0)
    if crossing:
        stations = stations[np.abs(stations - (tile.index + 0.5) * 20.0) > 6.0]
    for s in stations:
        if round(s / 10.0) % 3 == (0 if side > 0 else 1):
            at = tile.at(s, side * (_KERB + 0.5))
            meshes.append(place(lamp(), at, tile.heading(s) + turn + np.pi))
        elif rng.random() < 0.45:
            model = tree(int(rng.integers(VARIANTS)))
            at = tile.at(s + rng.uniform(-1.5, 1.5), side * (_KERB + 1.2))
            meshes.append(place(model, at, rng.uniform(0.0, 6.28), rng.uniform(0.6, 0.9)))
    if rng.random() < 0.5:
        s = rng.uniform(tile.start, tile.stop)
        meshes.append(tile.put(box((0.6, 0.6, 1.1), Material.METAL), s, side * (_KERB + 2.6)))
    return meshes


STREET = Scene(
    build=_street_build,
    relief=_street_relief,
    surface=paved((_KERB, Material.ASPHALT), (np.inf, Material.PAVING)),
    winding=0.05,
    bend=45.0,
    slope=0.012,
    shake=0.6,
)
