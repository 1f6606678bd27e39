from dataclasses import replace

import numpy as np
import pytest
from labelled_places import of_errors
from tables import table

from adaptune.model.rules import ERROR_FLOOR
from offline.labelled import LabelledData
from offline.tuning import expected_loss, interval_of, log_ratios, standard_error, worst_tenth


def labelled(runs):
    """Sequences on which each of three sets had these values in repeated runs."""
    sequences = [
        of_errors(
            f"s{i}",
            np.tile(np.mean(of_sets, axis=1).astype(np.float32), (4, 1)),
            values=np.mean(of_sets, axis=1),
            repeats=np.array(of_sets),
        )
        for i, of_sets in enumerate(runs)
    ]
    return LabelledData(sequences, table(np.eye(3), (0, 2, 5)))


def test_the_fixed_set_is_surely_good():
    # The second set has the least mean by luck; the third is surely better than the first.
    runs = [[[1.0, 1.0, 1.1], [0.1, 0.2, 2.3], [0.9, 0.91, 0.92]]] * 2
    data = labelled(runs)
    assert data.fixed() == 5
    assert data.training_data()[0].fixed == 5


def test_drives_of_whole_recordings_decide_where_there_are_some():
    data = labelled([[[1.0], [2.0], [3.0]]] * 2)
    for known, fixed in (
        ([{0: 1.0, 2: 9.0, 5: 3.0}, {0: 9.0, 2: 1.0, 5: 1.0}], 5),
        # A finalist that is not driven on all of them counts with its trials.
        ([{0: 9.0, 5: 3.0}, {0: 9.0, 2: 1.0}], 2),
        ([{2: 1.0}, {5: 1.0}], 0),
        ([{0: np.inf, 2: 1.0}, {0: 1.0, 2: 1.5}], 2),
    ):
        whole = [replace(s, whole=w) for s, w in zip(data.sequences, known, strict=True)]
        assert data._replace(sequences=whole).fixed() == fixed
    # With a sequence left out, the drives on the others decide.
    (_, others), _ = data._replace(
        sequences=[replace(s, whole={0: 3.0, 2: 2.0 + i, 5: 3.0 - i}) for i, s in enumerate(whole)]
    ).folds()
    assert others.fixed() == 5


def test_a_set_that_is_restarted_more_often_than_the_baseline_is_not_chosen():
    data = labelled([[[3.0], [1.0], [2.0]]] * 2)
    for restarts, fixed in (([1, 3, 1], 5), ([1, 1, 3], 2), ([0, np.inf, 1], 0)):
        counted = [replace(s, restarts=np.array(restarts, float)) for s in data.sequences]
        assert data._replace(sequences=counted).fixed() == fixed
    # The sum over the sequences counts.
    times = np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.0, 9.0])
    counted = [replace(s, restarts=r) for s, r in zip(data.sequences, times, strict=True)]
    assert data._replace(sequences=counted).fixed() == 2


def test_a_candidate_of_all_sequences_is_none_where_its_luck_is_left_out():
    rng = np.random.default_rng(0)
    errors = rng.uniform(0.9, 1.1, (8, 256))  # all sets are equally good
    luckiest = int(errors.mean(axis=0).argmin())
    whole = {0: 5.0, luckiest: 0.9}
    sequences = [
        of_errors(f"s{i}", np.tile(of, (4, 1)), whole=whole)
        for i, of in enumerate(errors.astype(np.float32))
    ]
    data = LabelledData(sequences, table(np.linspace(0, 1, 256)[:, None], tuple(range(256))))
    assert data.fixed() == luckiest
    of_fixed = [one.errors[0, others.fixed()] for one, others in data.folds()]
    assert np.mean(of_fixed) > errors[:, luckiest].mean() + 0.02


def test_one_disaster_outweighs_small_gains():
    values, names = np.full(24, -0.05), [str(i) for i in range(24)]
    assert expected_loss(values, names) < 0.0
    values[7] = np.log(10.0)
    assert values.mean() < 0.06
    assert expected_loss(values, names) > 0.5
    # A small harm does not outweigh what is gained elsewhere.
    values = np.full(24, -0.5)
    values[7] = np.log(1.2)
    assert expected_loss(values, names) < 0.0


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
