"""The kinds of place a course can lead through."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptune.simulation.mesh import (
    VARIANTS,
    Material,
    Mesh,
    bench,
    boulder,
    box,
    bush,
    car,
    foliage,
    fractal,
    fractal_plane,
    grid,
    lamp,
    merge,
    place,
    sign,
    tree,
    tube,
    variants,
)

# Scenes, and the tiles in which they are built.


Floats = NDArray[np.float64]

TILE = 20.0
"""Metres of road in a tile; tiles begin at multiples of it."""


@dataclass(frozen=True, eq=False)
class Spots:
    """Places on the ground, as arrays of one shape."""

    # In the world.
    x: Floats
    y: Floats
    # Station along the road and offset to its left.
    s: Floats
    d: Floats


class Line(Protocol):
    """What scenes need of a road, see `adaptune.simulation.world.Road`."""

    def heading(self, s: Floats) -> Floats:
        """Radians from the x axis at each station."""

    def plane(self, s: Floats, d: Floats) -> tuple[Floats, Floats]:
        """Coordinates x and y of a station and an offset."""

    def ground(self, x: Floats, y: Floats) -> Floats:
        """Height of the ground."""


@dataclass(frozen=True)
class Tile:
    """A piece of a scene: up to twenty metres of road and its surroundings."""

    road: Line
    index: int  # its number along the road: it begins at station ``index * TILE``
    # Stations of its ends, in metres; a leg may begin or end within it.
    start: float
    stop: float
    # Whether it is the leg's first or last tile with another scene next to it.
    opens: bool
    closes: bool
    rng: np.random.Generator = field(compare=False)  # its own random numbers
    seed: int  # seed of the whole world, for shapes that continue from tile to tile

    @property
    def ends(self) -> list[float]:
        """Stations at which another scene is next to the leg."""
        return [self.start] * self.opens + [self.stop] * self.closes

    def at(self, s: ArrayLike, d: ArrayLike, lift: ArrayLike = 0.0) -> Floats:
        """Points of shape (..., 3) `lift` metres above the ground at stations and offsets."""
        s, d = np.broadcast_arrays(np.asarray(s, np.float64), np.asarray(d, np.float64))
        x, y = self.road.plane(s, d)
        return np.stack([x, y, self.road.ground(x, y) + np.asarray(lift)], axis=-1)

    def heading(self, s: ArrayLike) -> Floats:
        """Heading of the road in radians."""
        return self.road.heading(np.asarray(s, np.float64))

    def put(
        self, model: Mesh, s: ArrayLike, d: ArrayLike, turn: float = 0.0, scale: ArrayLike = 1.0
    ) -> Mesh:
        """Put a model at stations and offsets, turned from the road's heading by some radians."""
        return place(model, self.at(s, d), self.heading(s) + turn, scale)

    def every(self, spacing: float) -> Floats:
        """Stations at the multiples of so many metres."""
        return np.arange(np.ceil(self.start / spacing), self.stop / spacing) * spacing

    def scatter(
        self, density: float, near: float, far: float, margin: float = 0.0
    ) -> tuple[Floats, Floats]:
        """Stations and offsets of objects strewn on both sides of the road.

        `density` is their mean number on a square metre, `near` and `far` bound their distance from
        the road's middle, and `margin` is kept free at the ends where another scene begins.
        """
        start = self.start + margin * self.opens
        # The last tile of a leg may be shorter than the margin.
        stop = max(self.stop - margin * self.closes, start)
        n = int(self.rng.poisson(density * (stop - start) * 2.0 * (far - near)))
        s = self.rng.uniform(start, stop, n)
        d = self.rng.uniform(near, far, n) * self.rng.choice([-1.0, 1.0], n)
        return s, d


@dataclass(frozen=True)
class Scene:
    """A kind of place."""

    summary: str  # what it is, in a line
    build: Callable[[Tile], list[Mesh]]  # makes what stands on the ground of a tile
    # Height of the ground above the road's line at some spots, for a seed.
    relief: Callable[[Spots, int], Floats]
    surface: Callable[[Floats], NDArray[np.uint8]]  # material of the ground at an offset
    # Radians by which the road swings to and fro, and metres from one side to the other.
    winding: float
    bend: float
    slope: float  # greatest rise of the road, as a ratio
    shake: float  # how rough the ride is; 1 is a paved road
    pace: float = 1.0  # share of its usual speed at which a vehicle goes
    # Whether it winds from its mouth on, however long the bends before it are.
    winds_at_once: bool = False


def paved(*bands: tuple[float, Material]) -> Callable[[Floats], NDArray[np.uint8]]:
    """Ground in bands along the road: each material reaches to a distance from its middle."""
    edges = np.array([edge for edge, _ in bands[:-1]])
    codes = np.array([material for _, material in bands], np.uint8)

    def surface(d: Floats) -> NDArray[np.uint8]:
        return np.asarray(codes[np.searchsorted(edges, np.abs(d))], np.uint8)

    return surface


def beyond(d: Floats, start: float, width: float) -> Floats:
    """Rise smoothly from 0 to 1 over `width` metres from a distance `start` off the road."""
    return smooth((np.abs(d) - start) / width)


