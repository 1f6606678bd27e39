import numpy as np
import pytest
from rooms import moved

from adaptune.live.hops import Hop
from adaptune.live.own_error import (
    GROWTH,
    HIDDEN,
    HOP_ERROR,
    LOG_DEVIATION,
    MIN_COVERED,
    OWN_SECONDS,
    PREDICTED_WINDOWS,
    Link,
    OwnErrors,
)

KNOWN = np.eye(3)


def link(start, end, believed, projection=KNOWN):
    """A hop that is right, and what was believed: poses as a function of the metres driven."""
    hop = Hop(moved(end - start), projection)
    return Link(start, end, end, believed(start), believed(end), hop)


def along(length, believed, n=40, **given):
    """The estimates after hops of 10 m, each a metre farther."""
    own, found = OwnErrors(length), []
    for start in range(n):
        own.add(link(start, start + 10.0, believed, **given))
        found.append(own.estimate())
    return own, found


def test_a_scale_that_is_wrong_is_wrong_over_every_length():
    _, found = along(25.0, lambda metres: moved(1.02 * metres))
    assert found[-1].mean == pytest.approx(2.0 * (25.0 / 20.0) ** GROWTH)


def test_errors_of_the_rotation_add_up_over_a_chain():
    """What single hops could not tell: over 25 m they are much worse than over 10 m."""
    per_metre = 0.05  # degrees
    poses = [np.eye(4)]
    for _ in range(1000):
        poses.append(poses[-1] @ moved(0.1, yaw=np.radians(0.1 * per_metre)))

    def believed(metres):
        return poses[round(10 * metres)]

    _, found = along(25.0, believed)
    end = 20.0  # a chain of two hops of 10 m
    true = 100.0 / end * np.linalg.norm((believed(end) - moved(end))[:3, 3])
    short = 100.0 / 10.0 * np.linalg.norm((believed(10.0) - moved(10.0))[:3, 3])
    assert true > 1.9 * short
    assert found[-1].mean == pytest.approx(true * (25.0 / end) ** GROWTH, rel=0.02)


def test_a_prediction_counts_as_a_few_chains():
    own = OwnErrors(10.0)
    assert own.estimate_with(1.0, 1.0) is None
    for start in (0.0, 10.0):
        own.add(link(start, start + 10.0, lambda metres: moved(1.02 * metres)))
    for predicted in (0.5, 2.0):
        shares = np.array([2.0, PREDICTED_WINDOWS]) / (2.0 + PREDICTED_WINDOWS)
        found = own.estimate_with(predicted, 1.0)
        assert found.mean == pytest.approx(2.0 ** shares[0] * predicted ** shares[1])
        assert found.mean / found.low == pytest.approx(found.high / found.mean)
        # Where it does not count, less is known.
        alone = own.estimate_with(predicted, 0.0)
        assert alone.mean == pytest.approx(2.0)
        assert alone.high / alone.low > found.high / found.low
    # One hop that is wrong by a metre does not make all of them wrong.
    for start in (20.0, 30.0, 40.0):
        own.add(link(start, start + 10.0, lambda metres: moved(1.02 * metres)))
    own.add(link(50.0, 60.0, lambda metres: moved(1.12 * metres)))
    assert own.estimate_with(2.0, 0.0).mean < 3.0 < own.estimate().mean


def test_hops_with_short_gaps_are_chained_and_with_long_ones_not():
    def believed(metres):
        return moved(1.02 * metres)

    apart = 1.0 / MIN_COVERED
    for share in (0.9, 1.1):
        own, start = OwnErrors(40.0), 10.0 * (2.0 * share * apart - 1.0)
        reach = start + 10.0 if share < 1.0 else 10.0
        own.add(link(0.0, 10.0, believed))
        own.add(link(start, start + 10.0, believed))
        newest = own._chains[-1]
        assert newest.end - newest.start == pytest.approx(reach)
        # In between, nobody measured: twice the path, and errors that are not in one direction.
        scale = np.sqrt(reach / (20.0 if share < 1.0 else 10.0))
        true = 0.02 * (20.0 if share < 1.0 else 10.0)
        assert newest.error == pytest.approx(true * scale)


