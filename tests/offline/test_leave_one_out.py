import itertools
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tables import table

from adaptune.errors import AdaptuneError
from adaptune.metrics import sub_trajectory_vectors
from adaptune.model import ErrorModel, ModelError
from adaptune.model.base import Rule
from adaptune.selection import Selection
from adaptune.study.config import SwitchingConfig
from adaptune.study.driven import driven
from adaptune.study.mistakes import ConfigurationError
from offline import tuning
from offline import validate as validation_of_study
from offline.bank_simulation import BankSimulation
from offline.curves import bank_curve, learning_curve
from offline.fit import fit, tuned
from offline.labelled import LabelledData, LabelledSequence
from offline.leave_one_out import LeftOut, Validation, ValidationError, leave_one_out
from offline.offline_study import load_study
from offline.tuning import DO_NOT_ADAPT, NO_BANK, PairedSettings, tune, tune_bank
from offline.validate import validate

TRIALS = (0, 3, 4, 7, 8)
SETS = table(np.linspace(0.0, 1.0, 5)[:, None], TRIALS)


def labelled(sequences):
    return LabelledData(sequences, SETS)


def sequence(name, means, kind, rng, n=80):
    """A sequence of one kind of place, whose errors differ from set to set."""
    histograms = rng.poisson(3.0, (n, 90)).astype(float)
    histograms[:, kind * 9 : kind * 9 + 9] += 30.0
    errors = (np.array(means) * rng.uniform(0.9, 1.1, (n, 1))).astype(np.float32)
    return LabelledSequence(name, np.arange(n) // 10, histograms, errors)


def two_kinds(rng):
    """Set 2 does everywhere; set 0 is better in one kind of place, set 4 in the other."""
    kinds = {0: [0.5, 1.5, 1.0, 2.0, 3.0], 1: [3.0, 2.0, 1.0, 1.5, 0.4]}
    return [sequence(f"{k}{i}", kinds[k], k, rng) for k, i in itertools.product((0, 1), range(4))]


def test_rules_gain_where_places_tell_the_sets_apart():
    validation = leave_one_out(labelled(two_kinds(np.random.default_rng(0))))
    for rule in ("paired", "paper"):
        np.testing.assert_allclose(validation.ratios[rule], [0.5] * 4 + [0.4] * 4, rtol=0.05)
        assert validation.verdict(rule).startswith(f"Adapt by `{rule}`")
    np.testing.assert_allclose(
        validation.ratios["oracle, period"], [0.5] * 4 + [0.4] * 4, rtol=0.05
    )
    np.testing.assert_allclose(validation.ratios["baseline"], [0.5] * 4 + [3.0] * 4, rtol=0.05)


class Cheat(Rule):
    """Knows only what it was fitted on, and shows it."""

    fitted = ()

    def fit(self, data):
        self.data = data
        Cheat.fitted += (data,)
        return self

    def predict(self, feature):
        raise NotImplementedError

    def select(self, _feature, _current=None):
        return Selection(0, {})


def test_the_sequence_left_out_is_never_seen():
    sequences = two_kinds(np.random.default_rng(1))
    marked = [
        LabelledSequence(s.name, s.period, s.descriptors, s.errors + np.float32(i))
        for i, s in enumerate(sequences)
    ]
    Cheat.fitted = ()
    leave_one_out(labelled(marked), {"cheat": lambda *_: Cheat()})
    for i, data in enumerate(Cheat.fitted):
        seen = {e.tobytes() for e in data.errors}
        assert not seen & {e.tobytes() for e in marked[i].errors}
        assert len(seen) == 7 * 80


def test_a_selection_holds_for_its_second():
    asked = []

    class Remember(Cheat):
        def select(self, feature, _current=None):
            asked.append(feature)
            return Selection(TRIALS[len(asked) % 2], {})

    sequences = two_kinds(np.random.default_rng(2))[:2]
    validation = leave_one_out(labelled(sequences), {"r": lambda *_: Remember()})
    assert len(asked) == 2 * 8
    expected = np.where(np.arange(80) // 10 % 2 == 0, 1, 0)
    np.testing.assert_allclose(
        validation.left_out[0].errors["r"], sequences[0].errors[np.arange(80), expected], rtol=1e-6
    )


def test_the_oracle_is_never_worse_than_anything():
    rng = np.random.default_rng(3)
    sequences = [sequence(str(i), rng.lognormal(size=5), i % 3, rng) for i in range(6)]
    ratios = leave_one_out(labelled(sequences)).ratios
    for mode in ratios:
        assert (ratios["oracle, period"] <= ratios[mode] + 1e-12).all()


@pytest.mark.parametrize(
    ("ratios", "verdict"),
    [
        ([0.5, 0.6, 0.7, 0.8, 0.5, 0.6], "Adapt by"),
        ([0.5, 0.6, 0.7, 0.8, 0.6], "Too few"),
        ([0.5, 0.6, 0.7, 0.5, 0.6, 1.2], "Do not adapt by"),
        ([0.7, 1.04, 1.02, 1.01, 1.0, 1.0], "Nothing shows that"),
        ([1.0] * 6, "Nothing shows that"),
    ],
)
def test_verdicts(ratios, verdict):
    kept = LeftOut(
        "a", {m: np.ones(9) for m in ("fixed", "rule")}, {"rule": 0.0}, *[np.ones(6)] * 2
    )
    assert Validation([kept] * 6).verdict("rule").startswith("`rule` kept the fixed set")
    left_out = [
        LeftOut(str(i), {"fixed": np.ones(9), "rule": np.full(9, r)}, {}, np.ones(9), np.ones(6))
        for i, r in enumerate(ratios)
    ]
    assert Validation(left_out).verdict("rule").startswith(verdict)


def test_intervals_over_time():
    fixed = 1.0 + np.arange(400) % 2
    errors = {"fixed": fixed, "rule": 0.5 * fixed}
    left_out = LeftOut("a", errors, {}, np.ones(400), np.ones(6), block=40)
    assert left_out.interval("rule") == pytest.approx((0.5, 0.5))
    assert left_out._replace(block=41).interval("rule") is None


def test_settings_are_chosen_on_the_sequences_at_hand():
    sequences = two_kinds(np.random.default_rng(0))
    # Set 2 everywhere, 0 in one kind of place and 4 in the other.
    assert tune(labelled(sequences)) == PairedSettings(sharpness=6.0)
    # Where nothing is to be gained anywhere, nothing is tried.
    same = [replace(s, errors=np.ones_like(s.errors)) for s in sequences]
    assert tune(labelled(same)) == DO_NOT_ADAPT
    # The last set is good in half of the sequences, and nothing tells which.
    rng = np.random.default_rng(5)
    random = [
        sequence(str(i), [9.0, 9.0, 1.0, 9.0, 0.5 if i % 2 else 2.5], 0, rng) for i in range(8)
    ]
    assert tune(labelled(random)) == DO_NOT_ADAPT
    assert tune(labelled(sequences[:5])) == DO_NOT_ADAPT


@pytest.mark.parametrize(("odd", "pays"), [(1.04, True), (1.5, False)])
def test_no_gain_makes_up_for_harm(odd, pays):
    rng = np.random.default_rng(0)
    one, other = [2.0, 2.0, 1.0, 2.0, 4.0], [2.0, 2.0, 1.0, 2.0, 0.4]
    sequences = [sequence(f"one{i}", one, 0, rng) for i in range(4)]
    sequences += [sequence(f"other{i}", other, 1, rng) for i in range(8)]
    # It looks like those where the last set does well.
    sequences.append(sequence("odd", [2.0, 2.0, 1.0, 2.0, odd], 1, rng))
    assert (tune(labelled(sequences)) != DO_NOT_ADAPT) is pays


def test_a_gain_that_may_be_chance_is_none():
    def places(gains):
        rng = np.random.default_rng(0)
        one, other = [2.0, 2.0, 1.0, 2.0, 2.0], [2.0, 2.0, 1.0, 2.0, 0.4]
        return [sequence(f"one{i}", one, 0, rng) for i in range(6)] + [
            sequence(f"other{i}", other, 1, rng) for i in range(gains)
        ]

    # Where two of eight gain, the interval of the mean holds 1; not so with six of twelve.
    assert tune(labelled(places(2))) == DO_NOT_ADAPT
    assert tune(labelled(places(6))) == PairedSettings(sharpness=6.0)


def test_a_sequence_left_out_is_judged_on_the_sets_it_has_seen():
    sequences = two_kinds(np.random.default_rng(0))
    for i, s in enumerate(sequences):
        s.errors[:, 1 + i % 2 * 2] = np.nan
    validation = leave_one_out(labelled(sequences))
    for mode, ratios in validation.ratios.items():
        assert np.isfinite(ratios).all(), mode
    np.testing.assert_allclose(validation.ratios["paired"], [0.5] * 4 + [0.4] * 4, rtol=0.05)


def test_what_several_sets_would_be_worth():
    validation = leave_one_out(labelled(two_kinds(np.random.default_rng(0))))
    # With two sets the second is for the other kind of place, of which one more was trained on.
    np.testing.assert_allclose(
        validation.portfolio(), [1.0, 1.0, *[np.sqrt(0.5 * 0.4)] * 4], rtol=0.05
    )


def test_more_sequences_teach_more():
    sequences = two_kinds(np.random.default_rng(0))
    rows = learning_curve(labelled(sequences))
    assert [row["sequences"] for row in rows] == [3, 5, 7]
    assert rows[-1]["geometric"] == pytest.approx(np.sqrt(0.5 * 0.4), rel=0.05)
    assert rows[-1]["geometric"] <= rows[0]["geometric"] + 1e-9
    assert learning_curve(labelled(sequences)) == rows


def test_one_sequence_cannot_be_validated():
    with pytest.raises(ValidationError, match="one sequence"):
        leave_one_out(labelled(two_kinds(np.random.default_rng(0))[:1]))


def test_a_sequence_is_left_out_with_its_views():
    sequences = two_kinds(np.random.default_rng(4))[:3]
    seen = [
        replace(s, name=f"{s.name}+noise", errors=s.errors + np.float32(100 + i))
        for i, s in enumerate(sequences)
    ]
    Cheat.fitted = ()
    validation = leave_one_out(labelled([*sequences, *seen]), {"cheat": lambda *_: Cheat()})
    assert [s.name for s in validation.left_out] == [s.name for s in sequences]
    for i, data in enumerate(Cheat.fitted):
        fitted = {e.tobytes() for e in data.errors}
        assert not fitted & {e.tobytes() for e in (*sequences[i].errors, *seen[i].errors)}
        assert len(fitted) == 4 * 80
    with pytest.raises(ValidationError, match="one sequence"):
        leave_one_out(labelled([sequences[0], seen[0]]))


def test_the_fixed_set_is_chosen_by_what_the_study_judges_by():
    sequences = two_kinds(np.random.default_rng(5))
    for value, expected in (([5, 4, 3, 2, 1], 4), ([np.inf, 1, 2, 3, 4], 1)):
        judged = [replace(s, values=np.array(value, float)) for s in sequences]
        data, _ = labelled(judged).training_data()
        assert data.fixed == labelled(judged).fixed() == TRIALS[expected]


def test_validates_a_study(study_file, trained_folder, tmp_path, caplog):
    study = load_study(study_file, [], shutil.copytree(trained_folder, tmp_path / "study"))
    validation, rows, learning, banks, verdicts = validate(study, curve=True, sizes=True)
    # Two sequences show nothing: the fixed set is driven.
    assert verdicts[0].startswith("`online` will drive the fixed set")
    assert verdicts[0].endswith("because adapting takes 6 training sequences, and there are 2.")
    assert all(np.isnan(one.familiarity).all() for one in validation.left_out)
    assert "Adapt" not in "".join(verdicts)
    assert [row["left out"] for row in rows] == ["one", "two", "geometric", "arithmetic", "worst"]
    assert rows[0]["paired"] == pytest.approx(validation.ratios["paired"][0])
    # Four sub-trajectories tell nothing; a dozen would.
    assert rows[0]["paired, 95 %"] is None
    summary = validation.summary("paired")
    assert rows[2]["paired, 95 %"] == f"{summary['low']:.2f}-{summary['high']:.2f}"
    assert validation.left_out[0].block > 1
    assert [row["sequences"] for row in learning] == [1]
    n_sets = len(ErrorModel.load(study.model_path).sets)
    # Two sequences show nothing: no bank is driven, of whatever size.
    assert [(row["instances"], row["geometric"]) for row in banks] == [
        (size, 1.0) for size in range(2, 1 + min(6, n_sets))
    ]
    for name in ("validation", "learning", "banks"):
        assert (study.folder / f"{name}.csv").exists()
    other_range = "odometry.parameters.keyframe_interval.high=20"
    with pytest.raises(ConfigurationError, match=r"keyframe_interval\.high has another value"):
        validate(load_study(study_file, [other_range], study.folder))
    for other, text in (
        ("training=[one]", "other training sequences"),
        ("descriptor.window=0", "other training sequences or descriptors"),
    ):
        with pytest.raises(AdaptuneError, match=text):
            validate(load_study(study_file, [other], study.folder))
    assert "no whole runs" not in caplog.text
    validate(load_study(study_file, ["health.max_speed=30"], study.folder))
    assert "have no whole runs with this health check" in caplog.text
    archive = study.folder / "trials/one"
    (archive / "00003.npz").rename(archive / "gone")
    with pytest.raises(ModelError, match=r"lacks trial 3 on one.*adaptune offline"):
        validate(study)


def with_motions(of, rng, n_steps=300):
    """A sequence along x on which sets 0 and 4 err in opposite directions, and set 2 in both."""
    T_ref_sensor = np.tile(np.eye(4), (n_steps, 1, 1))
    T_ref_sensor[1:, 0, 3] = 0.3 * np.arange(1, n_steps)
    stamps = np.arange(n_steps, dtype=np.int64) * 10**8
    noise = rng.normal(0.0, 0.003, (n_steps - 1, 5))
    noise[:, [0, 4]] = noise[:, :1] * [1.0, -1.0]
    motions = np.tile(np.eye(4), (n_steps - 1, 5, 1, 1))
    motions[..., 0, 3] = 0.3 + noise
    motions[..., 1, 3] = rng.normal(0.0, 0.0005, noise.shape)
    vectors, errors = [], []
    for j in range(5):
        T = np.tile(np.eye(4), (n_steps, 1, 1))
        T[1:, :2, 3] = np.cumsum(motions[:, j, :2, 3], axis=0)
        vectors.append(sub_trajectory_vectors(T_ref_sensor, T, 10.0))
        errors.append(np.linalg.norm(vectors[-1], axis=1))
    known = ~np.isnan(errors[0])
    described = rng.poisson(3.0, (n_steps, 90)).astype(np.float32)
    period = np.arange(n_steps) // 10
    simulation = BankSimulation(
        stamps, T_ref_sensor, described, period, 10.0, 3.0, lambda m: motions[:, SETS.columns(m)]
    )
    return LabelledSequence(
        of,
        period[known],
        described[known],
        np.array(errors, np.float32).T[known],
        vectors={t: v[known].astype(np.float32) for t, v in zip(TRIALS, vectors, strict=True)},
        simulation=simulation,
    )


def test_a_bank_gains_where_no_set_is_better_than_another():
    rng = np.random.default_rng(6)
    sequences = [with_motions(f"s{i}", rng, 200) for i in range(7)]
    validation = leave_one_out(labelled(sequences), {}, bank=3)
    assert validation.modes == ["paired"]
    assert validation.summary("paired")["geometric"] < 0.5
    assert validation.verdict("paired").startswith("Adapt by `paired` with the bank")
    assert all(0.2 < left_out.adapted["paired"] < 1.0 for left_out in validation.left_out)
    # Members that are named: what cancels is not among them.
    named = leave_one_out(labelled(sequences), {}, bank=[0, 3])
    assert 0.5 < named.summary("paired")["geometric"] < 0.9
    banks = bank_curve(labelled(sequences))
    assert [row["instances"] for row in banks] == [2, 3, 4, 5]
    assert banks[1] == {"instances": 3} | validation.summary("paired")
    assert not leave_one_out(labelled(sequences), {}, bank=0).modes
    rows = learning_curve(labelled(sequences[:6]), bank=2)
    assert [row["sequences"] for row in rows] == [3, 5]
    assert rows[0]["geometric"] == 1.0  # too few to show anything
    # Five others are enough, as the six sequences of a study are.
    assert rows[1]["geometric"] < 0.9
    six = leave_one_out(labelled(sequences[:6]), {}, bank=2)
    assert six.summary("paired") == {k: v for k, v in rows[1].items() if k != "sequences"}
    assert "dapt by `paired` with the bank" in six.verdict("paired")
    assert "over 6 sequences left out it has" in six.verdict("paired")
    assert leave_one_out(labelled(sequences[:5]), {}, bank=2).ratios["paired"].tolist() == [1.0] * 5


def judged(data, study, monkeypatch, given=()):
    """What `validate` says of a model that is fitted to these data, and the model."""
    switching = SwitchingConfig(size=3)
    model = fit(data, data.fixed(), {}, 10.0, 1, {})
    model = tuned(replace(model, blocks={"ndt": 90}), data, switching)
    model = replace(model, **dict(given))
    monkeypatch.setattr(validation_of_study, "_checked_model", lambda _: model)
    monkeypatch.setattr(validation_of_study, "_labelled", lambda *_: data)
    return model, validate(study)


def test_validate_judges_what_online_drives(study_file, tmp_path, monkeypatch):
    rng = np.random.default_rng(6)
    six = labelled([with_motions(f"s{i}", rng, 200) for i in range(6)])
    given = ["online.switching.mechanism=bank", "online.switching.size=3"]
    study = load_study(study_file, given, tmp_path)
    model, found = judged(six, study, monkeypatch)
    # Six sequences are enough for a bank; with one left out, five are.
    assert model.bank_adapts
    bank = ", ".join(map(str, model.bank))
    assert found.verdicts[0] == f"`online` will drive the bank of trials {bank} as `paired`."
    assert found.verdicts[0] == driven(study, model).words
    assert found.verdicts[1].startswith("Adapt by `paired` with the bank: over 6 sequences left")
    assert found.validation.bank
    assert found.validation.modes == ["paired", "one set", "paper"]
    assert {"paired", "one set"} <= set(found.rows[0])
    # The same model without a bank: one set at a time, or the fixed set alone.
    given = [("paired", PairedSettings()), ("bank_settings", NO_BANK)]
    _, found = judged(six, study, monkeypatch, given)
    assert found.verdicts[0] == "`online` will drive one set at a time as `paired`, changed live."
    assert "`paired` kept the fixed set" in found.verdicts[1]
    _, found = judged(six, study, monkeypatch, [("paired", DO_NOT_ADAPT), given[1]])
    assert found.verdicts[0].startswith("`online` will drive the fixed set (trial ")
    assert found.verdicts[0].endswith("did not show that adapting pays.")
    assert "sets that are chosen without each sequence, over 6 seq" in found.verdicts[1]
    assert not found.validation.bank
    assert "one set" not in found.rows[0]
    # Where it cannot be judged it says what is driven.
    alone = labelled(six.sequences[:1])
    with pytest.raises(ValidationError, match=r"one sequence cannot .* will drive the fixed set"):
        judged(alone, study, monkeypatch)


def test_validate_says_that_the_baseline_is_better(study_file, tmp_path, monkeypatch):
    data = labelled(two_kinds(np.random.default_rng(0)))
    whole = {0: 1.0, 3: 4.0, 4: 3.0}
    data = data._replace(sequences=[replace(s, whole=whole) for s in data.sequences])
    assert data.fixed() == 0
    study = load_study(study_file, ["online.switching.mechanism=live"], tmp_path)
    monkeypatch.setattr(validation_of_study, "_checked_model", lambda _: model)
    monkeypatch.setattr(validation_of_study, "_labelled", lambda *_: data)
    model = replace(fit(data, 0, {}, 10.0, 1, {}), blocks={"ndt": 90})
    said = validate(study).verdicts[-1]
    assert said == (
        "In whole runs with the health check, the baseline is better than the trials suggested: "
        "its rte is 1, that of trial 4, the best by its trials, 3. "
        "So the fixed set is the baseline."
    )


def test_a_bank_is_simulated_with_smoothed_weights(monkeypatch):
    rng = np.random.default_rng(8)
    sequences = [with_motions(f"s{i}", rng) for i in range(7)]
    seen = []

    def errors(self, weights):
        seen.append(weights.weights)
        return np.full(len(self.stamps), 0.1)

    def bank_weights(near, _):
        weights = np.zeros((len(near.fixed), near.products.shape[-1]))
        weights[::2, 0] = weights[1::2, 1] = 1.0
        near.evidence.familiarity[:] = 1.0
        return weights, np.ones(len(weights))

    monkeypatch.setattr(BankSimulation, "errors", errors)
    monkeypatch.setattr(tuning, "bank_weights", bank_weights)
    leave_one_out(labelled(sequences), {}, bank=2)
    # With each setting on each of the others, and then on the one left out.
    assert len(seen) == 7 * (6 * 12 + 1)
    for weights in seen:
        np.testing.assert_allclose(weights[:2], [[1.0, 0.0], [0.5, 0.5]], atol=0.01)
        assert np.abs(weights[5:] - 0.5).max() < 0.11


def test_a_bank_that_does_not_pay_keeps_the_fixed_set():
    rng = np.random.default_rng(7)
    sequences = [with_motions(f"s{i}", rng) for i in range(7)]
    # All members err alike: nothing cancels.
    alike = [
        replace(
            s,
            errors=np.repeat(s.errors[:, :1], 5, axis=1),
            vectors=dict.fromkeys(TRIALS, s.vectors[0]),
            simulation=replace(
                s.simulation,
                motions=lambda m, of=s.simulation.motions: of((0,) * len(m)),
            ),
        )
        for s in sequences
    ]
    assert tune_bank(labelled(alike), [0, 3, 4], 0) == NO_BANK
    validation = leave_one_out(labelled(alike), {})
    np.testing.assert_array_equal(validation.ratios["paired"], 1.0)
    assert "kept the fixed set" in validation.verdict("paired")
    assert tune_bank(labelled(sequences[:5]), [0, 8], 0).adapt is False
    assert tune_bank(labelled(sequences), [0, 8], 0).adapt
