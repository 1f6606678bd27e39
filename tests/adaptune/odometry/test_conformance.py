"""What every odometry must do to be tuned, one suite for all of them.

Run as a program, it prints digests of the poses of two instances of one odometry on one core.
"""

import hashlib
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from adaptune import cores
from adaptune.geometry import invert
from adaptune.odometry import BOXES, OdometryError, box_class
from adaptune.odometry.base import prepared_bytes
from adaptune.sequence import Scan

STEP = 0.4
"""Metres between scans."""
N_SCANS = 16

CLEAN = [name for name in BOXES if box_class(name).clean]
"""Those that live in this process; test_evalio.py holds what the others must do."""

every_box = pytest.mark.parametrize("name", CLEAN)


@cache
def street():
    """Points of a ground, two walls and poles along x, of shape (n, 3)."""
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, (9000, 2))
    ground = np.c_[45 * u[:3000, 0], 9 * u[:3000, 1], np.full(3000, -1.7)]
    walls = np.c_[45 * u[3000:, 0], 9 * rng.choice([-1, 1], 6000), 2 + 4 * u[3000:, 1]]
    at = rng.uniform((-35, -8), (45, 8), (16, 2))[rng.integers(0, 16, 3500)]
    around = rng.uniform(0, 2 * np.pi, 3500)
    poles = np.c_[
        at[:, 0] + 0.3 * np.cos(around), at[:, 1] + 0.3 * np.sin(around), rng.uniform(-1.7, 3, 3500)
    ]
    return np.concatenate([ground, walls, poles])


@cache
def scan(i):
    """Scan `i` of a drive straight ahead."""
    rng = np.random.default_rng(i)
    points = street()[rng.random(len(street())) < 0.5] - [STEP * i, 0.0, 0.0]
    points += rng.normal(0, 0.01, points.shape)
    return Scan(i * 10**8, points.astype(np.float32))


def poor_scan(n, i=0):
    """A scan of `n` points all over the place, in the place of scan `i`."""
    points = np.random.default_rng(n).uniform(2.0, 9.0, (n, 3))
    return Scan(i * 10**8, points.astype(np.float32))


@cache
def prepared_drive(name):
    box = box_class(name)()
    return [box.prepare(scan(i)) for i in range(N_SCANS)]


def drive(box, prepared, T_odom_sensor=None):
    """Start with the first scan and register the others; poses of shape (n, 4, 4)."""
    T = np.eye(4) if T_odom_sensor is None else T_odom_sensor
    box.start(prepared[0], T)
    return np.array([T, *(box.register(p).T_odom_sensor for p in prepared[1:])])


@cache
def usual_drive(name):
    return drive(box_class(name)(), prepared_drive(name))


def assert_rigid(T):
    assert T.dtype == np.float64
    assert T.shape[-2:] == (4, 4)
    R = T[..., :3, :3]
    np.testing.assert_allclose(
        R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9
    )
    np.testing.assert_array_equal(T[..., 3, :], np.broadcast_to([0, 0, 0, 1], T[..., 3, :].shape))


@every_box
def test_begins_at_the_identity(name):
    first = prepared_drive(name)[0]
    box = box_class(name)()
    box.start(first, np.eye(4))
    T_odom_sensor, registered = box.register(first)
    assert registered
    np.testing.assert_allclose(T_odom_sensor, np.eye(4), atol=1e-2)


@every_box
def test_straight_ahead_is_along_x(name):
    box = box_class(name)()
    prepared = prepared_drive(name)
    box.start(prepared[0], np.eye(4))
    registrations = [box.register(p) for p in prepared[1:]]
    assert all(r.registered for r in registrations)
    T = np.array([r.T_odom_sensor for r in registrations])
    assert_rigid(T)
    np.testing.assert_allclose(T[:, 0, 3], STEP * np.arange(1, N_SCANS), atol=0.1)
    np.testing.assert_allclose(T[:, 1:3, 3], 0.0, atol=0.03)
    np.testing.assert_allclose(T[:, :3, :3], np.tile(np.eye(3), (len(T), 1, 1)), atol=0.01)


@every_box
def test_the_same_scans_give_the_same_bytes_on_one_core(name):
    # A process of its own: threads that Open3D has already started would not be pinned.
    done = subprocess.run(
        [sys.executable, __file__, name], capture_output=True, text=True, check=True
    )
    first, second = done.stdout.split()
    assert first == second


def digests(name):
    cores.pin(0)
    for _ in range(2):
        poses = drive(box_class(name)(), prepared_drive(name))
        sys.stdout.write(hashlib.sha256(poses.tobytes()).hexdigest() + "\n")


