import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adaptune.geometry import invert
from adaptune.recording.poses import in_angles, sound
from adaptune.trajectory import Trajectory

RATES = [1, 10, 20, 100, 400]


def winding(rate, speed=1.5, turn=0.6, noise=0.01, seconds=60):
    """A winding drive: stamps, and noisy poses."""
    fine = np.arange(0.0, seconds, 1e-3)
    yaw = turn * np.sin(0.45 * fine) + 0.4 * turn * np.sin(1.1 * fine)
    xy = 1e-3 * speed * np.cumsum([np.cos(yaw), np.sin(yaw)], axis=1)
    some = np.arange(0, len(fine), round(1e3 / rate * 1.0)) if rate < 400 else np.arange(len(fine))
    T = np.tile(np.eye(4), (len(some), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", yaw[some, None]).as_matrix()
    T[:, :2, 3] = xy[:, some].T
    T[:, :3, 3] += np.random.default_rng(0).normal(0.0, noise, (len(T), 3))
    return (fine[some] * 1e9).astype(np.int64), T


def stopping(rate):
    """Poses free of noise, of a robot that stands for ten seconds."""
    stamps, T = winding(rate, noise=0.0)
    still = (stamps > 20e9) & (stamps < 30e9)
    T[still] = T[np.argmax(still)]
    step = T[np.flatnonzero(still)[-1]] @ invert(T[np.flatnonzero(still)[-1] + 1])
    after = stamps >= 30e9
    T[after] = step @ T[after]
    return stamps, T


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize(
    "drive",
    [
        winding,
        lambda rate: winding(rate, noise=0.03),
        lambda rate: winding(rate, speed=30.0, turn=0.1, noise=0.02),
        lambda rate: winding(rate, speed=0.8, turn=2.0),
        stopping,
    ],
    ids=["walking", "noisy", "car", "spinning", "stopping"],
)
def test_poses_that_a_robot_can_have_all_count(drive, rate):
    reference = Trajectory(*drive(rate))
    kept, found = sound(reference)
    assert found == []
    assert len(kept) == len(reference)


def reset(T, n):
    T[n:] = invert(T[n]) @ T[n:]


def corrected(T, n):
    T[n:, :3, 3] += (0.3, 0.4, 0.0)


def turned(T, n):
    place, R = T[n, :3, 3].copy(), Rotation.from_euler("z", 0.5).as_matrix()
    T[n:, :3, :3] = R @ T[n:, :3, :3]
    T[n:, :3, 3] = (T[n:, :3, 3] - place) @ R.T + place


def outlier(T, n):
    T[n, :3, 3] += (0.3, 0.6, 0.0)


@pytest.mark.parametrize("max_gap", [1.0, 1e9])
@pytest.mark.parametrize("spoil", [reset, corrected, turned, outlier])
def test_a_jump_leaves_a_gap_that_no_label_crosses(spoil, max_gap):
    stamps, T = winding(20)
    spoil(T, 600)
    kept, (finding,) = sound(Trajectory(stamps, T, max_gap), begin=10_000_000_000)
    assert "the reference jumps by up to" in finding.what
    begin, end = finding.seconds
    assert begin == pytest.approx(19.95, abs=0.06)
    assert 1.0 < end - begin < 1.3
    assert np.isnan(kept.at(stamps[600:619])).all()
    np.testing.assert_array_equal(kept.at(stamps[:599]), T[:599])
    np.testing.assert_array_equal(kept.at(stamps[625:]), T[625:])
    # Rare scans have one in the gap, too.
    kept, _ = sound(Trajectory(stamps, T, max_gap), hole=3.0)
    assert np.isnan(kept.at(stamps[600:659])).all()


@pytest.mark.parametrize("rate", RATES)
def test_a_pose_that_is_sent_again_while_the_robot_moves_is_left_out(rate):
    stamps, T = winding(rate)
    frozen = (stamps > 30e9) & (stamps < 33e9)
    T[frozen] = T[np.argmax(frozen) - 1]
    kept, (finding,) = sound(Trajectory(stamps, T))
    assert "repeats a pose while the robot moves" in finding.what
    assert finding.seconds == pytest.approx((30.0, 33.0), abs=0.01)
    assert not np.isin(stamps[frozen], kept.stamps).any()
    assert len(kept) == len(T) - frozen.sum()


def test_each_pose_that_is_sent_twice_counts_once():
    stamps, T = winding(10)
    T[1::2] = T[:-1:2]
    kept, (finding,) = sound(Trajectory(stamps, T))
    assert "(299 times)" in finding.what or "(300 times)" in finding.what
    assert len(kept) <= len(T) // 2 + 1


@pytest.mark.parametrize("rate", [10, 20, 100, 400])
def test_two_that_publish_by_turns_are_suspected(rate):
    stamps, T = winding(rate)
    T[1::2, :3, 3] += (0.3, 0.3, 0.0)
    _, (finding,) = sound(Trajectory(stamps, T))
    assert "to and fro by 0.42 m" in finding.what
    assert "two nodes" in finding.mend


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_few_poses_say_nothing(n):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = np.arange(n) ** 3
    assert sound(Trajectory(np.arange(n) * 10**9, T))[1] == []


def on_the_globe(stamps, T, at=(114.17, 22.3), noise=0.0):
    """The poses with longitude and latitude in degrees for x and y."""
    T = T.copy()
    T[:, :2, 3] += np.random.default_rng(1).normal(0.0, noise, (len(T), 2))
    T[:, :2, 3] /= 1.1e5 * np.cos(np.radians(at[1])), 1.1e5
    T[:, :2, 3] += at
    return Trajectory(stamps, T)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("drive", [winding, stopping, lambda rate: winding(rate, speed=30.0)])
def test_longitude_and_latitude_are_no_metres(rate, drive):
    found = in_angles(on_the_globe(*drive(rate)))
    assert "are degrees of longitude and latitude, not metres" in found.what
    assert "`reference: estimated`" in found.mend
    assert in_angles(Trajectory(*drive(rate))) is None


def test_longitude_and_latitude_are_known_in_any_order_and_unit():
    stamps, T = winding(10)
    degrees = on_the_globe(stamps, T, at=(-0.1, 51.5), noise=0.1).T_world_sensor
    swapped, radians = degrees.copy(), degrees.copy()
    swapped[:, :2, 3] = degrees[:, 1::-1, 3]
    radians[:, :2, 3] = np.radians(degrees[:, :2, 3])
    assert "degrees" in in_angles(Trajectory(stamps, swapped)).what
    assert "radians" in in_angles(Trajectory(stamps, radians)).what


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-5, 1e-4, 1e-3])
def test_who_stands_far_from_the_origin_may_do_so_in_metres(noise):
    T = np.tile(np.eye(4), (3000, 1, 1))
    T[:, :3, 3] = np.random.default_rng(0).normal((30.0, 20.0, 1.0), noise, (3000, 3))
    stamps = np.arange(3000) * 10**8
    assert in_angles(Trajectory(stamps, T)) is None
    T[2900:, 0, 3] += np.linspace(0.0, 3.0, 100)  # and drives in the end
    assert in_angles(Trajectory(stamps, T)) is None
