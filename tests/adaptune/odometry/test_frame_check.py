"""References that contradict an odometry's motion, and honest odometries that are bad."""

import numpy as np
import pytest
from made_passes import chained
from rooms import moved

from adaptune.geometry import invert
from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.program import contradiction

N = 400


def integrated(lengths, degrees):
    """Poses of a drive by its steps and its turns about z."""
    T = np.tile(np.eye(4), (len(lengths) + 1, 1, 1))
    for i, (length, angle) in enumerate(zip(lengths, degrees, strict=True)):
        T[i + 1] = T[i] @ moved(length, yaw=np.radians(angle))
    return T


def yaw(degrees):
    return moved(yaw=np.radians(degrees))


def drive(speed):
    """Along a winding road, faster and slower."""
    i = np.arange(N)
    return integrated(speed * (1.5 + np.sin(i / 90.0)), 0.6 * speed / 0.1 * np.sin(i / 31.0))


def noisy(T, rng, metres, degrees):
    """The steps of an odometry that errs at random with every one."""
    steps = invert(T[:-1]) @ T[1:]
    steps[:, :3, 3] += rng.normal(0.0, metres, (len(steps), 3))
    turns = rng.normal(0.0, degrees, len(steps))
    return steps @ np.array([yaw(angle) for angle in turns])


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
CAMERA = np.eye(4)[[1, 2, 0, 3]]
WRONG = {
    "by about 90 degrees": lambda T: T @ yaw(90.0),
    "by about 30 degrees": lambda T: T @ yaw(-30.0),
    "by about 180 degrees": lambda T: T @ yaw(180.0),
    "turned by about": lambda T: CAMERA @ T @ invert(CAMERA),
    "reversed in time": lambda T: T[::-1],
    "looks mirrored": lambda T: MIRROR @ T @ MIRROR,
    "z axis points down": lambda T: DOWN @ T @ DOWN,
}


@pytest.mark.parametrize("speed", [0.02, 0.1, 1.0])
@pytest.mark.parametrize(("words", "spoil"), WRONG.items())
def test_what_a_wrong_reference_looks_like(speed, words, spoil):
    T_ref_sensor = drive(speed)
    rng = np.random.default_rng(0)
    T_odom_sensor = chained(noisy(T_ref_sensor, rng, 0.05 * speed, 0.02))
    assert contradiction(T_odom_sensor, T_ref_sensor) is None
    assert words in contradiction(T_odom_sensor, spoil(T_ref_sensor))
    # Where nothing is known nothing is said.
    assert contradiction(T_odom_sensor, np.full_like(T_ref_sensor, np.nan)) is None


def test_swapped_positions_are_told_though_orientations_fit():
    angles = np.full(N, 1.0)
    T_ref_sensor = integrated(np.full(N, 0.3), angles)
    swapped = T_ref_sensor.copy()
    swapped[:, :2, 3] = swapped[:, [1, 0], 3]
    found = contradiction(T_ref_sensor, swapped)
    assert "axes were swapped" in found


@pytest.mark.parametrize("seed", range(6))
def test_a_bad_odometry_is_not_the_references_fault(seed):
    rng = np.random.default_rng(seed)
    T_ref_sensor = drive(0.1)
    # So noisy that it goes anywhere, or lost on half of the way: it stands, runs on, or turns.
    wild = noisy(T_ref_sensor, rng, 0.3, 20.0)
    lost = noisy(T_ref_sensor, rng, 0.01, 0.1)
    for begin in range(50, N, 100):
        lost[begin : begin + 50] = yaw(5.0 * (seed % 2))
        lost[begin : begin + 50, 0, 3] = 0.2 * (seed % 3)
    for T_odom_sensor in (chained(wild), chained(lost)):
        assert np.nanmean(sub_trajectory_rte(T_ref_sensor, T_odom_sensor, 10.0)) > 10.0
        assert contradiction(T_odom_sensor, T_ref_sensor) is None
    assert contradiction(np.tile(np.eye(4), (N + 1, 1, 1)), T_ref_sensor) is None
