"""The line that a course follows over the ground."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from adaptune.simulation.scenes.base import Scene, Spots

APRON = 40.0
"""Metres of world before the start and after the end of the drive."""

BLEND = 4.0
"""Metres on either side of a border over which the ground of one scene turns into the next's."""

_STEP = 0.25

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Leg:
    """A stretch of road through one scene, between two stations in metres."""

    scene: Scene
    start: float
    stop: float


class Road:
    """A smooth line through all scenes of a course.

    Stations are metres along the line, 0 where the drive starts; offsets are metres to its left.
    It stays within 70 degrees of the x axis and so never meets itself: each x belongs to one
    station. Each scene comes with the metres driven in it; the seed is that of bends and slopes.

    Attributes
    ----------
    legs : list of Leg
        The scenes along it; neighbours of one kind are one leg.
    length : float
        Metres of the drive.
    """

    def __init__(self, scenes: Sequence[tuple[Scene, float]], seed: int) -> None:
        self.seed = seed
        self.legs = _legs(scenes)
        self.length = self.legs[-1].stop - APRON
        stations = np.arange(self.legs[0].start, self.legs[-1].stop + _STEP, _STEP)
        rng = np.random.default_rng([seed, 1])
        winding = [(leg, leg.scene.winding, leg.scene.bend) for leg in self.legs]
        heading = _bends(winding, stations, rng)
        slope = _bends([(leg, leg.scene.slope, 35.0) for leg in self.legs], stations, rng)
        # No vehicle drives sharper: bends of a metre or two are rounded off.
        heading = gaussian_filter1d(heading, 2.0 / _STEP, mode="nearest")
        slope = gaussian_filter1d(slope, 4.0 / _STEP, mode="nearest")
        zero = int(np.searchsorted(stations, 0.0))
        line = np.stack([np.cos(heading), np.sin(heading), slope])
        steps = (line[:, 1:] + line[:, :-1]) * (_STEP / 2.0)
        line = np.hstack([np.zeros((3, 1)), np.cumsum(steps, axis=1)])
        self._x, self._y, self._z = line - line[:, zero : zero + 1]
        self._stations, self._heading = stations, heading

    def heading(self, s: Floats) -> Floats:
        """Radians from the x axis at each station."""
        return np.asarray(np.interp(s, self._stations, self._heading), np.float64)

    def height(self, s: Floats) -> Floats:
        """Metres above the start at each station."""
        return np.asarray(np.interp(s, self._stations, self._z), np.float64)

    def plane(self, s: Floats, d: Floats) -> tuple[Floats, Floats]:
        """Coordinates x and y of a station and an offset."""
        heading = self.heading(s)
        x = np.interp(s, self._stations, self._x) - d * np.sin(heading)
        y = np.interp(s, self._stations, self._y) + d * np.cos(heading)
        return x, y

    def station(self, x: Floats) -> Floats:
        """Station at which the line passes an x."""
        return np.asarray(np.interp(x, self._x, self._stations), np.float64)

    def shares(self, s: Floats) -> list[tuple[Leg, Floats]]:
        """Weight of each leg's scene at each station; the weights sum to one."""
        shares = []
        for leg in self.legs:
            first, last = leg is self.legs[0], leg is self.legs[-1]
            rise = np.ones_like(s) if first else _smooth((s - leg.start) / (2 * BLEND) + 0.5)
            fall = np.ones_like(s) if last else _smooth((leg.stop - s) / (2 * BLEND) + 0.5)
            shares.append((leg, rise * fall))
        return shares

    def ground(self, x: Floats, y: Floats) -> Floats:
        """Height of the ground, for coordinates of any one shape."""
        s = self.station(x)
        d = (y - np.interp(s, self._stations, self._y)) * np.cos(self.heading(s))
        spots = Spots(x, y, s, d)
        z = self.height(s)
        for leg, share in self.shares(s):
            if share.any():
                z = z + share * leg.scene.relief(spots, self.seed)
        return z


def _smooth(u: Floats) -> Floats:
    u = np.clip(u, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


def _legs(scenes: Sequence[tuple[Scene, float]]) -> list[Leg]:
    legs: list[Leg] = []
    start = -APRON
    stop = 0.0
    for scene, length in scenes:
        stop += length
        if legs and legs[-1].scene is scene:
            legs[-1] = Leg(scene, legs[-1].start, stop)
        else:
            legs.append(Leg(scene, start, stop))
        start = stop
    legs[-1] = Leg(legs[-1].scene, legs[-1].start, stop + APRON)
    return legs


def _bends(
    amplitudes: Sequence[tuple[Leg, float, float]], stations: Floats, rng: np.random.Generator
) -> Floats:
    """Wave to and fro by each leg's amplitude, turning back every so many metres."""
    nodes, values = [], []
    sign = 1.0
    s = stations[0]
    for leg, amplitude, spacing in amplitudes:
        while s < leg.stop:
            nodes.append(s)
            values.append(sign * amplitude * rng.uniform(0.4, 1.0))
            sign = -sign
            s += spacing * rng.uniform(0.8, 1.25)
    nodes.append(stations[-1] + 50.0)
    values.append(0.0)
    return np.asarray(PchipInterpolator(nodes, values)(stations), np.float64)
