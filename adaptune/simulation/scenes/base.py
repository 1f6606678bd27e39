"""Scenes, and the tiles in which they are built."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptune.simulation.mesh import Material, Mesh

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


class RoadLine(Protocol):
    """The line along which a scene is built: the part of `Road` that scenes use."""

    def heading(self, s: Floats) -> Floats:
        """Radians from the x axis at each station."""

    def plane(self, s: Floats, d: Floats) -> tuple[Floats, Floats]:
        """Coordinates x and y of a station and an offset."""

    def ground(self, x: Floats, y: Floats) -> Floats:
        """Height of the ground."""


@dataclass(frozen=True)
class Tile:
    """A piece of a scene: up to twenty metres of road and its surroundings."""

    line: RoadLine  # the road
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
        x, y = self.line.plane(s, d)
        return np.stack([x, y, self.line.ground(x, y) + np.asarray(lift)], axis=-1)

    def heading(self, s: ArrayLike) -> Floats:
        """Heading of the road in radians."""
        return self.line.heading(np.asarray(s, np.float64))

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
    # What moves about in it: kinds of mover with the offset they keep.
    movers: tuple[tuple[str, float], ...] = ()


def paved(*bands: tuple[float, Material]) -> Callable[[Floats], NDArray[np.uint8]]:
    """Ground in bands along the road: each material reaches to a distance from its middle."""
    edges = np.array([edge for edge, _ in bands[:-1]])
    codes = np.array([material for _, material in bands], np.uint8)

    def surface(d: Floats) -> NDArray[np.uint8]:
        return np.asarray(codes[np.searchsorted(edges, np.abs(d))], np.uint8)

    return surface


def beyond(d: Floats, start: float, width: float) -> Floats:
    """Rise smoothly from 0 to 1 over `width` metres from a distance `start` off the road."""
    u = np.clip((np.abs(d) - start) / width, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)
