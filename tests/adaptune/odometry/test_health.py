from collections import Counter

import numpy as np
import pytest
from pydantic import ValidationError
from rooms import moved

from adaptune.odometry import health
from adaptune.odometry.health import Guard, HealthCheck


class Cautious(HealthCheck):
    max_acceleration = 5.0


CHECK = Cautious(max_speed=10.0)


def unhealthy(check, motions, stamps, registered):
    """How often a guard finds each fault in a trajectory."""
    guard, elapsed = Guard(check), (np.diff(stamps) * 1e-9).tolist()
    found = map(guard.check, motions, elapsed, registered[1:].tolist())
    return dict(Counter(what for what in found if what is not None))


@pytest.mark.parametrize(
    ("velocity", "last", "elapsed", "healthy"),
    [
        ((0, 0, 0), None, 0.1, True),
        ((9.9, 0, 0), None, 0.1, True),
        ((0, 0, -10.1), None, 0.1, False),
        ((6, 6, 6), None, 0.1, False),
        # At once from rest to full speed: nothing is known of how fast it was.
        ((10, 0, 0), None, 0.001, True),
        ((5.4, 0, 0), (5, 0, 0), 0.1, True),
        ((5.6, 0, 0), (5, 0, 0), 0.1, False),
        ((4.4, 0, 0), (5, 0, 0), 0.1, False),
        ((5, 0.6, 0), (5, 0, 0), 0.1, False),
        ((-5, 0, 0), (5, 0, 0), 1.0, False),
        ((-5, 0, 0), (5, 0, 0), 2.1, True),
        # However long ago the last one was.
        ((10.5, 0, 0), (9, 0, 0), 100.0, False),
        ((np.nan, 0, 0), None, 0.1, False),
        ((0, np.inf, 0), (0, 0, 0), 0.1, False),
    ],
)
def test_healthy(velocity, last, elapsed, healthy):
    last = None if last is None else np.array(last, float)
    assert (CHECK.exceeded(np.array(velocity, float), last, elapsed) is None) is healthy


@pytest.mark.parametrize(
    ("degrees", "healthy"), [(0, True), (89, True), (91, False), (np.nan, False)]
)
def test_turning(degrees, healthy, monkeypatch):
    monkeypatch.setattr(HealthCheck, "max_turn_rate", 90.0)
    said = HealthCheck().exceeded(np.zeros(3), np.zeros(3), 0.1, np.radians(degrees))
    assert said == (None if healthy else "max_turn_rate")