def test_a_direction_that_no_hop_can_tell_counts_for_nothing():
    _, found = along(25.0, lambda metres: moved(1.1 * metres), projection=np.diag([0.0, 1.0, 1.0]))
    assert found[-1].mean == pytest.approx(0.0, abs=1e-9)


def test_a_length_that_no_chain_reaches_is_scaled_and_less_sure():
    own = OwnErrors(100.0)
    own.add(link(0.0, 10.0, lambda metres: moved(1.02 * metres)))
    one = own.estimate()
    assert one.mean == pytest.approx(2.0 * 10.0**GROWTH)
    deviation = LOG_DEVIATION * np.sqrt(1.0 + np.log(10.0) ** 2)
    factor = np.exp(1.96 * deviation)
    hidden = 10.0**GROWTH * 100.0 * HIDDEN / 10.0
    assert one.high == pytest.approx(np.hypot(factor * one.mean, hidden))
    of_hops = 10.0**GROWTH * 100.0 * HOP_ERROR / 10.0
    without = np.sqrt(one.mean**2 - of_hops**2)
    assert without / one.low == pytest.approx(factor)


def test_an_error_that_may_be_the_hops_own_may_be_none():
    """A chain of two hops is less wrong for its length than a single hop."""
    for length, of_hops in ((10.0, 0.5), (20.0, 0.5 / np.sqrt(2.0))):
        for times in (0.9, 1.1):
            share, own = 1.0 + times * of_hops / 100.0, OwnErrors(length)
            for start in range(0, 100, 10):
                own.add(
                    link(start, start + 10.0, lambda metres, share=share: moved(share * metres))
                )
            found = own.estimate()
            assert found.mean == pytest.approx(times * of_hops)
            assert (found.low > 0.0) == (times > 1.0)


def test_hops_that_overlap_tell_how_wrong_they_are():
    """Those that agree with each other leave the error to the odometry."""
    shares = []
    for noise in (0.0, 0.01, 0.03, 1.0):
        own = OwnErrors(10.0)
        for start in range(20):
            one = link(start, start + 10.0, lambda metres: moved(1.004 * metres))
            aside = moved(y=noise if start % 2 else -noise)
            own.add(one._replace(hop=one.hop._replace(T_start_end=one.hop.T_start_end @ aside)))
        found = own.estimate()
        shares.append(found.low / found.mean)
    sure, rather, hardly, wild = shares
    assert sure > rather > hardly + 0.1
    assert sure == pytest.approx(wild, abs=0.05)  # so much is nobody's but the odometry's


def test_what_is_long_ago_is_forgotten():
    """First it is wrong by 5 %, from 100 m on it is right."""
    own, found = along(25.0, lambda metres: moved(metres + 0.05 * min(metres, 100.0)), n=300)
    assert found[80].mean == pytest.approx(5.0, rel=0.05)
    assert found[100 + 25 + int(OWN_SECONDS) + 1].mean == pytest.approx(0.0, abs=1e-9)
    assert len(own._chains) < 2 * OWN_SECONDS
    assert len(own._links) < 25 + 10 / MIN_COVERED + 5


def test_of_a_whole_recording_every_chain_counts():
    def believed(metres):
        return moved(1.04 * min(metres, 200.0) + max(metres - 200.0, 0.0))

    last, whole = OwnErrors(10.0), OwnErrors(10.0, whole=True)
    for start in range(390):
        for own in (last, whole):
            own.add(link(start, start + 10.0, believed))
    assert last.estimate().mean == pytest.approx(0.0, abs=1e-6)
    assert whole.estimate().mean == pytest.approx(2.0, rel=0.05)
