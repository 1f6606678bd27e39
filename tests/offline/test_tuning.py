from dataclasses import replace

import numpy as np
import pytest
from labelled_places import TRIALS, labelled, sequence, two_kinds, with_motions

from adaptune.model import PairedSettings
from adaptune.model.rules import Costs, SetCost
from offline import tuning
from offline.labelled import BankSimulation, LabelledData
from offline.tuning import (
    BANK_SETTINGS,
    DO_NOT_ADAPT,
    NO_BANK,
    PAIRED_SETTINGS,
    choose,
    expected_loss,
    reserve,
)


def tune(sequences):
    return choose(labelled(sequences), 0)


def bank_only(sequences):
    """Labelled data of an odometry that cannot change its parameters between scans."""
    return labelled(sequences)._replace(live=False)


def choose_bank_of(sequences, members, monkeypatch):
    monkeypatch.setattr(tuning, "_choosers", lambda *_: [lambda *_: members])
    return choose(bank_only(sequences), len(members))


def test_settings_are_chosen_on_the_sequences_at_hand():
    sequences = two_kinds(np.random.default_rng(0))
    # Set 2 everywhere, 0 in one kind of place and 4 in the other.
    found = tune(sequences)
    assert found.one_set == PairedSettings(n_sets=3, sharpness=6.0)
    assert found.expected["one set"].geometric == pytest.approx(np.sqrt(0.5 * 0.4), rel=0.05)
    # Where nothing is to be gained anywhere, nothing is tried.
    same = [replace(s, errors=np.ones_like(s.errors)) for s in sequences]
    assert tune(same).one_set == DO_NOT_ADAPT
    assert tune(same).expected["one set"].loss == 0.0
    # The last set is good in half of the sequences, and nothing tells which.
    rng = np.random.default_rng(5)
    random = [
        sequence(str(i), [9.0, 9.0, 1.0, 9.0, 0.5 if i % 2 else 2.5], 0, rng) for i in range(8)
    ]
    assert tune(random).one_set == DO_NOT_ADAPT
    # A single stretch shows nothing at all.
    alone = tune(sequences[:1])
    assert (alone.one_set, alone.expected) == (DO_NOT_ADAPT, {})


@pytest.mark.parametrize(("odd", "gains"), [(1.2, True), (30.0, False)])
def test_a_small_harm_is_outweighed_and_a_disaster_is_not(odd, gains):
    rng = np.random.default_rng(0)
    one, other = [2.0, 2.0, 1.0, 2.0, 4.0], [2.0, 2.0, 1.0, 2.0, 0.4]
    sequences = [sequence(f"one{i}", one, 0, rng) for i in range(4)]
    sequences += [sequence(f"other{i}", other, 1, rng) for i in range(8)]
    # It looks like those where the last set does well.
    sequences.append(sequence("odd", [2.0, 2.0, 1.0, 2.0, odd], 1, rng))
    data = labelled(sequences)
    (of_odd,) = [rest for left, rest in data.folds() if left.name == "odd"]
    assert of_odd.fixed() == TRIALS[2]
    assert choose(data, 0).one_set.adapt is gains


def test_a_bank_that_gains_nothing_does_not_adapt(monkeypatch):
    rng = np.random.default_rng(7)
    sequences = [with_motions(f"s{i}", rng, 100) for i in range(7)]
    # All members err alike: nothing cancels.
    alike = [
        replace(
            s,
            errors=np.repeat(s.errors[:, :1], 5, axis=1),
            vectors=dict.fromkeys(TRIALS, s.vectors[0]),
            simulation=replace(
                s.simulation, motions=lambda m, of=s.simulation.motions: of((0,) * len(m))
            ),
        )
        for s in sequences
    ]
    found = choose_bank_of(alike, [0, 3, 4], monkeypatch)
    assert found.bank == NO_BANK
    assert found.members == [0, 3, 4]
    found = choose_bank_of(sequences, [0, 8], monkeypatch)
    assert found.bank in BANK_SETTINGS
    # Two recordings are enough where the gain is large.
    assert choose_bank_of(sequences[:3], [0, 8], monkeypatch).bank.adapt


