from functools import cache

import numpy as np
import pytest
from rooms import moved, scan_at, street, tunnel

from adaptune.live.evidence import LiveEvidence
from adaptune.live.monitor import HealthMonitor
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan

STEP, RATE = 0.2, 10
"""Metres from scan to scan, and scans a second."""
TURNED = moved(yaw=0.03)


@cache
def scan(i, world=street):
    return scan_at(world(), STEP * i, seed=i)


def states(motion, n=80, see=scan, starts=lambda _: 0):
    """States once a second; `motion` gives that to each scan, `see` its points."""
    live, found = LiveEvidence(), []
    for i in range(n):
        live.observe(
            i * 10**8, Scan(i * 10**8, see(i).points), Motions(motion(i - 1), {}, starts(i))
        )
        if i % RATE == 0:
            live.check()
            found.append(live.health)
    return found


def right(_):
    return moved(STEP)


def test_an_odometry_that_is_right_is_good():
    found = states(right)
    assert [one.state for one in found[:2]] == ["unknown", "unknown"]
    assert {one.state for one in found[2:]} == {"good"}


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda _: np.eye(4), id="freeze"),
        pytest.param(lambda _: moved(2.0 * STEP), id="twice as far"),
        pytest.param(lambda _: moved(STEP) @ TURNED, id="turns"),
    ],
)
def test_one_that_goes_wrong_is_lost_after_two_seconds(wrong):
    found = states(lambda i: wrong(i) if i > 40 else right(i))
    assert found[4].state == "good"
    assert {one.state for one in found[5:6]} == {"doubtful"}
    assert {one.state for one in found[6:]} == {"lost"}
    assert all(one.why for one in found[5:])


def test_a_jump_is_doubted_and_then_forgotten():
    found = states(lambda i: moved(STEP + 0.5 * (i == 35)))
    assert found[4].state == "doubtful"
    assert "its scans say" in found[4].why
    assert [one.state for one in found[5:]] == ["doubtful", "doubtful", "doubtful"]
    assert states(lambda i: moved(STEP + 0.5 * (i == 35)), n=100)[-1].state == "good"


def test_scans_that_are_much_smaller_are_doubted():
    def half(i):
        whole = scan(i)
        return Scan(0, whole.points[whole.points[:, 1] > 0.0]) if i >= 50 else whole

    found = states(right, see=half)
    assert found[4].state == "good"
    assert (found[5].state, found[5].why.split()[0]) == ("doubtful", "a")


def test_scans_that_no_longer_register_are_doubted():
    rng = np.random.default_rng(0)

    def noise(i):
        seen = scan(i).points
        return Scan(0, rng.uniform(-15, 15, seen.shape).astype(np.float32)) if i > 60 else scan(i)

    assert [one.state for one in states(right, see=noise)[7:]] == ["doubtful"]


def test_a_tunnel_tells_nothing():
    found = states(right, see=lambda i: scan(i, tunnel))
    assert {one.state for one in found[2:]} == {"unknown"}


def test_a_tunnel_that_looks_alike_everywhere_tells_nothing():
    """Its scans are those of a sensor that stands, and the odometry is not to blame."""
    found = states(right, see=lambda i: scan_at(tunnel(), 0.0, seed=i))
    assert {one.state for one in found[2:]} == {"unknown"}


def test_no_pose_and_many_restarts_are_loss():
    gone = states(lambda i: np.full((4, 4), np.nan) if i > 40 else right(i))
    assert gone[6].why.startswith("no pose for")
    restarted = states(right, starts=lambda i: max(0, i - 45))
    assert (restarted[5].state, restarted[7].state) == ("lost", "lost")
    once = states(right, starts=lambda i: int(i > 45))
    assert [one.state for one in once[4:]] == ["good", "doubtful", "doubtful", "doubtful"]


def test_where_nothing_is_in_doubt_one_second_of_five_is_compared():
    live, checked, found = LiveEvidence(), [], []
    for i in range(20 * RATE):
        live.observe(i * 10**8, scan(i), Motions(moved(STEP), {}))
        if i % RATE == 0:
            due = live.due(in_doubt=False)
            if due or live.checking:
                live.check()
                checked.append(i // RATE)
            if due:
                live.measure()
            found.append(live.health.state)
    assert len(checked) < 16
    assert set(found[3:]) == {"good"}


def test_rejected_hops_are_doubt_only_where_seconds_do_not_agree():
    live = LiveEvidence()
    for i in range(60):
        live.observe(i * 10**8, scan(i), Motions(moved(STEP), {}))
        if i % RATE == 0:
            live.check()
    assert live._monitor.health(rejected=1).state == "good"
    assert live._monitor.health(rejected=2).state == "unknown"
    assert live._monitor.health(wrong=1).state == "doubtful"
    assert HealthMonitor().health(rejected=2).state == "doubtful"
