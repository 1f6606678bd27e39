from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from labelled_places import of_errors
from tables import table

from adaptune.model.rules import ERROR_FLOOR, Costs, SetCost
from adaptune.paired import of_segments
from adaptune.runs.archive import TrialSummary
from offline.bank_choice import expected_loss, log_ratios, worst_tenth
from offline.labelled import LabelledData, measured_costs
from offline.whole import side_by_side


def labelled(*of_sequences):
    """Sequences of five blocks on which three sets have these errors, the baseline's first."""
    sequences = [
        of_errors(f"s{i}", np.tile(np.array(means, np.float32), (300, 1)))
        for i, means in enumerate(of_sequences)
    ]
    return LabelledData(sequences, table(np.eye(3), (0, 2, 5)))


def in_whole(data, *of_sequences):
    """The same with mean errors of finalists in drives of whole recordings."""
    sequences = [
        replace(
            s,
            whole=replace(
                s,
                errors=np.tile(np.array([*means.values()], np.float32), (len(s.errors), 1)),
                restarts=np.zeros(len(means)),
            ),
        )
        for s, means in zip(data.sequences, of_sequences, strict=True)
    ]
    return data._replace(sequences=sequences, driven=list(of_sequences[0]))


def test_members_come_from_the_best_sets_that_were_run_everywhere():
    data, known = labelled([3.0, 2.0, 1.0], [3.0, 2.0, 1.0]), dict.fromkeys((0, 2, 5))
    there = data._replace(sequences=[replace(s, vectors=known) for s in data.sequences])
    assert there.member_pool(0) == [0, 5, 2]
    assert there.member_pool(2) == [2, 5, 0]
    first, second = there.sequences
    errors = second.errors.copy()
    errors[:, 1] = np.nan
    for other in (replace(second, errors=errors), replace(second, vectors={0: None, 5: None})):
        assert there._replace(sequences=[first, other]).member_pool(0) == [0, 5]


def test_drives_of_whole_recordings_decide_where_there_are_some():
    data = labelled([3.0, 2.0, 1.0], [3.0, 2.0, 1.0])
    assert data.fixed() == data.training_data()[0].fixed == 5
    assert in_whole(data, {0: 3.0, 2: 1.0, 5: 3.0}, {0: 3.0, 2: 1.0, 5: 2.0}).fixed() == 2
    # Those that are not driven are not chosen.
    assert in_whole(data, {0: 3.0, 2: 4.0}, {0: 3.0, 2: 4.0}).fixed() == 0
    # Nor are those that are no more among the sets.
    all_driven = in_whole(data, {0: 3.0, 2: 1.0, 5: 2.0}, {0: 3.0, 2: 1.0, 5: 2.0})
    assert (all_driven.fixed(), all_driven.subset([0, 5]).fixed()) == (2, 5)
    # What they cost side by side counts, unless then none of them keeps to the budget.
    dear = {n: SetCost(ms, 0.0, 0) for n, ms in {0: 5.0, 2: 12.0, 5: 4.0}.items()}
    means = {0: 3.0, 2: 1.0, 5: 2.0}
    best_is_dear = in_whole(labelled([3.0, 1.0, 2.0], [3.0, 1.0, 2.0]), means, means)
    beside = best_is_dear._replace(
        costs=Costs(dear, 0.0), beside=Costs(dear | {2: SetCost(5.0, 0.0, 0)}, 0.0)
    )
    assert (beside.fixed(), beside._replace(beside=None).fixed()) == (2, 5)
    none = Costs(dict.fromkeys(dear, SetCost(9.0, 0.0, 0)), 0.0)
    assert beside._replace(beside=none, budget=4.5).fixed() == 5
    # With a sequence left out, the drives on the others decide.
    both = in_whole(data, {0: 3.0, 2: 1.0, 5: 3.0}, {0: 3.0, 2: 2.0, 5: 1.0})
    (_, without_first), (_, without_second) = both.folds(by_recording=True)
    assert (without_first.fixed(), without_second.fixed()) == (5, 2)


def run(register, prepare, failure=""):
    """A trial with these milliseconds."""
    others = {"register_ms": register, "prepare_ms": prepare}
    return TrialSummary({}, 1.0, 0, 0, 1.0, others, failure=failure)