def test_the_least_loss_wins():
    both = np.zeros((8, len(PAIRED_SETTINGS) + 2 * len(BANK_SETTINGS), 2))
    logs, rivals = both[..., 0], both[..., 1]
    names = [str(i) for i in range(8)]
    banks = [[0, 1], [0, 2]]

    def best():
        return tuning.least_loss(both, names, banks, len(PAIRED_SETTINGS), 0.1)

    assert (best().one_set, best().bank) == (DO_NOT_ADAPT, NO_BANK)
    logs[:, 5] = -0.2
    assert (best().one_set, best().bank) == (PAIRED_SETTINGS[5], NO_BANK)
    second = len(PAIRED_SETTINGS) + len(BANK_SETTINGS)
    logs[:, second + 3] = -0.1
    assert best().bank == NO_BANK
    assert best().members == [0, 2]
    logs[:, second + 3] = -0.3
    found = best()
    # One set at a time is kept for where no bank can run.
    assert (found.one_set, found.bank) == (PAIRED_SETTINGS[5], BANK_SETTINGS[3])
    assert found.expected["bank"].loss == expected_loss(logs[:, second + 3], names)
    # A bank costs several times as much: it has to gain a tenth, and surely.
    logs[:] = 0.0
    for gain, spread, n, worth, adapts in (
        (0.3, 0.0, 8, 0.1, True),
        (0.08, 0.0, 8, 0.1, False),
        (0.08, 0.0, 8, 0.05, True),
        (0.3, 0.0, 8, 0.5, False),
        (0.3, 0.2, 8, 0.1, True),
        (0.3, 0.2, 2, 0.0, False),
        (0.3, 0.0, 1, 0.1, False),
    ):
        logs[:, second + 3] = -gain + spread * (-1.0) ** np.arange(8)
        found = tuning.least_loss(both[:n], names[:n], banks, len(PAIRED_SETTINGS), worth)
        assert found.bank.adapt == adapts, (gain, spread, n, worth)
        if n > 1:
            assert found.expected["bank"].loss == expected_loss(logs[:n, second + 3], names[:n])
    # A set that costs as much does as well.
    logs[:] = 0.0
    logs[:, second + 3] = -0.3
    assert best().bank.adapt
    rivals[:, second + 3] = -0.25
    assert not best().bank.adapt
    logs[:, 5] = rivals[:, 5] = -0.2
    assert not best().one_set.adapt
    rivals[:] = 0.0
    # What rounding gains is no gain.
    logs[:] = 0.0
    logs[:, second + 3] = -1e-9
    assert (best().one_set, best().bank) == (DO_NOT_ADAPT, NO_BANK)
    rng = np.random.default_rng(7)
    alone = labelled([with_motions("s", rng, 100)])
    assert choose(alone, 2).bank == NO_BANK


def test_the_baseline_is_the_reserve_of_a_bank():
    rng = np.random.default_rng(7)
    data = labelled([with_motions("s", rng, 500)])
    assert reserve([3, 8, 4], data) == [0]
    assert reserve([3, 0, 4], data) == []
    assert reserve([3], data) == []  # there is no bank
    without = [replace(s, vectors={t: s.vectors[t] for t in (3, 4, 8)}) for s in data.sequences]
    assert reserve([3, 8, 4], labelled(without)) == []
    costs = Costs({trial: SetCost(2.0, 1.0, 0) for trial in data.sets}, 0.5)
    for budget, found in ((9.5, [0]), (9.4, [])):
        limited = LabelledData(data.sequences, data.sets, costs, budget)
        assert reserve([3, 8, 4], limited) == found


def test_a_bank_is_simulated_with_smoothed_weights(monkeypatch):
    rng = np.random.default_rng(8)
    sequences = [with_motions(f"s{i}", rng, 100) for i in range(3)]
    seen = []
    simulate = BankSimulation.errors

    def errors(self, weights, agreeing):
        seen.append(weights.weights)
        return simulate(self, weights, agreeing)

    def bank_weights(near, _, live):
        assert len(live) == len(near.fixed)
        weights = np.zeros((len(near.fixed), near.products.shape[-1]))
        weights[::2, 0] = weights[1::2, 1] = 1.0
        near.evidence.familiarity[:] = 1.0
        return weights, np.ones(len(weights))

    monkeypatch.setattr(BankSimulation, "errors", errors)
    monkeypatch.setattr(tuning, "bank_weights", bank_weights)
    choose_bank_of(sequences, [0, 8], monkeypatch)
    assert len(seen) == 3 * len(BANK_SETTINGS)
    for weights in seen:
        np.testing.assert_allclose(weights[:2], [[1.0, 0.0], [0.5, 0.5]], atol=0.01)
        assert np.abs(weights[5:] - 0.5).max() < 0.11
