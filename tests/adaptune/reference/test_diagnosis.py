import re
from collections.abc import Callable
from itertools import accumulate

import numpy as np
import pytest
from rooms import street
from scipy.spatial.transform import Rotation

from adaptune.geometry import from_quaternions, invert, to_quaternions
from adaptune.live.hops import Hops
from adaptune.recording.scan import Scan
from adaptune.reference import diagnosis
from adaptune.reference.diagnosis import (
    diagnose_odometry,
    diagnose_reference,
    diagnose_trajectory,
)
from adaptune.trajectory import Trajectory

SCANS = np.arange(0, 60_000_000_000, 100_000_000)
POSES = np.arange(-1_000_000_000, 61_000_000_000, 50_000_000)


def poses(stamps):
    """A winding way on a bumpy ground, whose turns do not repeat."""
    t = stamps * 1e-9
    yaw = 0.9 * np.sin(0.45 * t) + 0.4 * np.sin(1.1 * t + 0.004 * t**2) + 0.3 * np.sin(0.2 * t)
    tilt = 0.06 * np.sin(0.9 * t), 0.05 * np.cos(0.7 * t)
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, *tilt])).as_matrix()
    fine = np.arange(-2.0, 62.0, 0.01)
    turn = 0.9 * np.sin(0.45 * fine) + 0.4 * np.sin(1.1 * fine + 0.004 * fine**2)
    turn += 0.3 * np.sin(0.2 * fine)
    xy = 0.01 * np.cumsum(1.5 * np.array([np.cos(turn), np.sin(turn)]), axis=1)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = np.column_stack([*(np.interp(t, fine, row) for row in xy), 0.1 * np.sin(0.3 * t)])
    return T


def hops(noise=0.01, projection=None):
    """Registrations over four metres, once a second."""
    rng, T = np.random.default_rng(0), poses(SCANS)
    start = np.arange(0, len(SCANS) - 30, 10)
    end = start + 27
    apart = np.tile(np.eye(4), (len(start), 1, 1))
    apart[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 1e-3, (len(start), 3))).as_matrix()
    apart[:, :3, 3] = rng.normal(0, noise, (len(start), 3))
    known = np.tile(np.eye(3) if projection is None else projection, (len(start), 1, 1))
    return Hops(start, end, invert(T[start]) @ T[end] @ apart, known)


def quaternions(order):
    return lambda T: from_quaternions(T[:, :3, 3], to_quaternions(T)[:, order])


def quaternions_of(same):
    return lambda T: from_quaternions(T[:, :3, 3], np.tile(same, (len(T), 1)))


def with_positions(change: Callable) -> Callable:
    def spoil(T):
        T = T.copy()
        T[:, :3, 3] = change(T[:, :3, 3])
        return T

    return spoil


