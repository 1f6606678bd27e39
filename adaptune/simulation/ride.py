"""The sensor's true trajectory in continuous time."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from adaptune.geometry import Poses
from adaptune.simulation.motions import Motion
from adaptune.simulation.road import Road

Floats = NDArray[np.float64]

_KNOTS = 50.0
"""Knots of the trajectory's spline in a second; nothing in it moves faster than a tenth of it."""

_STEP = 0.25


class Ride:
    """The sensor's trajectory in continuous time, with its derivatives.

    One spline of fifth order through positions and roll, pitch and yaw contains the ground, the
    vehicle and its shake. Poses, velocities and accelerations thus match exactly. The seed is that
    of its straying, its speed and its shake.

    Attributes
    ----------
    duration : float
        Seconds until the end of the road's drive.
    """

    def __init__(self, road: Road, motion: Motion, seed: int) -> None:
        rng = np.random.default_rng([seed, 2])
        s = np.arange(-10.0, road.length + 10.0, _STEP)
        lane = _lane(road, motion, s, rng)
        times = _schedule(road, motion, s, lane, rng)
        times -= np.interp(0.0, s, times)
        self.duration = float(np.interp(road.length, s, times))
        knots = np.arange(np.ceil(times[0] * _KNOTS), np.floor(times[-1] * _KNOTS)) / _KNOTS
        # Smoothed over a third of a second: no vehicle changes its acceleration at once.
        along = gaussian_filter1d(np.interp(knots, times, s), 0.15 * _KNOTS, mode="reflect")
        values = np.stack([np.interp(along, s, column) for column in lane.T], axis=1)
        values = gaussian_filter1d(values, 0.1 * _KNOTS, axis=0, mode="nearest")
        roughness = np.zeros_like(along)
        for leg, share in road.shares(along):
            roughness += share * leg.scene.shake
        shake = _shake(motion, knots, rng) * roughness[:, None]
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
    pace = np.zeros_like(s)
    for leg, share in road.shares(s):
        pace += share * leg.scene.pace
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
    """Differentiate `_angular_velocity`."""
    (sr, sp), (cr, cp) = np.sin(angles[:, :2]).T, np.cos(angles[:, :2]).T
    d_roll, d_pitch, d_yaw = rates.T
    dd_roll, dd_pitch, dd_yaw = second.T
    x = dd_roll - dd_yaw * sp - d_yaw * d_pitch * cp
    y = dd_pitch * cr - d_pitch * d_roll * sr + dd_yaw * sr * cp
    y = y + d_yaw * d_roll * cr * cp - d_yaw * d_pitch * sr * sp
    z = -dd_pitch * sr - d_pitch * d_roll * cr + dd_yaw * cr * cp
    z = z - d_yaw * d_roll * sr * cp - d_yaw * d_pitch * cr * sp
    return np.stack([x, y, z], axis=1)
