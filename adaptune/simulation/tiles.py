"""Scenes, and the tiles in which they are built."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptune.simulation.mesh import Material, Mesh, grid, merge, place

if TYPE_CHECKING:
    from adaptune.simulation.world import Road

Floats = NDArray[np.float64]

TILE = 20.0  # metres of road in a tile; tiles begin at multiples of it


@dataclass(frozen=True, eq=False)
class Spots:
    """Places on the ground, as arrays of one shape."""

    x: Floats  # in the world
    y: Floats
    s: Floats  # station along the road
    d: Floats  # offset to its left


@dataclass(frozen=True)
class Tile:
    """A piece of a scene: up to twenty metres of road and its surroundings."""

    road: "Road"
    index: int  # its number along the road: it begins at station ``index * TILE``
    start: float  # station of its beginning, in metres; a leg may begin or end within it
    stop: float
    opens: bool  # whether it is the leg's first tile, after another scene
    closes: bool  # whether it is the last one, before another scene
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
        """Stations and offsets of objects strewn beside the road, `density` on a square metre.

        `near` and `far` bound their distance from the road's middle. `margin` is kept free at the
        ends where another scene begins.
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

    build: Callable[[Tile], list[Mesh]]  # makes what stands on the ground of a tile
    relief: Callable[[Spots, int], Floats]  # height of the ground above the road, for a seed
    surface: Callable[[Floats], NDArray[np.uint8]]  # material of the ground at an offset
    winding: float  # radians by which the road swings to and fro
    bend: float  # metres from one side to the other
    slope: float  # greatest rise of the road, as a ratio
    shake: float  # how rough the ride is; 1 is a paved road
    pace: float = 1.0  # share of its usual speed at which a vehicle goes
    winds_at_once: bool = False  # from its mouth on, however long the bends before it are


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
