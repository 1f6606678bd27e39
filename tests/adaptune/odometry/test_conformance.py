"""What every odometry must do to be tuned, one suite for all of them.

Run as a program, it prints digests of the poses of two instances of each odometry on one core.
"""

import hashlib
import os
import subprocess
import sys
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from rooms import moved
from scipy.spatial.transform import Rotation
from street import (
    LOCKSTEP,
    N_SCANS,
    STEP,
    drive,
    is_live,
    make,
    poor_scan,
    prepared_drive,
    scan,
    space_of,
    usual_drive,
)

from adaptune._system import machine
from adaptune.geometry import invert
from adaptune.odometry import OdometryError
from adaptune.odometry.prepared import prepared_bytes
from adaptune.odometry.registry import CONTAINERS, ODOMETRIES, PROGRAMS, odometry_class
from adaptune.recording import Scan
from adaptune.space import Selection

CLEAN = [name for name in ODOMETRIES if odometry_class(name).clean]
"""Those that live in this process; test_conformance_isolated.py holds what the others must do."""

# Programs are reached in many ways, but what they do is theirs.
programs = [
    pytest.param(name, marks=pytest.mark.services) if name in CONTAINERS else name
    for name in PROGRAMS
    if name != "ros2"
]
in_lockstep = [pytest.param(name, marks=pytest.mark.services) for name in (LOCKSTEP, "ros2")]
every_odometry = pytest.mark.parametrize("name", [*CLEAN, *programs, *in_lockstep])

# A node's clock does not go back; test_lockstep.py holds more of it.
but_lockstep = pytest.mark.parametrize("name", [*CLEAN, *programs])

in_python = pytest.mark.parametrize("name", CLEAN)


def assert_rigid(T):
    assert T.dtype == np.float64
    assert T.shape[-2:] == (4, 4)
    R = T[..., :3, :3]
    np.testing.assert_allclose(
        R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9
    )
    np.testing.assert_array_equal(T[..., 3, :], np.broadcast_to([0, 0, 0, 1], T[..., 3, :].shape))


@every_odometry
def test_begins_at_the_identity(name):
    first = prepared_drive(name)[0]
    odometry = make(name)
    odometry.start(first, np.eye(4))
    T_odom_sensor, registered = odometry.register(first)
    assert registered
    np.testing.assert_allclose(T_odom_sensor, np.eye(4), atol=1e-2)


@every_odometry
def test_straight_ahead_is_along_x(name):
    odometry = make(name)
    prepared = prepared_drive(name)
    odometry.start(prepared[0], np.eye(4))
    registrations = [odometry.register(p) for p in prepared[1:]]
    assert all(r.registered for r in registrations)
    T = np.array([r.T_odom_sensor for r in registrations])
    assert_rigid(T)
    np.testing.assert_allclose(T[:, 0, 3], STEP * np.arange(1, N_SCANS), atol=0.1)
    np.testing.assert_allclose(T[:, 1:3, 3], 0.0, atol=0.03)
    np.testing.assert_allclose(T[:, :3, :3], np.tile(np.eye(3), (len(T), 1, 1)), atol=0.01)


@cache
def digests():
    """Of every odometry, the digests of the poses of two instances on one core."""
    # A process of its own: threads that Open3D has already started would not be pinned.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, __file__], capture_output=True, text=True, check=True, env=environment
    )
    return {name: found for name, *found in map(str.split, done.stdout.splitlines())}


@in_python
def test_the_same_scans_give_the_same_bytes_on_one_core(name):
    first, second = digests()[name]
    assert first == second


def print_digests():
    machine.pin(0)
    for name in CLEAN:
        poses = [drive(make(name), prepared_drive(name)) for _ in range(2)]
        found = (hashlib.sha256(of_one.tobytes()).hexdigest() for of_one in poses)
        sys.stdout.write(f"{name} {' '.join(found)}\n")


@but_lockstep
def test_a_second_instance_is_fresh(name):
    prepared = prepared_drive(name)
    first, second = make(name), make(name)
    drive(first, prepared[:8])
    np.testing.assert_allclose(drive(second, prepared), usual_drive(name), atol=1e-6)
    # So is the first, when it starts again.
    if name in CLEAN:
        np.testing.assert_allclose(drive(first, prepared), usual_drive(name), atol=1e-6)


