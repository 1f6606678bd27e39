import numpy as np
import pytest

import offline.labelled
from adaptune.archive import Archive
from adaptune.model import ErrorModel
from adaptune.model.rules import mean_errors
from offline.config import load_study
from offline.labelled import labelled_data


@pytest.mark.parametrize("pool", [1, 64])
def test_motions_are_read_of_the_best_sets_and_of_the_baseline(
    study_file, trained_folder, monkeypatch, pool
):
    monkeypatch.setattr(offline.labelled, "MEMBER_POOL_SIZE", pool)
    study = load_study(study_file, [], trained_folder)
    model = ErrorModel.load(study.model_path)
    data = labelled_data(
        Archive(study.folder / "trials"),
        {name: list(model.sets) for name in model.sequences},
        model.sets,
        study.config,
        study.window,
        study.sequences.recorded_in,
        study.odometry,
    )
    errors = np.concatenate([s.errors for s in data.sequences])
    means = mean_errors(errors, data.stretches())
    best = [model.sets.trials[c] for c in np.argsort(means)[: 2 * pool]]
    assert (0 in best) == (pool > 1)
    for sequence in data.sequences:
        assert set(sequence.vectors) == {0, *best}
