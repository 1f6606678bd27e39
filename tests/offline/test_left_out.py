import shutil
from dataclasses import replace

import numpy as np
import pytest
from labelled_places import SETS, TRIALS, labelled, two_kinds, with_motions

from adaptune._system.strict import ConfigurationError
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel, ModelError
from adaptune.model.rules import NOTHING, Rule
from adaptune.paired import MIN_BLOCKS
from adaptune.space import Selection
from adaptune.study.config import SwitchingConfig
from adaptune.study.driven import driven
from offline import bank_choice
from offline import validate as validation
from offline.config import load_study
from offline.train import fit, with_bank
from offline.validate import (
    LeftOut,
    Validation,
    ValidationError,
    baseline_in_words,
    leave_one_out,
    validate,
)


@pytest.fixture(autouse=True)
def _few_settings(monkeypatch):
    """Try few settings of a bank, on few folds: the tests are about what is left out."""
    monkeypatch.setattr(bank_choice, "BANK_SETTINGS", bank_choice.BANK_SETTINGS[1:2])
    monkeypatch.setattr(validation, "MOST_FOLDS", 5)


def test_rules_gain_where_places_tell_the_sets_apart():
    validation = leave_one_out(labelled(two_kinds(np.random.default_rng(0))), bank=0)
    np.testing.assert_allclose(validation.ratios["paper"], [0.5] * 4 + [0.4] * 4, rtol=0.05)
    said = validation.verdict("paper")
    assert said.startswith("`paper`: expected gain 5")
    assert "in other recordings (8 segments of 8 recordings), adapting 100 %" in said
    # Without a bank, the fixed set is kept.
    assert validation.ratios["adaptive"].tolist() == [1.0] * 8
    assert "kept the fixed set" in validation.verdict("adaptive")
    np.testing.assert_allclose(validation.ratios["baseline"], [1.5] * 4 + [2.0] * 4, rtol=0.05)


class Cheat(Rule):
    """Knows only what it was fitted on, and shows it."""

    fitted = ()

    def fit(self, data):
        self.data = data
        Cheat.fitted += (data,)
        return self

    def predict(self, feature):
        raise NotImplementedError

    def select(self, feature, evidence=NOTHING):  # noqa: ARG002
        return Selection(0, {})


