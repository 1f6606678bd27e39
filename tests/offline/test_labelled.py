from dataclasses import replace

import numpy as np
from tables import table

from adaptune.archive import Summary
from offline.config import OfflineConfig
from offline.labelled import LabelledData, LabelledSequence
from offline.objective import best_by_trials, judge


def labelled(runs):
    """Sequences on which each of three sets had these values in repeated runs."""
    sequences = [
        LabelledSequence(
            f"s{i}",
            np.arange(4),
            np.zeros((4, 90), np.float32),
            np.tile(np.mean(of_sets, axis=1).astype(np.float32), (4, 1)),
            values=np.mean(of_sets, axis=1),
            repeats=np.array(of_sets),
        )
        for i, of_sets in enumerate(runs)
    ]
    return LabelledData(sequences, table(np.eye(3), (0, 2, 5)))


def verdicts(runs):
    """The same as the campaign judges it."""
    config = OfflineConfig(repeats=len(runs[0][0]))
    return config, {
        trial: judge(
            config,
            [
                Summary({}, float(np.mean(r[i])), 0, 0, 1.0, repeats=[{"rte": v} for v in r[i]])
                for r in runs
            ],
        )
        for i, trial in enumerate((0, 2, 5))
    }


def test_the_fixed_set_is_surely_good_here_as_in_the_campaign():
    # The second set has the least mean by luck; the third is surely better than the first.
    runs = [[[1.0, 1.0, 1.1], [0.1, 0.2, 2.3], [0.9, 0.91, 0.92]]] * 2
    config, found = verdicts(runs)
    assert min(found, key=lambda trial: found[trial].values) == 2
    assert best_by_trials(config, found) == 5
    data = labelled(runs)
    assert data.fixed() == 5
    assert data.training_data()[0].fixed == 5


def test_whole_runs_decide_where_there_are_some():
    data = labelled([[[1.0], [2.0], [3.0]]] * 2)
    # The baseline alone decides nothing.
    for known, fixed in (
        ([{0: 1.0, 2: 9.0, 5: 3.0}, {0: 9.0, 2: 1.0, 5: 1.0}], 5),
        ([{0: 1.0, 5: 3.0}, {0: 9.0, 2: 1.0}], 0),
        ([{0: 9.0, 5: 5.0}, {0: 9.0, 5: 5.0}], 2),  # which lost track in no trial
        ([{2: 1.0}, {5: 1.0}], 0),
    ):
        whole = [replace(s, whole=w) for s, w in zip(data.sequences, known, strict=True)]
        found = data._replace(sequences=whole)
        assert found.fixed() == fixed
        assert found.subset((0, 2)).fixed() == 0
    # With a sequence left out, the whole runs on the others decide.
    (_, others), _ = data._replace(
        sequences=[replace(s, whole={0: 3.0, 2: 2.0 + i, 5: 3.0 - i}) for i, s in enumerate(whole)]
    ).folds()
    assert others.fixed() == 5


def test_a_candidate_of_all_sequences_is_none_where_its_luck_is_left_out():
    rng = np.random.default_rng(0)
    errors = rng.uniform(0.9, 1.1, (8, 256))  # all sets are equally good
    luckiest = int(errors.mean(axis=0).argmin())
    whole = {0: 5.0, luckiest: 0.9}
    sequences = [
        LabelledSequence(
            f"s{i}", np.arange(4), np.zeros((4, 90), np.float32), np.tile(of, (4, 1)), whole=whole
        )
        for i, of in enumerate(errors.astype(np.float32))
    ]
    data = LabelledData(sequences, table(np.linspace(0, 1, 256)[:, None], tuple(range(256))))
    assert data.fixed() == luckiest
    of_fixed = [one.errors[0, others.fixed()] for one, others in data.folds()]
    assert np.mean(of_fixed) > errors[:, luckiest].mean() + 0.02
    # A set that lost track and has no whole runs counts nowhere.
    lost = sequences[3].errors.copy()
    others = data.folds()[0][1]
    lost[1, others.fixed()] = np.inf
    some = [replace(s, errors=lost if s.name == "s3" else s.errors) for s in others.sequences]
    assert others._replace(sequences=some).fixed() != others.fixed()
