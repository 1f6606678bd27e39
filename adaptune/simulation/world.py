"""The world around a road, in tiles that are built and dropped along the drive."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from adaptune.geometry import Poses
from adaptune.simulation.course import Motion
from adaptune.simulation.mesh import Mesh, grid, merge
from adaptune.simulation.tiles import TILE, Scene, Spots, Tile, smooth

APRON = 40.0  # metres of world before the start and after the end of the drive
_BLEND = 4.0
"""Metres on either side of a border over which the ground of one scene turns into the next's."""
_STEP = 0.25

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Leg:
    """A segment of road through one scene, between two stations in metres."""

    scene: Scene
    start: float
    stop: float


class Road:
    """A smooth line through all scenes of a course.

    Stations are metres along the line, 0 where the drive starts; offsets are metres to its left.
    It stays within 70 degrees of the x axis and so never meets itself: each x belongs to one
    station. Each scene comes with the metres driven in it; neighbours of one kind are one leg.
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
            rise = np.ones_like(s) if first else smooth((s - leg.start) / (2 * _BLEND) + 0.5)
            fall = np.ones_like(s) if last else smooth((leg.stop - s) / (2 * _BLEND) + 0.5)
            shares.append((leg, rise * fall))
        return shares

    def ground(self, x: Floats, y: Floats) -> Floats:
        """Height of the ground, for coordinates of any one shape."""
        s = self.station(x)
        d = (y - np.interp(s, self._stations, self._y)) * np.cos(self.heading(s))
        spots = Spots(x, y, s, d)
        z = np.asarray(np.interp(s, self._stations, self._z), np.float64)
        for leg, share in self.shares(s):
            if share.any():
                z = z + share * leg.scene.relief(spots, self.seed)
        return z


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
        s = min(s, leg.start + spacing) if leg.scene.winds_at_once else s
        while s < leg.stop:
            nodes.append(s)
            values.append(sign * amplitude * rng.uniform(0.4, 1.0))
            sign = -sign
            s += spacing * rng.uniform(0.8, 1.25)
    nodes.append(stations[-1] + 50.0)
    values.append(0.0)
    return np.asarray(PchipInterpolator(nodes, values)(stations), np.float64)


_GROUND_CELL = 0.7  # metres between vertices of the ground near the road
_GROUND = 115.0  # metres of ground on either side of the road


def _offsets() -> NDArray[np.float64]:
    """Lay the ground's vertices across the road: dense near it, ever sparser beyond."""
    offsets = list(np.arange(0.0, 9.0, _GROUND_CELL))
    while offsets[-1] < _GROUND:
        offsets.append(offsets[-1] + max(_GROUND_CELL, 0.09 * offsets[-1]))
    return np.array([*(-x for x in reversed(offsets[1:])), *offsets])


