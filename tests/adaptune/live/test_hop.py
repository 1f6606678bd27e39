import numpy as np
import pytest
from rooms import moved, scan_at, street, tunnel

from adaptune.live.hops import HopCloud, register
from adaptune.recording.scan import Scan


def cloud(scan):
    return HopCloud(scan, np.eye(4), 0.0)


def hop(world, far=10.0, guess=None, other=None):
    guess = moved(far + 0.4, 0.1) if guess is None else guess
    end = scan_at(world if other is None else other, far)
    return register(cloud(scan_at(world, 0.0)), cloud(end), [guess])


def test_it_finds_the_motion():
    found = hop(street())
    np.testing.assert_allclose(found.T_start_end, moved(10.0), atol=0.03)
    np.testing.assert_allclose(found.projection, np.eye(3), atol=1e-6)


def test_the_first_sound_guess_wins():
    start, end = (cloud(scan_at(street(), x)) for x in (0.0, 10.0))
    far_off = moved(10.0, 0.0, 60.0)
    assert register(start, end, [far_off]) is None
    found = register(start, end, iter([far_off, moved(10.3)]))
    np.testing.assert_allclose(found.T_start_end, moved(10.0), atol=0.03)
    assert register(start, end, []) is None


def test_scans_that_share_no_place_are_rejected():
    elsewhere = np.random.default_rng(0).uniform(-5.0, 25.0, (3000, 3)) - np.array([0.0, 10, 10])
    assert hop(street(), other=elsewhere) is None


@pytest.mark.parametrize("n", [0, 3, 99])
def test_a_scan_of_few_points_is_rejected(n):
    whole = scan_at(street(), 10.0)
    few = Scan(0, whole.points[:n])
    for pair in ((whole, few), (few, whole)):
        assert register(*map(cloud, pair), [np.eye(4)]) is None


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_a_tunnel_says_nothing_along_itself(yaw):
    """The projection is in the frame of the start."""
    turn = moved(yaw=yaw)
    start, end = (scan_at(tunnel(seed=seed), x) for seed, x in enumerate((0.0, 10.0)))
    turned = Scan(0, (end.points @ turn[:3, :3]).astype(np.float32))
    found = register(cloud(start), cloud(turned), [moved(10.5, 0.1, yaw=yaw)])
    np.testing.assert_allclose(found.projection, np.diag([0.0, 1.0, 1.0]), atol=0.05)
    error = found.T_start_end[:3, 3] - [10.0, 0.0, 0.0]
    assert np.linalg.norm(found.projection @ error) < 0.05


def test_points_with_times_are_compensated():
    whole = scan_at(street(), 10.0)
    times = np.linspace(-0.1, 0.0, len(whole.points)).astype(np.float32)
    # The sensor moved 2 m while it scanned: points were seen from farther behind.
    smeared = whole.points - np.outer(times / 0.1 * 2.0, [1.0, 0.0, 0.0])
    scan = Scan(0, smeared.astype(np.float32), times=times)
    start = cloud(scan_at(street(), 0.0))
    plain, compensated = (
        register(start, HopCloud(scan, moved(2.0), seconds), [moved(10.0)])
        for seconds in (0.0, 0.1)
    )
    np.testing.assert_allclose(compensated.T_start_end, moved(10.0), atol=0.04)
    assert plain is None or abs(plain.T_start_end[0, 3] - 10.0) > 0.1