@in_python
def test_two_instances_side_by_side_do_not_meet(name):
    prepared = prepared_drive(name)
    there, back = make(name), make(name)
    there.start(prepared[0], np.eye(4))
    back.start(prepared[-1], np.eye(4))
    for i in range(1, N_SCANS):
        T_there = there.register(prepared[i]).T_odom_sensor
        T_back = back.register(prepared[-1 - i]).T_odom_sensor
    np.testing.assert_allclose(T_there, usual_drive(name)[-1], atol=1e-6)
    assert T_back[0, 3] == pytest.approx(-STEP * (N_SCANS - 1), abs=0.1)


@every_odometry
def test_where_it_starts_does_not_matter(name):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.2, -0.3]).as_matrix()
    T[:3, 3] = 20.0, -30.0, 4.0
    before = T.copy()
    poses = drive(make(name), prepared_drive(name), T)
    np.testing.assert_array_equal(T, before)
    np.testing.assert_allclose(invert(T) @ poses, usual_drive(name), atol=0.02)


@in_python
def test_it_goes_on_from_a_pose_and_a_motion(name):
    prepared = prepared_drive(name)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", np.pi / 2).as_matrix()
    T[:3, 3] = 5.0, 6.0, 7.0
    T_previous_current = moved(STEP)
    odometry = make(name)
    odometry.start(prepared[4], T, T_previous_current)
    # With nothing to register, the motion it was given goes on.
    T_next, registered = odometry.register(odometry.prepare(poor_scan(0, 5)))
    assert not registered
    np.testing.assert_allclose(T_next, T @ T_previous_current, atol=1e-9)
    for i in range(6, N_SCANS):
        T_next = odometry.register(prepared[i]).T_odom_sensor
        np.testing.assert_allclose(T_next[:3, 3], [5.0, 6.0 + STEP * (i - 4), 7.0], atol=0.1)


@in_python
def test_without_a_motion_it_stood_still(name):
    odometry = make(name)
    odometry.start(prepared_drive(name)[0], np.eye(4))
    T_odom_sensor, registered = odometry.register(odometry.prepare(poor_scan(3)))
    assert not registered
    np.testing.assert_allclose(T_odom_sensor, np.eye(4), atol=1e-12)


@in_python
@pytest.mark.parametrize("n", [0, 1, 4, 19, "NaN", "near", "far"])
def test_a_poor_scan_keeps_the_last_motion(name, n):
    prepared = prepared_drive(name)
    odometry = make(name)
    T_before, T = drive(odometry, prepared[:6])[-2:]
    for i in (6, 7):
        T_next, registered = odometry.register(odometry.prepare(poor_scan(n, i)))
        assert not registered
        np.testing.assert_allclose(T_next, T @ invert(T_before) @ T, atol=1e-6)
        T_before, T = T, T_next
    for i in range(8, N_SCANS):
        T_next, registered = odometry.register(prepared[i])
        # A keyframe may have begun with points that are far away.
        assert registered or (n == "far" and i == 8)
        np.testing.assert_allclose(T_next[:3, 3], [STEP * i, 0, 0], atol=0.1)


@in_python
@pytest.mark.parametrize("n", [0, 5, 19])
def test_a_poor_first_scan(name, n):
    prepared = prepared_drive(name)
    odometry = make(name)
    T = moved(1.0, 2.0, 3.0)
    odometry.start(odometry.prepare(poor_scan(n)), T)
    poses = np.array([odometry.register(p).T_odom_sensor for p in prepared])
    assert_rigid(poses)
    np.testing.assert_allclose(poses[0], T, atol=1e-9)
    way = poses[:, :3, 3] - T[:3, 3]
    np.testing.assert_allclose(way[:, 0], STEP * np.arange(N_SCANS), atol=0.1)
    np.testing.assert_allclose(way[:, 1:], 0.0, atol=0.05)


@in_python
def test_prepared_scans_say_what_they_take(name):
    odometry, points = make(name), np.random.default_rng(0).uniform(-50, 50, (200_000, 3))
    times = np.linspace(0, 0.1, len(points), dtype=np.float32)
    prepared = odometry.prepare(Scan(0, points.astype(np.float32), times))
    cloud = getattr(prepared, "cloud", prepared).points
    held = np.asarray(cloud() if callable(cloud) else cloud).nbytes
    assert prepared_bytes(prepared) >= 0.9 * held > 1e5


class Mine(NamedTuple):
    ranges: np.ndarray
    rings: list
    gain: float = 0.5
    frame: str = "lidar"
    stamp: int = 1_700_000_000_000_000_000