@every_box
def test_a_second_instance_is_fresh(name):
    prepared = prepared_drive(name)
    first, second = box_class(name)(), box_class(name)()
    drive(first, prepared[:8])
    np.testing.assert_allclose(drive(second, prepared), usual_drive(name), atol=1e-6)


@every_box
def test_two_instances_side_by_side_do_not_meet(name):
    prepared = prepared_drive(name)
    there, back = box_class(name)(), box_class(name)()
    there.start(prepared[0], np.eye(4))
    back.start(prepared[-1], np.eye(4))
    for i in range(1, N_SCANS):
        T_there = there.register(prepared[i]).T_odom_sensor
        T_back = back.register(prepared[-1 - i]).T_odom_sensor
    np.testing.assert_allclose(T_there, usual_drive(name)[-1], atol=1e-6)
    assert T_back[0, 3] == pytest.approx(-STEP * (N_SCANS - 1), abs=0.1)


@every_box
def test_start_forgets_all_before(name):
    prepared = prepared_drive(name)
    box = box_class(name)()
    drive(box, prepared[::-1])
    np.testing.assert_allclose(drive(box, prepared), usual_drive(name), atol=1e-6)


@every_box
def test_where_it_starts_does_not_matter(name):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.2, -0.3]).as_matrix()
    T[:3, 3] = 20.0, -30.0, 4.0
    before = T.copy()
    poses = drive(box_class(name)(), prepared_drive(name), T)
    np.testing.assert_array_equal(T, before)
    np.testing.assert_allclose(invert(T) @ poses, usual_drive(name), atol=0.02)


@every_box
def test_it_goes_on_from_a_pose_and_a_motion(name):
    prepared = prepared_drive(name)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", np.pi / 2).as_matrix()
    T[:3, 3] = 5.0, 6.0, 7.0
    T_previous_current = np.eye(4)
    T_previous_current[0, 3] = STEP
    box = box_class(name)()
    box.start(prepared[4], T, T_previous_current)
    # With nothing to register, the motion it was given goes on.
    T_next, registered = box.register(box.prepare(poor_scan(0, 5)))
    assert not registered
    np.testing.assert_allclose(T_next, T @ T_previous_current, atol=1e-9)
    for i in range(6, N_SCANS):
        T_next = box.register(prepared[i]).T_odom_sensor
        np.testing.assert_allclose(T_next[:3, 3], [5.0, 6.0 + STEP * (i - 4), 7.0], atol=0.1)


@every_box
def test_without_a_motion_it_stood_still(name):
    box = box_class(name)()
    box.start(prepared_drive(name)[0], np.eye(4))
    T_odom_sensor, registered = box.register(box.prepare(poor_scan(3)))
    assert not registered
    np.testing.assert_allclose(T_odom_sensor, np.eye(4), atol=1e-12)


@every_box
@pytest.mark.parametrize("n", [0, 1, 4, 19])
def test_a_poor_scan_keeps_the_last_motion(name, n):
    prepared = prepared_drive(name)
    box = box_class(name)()
    T_before, T = drive(box, prepared[:6])[-2:]
    for i in (6, 7):
        T_next, registered = box.register(box.prepare(poor_scan(n, i)))
        assert not registered
        np.testing.assert_allclose(T_next, T @ invert(T_before) @ T, atol=1e-6)
        T_before, T = T, T_next
    for i in range(8, N_SCANS):
        T_next, registered = box.register(prepared[i])
        assert registered
        np.testing.assert_allclose(T_next[:3, 3], [STEP * i, 0, 0], atol=0.1)


@every_box
@pytest.mark.parametrize("n", [0, 5, 19])
def test_a_poor_first_scan(name, n):
    prepared = prepared_drive(name)
    box = box_class(name)()
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    box.start(box.prepare(poor_scan(n)), T)
    poses = np.array([box.register(p).T_odom_sensor for p in prepared])
    assert_rigid(poses)
    np.testing.assert_allclose(poses[0], T, atol=1e-9)
    way = poses[:, :3, 3] - T[:3, 3]
    np.testing.assert_allclose(way[:, 0], STEP * np.arange(N_SCANS), atol=0.1)
    np.testing.assert_allclose(way[:, 1:], 0.0, atol=0.05)


@every_box
@pytest.mark.parametrize("scale", [0.005, 1e4], ids=["near", "far"])
def test_points_that_are_all_too_near_or_too_far_make_a_poor_scan(name, scale):
    box = box_class(name)()
    T_before, T = drive(box, prepared_drive(name)[:6])[-2:]
    points = scan(6).points * np.float32(scale)
    T_next, registered = box.register(box.prepare(Scan(scan(6).stamp, points)))
    assert not registered
    np.testing.assert_allclose(T_next, T @ invert(T_before) @ T, atol=1e-6)