def turned(T):
    place = np.eye(4)
    place[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    return T @ place


def transposed(T):
    T = T.copy()
    T[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    return T


def carried(T):
    place = np.eye(4)
    place[:3, 3] = 0.8, 0.3, 0.2
    return T @ place


def counted(T, ways=1.0, turns=1.0, drift=0.0):
    """What wheels and a gyroscope make of poses, which turn by so many degrees more each."""
    step = invert(T[:-1]) @ T[1:]
    turn = turns * Rotation.from_matrix(step[:, :3, :3]).as_rotvec() + (0, 0, np.radians(drift))
    step[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
    step[:, :3, 3] *= ways
    return np.array([*accumulate([T[0], *step], np.matmul)])


def percents(found):
    """How far poses differ, and what is left without the cause."""
    before, *left = re.findall(r"([\d.e+-]+) %", found.what)
    return float(before), float(left[0]) if left else 0.0


@pytest.mark.parametrize(
    ("spoil", "what", "mend"),
    [
        (quaternions([3, 0, 1, 2]), "began with w", "qx qy qz qw"),
        (with_positions(lambda p: 1000.0 * p), "times as long", "metres"),
        (with_positions(lambda p: p / 0.3048), "3.282 times as long", "metres"),
        (with_positions(lambda p: 1.1 * p), "1.1 times as long", "`reference: estimated`"),
        (lambda T: counted(T, turns=1.26), "1.26 times as far", "`reference: estimated`"),
        (lambda T: counted(T, turns=0.9), "0.9 times as far", "`reference: estimated`"),
        (
            lambda T: counted(T, ways=1.1, turns=1.26),
            "1.26 times as far as the scans, and 1.1 times as long",
            "`reference: estimated`",
        ),
        (lambda T: counted(T, drift=0.1), "0.2 degrees too much", "`reference: estimated`"),
        (invert, "inverted", "LiDAR in the world"),
        (transposed, "transposed", "rows as rows"),
        (turned, "other axes", "extrinsic: [0, 0, 0, 0, 0, -0.707"),
        (carried, "lever arm", "extrinsic: [-0.79"),
        (lambda T: turned(carried(T)), "other axes", "extrinsic: [-0.299"),
        (quaternions_of([0.0, 0.0, 0.0, 1.0]), "without orientation", "`reference: estimated`"),
    ],
)
def test_a_broken_convention_is_named_with_what_mends_it(spoil, what, mend):
    reference = Trajectory(POSES, spoil(poses(POSES)))
    found = diagnose_reference(reference, SCANS, hops())
    assert what in found.what
    assert mend in found.mend
    before, after = percents(found)
    assert before > 4.0
    assert after < 0.2 * before


@pytest.mark.parametrize(
    "spoil",
    [
        lambda T: carried(counted(T, turns=1.3)),
        lambda T: noisy(counted(T, turns=0.5, drift=-0.2)),
        lambda T: counted(T, ways=np.linspace(0.4, 1.8, len(T) - 1)[:, None]),
    ],
)
def test_a_cause_that_leaves_much_is_no_cause(spoil):
    late = Trajectory(POSES + 250_000_000, spoil(poses(POSES)))
    assert diagnose_reference(late, SCANS, hops()) is None


@pytest.mark.parametrize("seconds", [0.1, 0.5, -3.0, 18.0])
def test_another_clock_is_found_to_the_hundredth(seconds):
    reference = Trajectory(POSES + round(seconds * 1e9), poses(POSES))
    found = diagnose_reference(reference, SCANS, hops())
    assert "clock" in found.what
    assert float(found.mend.split()[1]) == pytest.approx(-seconds, abs=0.01)


def test_units_are_found_where_the_study_says_where_the_sensor_is():
    place = carried(turned(np.eye(4)[None]))[0]
    T_world_body = poses(POSES) @ invert(place)
    millimetres = with_positions(lambda p: 1000.0 * p)(T_world_body)
    found = diagnose_reference(Trajectory(POSES, millimetres @ place), SCANS, hops(), place)
    assert "times as long" in found.what
    assert "metres" in found.mend


@pytest.mark.parametrize("rate", [0.7, 1.0, 1.5])
def test_poses_that_are_too_rare_are_named(rate):
    stamps = np.arange(0, 61e9, 1e9 / rate).astype(np.int64)
    found = diagnose_reference(Trajectory(stamps, poses(stamps), 2.0), SCANS, hops())
    assert f"too rare: one every {1.0 / rate:.2g} s" in found.what
    before, after = percents(found)
    assert after < 0.5 * before
    # At the scans, nothing lies between.
    assert (
        diagnose_reference(Trajectory(SCANS[::10], poses(SCANS[::10])), SCANS[::10], few()) is None
    )


def few():
    """Registrations of every tenth scan."""
    T = poses(SCANS[::10])
    start = np.arange(len(T) - 3)
    return Hops(
        start, start + 3, invert(T[start]) @ T[start + 3], np.tile(np.eye(3), (len(start), 1, 1))
    )


def flat(stamps, turning):
    """The drive of a car, on flat ground."""
    T = poses(stamps)
    T[:, 2, 3] = 0.0
    yaw = Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX")[:, 0] if turning else np.zeros(len(T))
    T[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    if not turning:
        T[:, :3, 3] = stamps[:, None] * (1.5e-9, 0.0, 0.0)
    return T


@pytest.mark.parametrize("turning", [True, False])
def test_only_turns_show_a_lever_arm(turning):
    start = np.arange(0, len(SCANS) - 30, 10)
    T = flat(SCANS, turning)
    measured = hops()._replace(T_start_end=invert(T[start]) @ T[start + 27])
    pitching = np.tile(np.eye(4), (len(POSES), 1, 1))
    pitch = 0.02 * np.sin(1.3e-9 * POSES)
    pitching[:, :3, :3] = Rotation.from_euler("y", pitch[:, None]).as_matrix()
    place = np.eye(4)
    place[:3, 3] = 0.8, 0.3, 1.6
    reference = Trajectory(POSES, flat(POSES, turning) @ pitching @ place)
    found = diagnose_reference(reference, SCANS, measured)
    assert "lever arm" in found.what if turning else found is None or "lever" not in found.what
    if turning:
        numbers = [float(n) for n in re.findall(r"-?[\d.]+", found.mend.split("[")[1])][:3]
        assert numbers == pytest.approx([-0.8, -0.3, 0.0], abs=0.1)


def noisy(T):
    apart = np.random.default_rng(1).normal(0.0, 0.15, (len(T), 3))
    return with_positions(lambda p: p + apart)(T)


def drifting(T):
    return with_positions(lambda p: p * (1, 1, 1) + 0.02 * np.cumsum(np.abs(p), axis=0) / len(p))(T)


@pytest.mark.parametrize("spoil", [lambda T: T, noisy, drifting])
def test_noise_and_drift_break_no_convention(spoil):
    assert diagnose_reference(Trajectory(POSES, spoil(poses(POSES))), SCANS, hops()) is None
    assert diagnose_odometry(spoil(poses(SCANS)), hops()) is None


def test_what_the_place_does_not_show_contradicts_nothing():
    long = Trajectory(POSES, with_positions(lambda p: p * 1.1)(poses(POSES)))
    assert diagnose_reference(long, SCANS, hops()) is not None
    assert diagnose_reference(long, SCANS, Hops(*(array[:4] for array in hops()))) is None
    given = hops()
    way = given.T_start_end[:, :3, 3] / np.linalg.norm(given.T_start_end[:, :3, 3], axis=1)[:, None]
    across = np.eye(3) - np.einsum("ni,nj->nij", way, way)
    assert diagnose_reference(long, SCANS, given._replace(projection=across)) is None


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (lambda T: np.concatenate([T[:1], invert(T[:-1]) @ T[1:]]), "increments"),
        (invert, "inverted"),
        (transposed, "transposed"),
        (quaternions([3, 0, 1, 2]), "began with w"),
        (turned, "other axes"),
        (carried, "lever arm"),
        (lambda T: counted(T, ways=0.95), "0.9503 times as long"),
        (lambda T: counted(T, turns=1.1), "1.1 times as far"),
    ],
)
def test_what_an_odometry_returns_instead_of_poses_is_named(spoil, what):
    found = diagnose_odometry(spoil(poses(SCANS)), hops())
    assert what in found.what
    assert ("own error" in found.mend) == ("times" in what)
    assert "metres" not in found.mend
    before, after = percents(found)
    assert after < 0.2 * before


def test_an_odometry_may_fall_short_and_break_a_convention():
    found = diagnose_odometry(carried(counted(poses(SCANS), ways=0.93)), hops())
    assert "lever arm" in found.what
    assert 3.0 < percents(found)[1] < 8.0


def test_an_odometry_that_is_lost_breaks_no_convention():
    still = np.tile(np.eye(4), (len(SCANS), 1, 1))
    assert diagnose_odometry(still, hops()) is None
    lost = poses(SCANS)
    lost[200:, :3, 3] += np.arange(len(lost) - 200)[:, None] * 0.2
    assert diagnose_odometry(lost, hops()) is None
    assert diagnose_odometry(np.full_like(lost, np.nan), hops()) is None


class Recorded:
    """Scans without points, and a reference."""

    def __init__(self, T):
        self.reference = lambda: Trajectory(SCANS, T)

    def __iter__(self):
        return (Scan(int(stamp), np.zeros((0, 3), np.float32)) for stamp in SCANS)


def test_scans_that_were_dropped_do_not_count(monkeypatch):
    """An odometry that was given half of the scans is as right as one that was given all."""
    half = SCANS[::2]

    T = poses(half)
    start, end = hops().start // 2, (hops().end + 1) // 2
    measured = hops()._replace(start=start, end=end, T_start_end=invert(T[start]) @ T[end])
    monkeypatch.setattr(diagnosis, "measured_motions", lambda scans, _: [*scans] and measured)
    found = diagnosis.contradictions(
        Recorded(poses(SCANS)), T, 10.0, None, True, set(half.tolist())
    )
    assert not list(found)
    assert not list(diagnosis.contradictions(Recorded(poses(SCANS)), T, 1.0, None, True))
    wrong = diagnosis.contradictions(Recorded(turned(poses(SCANS))), T, 99.0, None, True, set(half))
    (words,) = wrong
    assert str(words).startswith("the reference contradicts the scans: over some metres they")
    # Without a cause, too, if the odometry is surely the righter one.
    vague = list(
        diagnosis.contradictions(Recorded(noisy(poses(SCANS))), T, 3.0, None, True, set(half))
    )
    assert "and the odometry by" in vague[0].what
    assert "none of the known causes explains" in vague[0].what
    assert "`reference: estimated`" in vague[0].mend
    both = diagnosis.contradictions(
        Recorded(noisy(poses(SCANS))), noisy(T), 3.0, None, True, set(half)
    )
    assert not list(both)


@pytest.mark.parametrize(
    ("later", "told"),
    [(0.1, True), (0.09, True), (0.0, False), (0.05, False), (-0.1, False), (0.2, False)],
)
@pytest.mark.parametrize("span", [0.0, 0.1])
def test_poses_of_the_end_of_scans_are_named(monkeypatch, span, later, told):
    """Those of another moment, and of scans without times, may be anything."""

    class Timed(Recorded):
        def __iter__(self):
            points, times = np.zeros((2, 3), np.float32), np.array([0.0, span], np.float32)
            return (Scan(int(stamp), points, times) for stamp in SCANS)

    monkeypatch.setattr(diagnosis, "measured_motions", lambda scans, _: [*scans] and hops())
    T = poses(SCANS + round(later * 1e9))
    found = list(diagnosis.contradictions(Timed(poses(SCANS)), T, 2.0, None, True))
    named = any("odometry.settings.pose_time: end" in one.mend for one in found)
    assert named == (told and span > 0)


@pytest.mark.parametrize(
    ("metres", "seconds", "used"), [(0.1, 0.1, 4), (0.2, 0.1, 2), (0.5, 0.1, 1), (0.1, 1.0, 1)]
)
def test_of_slow_scans_some_are_enough(monkeypatch, metres, seconds, used):
    world, T = street(), np.tile(np.eye(4), (80, 1, 1))
    yaw = 0.01 * np.arange(80) * metres / 0.5
    T[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    T[:, 0, 3] = metres * np.arange(80)
    scans = [
        Scan(int(i * seconds * 1e9), (world @ at[:3, :3] + invert(at)[:3, 3]).astype(np.float32))
        for i, at in enumerate(T)
    ]
    read = []
    of_neighbours = diagnosis.neighbour_motions
    monkeypatch.setattr(
        diagnosis,
        "neighbour_motions",
        lambda some: of_neighbours(read.append(s.stamp) or s for s in some),
    )
    found = diagnosis.measured_motions(scans, len(scans))
    assert len(found.start) >= diagnosis.FEWEST_HOPS
    assert diagnosis.mismatch(T, found).max() < 1.0
    between = np.diff(np.unique(np.array(read))[2:]) / (seconds * 1e9)
    assert np.median(between) == used


def rarely(every):
    return lambda T: Trajectory(SCANS[::every], T[::every], 100.0)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (carried, '--extrinsic "-0.801 -0.3 '),
        (turned, '--extrinsic "0 0 0 0 0 -0.707'),
        (invert, "look inverted"),
        (transposed, "rotations were transposed"),
        (quaternions([3, 0, 1, 2]), "qx qy qz qw"),
        (lambda T: Trajectory(SCANS + 400_000_000, T), "add -0.400 to `--clock-offset`"),
        (lambda _: Trajectory(SCANS[:-1], poses(SCANS[:-1] + 100_000_000)), "--pose-time end"),
        (lambda T: counted(T, ways=1.05), "its own error, and no option mends it"),
        (lambda T: T[::-1], "of another drive, or lost nearly everywhere"),
        (lambda T: T, None),
        (noisy, None),
        (rarely(10), None),
        (rarely(30), None),
    ],
)
def test_what_a_trajectory_is_and_the_option_that_mends_it(make, words):
    T = poses(SCANS)
    made = make(T)
    made = made if isinstance(made, Trajectory) else Trajectory(SCANS, made)
    found = diagnose_trajectory(made, Trajectory(SCANS, T), made.stamps[:-4], 100_000_000)
    assert (found is None) == (words is None), found
    assert words is None or words in str(found)