def test_a_selection_holds_for_its_second(monkeypatch):
    asked = []

    class Remember(Cheat):
        def select(self, feature, evidence=NOTHING):  # noqa: ARG002
            asked.append(feature)
            trial = TRIALS[len(asked) % 2]
            return Selection(trial, SETS[trial])

    sequences = two_kinds(np.random.default_rng(2))[:2]
    monkeypatch.setattr(validation, "rule_class", lambda _: Remember)
    found = leave_one_out(labelled(sequences), bank=0, rules=("adaptive", "paper"))
    assert len(asked) == 2 * 8
    expected = np.where(np.arange(80) // 10 % 2 == 0, 1, 0)
    np.testing.assert_allclose(
        found.left_out[0].errors["paper"], sequences[0].errors[np.arange(80), expected], rtol=1e-6
    )


def test_the_fixed_set_is_chosen_by_what_the_study_judges_by():
    sequences = two_kinds(np.random.default_rng(5))
    for value, expected in (([5, 4, 3, 2, 1], 4), ([5, 1, np.inf, 3, 4], 1)):
        judged = [replace(s, values=np.array(value, float)) for s in sequences]
        data, _ = labelled(judged).training_data()
        assert data.fixed == labelled(judged).fixed() == TRIALS[expected]
        # Rotation errors of blocks say nothing of such a value.
        turning = [
            replace(s, turns=np.ones_like(s.errors), block=np.arange(80) // 40) for s in judged
        ]
        assert labelled(turning).fixed() == TRIALS[expected]


def test_validates_a_study(study_file, trained_folder, tmp_path):
    study = load_study(study_file, [], shutil.copytree(trained_folder, tmp_path / "study"))
    validation, rows, verdicts = validate(study)
    assert verdicts[0] == driven(
        ErrorModel.load(study.model_path), study.config.online, study.odometry, study.mechanism
    )
    ends = ["cost [ms]", "geometric", "arithmetic", "worst tenth", "worst"]
    assert [row["left out"] for row in rows] == ["one", "two", *ends]
    assert rows[0]["adaptive"] == pytest.approx(validation.ratios["adaptive"][0])
    # Four sub-trajectories tell nothing, nor do two segments; a dozen would.
    assert len(validation.recordings) < MIN_BLOCKS
    assert [rows[i]["adaptive, 95 %"] for i in (0, 3, 4)] == ["too few", "too few", None]
    assert validation.left_out[0].span > 1
    for name in ("validation.csv", "validation.svg", "segments.csv"):
        assert (study.folder / name).exists()
    other_range = "odometry.parameters.keyframe_interval.high=20"
    with pytest.raises(ConfigurationError, match=r"\.high changed from 15\.0 to 20"):
        validate(load_study(study_file, [other_range], study.folder))
    for other, text in (
        ("training=[one]", "two is gone"),
        ("online.period=3", "other training sequences or descriptors"),
    ):
        with pytest.raises(AdaptuneError, match=text):
            validate(load_study(study_file, [other], study.folder))
    archive = study.archive().of("one")
    (archive / "00003.npz").rename(archive / "gone")
    with pytest.raises(ModelError, match=r"lacks trial 3 on one.*adaptune offline"):
        validate(study)


def test_a_bank_gains_where_no_set_is_better_than_another():
    rng = np.random.default_rng(6)
    sequences = [with_motions(f"s{i}", rng, 120) for i in range(7)]
    validation = leave_one_out(labelled(sequences), bank=3)
    assert validation.modes == ["adaptive", "paper"]
    assert validation.summary("adaptive")["geometric"] < 0.7
    assert "expected gain" in validation.verdict("adaptive")
    assert "of the weight on other sets than fixed" in validation.verdict("adaptive")
    assert all(0.2 < left_out.adapted["adaptive"] < 1.0 for left_out in validation.left_out)


def judged(data, study, monkeypatch, given=()):
    """What `validate` says of a model that is fitted to these data, and the model."""
    switching = SwitchingConfig(size=3)
    model = fit(data, data.fixed(), {}, 10.0, 1, {})
    model = with_bank(replace(model, blocks={"ndt": 90}), data, switching)
    model = replace(model, **dict(given))
    its_own = replace(model, sequences=study.training, window=study.window)
    monkeypatch.setattr(type(study), "model", lambda _: its_own)
    monkeypatch.setattr(validation, "_labelled", lambda *_: data)
    return model, validate(study)


def test_validate_judges_what_online_drives(study_file, tmp_path, monkeypatch):
    rng = np.random.default_rng(6)
    six = labelled([with_motions(f"s{i}", rng, 100) for i in range(6)])
    given = ["online.switching.mechanism=bank", "online.switching.size=3"]
    study = load_study(study_file, given, tmp_path)
    model, found = judged(six, study, monkeypatch)
    assert model.recommended == "fixed"  # what sets cost is not known
    assert model.expected["geometric"] < 1.0
    bank = ", ".join(map(str, model.bank))
    said = f"Recommended: trial {model.fixed}"
    assert found.verdicts[0].startswith(said)
    assert f"With cores to spare: adaptive, the bank of trials {bank}: exp" in found.verdicts[0]
    assert found.verdicts[0] == driven(model, study.config.online, study.odometry, study.mechanism)
    expected = "`adaptive`: expected gain "
    assert found.verdicts[1].startswith(expected)
    assert found.validation.modes == ["adaptive", "paper"]
    assert "adaptive" in found.rows[0]
    better = replace(model, recommended="adaptive")
    said = driven(better, study.config.online, study.odometry, study.mechanism)
    assert said.startswith(f"Recommended: adaptive, the bank of trials {bank}: expected gain")
    assert "what is left out, over 6 segments (" in found.verdicts[2]
    # Where it cannot be judged it says what is driven.
    alone = labelled(six.sequences[:1])
    for mechanism, why in (("bank", "With cores to spare: ad"), ("live", "names no bank")):
        given = [f"online.switching.mechanism={mechanism}", "online.switching.size=3"]
        study = load_study(study_file, given, tmp_path)
        match = f"one segment only, .* Recommended: trial .* {why}"
        with pytest.raises(ValidationError, match=match):
            judged(alone, study, monkeypatch)


def test_segments_of_one_recording_are_left_out():
    # 400 m, with sub-trajectories of 10 m.
    one = with_motions("one", np.random.default_rng(6), 1334)
    data = labelled([one])
    validation = leave_one_out(data, bank=2)
    assert [s.name for s in validation.left_out] == ["one"]
    assert len(validation.logs["adaptive"]) == len(validation.recordings) == 10
    assert validation.summary("adaptive")["geometric"] < 0.9
    assert "elsewhere along this recording (10 segments of one rec" in validation.verdict(
        "adaptive"
    )
    (left_out,) = validation.left_out
    np.testing.assert_array_equal(left_out.segment, one.segment)
    # The fixed set is another one in each segment; the errors are those of the whole recording.
    for number, (left, others) in enumerate(data.folds()):
        of = left_out.segment == number
        fixed = one.errors[of, SETS.column(others.fixed())]
        np.testing.assert_allclose(left_out.errors["fixed"][of], fixed, rtol=1e-6)
        assert len(left.errors) == of.sum()


@pytest.mark.parametrize(
    ("errors", "better"), [((0.5, 0.51), True), ((0.5, 1.0), False), ((1.5, 1.51), False)]
)
def test_the_baseline_is_better_only_where_the_interval_shows_it(errors, better):
    one_segment = np.zeros(9, int)
    left_out = [
        LeftOut(*2 * [f"s{i}"], one_segment, 1, {"baseline": of, "fixed": np.ones(9)}, {}, {})
        for i, of in enumerate(np.outer(errors, np.ones(9)))
    ]
    said = baseline_in_words(Validation(left_out))
    assert " times the error of the sets that are chosen without what is left out, over 2 " in said
    assert said.endswith("): there the baseline is better.") == better
    for one in left_out:
        one.errors["baseline"] = one.errors["fixed"]
    said = baseline_in_words(Validation(left_out))
    assert said == "Without what is left out, the baseline is chosen each time, over 2 segments."
