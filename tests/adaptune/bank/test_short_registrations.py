import numpy as np
import pytest
from rooms import along_x, scan_at, street

from adaptune.bank.bank import ShortRegistrations

SECOND = 10**9
WORLD = street()


def room(x, seed):
    return scan_at(WORLD, x, seed=seed).points


def seen(n=11, step=0.1):
    short = ShortRegistrations()
    short.start(0, room(0.0, 0))
    for i in range(1, n):
        short.add(i * SECOND // 10, room(i * step, i))
    return short


def test_a_wrong_motion_places_the_scan_farther_away():
    distances = seen()(
        np.array([along_x([0.1, 0.0, 0.3, 0.1]), along_x([1.0, 0.0, 1.3, 0.7])]), (1, 10)
    )
    assert distances.argmin() == 0
    assert (distances[1:] > distances[0] + 0.006).all()
    assert (distances < 1.0).all()


def test_points_of_the_robot_itself_do_not_count():
    rng = np.random.default_rng(0)
    robot = rng.uniform(-0.5, 0.5, (50_000, 3)).astype(np.float32)
    plain, short = seen(), ShortRegistrations()
    short.start(0, np.vstack([robot, room(0.0, 0)]))
    for i in range(1, 11):
        short.add(i * SECOND // 10, np.vstack([robot, room(i * 0.1, i)]))
    T = np.array([along_x([0.1, 0.0])])
    np.testing.assert_allclose(short(T, (1,)), plain(T, (1,)), rtol=1e-9)


@pytest.mark.parametrize("empty", ["now", "then", "robot"])
def test_where_there_is_nothing_to_compare_it_is_endless(empty):
    short, nothing = ShortRegistrations(), np.empty((0, 3), np.float32)
    if empty == "robot":
        nothing = np.full((100, 3), 0.1, np.float32)
    short.start(0, nothing if empty != "now" else room(0.0, 0))
    short.add(SECOND // 10, nothing if empty != "then" else room(0.1, 1))
    assert np.isinf(short(np.array([along_x([0.1, 0.2])]), (1,))).all()
    # Another scan tells all the same.
    if empty == "then":
        short.add(2 * SECOND // 10, room(0.2, 2))
        both = short(np.array([along_x([0.1, 0.2]), along_x([0.2, 0.4])]), (1, 2))
        np.testing.assert_array_equal(both, short(np.array([along_x([0.1, 0.2])]), (1,)))


def test_scans_of_the_last_second_are_kept_and_no_others():
    short = seen(n=100)
    assert np.isfinite(short(np.array([along_x([1.0])]), (10,))).all()
    assert np.isinf(short(np.array([along_x([9.0])]), (90,))).all()
    # Rare scans: the one before is there.
    rare = ShortRegistrations()
    for i in range(5):
        rare.add(i * 10 * SECOND, room(0.1 * i, i))
    assert np.isfinite(rare(np.array([along_x([0.1])]), (1,))).all()
