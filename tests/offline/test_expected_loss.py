import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.model.rules import ERROR_FLOOR
from offline.tuning import (
    expected_loss,
    interval_of,
    log_ratios,
    standard_error,
    worst_tenth,
)

logs = st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=30).map(np.array)


def alone(values):
    """Each stretch is a recording."""
    return [str(i) for i in range(len(values))]


def test_one_stretch_shows_nothing():
    assert expected_loss(np.array([-1.0]), ["one"]) == np.inf


@given(logs)
def test_loss_is_the_mean_and_what_may_go_wrong(values):
    loss = expected_loss(values, alone(values))
    if values.any():
        assert loss >= values.mean()
        risk = 0.5 * max(0.0, worst_tenth(values))
        assert loss == pytest.approx(values.mean() + risk + standard_error(values, alone(values)))


def test_one_disaster_outweighs_small_gains():
    values = np.full(24, -0.05)
    assert expected_loss(values, alone(values)) < 0.0
    values[7] = np.log(10.0)
    assert values.mean() < 0.06
    assert expected_loss(values, alone(values)) > 0.5
    # A small harm does not outweigh what is gained elsewhere.
    values = np.full(24, -0.5)
    values[7] = np.log(1.2)
    assert expected_loss(values, alone(values)) < 0.0


def test_the_worst_tenth_counts_parts_of_stretches():
    values = np.arange(24.0)[::-1]
    assert worst_tenth(values) == pytest.approx((23.0 + 22.0 + 0.4 * 21.0) / 2.4)
    assert worst_tenth(values[:5]) == 23.0


def test_stretches_of_a_recording_are_not_taken_for_independent():
    # Six recordings, each of whose stretches are alike.
    of_recordings = np.array([-0.5, -0.2, -0.4, 0.1, -0.3, -0.1])
    names = [str(i) for i in range(6)]
    one = standard_error(of_recordings, names)
    assert one == pytest.approx(of_recordings.std(ddof=1) / np.sqrt(6))
    repeated = np.repeat(of_recordings, 4), np.repeat(names, 4).tolist()
    assert standard_error(*repeated) == pytest.approx(one)
    assert interval_of(*repeated) == pytest.approx(interval_of(of_recordings, names))


def test_few_recordings_are_resampled_in_blocks():
    rng = np.random.default_rng(0)
    drawn = [rng.normal(0.0, 1.0, 8) for _ in range(200)]
    errors = [standard_error(values, ["a"] * 4 + ["b"] * 4) for values in drawn]
    # On average it is that of the mean of eight independent values.
    assert np.mean(errors) == pytest.approx(1.0 / np.sqrt(8), rel=0.2)
    # Neighbours that agree count as less.
    alike = np.repeat([1.0, -1.0, 1.0, -1.0], 2)
    apart = np.tile([1.0, -1.0], 4)
    assert standard_error(alike, ["a"] * 8) > standard_error(apart, ["a"] * 8)
    # Two stretches are one block, which does not make them sure.
    assert standard_error(np.array([0.1, 0.3]), ["a"] * 2) == pytest.approx(0.1)
    assert standard_error(alike, ["a"] * 8) == standard_error(alike, ["a"] * 8)


def test_ratios_are_of_mean_errors_on_each_stretch():
    errors, fixed = np.array([1.0, 3.0, 5.0]), np.array([4.0, 4.0, 1.0])
    found = np.exp(log_ratios(errors, fixed, np.array([3, 3, 7])))
    expected = [
        (2.0 + ERROR_FLOOR) / (4.0 + ERROR_FLOOR),
        (5.0 + ERROR_FLOOR) / (1.0 + ERROR_FLOOR),
    ]
    np.testing.assert_allclose(found, expected)
