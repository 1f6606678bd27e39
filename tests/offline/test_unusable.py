"""A parameter set with which the odometry gives no poses is never chosen."""

import fragile
import pytest

from adaptune.model.knn import NearestNeighbours
from adaptune.runs.archive import Archive, TrialSummary
from offline.config import OfflineConfig, load_study
from offline.objective import judge, sampler_results
from offline.train import train
from offline.validate import validate

GOOD = TrialSummary({"x": 1}, 2.0, 0, 0, 10.0)
FAILS = [TrialSummary({"x": 2}, 1.0, 0, 10, 0.01, failure=why) for why in ("10 faults", "too slow")]
FAST = "offline.objective={rte: 0.001, ms_per_scan: 1.0}"


def trained(study_file, folder, fails, *given):
    odometry = [f"odometry.name={fragile.NAME}", f"odometry.settings.fails={fails}"]
    study = load_study(study_file, [*odometry, *given], folder)
    return study, train(study)


@pytest.mark.parametrize(
    ("fails", "given"),
    [
        ("always", [FAST]),
        ("every fifth", [FAST]),
        ("in two", [FAST]),
        ("always", ["online.switching={mechanism: bank, size: 6}"]),
    ],
)
def test_a_set_that_fails_is_never_chosen(study_file, tmp_path, fails, given):
    study, training = trained(study_file, tmp_path / "study", fails, *given)
    sets = Archive(study.folder / "trials").sets()
    failing = {n for n, s in sets.items() if s["keyframe_interval"] > fragile.MOST}
    assert len(failing) > 2
    assert len(sets) - len(failing) > 1
    model = training.model
    assert not failing & {model.fixed, *model.bank}
    said = [text for text in training.words if "never chosen" in text]
    assert [text.split()[0] for text in said] == [str(len(failing))]
    # They show the rules where not to go.
    assert set(model.sets) == set(sets)
    data = model.training_data(model.pca())
    rule = NearestNeighbours().fit(data)
    assert not failing & {rule.select(feature).trial for feature in data.features[::9]}
    assert not failing & set(model.allowed())
    if fails == "in two":
        assert validate(study).rows


def test_where_all_others_fail_the_baseline_is_left(study_file, tmp_path):
    _, training = trained(
        study_file, tmp_path / "study", "but the baseline", FAST, "offline.sampler=random"
    )
    assert (training.model.fixed, training.model.bank) == (0, [0])
    assert any(
        "9 of 10 parameter sets failed and are never chosen" in text for text in training.words
    )


@pytest.mark.parametrize("fails", FAILS)
def test_a_set_that_fails_on_one_sequence_is_not_usable(fails):
    of = OfflineConfig(objective="ms_per_scan")
    good, bad = (judge(of, {"one": GOOD, "two": two}) for two in (GOOD, fails))
    assert (good.state, bad.state) == ("complete", f"failed: {fails.failure}")
    # Samplers are told that it is bad.
    (_, own), (_, worse) = sampler_results([good, bad])
    assert own == 10.0
    assert 100.0 <= worse < 1e6