@pytest.mark.parametrize(
    ("prepared", "at_least", "at_most"),
    [
        (Mine(np.zeros(300), [np.zeros(10), 2]), 2480, 3000),
        ({"ranges": np.zeros(300), "note": b"none"}, 2400, 2600),
        (np.zeros(300), 2400, 2400),
        ((1, 2.0, "three", None), 4, 500),
        (object(), 1e6, 1e6),
    ],
)
def test_plain_values_count_little_in_prepared_scans(prepared, at_least, at_most):
    assert at_least <= prepared_bytes(prepared) <= at_most


def parameter_cases():
    cases = [(name, parameter) for name in CLEAN for parameter in odometry_class(name).space.names]
    # Tests of their own compare whole runs in containers with those of this process.
    return [*cases, *((name, space_of(name).names[0]) for name in ("process", "command"))]


@pytest.mark.parametrize(("name", "parameter"), parameter_cases())
def test_every_parameter_takes_effect(name, parameter):
    one = space_of(name).parameters[parameter]
    # Each prepares for itself: what it prepares may depend on the parameter.
    both = [make(name, {parameter: one.from_unit(u)}) for u in (0.0, 1.0)]
    low, high = (drive(o, [o.prepare(scan(i)) for i in range(N_SCANS)]) for o in both)
    assert np.abs(low - high).max() > 1e-5


@in_python
def test_parameters_not_given_keep_their_baseline(name):
    cls = odometry_class(name)
    first = cls.space.names[0]
    given = {first: cls.space.parameters[first].from_unit(0.9)}
    odometry = cls(given)
    assert odometry.parameters == cls.space.baseline | given
    assert cls().parameters == cls.space.baseline
    cls.space.check(odometry.parameters)
    odometry.configure({first: cls.space.parameters[first].from_unit(0.1)})
    assert given == {first: cls.space.parameters[first].from_unit(0.9)}
    assert cls().parameters == cls.space.baseline


@in_python
def test_the_same_parameters_again_change_nothing(name):
    prepared = prepared_drive(name)
    odometry = make(name, space_of(name).baseline)
    odometry.start(prepared[0], np.eye(4))
    poses = [np.eye(4)]
    for p in prepared[1:]:
        odometry.apply(Selection(0, space_of(name).baseline))
        poses.append(odometry.register(p).T_odom_sensor)
    np.testing.assert_allclose(poses, usual_drive(name), atol=1e-6)


@in_python
def test_parameters_change_between_scans(name):
    space, prepared = space_of(name), prepared_drive(name)
    (other,) = space.from_unit(np.zeros((1, len(space))))
    odometry = make(name, space.baseline)
    T = drive(odometry, prepared[:6])[-1]
    odometry.apply(Selection(0, other))
    assert odometry.odometry.parameters == other
    poses = np.array([odometry.register(p).T_odom_sensor for p in prepared[6:]])
    # From here on it is another odometry, at the same place.
    assert np.abs(poses - usual_drive(name)[6:]).max() > 1e-5
    assert np.linalg.norm(poses[0, :3, 3] - T[:3, 3] - [STEP, 0, 0]) < 0.2
    # What is given before the start is as if given to a new instance.
    early = make(name)
    early.apply(Selection(0, other))
    np.testing.assert_allclose(
        drive(early, prepared), drive(make(name, other), prepared), atol=1e-6
    )


@in_python
def test_preparing_leaves_the_scan_and_serves_all_instances(name):
    points = scan(0).points.copy()
    times = np.linspace(0.0, 0.09, len(points), dtype=np.float32)
    before = points.copy(), times.copy()
    prepared = [make(name).prepare(Scan(scan(0).stamp, points, times)), *prepared_drive(name)[1:6]]
    first = drive(make(name), prepared)
    np.testing.assert_allclose(drive(make(name), prepared), first, atol=1e-6)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(times, before[1])


@every_odometry
def test_parameters_that_do_not_exist_are_refused(name):
    words = "voxl: (no argument holds|(params|icp).yaml has no)|has no parameter 'voxl'"
    with pytest.raises(OdometryError, match=words):  # noqa: PT012 - a program is asked at its start
        odometry = make(name, space_of(name).baseline | {"voxl": 1.0})
        odometry.start(prepared_drive(name)[0], np.eye(4))
    if is_live(name):
        odometry = make(name)
        odometry.start(prepared_drive(name)[0], np.eye(4))
        with pytest.raises(OdometryError, match="has no parameter 'voxl'"):
            odometry.apply(Selection(0, {"voxl": 1.0}))


if __name__ == "__main__":
    print_digests()