@every_box
@pytest.mark.parametrize("n", [26, 32, 36])
def test_a_scan_that_stays_where_it_was_predicted_is_counted(name, n):
    box = box_class(name)()
    T_before, T = drive(box, prepared_drive(name)[:6])[-2:]
    T_next, registered = box.register(box.prepare(poor_scan(n, 6)))
    if np.allclose(T_next, T @ invert(T_before) @ T, atol=1e-9):
        assert not registered


@every_box
def test_prepared_scans_say_what_they_take(name):
    box, points = box_class(name)(), np.random.default_rng(0).uniform(-50, 50, (200_000, 3))
    times = np.linspace(0, 0.1, len(points), dtype=np.float32)
    prepared = box.prepare(Scan(0, points.astype(np.float32), times))
    cloud = getattr(prepared, "cloud", prepared).points
    held = np.asarray(cloud() if callable(cloud) else cloud).nbytes
    assert prepared_bytes(prepared) >= 0.9 * held > 1e5


def parameter_cases():
    return [(name, parameter) for name in CLEAN for parameter in box_class(name).space.names]


@pytest.mark.parametrize(("name", "parameter"), parameter_cases())
def test_every_parameter_takes_effect(name, parameter):
    cls = box_class(name)
    low, high = (
        drive(cls({parameter: cls.space.parameters[parameter].from_unit(u)}), prepared_drive(name))
        for u in (0.0, 1.0)
    )
    assert np.abs(low - high).max() > 1e-5


@every_box
def test_parameters_not_given_keep_their_baseline(name):
    cls = box_class(name)
    first = cls.space.names[0]
    given = {first: cls.space.parameters[first].from_unit(0.9)}
    box = cls(given)
    assert box.parameters == cls.space.baseline | given
    assert cls().parameters == cls.space.baseline
    cls.space.check(box.parameters)
    if cls.live:
        box.configure({first: cls.space.parameters[first].from_unit(0.1)})
    assert given == {first: cls.space.parameters[first].from_unit(0.9)}
    assert cls().parameters == cls.space.baseline


@every_box
def test_the_same_parameters_again_change_nothing(name):
    cls, prepared = box_class(name), prepared_drive(name)
    if not cls.live:
        return
    box = cls()
    box.start(prepared[0], np.eye(4))
    poses = [np.eye(4)]
    for p in prepared[1:]:
        box.configure(dict(box.parameters))
        poses.append(box.register(p).T_odom_sensor)
    np.testing.assert_allclose(poses, usual_drive(name), atol=1e-6)


@every_box
def test_parameters_change_between_scans_or_not_at_all(name):
    cls, prepared = box_class(name), prepared_drive(name)
    other = cls.space.from_unit(np.zeros((1, len(cls.space))))[0]
    box = cls()
    T = drive(box, prepared[:6])[-1]
    if not cls.live:
        with pytest.raises(OdometryError, match=cls.__name__):
            box.configure(other)
        assert box.parameters == cls.space.baseline
        return
    box.configure(other)
    assert box.parameters == other
    poses = np.array([box.register(p).T_odom_sensor for p in prepared[6:]])
    # From here on it is another odometry, at the same place.
    assert np.abs(poses - usual_drive(name)[6:]).max() > 1e-5
    assert np.linalg.norm(poses[0, :3, 3] - T[:3, 3] - [STEP, 0, 0]) < 0.2
    # What is given before the start is as if given to a new instance.
    early = cls()
    early.configure(other)
    np.testing.assert_allclose(drive(early, prepared), drive(cls(other), prepared), atol=1e-6)


@every_box
def test_preparing_leaves_the_scan_and_serves_all_instances(name):
    cls = box_class(name)
    points = scan(0).points.copy()
    times = np.linspace(0.0, 0.09, len(points), dtype=np.float32)
    before = points.copy(), times.copy()
    prepared = [cls().prepare(Scan(0, points, times)), *prepared_drive(name)[1:6]]
    first = drive(cls(), prepared)
    np.testing.assert_allclose(drive(cls(), prepared), first, atol=1e-6)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(times, before[1])
    assert prepared_bytes(prepared[0]) > 0


@every_box
def test_settings_that_do_not_exist_are_refused(name):
    with pytest.raises(ValidationError, match="donwsampling"):
        box_class(name).settings_type(donwsampling=0.5)


@pytest.mark.parametrize(
    ("name", "help_"), [("gipc", "did you mean 'gicp'"), ("zzz", "'gicp', 'kiss_icp'.*'ndt'")]
)
def test_an_odometry_that_does_not_exist(name, help_):
    with pytest.raises(OdometryError, match=help_):
        box_class(name)


if __name__ == "__main__":
    digests(sys.argv[1])
