import numpy as np
from made_trials import SPACE, made_sets, made_table, write_trials

from adaptune import files
from adaptune.archive import Summary
from adaptune.space import Float, ParameterSpace, PooledSpace
from offline.charts import read_trials, trial_table
from offline.config import OfflineConfig, load_study


def test_the_mean_is_over_all_sequences_or_unknown():
    sets = made_sets(3)
    runs = {
        "one": {i: Summary(p, 1.0 + i, 0, 0, 1.0) for i, p in enumerate(sets)},
        "two": {i: Summary(p, 3.0, 0, 0, 1.0) for i, p in enumerate(sets[:2])},
    }
    table = trial_table(OfflineConfig(), SPACE, runs, sets[1])
    np.testing.assert_array_equal(table.values, [2.0, 2.5, np.nan])
    np.testing.assert_array_equal(table.by_sequence["two"], [3.0, 3.0, np.nan])
    assert (table.fixed, table.objective, len(table)) == (1, "RTE [%]", 3)
    assert np.isnan(table.costs).all()


def test_sets_of_several_odometries_are_told_apart():
    space = PooledSpace(
        {
            "gicp": ParameterSpace({"distance": Float(low=1.0, high=9.0, baseline=4.0)}),
            "ndt": ParameterSpace({"resolution": Float(low=1.0, high=9.0, baseline=2.0)}),
        }
    )
    sets = space.baselines
    runs = {"one": {i: Summary(p, 1.0 + i, 0, 0, 1.0) for i, p in enumerate(sets)}}
    table = trial_table(OfflineConfig(), space, runs)
    assert table.column("ndt.resolution") == [None, 2.0]
    parts = table.odometries()
    assert {name: list(part.numbers) for name, part in parts.items()} == {"gicp": [0], "ndt": [1]}


def test_a_study_is_read(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    assert not len(read_trials(study))
    write_trials(study, lambda _, p: p["keyframe_interval"], 5)
    table = read_trials(study)
    intervals = table.column("keyframe_interval")
    np.testing.assert_allclose(table.values, intervals, rtol=1e-6)
    assert table.fixed is None
    (study.folder / "fixed.yaml").write_text(files.dump(table.sets[2]), "utf-8")
    assert read_trials(study).fixed == 2


def test_other_objectives_have_their_units():
    config = OfflineConfig.model_validate({"objective": {"ape": 1.0}})
    runs = {"one": {0: Summary(SPACE.baseline, 1.0, 0, 0, 1.0, {"ape": 0.25})}}
    table = trial_table(config, SPACE, runs)
    assert (table.values.tolist(), table.objective) == ([0.25], "ape [m]")
    assert made_table(lambda *_: 1.0, 2).odometries().keys() == {""}
