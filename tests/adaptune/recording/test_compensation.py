import numpy as np
import pytest
import rec
from scipy.spatial.transform import Rotation

from adaptune import geometry
from adaptune.recording import Imu, Scan, SequenceConfig, SequenceError
from adaptune.recording.compensation import clock_offset, compensate, compensate_neighbours
from adaptune.recording.recording import open_sequence
from adaptune.trajectory import Trajectory

TWIST = np.array([3.0, 0.5, -0.2, 0.3, -0.2, 1.5])
"""Metres and radians a second."""


def motion(twist, seconds=0.1):
    """How far a velocity and a rate lead in a time."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(twist[3:] * seconds).as_matrix(), twist[:3] * seconds
    return T


def test_constant_velocity_is_undone():
    world = np.random.default_rng(0).normal(0, 20, (500, 3))
    scan = drive_through(world, 10**18, np.eye(4), TWIST)
    assert np.abs(scan.points - world).max() > 1
    compensated = compensate(scan, motion(TWIST, 0.2), 0.2)
    np.testing.assert_allclose(compensated.points, world, atol=1e-4)


def test_a_scan_without_times_stays_as_it_is():
    timeless = Scan(1, np.ones((5, 3), np.float32))
    assert compensate(timeless, np.eye(4), 0.1) is timeless


def room(rng, n=1500):
    """Points on the walls, the floor and a few pillars, of shape (n, 3)."""
    points = rng.uniform(-1, 1, (n, 3)) * (12, 8, 2)
    side = rng.integers(0, 5, n)
    points[side == 0, 0] = rng.choice([-12, 12], np.count_nonzero(side == 0))
    points[side == 1, 1] = rng.choice([-8, 8], np.count_nonzero(side == 1))
    points[side == 2, 2] = -2
    pillars = np.flatnonzero(side > 2)
    angle = rng.uniform(0, 2 * np.pi, len(pillars))
    middle = np.array([(5, 3), (-6, 4), (-3, -5), (8, -4)])[rng.integers(0, 4, len(pillars))]
    points[pillars, 0] = middle[:, 0] + 0.5 * np.cos(angle)
    points[pillars, 1] = middle[:, 1] + 0.5 * np.sin(angle)
    return points


def drive_through(room_, stamp, T, twist):
    """A scan of 0.1 s that begins at a pose, in a motion of constant velocity in its own frame."""
    times = np.linspace(0, 0.1, len(room_)).astype(np.float32)
    seen = (room_ - T[:3, 3]) @ T[:3, :3] - times[:, None] * twist[:3]
    points = Rotation.from_rotvec(times[:, None] * twist[3:]).inv().apply(seen)
    return Scan(stamp, points.astype(np.float32), times)


def test_the_velocity_since_the_scan_before_is_undone():
    rng = np.random.default_rng(0)
    twist = np.array([2.0, 0.3, 0.0, 0.0, 0.0, 0.8])
    T, scans, worlds = np.eye(4), [], []
    for i in range(4):
        worlds.append(room(rng))
        scans.append(drive_through(worlds[-1], 10**18 + i * 10**8, T, twist))
        worlds[-1] = (worlds[-1] - T[:3, 3]) @ T[:3, :3]
        T = T @ motion(twist)
    compensated = list(compensate_neighbours(scans))
    assert compensated[0] is scans[0]
    for before, after, world in zip(scans[1:], compensated[1:], worlds[1:], strict=True):
        assert np.abs(before.points - world).max() > 0.5
        assert np.abs(after.points - world).max() < 0.15


def test_the_motion_known_last_holds_for_a_second():
    rng = np.random.default_rng(0)
    twist = np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    first, second = (
        drive_through(room(rng), 10**18 + i * 10**8, T, twist)
        for i, T in enumerate((np.eye(4), motion(twist)))
    )
    few = [
        Scan(10**18 + stamp, np.ones((5, 3), np.float32), np.full(5, 0.1, np.float32))
        for stamp in (2 * 10**8, 10**9, 15 * 10**8)
    ]
    *_, soon, late, too_late = compensate_neighbours([first, second, *few])
    for scan in (soon, late):
        np.testing.assert_allclose(scan.points - 1.0, np.tile([0.2, 0.0, 0.0], (5, 1)), atol=0.02)
    assert too_late is few[-1]


def test_scans_that_cannot_be_registered_stay_as_they_are():
    rng = np.random.default_rng(0)
    few = Scan(10**18, np.ones((5, 3), np.float32), np.zeros(5, np.float32))
    whole = drive_through(room(rng), 10**18 + 10**8, np.eye(4), np.zeros(6))
    late = drive_through(room(rng), 10**18 + 10**10, np.eye(4), np.zeros(6))
    empty = Scan(10**18 + 2 * 10**10, np.empty((0, 3), np.float32), np.empty(0, np.float32))
    given = [few, whole, late, empty]
    assert all(a is b for a, b in zip(compensate_neighbours(given), given, strict=True))


def turning(seconds):
    """Rate of turning about z, never the same twice."""
    return np.sin(0.7 * seconds) + 0.6 * np.sin(1.9 * seconds + 1) + 0.8 * np.sin(0.02 * seconds**2)


def imu_and_trajectory(offset, seconds=60.0):
    """The same motion on two clocks: add `offset` to the trajectory's stamps to make them one."""
    fine = np.arange(0, seconds, 0.005)
    yaw = np.cumsum(turning(fine)) * 0.005
    rates = np.zeros((len(fine), 3))
    rates[:, 1] = turning(fine)
    stamps = 10**18 + np.rint(fine * 1e9).astype(np.int64)
    imu = Imu(stamps, rates, np.zeros_like(rates))
    some = slice(2000, 8000, 20)
    T = np.tile(np.eye(4), (len(yaw[some]), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", yaw[some][:, None]).as_matrix()
    return imu, Trajectory(stamps[some] - round(offset * 1e9), T)


def offset_of(trajectory, imu):
    return clock_offset(trajectory, imu.stamps, np.linalg.norm(imu.angular_velocity, axis=1))


@pytest.mark.parametrize("offset", [0.0, 0.37, -18.0, 1.6e9 - 0.123])
def test_the_offset_of_clocks_is_found_by_turning(offset):
    imu, trajectory = imu_and_trajectory(offset)
    assert offset_of(trajectory, imu) == pytest.approx(offset, abs=0.03)


def test_no_offset_is_proposed_where_the_motions_differ():
    imu, trajectory = imu_and_trajectory(0.0)
    rng = np.random.default_rng(0)
    other = Imu(imu.stamps, rng.normal(0, 1, (len(imu), 3)), imu.acceleration)
    assert offset_of(trajectory, other) is None
    short = Trajectory(trajectory.stamps[:2], trajectory.T_world_sensor[:2])
    assert offset_of(short, imu) is None


@pytest.mark.parametrize("wrong", [0.0, 5000.0])
def test_clocks_that_do_not_meet_are_an_error_with_a_proposal(tmp_path, wrong):
    rng = np.random.default_rng(0)
    seconds = np.arange(0, 12, 0.1)
    yaw = np.cumsum(turning(seconds)) * 0.1
    T = np.tile(np.eye(4), (len(yaw), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    stamps = 10**18 + np.rint(seconds * 1e9).astype(np.int64)
    messages = []
    for stamp, pose, q in zip(stamps.tolist(), T, geometry.to_quaternions(T).tolist(), strict=True):
        points = (room(rng, 500) @ pose[:3, :3]).astype(np.float32)
        messages.append(("/points", stamp, rec.cloud(rec.velodyne(points), stamp, rec.ROS1)))
        messages.append(("/poses", stamp, rec.pose(stamp - 10**15, (0, 0, 0), q, rec.ROS1)))
    bag = str(rec.write_bag(tmp_path / "a.bag", messages))
    given = {"bag": bag, "reference": "/poses"}
    with pytest.raises(SequenceError, match=r"set `clock_offset`.*the scans show the") as caught:
        open_sequence(SequenceConfig(**given, clock_offset=wrong)).reference()
    proposed = float(str(caught.value).split("clock_offset: ")[-1].rstrip(")"))
    assert proposed == pytest.approx(1e6, abs=0.1)
    assert open_sequence(SequenceConfig(**given, clock_offset=proposed)).reference() is not None


def test_what_has_no_times_cannot_be_compensated(tmp_path):
    raw = np.zeros(30, [(a, "<f4") for a in "xyz"])
    raw["x"] = np.arange(1, 31)
    message = rec.cloud(raw, 10**18, rec.ROS1)
    bag = str(rec.write_bag(tmp_path / "a.bag", [("/flat", 10**18, message)]))
    given = {"bag": bag, "compensate": "constant_velocity"}
    sequence = open_sequence(SequenceConfig(**given))
    with pytest.raises(SequenceError, match="have no times"):
        list(sequence)


def test_an_imu_comes_in_si_units_with_its_place(tmp_path):
    cloud = rec.cloud(rec.velodyne(rec.scans(1)[0]), 10**18, rec.ROS1)
    measured = rec.imu(10**18, (0, 0, 0), (0, 0, 1), rec.ROS1)
    messages = [("/points", 10**18, cloud), ("/imu", 10**18, measured)]
    bag = str(rec.write_bag(tmp_path / "a.bag", messages))
    assert open_sequence(SequenceConfig(bag=bag)).imu() is None
    extrinsic = [1, 2, 3, 0, 0, 0, 1]
    imu = open_sequence(SequenceConfig(bag=bag, imu={"unit": "g", "extrinsic": extrinsic})).imu()
    np.testing.assert_allclose(imu.acceleration[0], [0, 0, 9.80665])
    np.testing.assert_allclose(imu.T_sensor_imu[:3, 3], [1, 2, 3])
    config = SequenceConfig(bag=bag, imu={}, compensate="constant_velocity")
    assert open_sequence(config).imu() is not None
