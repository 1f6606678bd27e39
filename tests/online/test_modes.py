"""The modes of a replay."""

from dataclasses import replace

import numpy as np
import pytest
from random_models import random_model

from adaptune.model import BankSettings
from adaptune.model.rules import Costs, SetCost
from adaptune.odometry.factory import OdometryFactory, OdometryPool
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.space import ParameterSpace
from adaptune.study.config import ALSO, RealTimeConfig, StudyConfig
from adaptune.study.driven import ModeError
from online.modes import ReplaySetup


def setup(mechanism="live", size=4, **online):
    gicp = odometry_class("gicp")
    factory = OdometryFactory("gicp", {}, gicp.space, Limits())
    online["switching"] = {"mechanism": mechanism, "size": size}
    config = StudyConfig(odometry={"name": "gicp"}, training=("a",), online=online)
    return ReplaySetup(config, factory, mechanism, ("adaptive", "paper"))


def test_rivals_are_driven_where_the_model_has_some():
    model = random_model()
    assert setup().modes(model) == ("baseline", "fixed", "adaptive", "paper")
    one = replace(model, rivals={"equal_cost": 6})
    assert setup().modes(one) == ("baseline", "equal_cost", "fixed", "adaptive", "paper")
    both = replace(model, rivals={"equal_cost": 6, "best_default": 2})
    assert setup().modes(both)[:4] == ("baseline", "best_default", "equal_cost", "fixed")
    # One that is the fixed set is not replayed again.
    same = replace(model, rivals={"equal_cost": model.fixed, "best_default": 2})
    assert setup().modes(same)[:3] == ("baseline", "best_default", "fixed")
    for mode, trial in {"equal_cost": 6, "best_default": 2, "fixed": 4}.items():
        assert setup().mode(mode, both)[1:4] == ({trial: both.sets[trial]}, False, None)
    identity = setup().identity("equal_cost", both, "digest")
    assert identity["parameters"] == both.sets[6]
    # Another model with the same rival replays the same.
    assert identity["model"] is None


def test_a_rival_keeps_its_parameters():
    model = random_model()
    gicp = odometry_class("gicp").space
    rng = np.random.default_rng(0)
    own = tuple(gicp.from_unit(rng.random((len(model.sets), len(gicp)))))
    sets = replace(model.sets, space=gicp, parameters=own)
    mode = setup().mode("equal_cost", replace(model, sets=sets, rivals={"equal_cost": 6}))
    assert mode.selector is None
    assert setup().instance(mode).odometry.parameters == sets[6]


def test_a_model_for_another_budget_is_refused(tmp_path):
    model = random_model()
    setup().check(model, tmp_path)
    setup(budget=9.0).check(replace(model, budget=9.0), tmp_path)
    for given, fitted in ((9.0, None), (None, 9.0), (9.0, 8.0)):
        with pytest.raises(ModeError, match=r"online\.budget: .* run `adaptune offline` again"):
            setup(budget=given).check(replace(model, budget=fitted), tmp_path)
    setup().check(replace(model, worth=0.1), tmp_path)
    with pytest.raises(ModeError, match=r"online\.worth: .* run `adaptune offline` again"):
        setup().check(replace(model, worth=0.2), tmp_path)


def test_a_mode_is_replayed_where_it_is_possible():
    model = random_model()
    asked = replace(setup(), also=ALSO)
    every = ("baseline", "fixed", "adaptive", "untrained", "even", "paper")
    odometry = asked.odometry
    assert asked.modes(model) == every
    # A bank of one member, and an odometry that cannot change its set.
    alone = replace(model, bank=[4], vectors=np.zeros((50, 1, 3), np.float32))
    assert asked.modes(alone) == tuple(mode for mode in every if mode != "even")
    assert "no other member" in asked.obstacle("even", alone)
    stiff = replace(asked, odometry=OdometryPool({"a": odometry, "b": odometry}), mechanism="bank")
    unpaying = replace(alone, bank_settings=BankSettings(adapt=False))
    assert "cannot change its parameters between scans" in stiff.obstacle("adaptive", unpaying)
    assert "adaptive" in stiff.modes(model)


def test_what_each_mode_drives():
    model = replace(random_model(), rivals={"equal_cost": 6})
    live, bank = (setup(mechanism, size=2) for mechanism in ("live", "bank"))
    assert list(live.mode("adaptive", model).sets) == [model.fixed]
    assert live.identity("adaptive", model, "of it")["switching"] == {"mechanism": "live"}
    assert bank.identity("adaptive", model, "of it")["switching"]["mechanism"] == "bank"
    # The bank that is driven may rest.
    rests = replace(model, bank_settings=BankSettings(adapt=False))
    assert bank.mode("adaptive", rests).bank
    # Only `adaptive` has a reserve.
    vectors = np.zeros((len(model.errors), 3, 3), np.float32)
    members = [*model.bank, 0]
    reserve = replace(model, bank=members, vectors=vectors, bank_settings=BankSettings(reserve=1))
    assert list(bank.mode("adaptive", reserve).sets) == reserve.bank
    assert list(bank.mode("even", reserve).sets) == reserve.bank[:-1]
    # What was published has one instance, and all sets to choose from.
    assert bank.mode("paper", reserve).sets == {model.fixed: model.sets[model.fixed]}
    assert bank.identity("even", model, "of it")["model"] == "of it"


def test_a_program_that_runs_whole_recordings_has_none():
    whole = {"command": ["sh", "{input}", "{output}"]}
    program = OdometryFactory("command", whole, ParameterSpace({}), Limits())
    asked = replace(setup(), odometry=program, rules=(), also=ALSO)
    assert asked.modes(random_model()) == ("baseline", "fixed")
    assert "whole recordings" in asked.obstacle("even", random_model())
    with pytest.raises(ModeError, match="untrained is not possible: a program that runs whole"):
        asked.mode("untrained")


def test_a_cheap_bank_runs_on_one_core(monkeypatch):
    monkeypatch.setattr("online.modes.available", lambda: 3)
    made = []
    monkeypatch.setattr("online.modes.Bank", lambda *given: made.append(given[4]))
    model = random_model()
    # Two members, which share what they prepare, and live evidence.
    for register, pace, cores in ((5.0, None, 1), (5.0, 3.0, 1), (5.0, 4.0, 3), (25.0, None, 3)):
        costs = Costs({trial: SetCost(register, 4.0, 0) for trial in model.sets}, 1.0)
        in_real_time = None if pace is None else RealTimeConfig(rate=pace)
        given = setup("bank", size=2, real_time=in_real_time)
        given.instance(given.mode("adaptive", replace(model, costs=costs)))
        assert made.pop() == cores, (register, pace)
    bank = setup("bank", size=2)
    bank.instance(bank.mode("adaptive", replace(model, costs=None)))
    assert made == [3]


def test_sets_that_fail_are_missing_in_no_bank():
    model, four = random_model(), setup("bank", size=4)  # fitted for two
    given = {trial: SetCost(5.0 if trial in model.bank else np.inf, 4.0, 0) for trial in model.sets}
    failing = replace(model, costs=Costs(given, 1.0))
    assert list(four.mode("adaptive", failing).sets) == model.bank
    with pytest.raises(ModeError, match="another bank"):
        four.mode("adaptive", model)