def smooth(u: Floats) -> Floats:
    """Rise from 0 to 1 while `u` does, level at both ends."""
    u = np.clip(u, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


def strew(
    tile: Tile, models: list[Mesh], s: Floats, d: Floats, scale: ArrayLike, *, sink: float = 0.1
) -> Mesh:
    """Put models, in turn and turned at random, at stations and offsets, sunk into the ground."""
    scale = np.broadcast_to(np.asarray(scale, np.float64), len(s))
    yaw = tile.rng.uniform(0.0, 2.0 * np.pi, len(s))
    at = tile.at(s, d, -sink * scale)
    n, used = len(models), models[: len(s)]
    return merge([place(m, at[i::n], yaw[i::n], scale[i::n]) for i, m in enumerate(used)])


def wall(tile: Tile, s: ArrayLike, d: ArrayLike, height: ArrayLike, material: Material) -> Mesh:
    """Raise a wall of some height over a line of stations and offsets, from below the ground."""
    foot = tile.at(s, d, -0.3)
    top = foot.copy()
    top[:, 2] += 0.3 + np.asarray(height)
    return grid(np.stack([foot, top]), material)


# A winding cave of rough rock, with narrows, side chambers and dripstones.


_CHAMBERS, _ROOMS = 13.0, 6.0
"""Metres from one side chamber to the next, and from one narrow to the next."""


def _cave_relief(spots: Spots, seed: int) -> Floats:
    rubble = fractal_plane(spots.x, spots.y, 2.2, seed + 11, 2)
    return 0.010 * rubble + 0.35 * beyond(spots.d, 0.9, 1.6) * rubble


def _chambers(s: Floats, angle: Floats, seed: int) -> Floats:
    """Depth of the side chambers in metres."""
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
    # Metre-scale bumps make each stretch of wall distinct; a robot fits through.
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
    """Build the rock face around the mouth of a tunnel."""
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
    summary="winding, rough tunnel with narrows, side chambers and dripstones",
    build=_cave_build,
    relief=_cave_relief,
    surface=paved((np.inf, Material.ROCK)),
    winding=0.4,
    bend=7.0,
    slope=0.03,
    shake=1.2,
    pace=0.35,
)


# A narrow gallery of a mine, driven fast: it winds every few metres, and its walls are uneven.


def _gallery(s: Floats, angle: Floats, seed: int) -> tuple[Floats, Floats]:
    """Offset and height of the rock at stations and angles from the left, over the top."""
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
    summary="narrow gallery that bends every few metres, with uneven walls",
    build=_mine_build,
    relief=_cave_relief,
    surface=paved((np.inf, Material.ROCK)),
    winding=1.2,
    bend=6.0,
    slope=0.02,
    shake=1.0,
    winds_at_once=True,
)


# A corridor between smooth parallel walls, with doors.


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
    summary="smooth parallel walls with doors, degenerate along its axis",
    build=_corridor_build,
    relief=lambda spots, _seed: np.zeros_like(spots.x),
    surface=paved((np.inf, Material.PAVING)),
    winding=0.0,
    bend=30.0,
    slope=0.0,
    shake=0.4,
    pace=0.5,
)


# A botanic garden: paths under dense trees, hedges, slopes, a riverside and bridges.


_KINDS = {"wood": 0.035, "avenue": 0.012, "hedges": 0.014, "clearing": 0.002, "bridge": 0.012}
"""Trees on a square metre of each kind of tile."""
_BANK, _RIVER = -13.0, -30.0
"""Offsets of the river's near and far bank."""


def _kind(index: int, seed: int) -> str:
    number = np.random.default_rng([seed, 71, index + 1000]).integers(len(_KINDS))
    return list(_KINDS)[number]


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
    s, d = _on_land(*tile.scatter(_KINDS[kind], near, 32.0, margin=4.0))
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
    """Build the parapets of a bridge and its piers."""
    meshes = []
    for side in (-1.0, 1.0):
        posts = np.arange(middle - 5.0, middle + 5.1, 1.25)
        meshes.append(tile.put(box((0.12, 0.12, 1.15), Material.WOOD), posts, side * 1.55))
        for lift in (0.55, 1.05):
            rail = [tile.at(posts, side * 1.55, height) for height in (lift, lift + 0.1)]
            meshes.append(grid(np.stack(rail), Material.WOOD))
    return meshes


GARDEN = Scene(
    summary="paths under dense trees, hedges, slopes, a riverside clearing, bridges",
    build=_garden_build,
    relief=_garden_relief,
    surface=paved((1.6, Material.SOIL), (np.inf, Material.GRASS)),
    winding=0.3,
    bend=22.0,
    slope=0.06,
    shake=1.2,
    pace=0.6,
)


# Open ground with sparse boulders and bushes under far hills and trees.


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
    summary="open ground with sparse boulders and bushes, far hills and trees",
    build=_open_ground_build,
    relief=_open_ground_relief,
    surface=paved((np.inf, Material.SOIL)),
    winding=0.18,
    bend=30.0,
    slope=0.03,
    shake=1.2,
)


# A street of a town: fronts with gaps, poles, parked cars, trees and crossings.


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
    summary="house fronts with gaps, lamps, parked cars, trees and crossings",
    build=_street_build,
    relief=_street_relief,
    surface=paved((_KERB, Material.ASPHALT), (np.inf, Material.PAVING)),
    winding=0.05,
    bend=45.0,
    slope=0.012,
    shake=0.6,
)


SCENES: Mapping[str, Scene] = {
    "cave": CAVE,
    "open": OPEN,
    "street": STREET,
    "garden": GARDEN,
    "corridor": CORRIDOR,
    "mine": MINE,
}
"""Scenes by name."""