@pytest.mark.parametrize(
    ("steps", "rate", "faults"),
    [
        ([0.25] * 20 + [0.0] * 9, 10, {}),
        ([0.25] * 20 + [0.0] * 13, 10, {"max_freeze": 1}),
        ([0.04] * 20 + [0.0] * 90, 10, {}),
        ([0.1, 0.08, 0.06, 0.04, 0.02] + [0.0] * 40, 10, {}),
        ([0.0] * 40, 10, {}),
        # Keyframes once a second may look alike.
        ([1.0] * 20 + [0.0] * 9, 1, {}),
        ([1.0] * 20 + [0.0] * 12, 1, {"max_freeze": 1}),
    ],
)
def test_who_stops_dead_has_frozen(steps, rate, faults):
    motions = np.array([moved(step) for step in steps])
    stamps = np.arange(len(motions) + 1) * (10**9 // rate)
    assert unhealthy(HealthCheck(), motions, stamps, np.ones(len(stamps), bool)) == faults


@pytest.mark.parametrize("bounds", [{"max_speed": 0}, {"max_speed": -1}, {"max_jerk": 1}])
def test_bounds_that_make_no_sense(bounds):
    with pytest.raises(ValidationError):
        HealthCheck(**bounds)


def test_what_would_have_been_said_of_a_drive(monkeypatch):
    monkeypatch.setattr(HealthCheck, "max_acceleration", 20.0)
    monkeypatch.setattr(HealthCheck, "max_unregistered", 3)
    steps = [0.1, 0.1, 9.0, 0.1, 0.1, np.nan, 0.1, *[0.0] * 6, 0.1, *[0.8] * 10, *[0.1] * 5]
    monkeypatch.setattr(HealthCheck, "max_freeze", 0.45)
    monkeypatch.setattr(health, "_FROZEN_SCANS", 1)
    check = HealthCheck(max_speed=10.0)
    registered = np.ones(len(steps) + 1, bool)
    registered[-4:] = False
    said = unhealthy(
        check, np.array([moved(x) for x in steps]), np.arange(len(steps) + 1) * 10**8, registered
    )
    assert said == {
        "max_speed": 1,
        "no_pose": 1,
        "max_freeze": 1,
        "max_acceleration": 1,
        "max_unregistered": 1,
    }
    regular = np.array([moved(0.1)] * 20)
    assert unhealthy(check, regular, np.arange(21) * 10**8, np.ones(21, bool)) == {}


@pytest.mark.parametrize(("in_a_row", "said"), [(9, None), (10, "max_unregistered")])
def test_scans_that_do_not_register(in_a_row, said):
    guard = Guard(HealthCheck())
    for i in range(50):
        assert guard.check(moved(0.1), 0.1, registered=i % 10 == 0) is None
    guard.check(moved(0.1), 0.1)
    for _ in range(in_a_row):
        last = guard.check(moved(0.1), 0.1, registered=False)
    assert last == said
    # It begins to count anew, and the motion that was predicted goes on.
    assert guard.check(moved(0.1), 0.1, registered=False) == (
        "max_unregistered" if not said else None
    )
    T_previous_healthy, T_healthy = guard.go_on(0.2)
    np.testing.assert_array_equal(T_previous_healthy, np.eye(4))
    np.testing.assert_allclose(T_healthy, moved(0.2), atol=1e-12)


def test_a_jump_that_came_back_is_not_undone_where_scans_do_not_register(monkeypatch):
    monkeypatch.setattr(HealthCheck, "max_unregistered", 2)
    guard = Guard(HealthCheck())
    for _ in range(12):
        guard.check(moved(1.0), 0.1)
    assert guard.check(moved(1.6), 0.1, registered=False) is None  # a doubtful step
    assert guard.check(moved(0.4), 0.1, registered=False) == "max_unregistered"
    np.testing.assert_allclose(guard.go_on(0.1)[0], np.eye(4))


def drive(elapsed, steps):
    guard = Guard(HealthCheck())
    return [guard.check(moved(x), t) for x, t in zip(steps, elapsed, strict=True)]


def test_jitter_of_stamps_is_not_acceleration():
    """A car at 10 m/s, a laser at a regular 10 Hz, and stamps of the moment of arrival."""
    rng = np.random.default_rng(0)
    for most in (0.01, 0.02, 0.03):
        arrived = 0.1 * np.arange(201) + rng.uniform(0.0, most, 201)
        assert set(drive(np.diff(arrived), np.ones(200))) == {None}
    # Late and then early, as a recording in a town has it; so is a scan that is missing.
    elapsed = [*[0.1] * 10, 0.13, 0.07, 0.1, 0.1, 0.21, 0.09, 0.1]
    assert set(drive(elapsed, [*[1.0] * 14, 2.0, 1.0, 1.0])) == {None}


@pytest.mark.parametrize("elapsed", [0.1, 0.02, 0.07, 0.13, 0.2])
def test_a_step_is_not_excused_by_jitter(elapsed):
    """A step of three times what the robot drives, however its stamps are."""
    n = int(np.ceil(0.95 / elapsed))  # so many scans it may take to take it back
    said = drive([*[0.1] * 12, *[elapsed] * n], [*[1.0] * 12, *[30.0 * elapsed] * n])
    assert said == [*[None] * (11 + n), "max_acceleration"]


@pytest.mark.parametrize("seconds", [0.1, 1.0])
def test_a_jump_that_is_taken_back_at_once_is_no_fault(seconds):
    """As a noisy odometry makes them in a garden; where scans are rare, nobody can wait."""
    jump = 1.2 * 30.0 * seconds**2
    steps = 10.0 * seconds + jump * np.array([*[0] * 12, 1, -1, 0, -1, 1, 0])
    said = drive([seconds] * len(steps), steps)
    assert (set(said) == {None}) == (seconds < 1.0)


def test_a_recording_may_begin_in_motion():
    """The odometry takes some scans to learn that the car drives at 15 m/s."""
    assert set(drive([0.1] * 20, [0.2, 0.6, *[1.5] * 18])) == {None}
    # And then it catches up.
    slow = [0.0, 0.0, -0.2, -0.3, 1.3, 2.6, 2.4]
    assert set(drive([0.1] * 30, [*slow, *[1.3] * 23])) == {None}
    assert drive([0.1] * 30, [*[0.2] * 14, *[1.5] * 16])[23] == "max_acceleration"


def test_a_restart_takes_back_the_jump():
    guard = Guard(HealthCheck())
    assert {guard.check(moved(1.0), 0.1) for _ in range(12)} == {None}
    # Nine steps aside in doubt, and the tenth is one too many.
    aside = moved(1.0, 0.6)
    assert [guard.check(aside, 0.1) for _ in range(10)] == [*[None] * 9, "max_acceleration"]
    T_previous_healthy, T_healthy = guard.go_on(0.1)
    np.testing.assert_allclose(T_healthy, moved(1.0), atol=1e-12)
    where = np.linalg.matrix_power(aside, 9) @ T_previous_healthy @ T_healthy
    np.testing.assert_allclose(where, moved(10.0), atol=1e-9)
    # Nothing of it is remembered at the next fault.
    assert guard.check(moved(1.0), 0.1) is None
    assert guard.check(np.full((4, 4), np.nan), 0.1) == "no_pose"
    np.testing.assert_allclose(guard.go_on(0.1)[0], np.eye(4))