class World:
    """All static objects along a road that rays can hit; only tiles in reach are kept.

    Every tile has its own random numbers and is always built the same.
    """

    def __init__(self, road: Road) -> None:
        self._road = road
        self._tiles: dict[int, Mesh] = {}
        self._last = int(np.floor((road.length + APRON) / TILE))

    def around(self, station: float, reach: float) -> Mesh:
        """Build the world within `reach` metres of a station, and drop the rest."""
        first = max(int(np.floor((station - reach) / TILE)), int(-APRON // TILE))
        last = min(int(np.floor((station + reach) / TILE)), self._last)
        wanted = range(first, last + 1)
        self._tiles = {i: self._tiles[i] if i in self._tiles else self._tile(i) for i in wanted}
        return merge(list(self._tiles.values()))

    def _tile(self, index: int) -> Mesh:
        road = self._road
        start, stop = index * TILE, (index + 1) * TILE
        meshes = [self._ground(start, stop)]
        for number, leg in enumerate(road.legs):
            first, last = max(start, leg.start), min(stop, leg.stop)
            # A sliver of a tile has no room for a scene's things.
            if last - first < 1e-6:
                continue
            tile = Tile(
                road=road,
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
        x = np.linspace(ends[0], ends[1], max(int((ends[1] - ends[0]) / _GROUND_CELL), 1) + 1)
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


_KNOTS = 50.0
"""Knots of the trajectory's spline in a second; nothing in it moves faster than a tenth of it."""
_SPEED_UP = 2.0  # seconds in which a vehicle that stood reaches its speed


class Ride:
    """The sensor's trajectory in continuous time, with its derivatives.

    One spline of fifth order through positions and roll, pitch and yaw contains the ground, the
    vehicle and its shake, so that poses, velocities and accelerations match exactly. It stands for
    some seconds first; `duration` is seconds until the end of the road's drive.
    """

    def __init__(self, road: Road, motion: Motion, seed: int, standstill: float = 0.0) -> None:
        rng = np.random.default_rng([seed, 2])
        s = np.arange(-10.0, road.length + 10.0, _STEP)
        lane = _lane(road, motion, s, rng)
        times = _schedule(road, motion, s, lane, rng)
        times -= np.interp(0.0, s, times)
        self.duration = float(np.interp(road.length, s, times))
        knots = np.arange(np.ceil(times[0] * _KNOTS), np.floor(times[-1] * _KNOTS)) / _KNOTS
        # Smoothed over a third of a second: no vehicle changes its acceleration at once.
        moves = np.ones_like(knots)
        if standstill:
            self.duration += standstill + _SPEED_UP / 2.0
            knots = np.arange(-_KNOTS, np.floor((self.duration + 1.0) * _KNOTS)) / _KNOTS
            since = np.maximum(knots - standstill, 0.0)
            moves = np.minimum(since / _SPEED_UP, 1.0)
            knots_of_drive = since - _SPEED_UP * (moves - 0.5 * moves**2)
            along = np.interp(knots_of_drive, times, s)
        else:
            along = np.interp(knots, times, s)
        along = gaussian_filter1d(along, 0.15 * _KNOTS, mode="reflect")
        values = np.stack([np.interp(along, s, column) for column in lane.T], axis=1)
        values = gaussian_filter1d(values, 0.1 * _KNOTS, axis=0, mode="nearest")
        roughness = sum(share * leg.scene.shake for leg, share in road.shares(along))
        shake = _shake(motion, knots, rng) * (roughness * moves)[:, None]
        # The mount shakes about its own axes; yaw turns what shakes along and across.
        yaw = values[:, 5]
        values[:, 0] += np.cos(yaw) * shake[:, 0] - np.sin(yaw) * shake[:, 1]
        values[:, 1] += np.sin(yaw) * shake[:, 0] + np.cos(yaw) * shake[:, 1]
        values[:, 2:] += shake[:, 2:]
        self._spline = make_interp_spline(knots, values, k=5)
        self._first, self._second = self._spline.derivative(1), self._spline.derivative(2)

    def poses(self, t: Floats) -> Poses:
        """Poses ``T_world_sensor`` of shape (n, 4, 4) at `t` seconds since the start."""
        values = self._spline(t)
        T = np.zeros((len(t), 4, 4))
        T[:, :3, :3] = _rotations(values[:, 3:])
        T[:, :3, 3] = values[:, :3]
        T[:, 3, 3] = 1.0
        return T

    def velocities(self, t: Floats) -> tuple[Floats, Floats]:
        """Velocity in the world (m/s) and angular velocity in the sensor's frame (rad/s)."""
        angles, rates = self._spline(t)[:, 3:], self._first(t)
        return rates[:, :3], _angular_velocity(angles, rates[:, 3:])

    def accelerations(self, t: Floats) -> tuple[Floats, Floats]:
        """Acceleration in the world (m/s^2) and angular acceleration in the sensor's frame."""
        angles, rates, second = self._spline(t)[:, 3:], self._first(t)[:, 3:], self._second(t)
        return second[:, :3], _angular_acceleration(angles, rates, second[:, 3:])


def _lane(road: Road, motion: Motion, s: Floats, rng: np.random.Generator) -> Floats:
    """Position and attitude, (n, 6), at each station of a vehicle that rolls over the ground."""
    stray = gaussian_filter1d(rng.normal(size=len(s)), 8.0 / _STEP, mode="nearest")
    stray *= motion.weave / max(float(stray.std()), 1e-9)
    x, y = road.plane(s, stray)
    length, width = motion.base
    side = width / 2.0 * np.stack([-np.sin(road.heading(s)), np.cos(road.heading(s))])
    left, right = road.ground(x + side[0], y + side[1]), road.ground(x - side[0], y - side[1])
    wheels = max(length / 2.0, 0.3) / _STEP
    left, right = gaussian_filter1d(left, wheels), gaussian_filter1d(right, wheels)
    z = (left + right) / 2.0
    yaw = np.unwrap(np.arctan2(np.gradient(y, s), np.gradient(x, s)))
    yaw = gaussian_filter1d(yaw, 1.0 / _STEP, mode="nearest")
    pitch = -np.arctan(np.gradient(z, s))
    roll = np.arctan2(left - right, width)
    # The sensor stands on a mast, upright on the vehicle.
    up = np.stack([np.sin(pitch), -np.sin(roll)]) * motion.height
    x = x + np.cos(yaw) * up[0] - np.sin(yaw) * up[1]
    y = y + np.sin(yaw) * up[0] + np.cos(yaw) * up[1]
    return np.stack([x, y, z + motion.height, roll, pitch, yaw], axis=1)


def _schedule(
    road: Road, motion: Motion, s: Floats, lane: Floats, rng: np.random.Generator
) -> Floats:
    """Seconds at each station, within the vehicle's speed, acceleration and turning."""
    swing = gaussian_filter1d(rng.normal(size=len(s)), 12.0 / _STEP, mode="nearest")
    swing *= 0.1 / max(float(swing.std()), 1e-9)
    pace = sum(share * leg.scene.pace for leg, share in road.shares(s))
    curvature = np.abs(np.gradient(gaussian_filter1d(lane[:, 5], 1.0 / _STEP), s))
    bends = np.sqrt(motion.turning / np.maximum(curvature, 1e-6))
    speed = np.minimum(motion.speed * pace * np.clip(1.0 + swing, 0.7, 1.3), bends)
    gain = 2.0 * motion.acceleration * _STEP
    for i in range(1, len(s)):
        speed[i] = min(speed[i], np.sqrt(speed[i - 1] ** 2 + gain))
    for i in range(len(s) - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + gain))
    seconds = _STEP * 2.0 / (speed[1:] + speed[:-1])
    return np.concatenate([[0.0], np.cumsum(seconds)])


def _shake(motion: Motion, t: Floats, rng: np.random.Generator) -> Floats:
    """Sum sinusoids within the band to the wanted deviation, of shape (n, 6)."""
    waves = 24
    deviation = np.array([*motion.shift, *motion.turn])
    frequency = rng.uniform(*motion.band, (waves, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, (waves, 6))
    # Lower frequencies swing further, as masses on springs do.
    weight = 1.0 / frequency**2
    weight *= deviation * np.sqrt(2.0 / np.sum(weight**2, axis=0))
    shake = np.zeros((len(t), 6))
    for f, p, w in zip(frequency, phase, weight, strict=True):
        shake += w * np.sin(2.0 * np.pi * f * t[:, None] + p)
    return shake


def _rotations(angles: Floats) -> Floats:
    """Rotation matrices of roll, pitch and yaw of shape (n, 3), applied in this order."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles).T, np.cos(angles).T
    R = np.empty((len(angles), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = -sp, cp * sr, cp * cr
    return R


def _angular_velocity(angles: Floats, rates: Floats) -> Floats:
    (sr, sp), (cr, cp) = np.sin(angles[:, :2]).T, np.cos(angles[:, :2]).T
    d_roll, d_pitch, d_yaw = rates.T
    x = d_roll - d_yaw * sp
    y = d_pitch * cr + d_yaw * sr * cp
    return np.stack([x, y, -d_pitch * sr + d_yaw * cr * cp], axis=1)


def _angular_acceleration(angles: Floats, rates: Floats, second: Floats) -> Floats:
    (sr, sp), (cr, cp) = np.sin(angles[:, :2]).T, np.cos(angles[:, :2]).T
    d_roll, d_pitch, d_yaw = rates.T
    dd_roll, dd_pitch, dd_yaw = second.T
    x = dd_roll - dd_yaw * sp - d_yaw * d_pitch * cp
    y = dd_pitch * cr - d_pitch * d_roll * sr + dd_yaw * sr * cp
    y = y + d_yaw * d_roll * cr * cp - d_yaw * d_pitch * sr * sp
    z = -dd_pitch * sr - d_pitch * d_roll * cr + dd_yaw * cr * cp
    z = z - d_yaw * d_roll * sr * cp - d_yaw * d_pitch * cr * sp
    return np.stack([x, y, z], axis=1)