def test_what_failed_tells_nothing_of_preparing():
    runs = {0: run(4.0, 5.0), 2: run(3.0, 0.0, "no pose"), 5: run(2.0, np.nan), 7: run(3.0, 6.0)}
    archive = SimpleNamespace(
        finished=lambda _: runs, read_frames=lambda _: SimpleNamespace(evidence_ms=0.0)
    )
    sets = dict.fromkeys(runs)
    alike = SimpleNamespace(preparation="alike")
    costs = measured_costs(archive, ["s"], sets, lambda _: alike)
    assert [costs.alone(trial) for trial in (0, 5, 7)] == [9.5, 7.5, 8.5]
    assert not costs.usable(2)


def test_costs_of_finalists_are_those_of_drives_side_by_side():
    """A machine that is busy in the trials of one set alone does not make that set dear."""
    sets = {n: SetCost(ms, 2.0, 0) for n, ms in {0: 6.0, 2: 9.0, 5: 6.0, 7: 1.0, 9: 2.0}.items()}
    costs = Costs(sets, evidence=1.0)
    runs = {
        0: [run(10.0, 4.0), run(14.0, 4.0)],  # twice the baseline's cost in the trials
        2: [run(12.0, 4.0), run(12.0, 4.0)],
        5: [run(20.0, 4.0), run(20.0, 4.0)],
        7: [run(1.0, 1.0), run(1.0, 1.0, "no pose")],
    }
    found = side_by_side(costs, runs)
    assert [found.alone(n) for n in (0, 2, 5, 7, 9)] == pytest.approx([8.0, 8.0, 12.0, 3.0, 4.0])
    assert found.evidence == 1.0
    cheap = {0: SetCost(0.4, 0.1, 0), 2: SetCost(0.4, 0.1, 0)}
    both = {0: [run(0.4, 0.1)], 2: [run(0.8, 0.2)]}
    found = side_by_side(Costs(cheap, 0.0), both)
    assert [found.alone(n) for n in (0, 2)] == pytest.approx([0.5, 1.0])
    assert side_by_side(costs, {2: runs[2]}).sets == sets
    # Where the baseline's is unknown, or it failed, nothing compares.
    for unknown in (run(np.nan, 4.0), run(10.0, 4.0, "no pose")):
        assert side_by_side(costs, runs | {0: [unknown]}).sets == sets


def test_restarts_of_all_sequences_count():
    data = labelled([3.0, 1.0, 2.0], [3.0, 1.0, 2.0])
    for restarts, fixed in (([1, 7, 1], 5), ([1, 1, 7], 2), ([0, np.inf, 4], 0)):
        counted = [replace(s, restarts=np.array(restarts, float)) for s in data.sequences]
        assert data._replace(sequences=counted).fixed() == fixed
    times = np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.0, 9.0])
    counted = [replace(s, restarts=r) for s, r in zip(data.sequences, times, strict=True)]
    assert data._replace(sequences=counted).fixed() == 2


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


def test_the_worst_tenth_counts_parts_of_segments():
    values = np.arange(24.0)[::-1]
    assert worst_tenth(values) == pytest.approx((23.0 + 22.0 + 0.4 * 21.0) / 2.4)
    assert worst_tenth(values[:5]) == 23.0


def test_segments_of_a_recording_are_not_taken_for_independent():
    # Six recordings, each of whose segments are alike.
    of_recordings = np.array([-0.5, -0.2, -0.4, 0.1, -0.3, -0.1])
    names = [str(i) for i in range(6)]
    one = of_segments(of_recordings, names)
    repeated = of_segments(np.repeat(of_recordings, 2), list(np.repeat(names, 2)))
    assert one.error == pytest.approx(of_recordings.std(ddof=1) / np.sqrt(6))
    assert repeated.error == pytest.approx(one.error)
    assert repeated.interval == pytest.approx(one.interval)
    # Of few recordings, each segment counts.
    few = of_segments(np.array([0.1, 0.3, 0.2]), ["a", "a", "b"])
    assert few.error == pytest.approx(0.1 / np.sqrt(3.0))
    assert of_segments(np.array([0.1]), ["a"]).interval is None


def test_ratios_are_of_mean_errors_on_each_segment():
    errors, fixed = np.array([1.0, 3.0, 5.0]), np.array([4.0, 4.0, 1.0])
    found = np.exp(log_ratios(errors, fixed, np.array([3, 3, 7])))
    expected = [
        (2.0 + ERROR_FLOOR) / (4.0 + ERROR_FLOOR),
        (5.0 + ERROR_FLOOR) / (1.0 + ERROR_FLOOR),
    ]
    np.testing.assert_allclose(found, expected)
