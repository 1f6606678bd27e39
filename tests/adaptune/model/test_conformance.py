"""What every selection rule must do, one suite for all of them, a user's own included."""

import math
from dataclasses import replace

import numpy as np
import pytest
from random_models import random_model
from tables import table

from adaptune.model import BankSettings, Rule, TrainingData
from adaptune.model.registry import RULES, rule_class
from adaptune.model.rules import Costs, Evidence, SetCost
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from adaptune.selector import Selector

USERS = "users_rule:Cheapest"
NAMES = [*RULES, "adaptune.model:FixedSet", USERS]
TRIALS, FIXED, MEMBERS = (0, 3, 4, 7, 9), 4, (4, 9, 3)
N_SEQUENCES, N_FRAMES = 3, 40

every_rule = pytest.mark.parametrize("name", NAMES)
every_mechanism = pytest.mark.parametrize("members", [None, MEMBERS], ids=["one set", "bank"])
every_case = lambda test: every_rule(every_mechanism(test))  # noqa: E731


def training(members=None, allowed=None, n_frames=N_FRAMES, n_sequences=N_SEQUENCES):
    """Errors of five sets: some tracks are lost, and one set was not run on all sequences."""
    rng = np.random.default_rng(0)
    n = n_frames * n_sequences
    vectors = rng.normal(0.0, 1.0, (n, len(TRIALS), 3)).astype(np.float32)
    vectors[rng.random((n, len(TRIALS))) < 0.05] = np.inf
    errors = np.linalg.norm(vectors, axis=-1)
    sequence = np.repeat(np.arange(n_sequences), n_frames)
    if n_sequences > 1:
        errors[sequence == 0, TRIALS.index(7)] = np.nan
    columns = [TRIALS.index(trial) for trial in members or ()]
    costs = {trial: SetCost(5.0 + trial, 1.0, 0) for trial in TRIALS}
    return TrainingData(
        rng.normal(size=(n, 3)),
        sequence,
        errors,
        table(rng.random((len(TRIALS), 2)), TRIALS),
        FIXED,
        members,
        vectors[:, columns] if members else None,
        allowed,
        Costs(costs, 2.0),
    )


def fitted(name, data):
    """The rule as a selector makes it."""
    cls = rule_class(name)
    has_weights = cls.gives_weights and data.candidates is not None
    return cls.of(BankSettings() if has_weights else None).fit(data)


def check(selection, data, gives_weights):
    """A set that may be chosen, or weights of just the members."""
    assert selection.trial in (data.candidates or TRIALS)
    assert selection.trial in (data.allowed or TRIALS)
    assert selection.parameters == data.sets[selection.trial]
    for figure in (selection.predicted_error, selection.predicted_fixed, selection.similarity):
        assert math.isnan(figure) or 0.0 <= figure < math.inf
    assert (selection.weights is not None) == gives_weights
    if gives_weights:
        weights = list(selection.weights.values())
        assert list(selection.weights) == list(data.candidates)
        assert min(weights) >= 0.0
        assert math.fsum(weights) == pytest.approx(1.0)
        assert selection.weights[selection.trial] == max(weights)


def scans(data):
    """Descriptors: one of the training's, some others, and one unlike anything."""
    rng = np.random.default_rng(1)
    return [data.features[0], *rng.normal(size=(8, data.features.shape[1])), np.full(3, 1e6)]


@every_rule
def test_it_says_what_it_is(name):
    cls = rule_class(name)
    assert issubclass(cls, Rule)
    if name in (*RULES, USERS):
        assert cls.sentence != Rule.sentence
        assert not cls.sentence.endswith(".")


@every_case
def test_it_selects_what_may_be_chosen(name, members):
    for allowed in (None, (0, 3, 4)):  # a budget allows the cheap ones
        data = training(members, allowed)
        rule = fitted(name, data)
        has_weights = rule.gives_weights and members is not None
        # All members of a bank work together; a budget has allowed that already.
        seen = data if not has_weights else replace(data, allowed=None)
        for feature in scans(data):
            check(rule.select(feature), seen, has_weights)


@every_case
def test_it_selects_the_same_again_and_keeps_its_data(name, members):
    data = training(members)
    for array in (data.features, data.sequence, data.errors, data.vectors):
        if array is not None:
            array.flags.writeable = False
    first, second = fitted(name, data), fitted(name, training(members))
    asked = scans(data)
    found = [first.select(feature) for feature in asked]
    # In whatever order it is asked: a selector begins anew and keeps the rule.
    assert [repr(second.select(feature)) for feature in asked[::-1]] == list(
        map(repr, reversed(found))
    )


@every_case
def test_fit_returns_the_rule(name, members):
    data = training(members)
    rule = fitted(name, data)
    assert isinstance(rule, Rule)
    assert rule.fit(data) is rule


@every_case
@pytest.mark.parametrize(("n_frames", "n_sequences"), [(1, 1), (2, 3), (N_FRAMES, 1)])
def test_little_training_is_enough(name, members, n_frames, n_sequences):
    data = training(members, n_frames=n_frames, n_sequences=n_sequences)
    rule = fitted(name, data)
    for feature in scans(data):
        check(rule.select(feature), data, rule.gives_weights and members is not None)


@every_case
def test_it_heeds_only_what_may_be_chosen_while_driving(name, members):
    data = training(members)
    rule, asked = fitted(name, data), []

    def at_work(those, similarity, predicted):
        asked.append((similarity, predicted))
        return those[:1]

    worse = dict.fromkeys(TRIALS, 20.0) | {FIXED: 25.0}
    evidence = Evidence(lambda: worse, lambda _: None, at_work)
    for feature in scans(data):
        selection = rule.select(feature, evidence)
        check(selection, data, rule.gives_weights and members is not None)
        if asked:  # who rests has no weight
            assert selection.weights[members[0]] == pytest.approx(1.0)


@every_rule
@pytest.mark.parametrize("members", [(), (4, 10)], ids=["one set", "bank"])
def test_a_selector_takes_it(name, members):
    costs = Costs({trial: SetCost(5.0, 1.0, 0) for trial in range(0, 12, 2)}, 2.0)
    model = replace(random_model(), costs=costs)
    selector = Selector(model, name, members)
    assert selector.members == members
    points = np.random.default_rng(0).uniform(-20.0, 20.0, (2000, 3)).astype(np.float32)
    moved = Motions(np.eye(4), {member: np.eye(4) for member in members})
    selector.observe(10**9, Scan(10**9, points), moved)
    selection = selector.select()
    assert selection.trial in (members or model.sets)
    assert selection.parameters == model.sets[selection.trial]
