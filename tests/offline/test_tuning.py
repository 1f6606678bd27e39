from dataclasses import replace

import numpy as np
from labelled_places import TRIALS, labelled, with_motions

from adaptune.model.rules import Costs, SetCost
from adaptune.study.driven import expected_in_words
from offline import tuning
from offline.labelled import BankSimulation, LabelledData
from offline.tuning import (
    BANK_SETTINGS,
    NO_BANK,
    choose,
    expected_loss,
    reserve,
)


def choose_bank_of(sequences, members, monkeypatch):
    monkeypatch.setattr(tuning, "MEMBER_CHOOSERS", [lambda *_: members])
    return choose(labelled(sequences), len(members))


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
    both = np.zeros((8, 2 * len(BANK_SETTINGS), 2))
    logs, rivals = both[..., 0], both[..., 1]
    names = [str(i) for i in range(8)]
    banks = [[0, 1], [0, 2]]

    def best():
        return tuning.least_loss(both, names, banks, 0.1)

    assert best().bank == NO_BANK
    third = len(BANK_SETTINGS) + 3
    logs[:, 1] = -0.2
    assert (best().bank, best().members) == (BANK_SETTINGS[1], [0, 1])
    logs[:, third] = -0.3
    assert (best().bank, best().members) == (BANK_SETTINGS[3], [0, 2])
    assert best().expected.loss == expected_loss(logs[:, third], names)
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
        logs[:, third] = -gain + spread * (-1.0) ** np.arange(8)
        found = tuning.least_loss(both[:n], names[:n], banks, worth)
        assert found.bank.adapt == adapts, (gain, spread, n, worth)
        if n > 1:
            assert found.expected.loss == expected_loss(logs[:n, third], names[:n])
    # A set that costs as much does as well.
    logs[:] = 0.0
    logs[:, third] = -0.3
    assert best().bank.adapt
    rivals[:, third] = -0.25
    assert not best().bank.adapt
    gain = "expected gain 26 % (95 % interval 26 to 26 %"
    said = expected_in_words(best().expected._asdict())
    assert said.startswith(
        f"{gain}; 5 % over the best single set that costs no more), in the worst"
    )
    rivals[:] = 0.0
    assert expected_in_words(best().expected._asdict()).startswith(f"{gain}), in the worst")
    # What rounding gains is no gain.
    logs[:] = 0.0
    logs[:, third] = -1e-9
    assert best().bank == NO_BANK
    rng = np.random.default_rng(7)
    alone = choose(labelled([with_motions("s", rng, 100)]), 2)
    assert (alone.bank, alone.expected) == (NO_BANK, None)


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


def test_a_bank_is_simulated_with_the_weights_of_each_period(monkeypatch):
    rng = np.random.default_rng(8)
    sequences = [with_motions(f"s{i}", rng, 100) for i in range(3)]
    seen = []
    simulate = BankSimulation.errors

    def errors(self, members, weights, agreeing):
        seen.append(weights)
        return simulate(self, members, weights, agreeing)

    def bank_weights(near, _, live):
        assert len(live) == len(near.fixed)
        weights = np.zeros((len(near.fixed), near.products.shape[-1]))
        weights[::2, 0] = weights[1::2, 1] = 1.0
        near.frames.familiarity[:] = 1.0
        return weights, np.ones(len(weights))

    monkeypatch.setattr(BankSimulation, "errors", errors)
    monkeypatch.setattr(tuning, "bank_weights", bank_weights)
    choose_bank_of(sequences, [0, 8], monkeypatch)
    assert len(seen) == 3 * len(BANK_SETTINGS)
    for weights in seen:
        np.testing.assert_array_equal(weights[:2], [[1.0, 0.0], [0.0, 1.0]])
