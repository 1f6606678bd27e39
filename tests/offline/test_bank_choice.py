from dataclasses import replace

import numpy as np
from labelled_places import TRIALS, labelled, with_motions

from adaptune.model.rules import Costs, SetCost
from offline import bank_choice
from offline.bank_choice import (
    BANK_SETTINGS,
    Policy,
    choose,
    expected_loss,
    figures,
    recommends_bank,
    reserve,
)
from offline.labelled import BankSimulation, LabelledData


def choose_bank_of(sequences, members, monkeypatch):
    monkeypatch.setattr(bank_choice, "MEMBER_CHOOSERS", [lambda *_: members])
    return choose(labelled(sequences), len(members))


def test_a_bank_that_gains_nothing_is_not_expected_to(monkeypatch):
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
    assert abs(found.expected.loss) < 1e-6
    assert found.members == [0, 3, 4]
    found = choose_bank_of(sequences, [0, 8], monkeypatch)
    assert found.bank in BANK_SETTINGS
    assert found.expected.loss < 0.0
    # Two recordings are enough where the gain is large.
    assert choose_bank_of(sequences[:3], [0, 8], monkeypatch).expected.loss < 0.0


def test_the_least_loss_wins():
    logs = np.zeros((8, 2 * len(BANK_SETTINGS)))
    names = [str(i) for i in range(8)]
    banks = [[0, 1], [0, 2]]

    def best():
        return bank_choice.least_loss(logs, names, banks)

    assert best().expected.loss == 0.0
    third = len(BANK_SETTINGS) + 3
    logs[:, 1] = -0.2
    assert (best().bank, best().members) == (BANK_SETTINGS[1], [0, 1])
    logs[:, third] = -0.3
    assert (best().bank, best().members) == (BANK_SETTINGS[3], [0, 2])
    assert best().expected.loss == expected_loss(logs[:, third], names)
    # What rounding gains is no gain.
    logs[:] = 0.0
    logs[:, third] = -1e-9
    assert (best().bank, best().members) == (BANK_SETTINGS[0], [0, 1])
    rng = np.random.default_rng(7)
    alone = choose(labelled([with_motions("s", rng, 100)]), 2)
    assert (alone.bank, alone.expected) == (BANK_SETTINGS[0], None)
    assert len(alone.members) == 2


def test_a_bank_is_recommended_within_the_budget_or_where_the_fixed_set_fails():
    rng = np.random.default_rng(7)
    data = labelled([with_motions("s", rng, 100)])
    costs = Costs({trial: SetCost(2.0, 1.0, 0) for trial in data.sets}, 0.5)
    data, members = data._replace(costs=costs), [3, 4]  # 5.5 ms, where the baseline has 3
    gains = figures(np.array([-0.5, -0.4]), ["a", "a"])
    chosen = Policy(BANK_SETTINGS[0], members, gains)
    assert recommends_bank(data, chosen, 3)
    assert not recommends_bank(data._replace(budget=5.0), chosen, 3)
    assert recommends_bank(data._replace(budget=5.5), chosen, 3)
    restarts = np.full(len(data.sets), 1.0)
    failing = [replace(s, restarts=restarts) for s in data.sequences]
    assert recommends_bank(data._replace(budget=5.0, sequences=failing), chosen, 3)
    loses = chosen._replace(expected=figures(np.array([0.5, 0.4]), ["a", "a"]))
    for none in (loses, chosen._replace(expected=None), chosen._replace(members=[3])):
        assert not recommends_bank(data, none, 3)


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
    # Without a budget, half of the time from scan to scan on each core.
    dear = {trial: SetCost(data.period / 8.0, 0.0, 0) for trial in data.sets}
    slow = LabelledData(data.sequences, data.sets, Costs(dear, 0.0))
    assert [slow._replace(cores=n).can_pay(TRIALS[:4]) for n in (1, 2)] == [True, True]
    assert [slow._replace(cores=n).can_pay(TRIALS) for n in (1, 2)] == [False, True]


def test_a_bank_is_simulated_with_the_weights_of_each_period(monkeypatch):
    rng = np.random.default_rng(8)
    sequences = [with_motions(f"s{i}", rng, 100) for i in range(3)]
    seen = []
    simulate = BankSimulation.errors

    def errors(self, members, weights, agreeing):
        seen.append(weights)
        return simulate(self, members, weights, agreeing)

    def bank_weights(near, _, hops):
        assert len(hops) == len(near.fixed)
        weights = np.zeros((len(near.fixed), near.products.shape[-1]))
        weights[::2, 0] = weights[1::2, 1] = 1.0
        near.frames.similarity[:] = 1.0
        return weights, np.ones(len(weights))

    monkeypatch.setattr(BankSimulation, "errors", errors)
    monkeypatch.setattr(bank_choice, "bank_weights", bank_weights)
    choose_bank_of(sequences, [0, 8], monkeypatch)
    assert len(seen) == 3 * len(BANK_SETTINGS)
    for weights in seen:
        np.testing.assert_array_equal(weights[:2], [[1.0, 0.0], [0.0, 1.0]])
