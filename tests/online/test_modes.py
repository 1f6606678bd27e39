"""The modes of a replay."""

from dataclasses import replace

import numpy as np
import pytest
from random_models import random_model

from adaptune.model import BankSettings
from adaptune.model.registry import RULES
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


def of(setup, model):
    return replace(setup, model=model)


def test_what_is_recommended_is_replayed():
    model = replace(random_model(), bank_size=2)
    bank = replace(setup("bank", size=2), rules=("paper",))
    assert of(bank, model).modes == ("baseline", "fixed", "paper")
    recommended = replace(model, recommended="adaptive")
    assert of(bank, recommended).modes == ("baseline", "fixed", "adaptive", "paper")
    assert of(setup(), recommended).modes == ("baseline", "fixed", "paper")  # there is no bank
    fixed = of(bank, model).mode("fixed")
    assert fixed[1:4] == ({4: model.sets[4]}, False, None)
    # Another model with the same set replays the same.
    identity = of(bank, model).identity("fixed")
    assert (identity["parameters"], identity["model"]) == (model.sets[4], None)


def test_a_robot_drives_what_is_recommended():
    model, bank = replace(random_model(), bank_size=2), setup("bank", size=2)
    assert of(bank, model).default() == "standby"
    better = replace(model, recommended="adaptive")
    assert of(bank, better).default() == "adaptive"
    # A node that is steered has one set, as an odometry without a bank.
    assert of(bank, better).default(steered=True) == of(setup(), better).default() == "standby"
    alone = replace(model, bank=[4], vectors=np.zeros((50, 1, 3), np.float32))
    stiff = replace(bank, odometry=OdometryPool({"a": bank.odometry, "b": bank.odometry}))
    assert of(stiff, alone).default() == "fixed"


def test_the_fixed_set_keeps_its_parameters():
    model = random_model()
    gicp = odometry_class("gicp").space
    rng = np.random.default_rng(0)
    own = tuple(gicp.from_unit(rng.random((len(model.sets), len(gicp)))))
    sets = replace(model.sets, space=gicp, parameters=own)
    mode = of(setup(), replace(model, sets=sets)).mode("fixed")
    assert mode.selector is None
    assert setup().instance(mode).odometry.parameters == sets[4]


def test_a_model_for_another_budget_is_refused(tmp_path):
    model = random_model()
    of(setup(), model).check(tmp_path)
    of(setup(budget=9.0), replace(model, budget=9.0)).check(tmp_path)
    for given, fitted in ((9.0, None), (None, 9.0), (9.0, 8.0)):
        with pytest.raises(ModeError, match=r"online\.budget: .* run `adaptune offline` again"):
            of(setup(budget=given), replace(model, budget=fitted)).check(tmp_path)


def test_a_mode_is_replayed_where_it_is_possible():
    model = replace(random_model(), bank_size=4)
    asked = replace(setup("bank"), also=ALSO, rules=(*RULES,))
    every = ("baseline", "fixed", "adaptive", "standby", "untrained", "even", "paper")
    assert of(asked, model).modes == every
    # A bank of one member, and an odometry that cannot change its set.
    alone = replace(model, bank=[4], vectors=np.zeros((50, 1, 3), np.float32))
    assert of(asked, alone).modes == ("baseline", "fixed", "standby", "untrained", "paper")
    assert "no other member" in of(asked, alone).obstacle("even")
    assert "no second set may join" in of(asked, alone).obstacle("adaptive")
    odometry = asked.odometry
    stiff = replace(asked, odometry=OdometryPool({"a": odometry, "b": odometry}))
    assert of(stiff, alone).modes == ("baseline", "fixed", "untrained")
    # Without a bank, one instance changes its set.
    live = replace(asked, mechanism="live")
    assert "names no bank" in of(live, model).obstacle("adaptive")
    assert {"standby", "paper"} <= set(of(live, model).modes)


def test_what_each_mode_drives():
    model = replace(random_model(), bank_size=2)
    live, bank = (setup(mechanism, size=2) for mechanism in ("live", "bank"))
    assert list(of(live, model).mode("standby").sets) == [model.fixed]
    assert of(live, model).identity("standby")["switching"] == {"mechanism": "live"}
    for mode in ("adaptive", "standby"):
        assert of(bank, model).identity(mode)["switching"]["mechanism"] == "bank"
        assert of(bank, model).mode(mode).bank
    # Only these two have a reserve.
    vectors = np.zeros((len(model.errors), 3, 3), np.float32)
    members = [*model.bank, 0]
    reserve = replace(model, bank=members, vectors=vectors, bank_settings=BankSettings(reserve=1))
    assert list(of(bank, reserve).mode("adaptive").sets) == reserve.bank
    assert list(of(bank, reserve).mode("even").sets) == reserve.bank[:-1]
    # What was published has one instance, and all sets to choose from.
    assert of(bank, reserve).mode("paper").sets == {model.fixed: model.sets[model.fixed]}
    assert of(bank, model).identity("even")["model"] == model.digest


def test_a_program_that_runs_whole_recordings_has_none():
    whole = {"command": ["sh", "{input}", "{output}"]}
    program = OdometryFactory("command", whole, ParameterSpace({}), Limits())
    asked = replace(setup(), odometry=program, rules=(), also=ALSO)
    assert of(asked, random_model()).modes == ("baseline", "fixed")
    assert "whole recordings" in of(asked, random_model()).obstacle("even")
    with pytest.raises(ModeError, match="untrained is not possible: a program that runs whole"):
        asked.mode("untrained")


def test_a_cheap_bank_runs_on_one_core(monkeypatch):
    monkeypatch.setattr("online.modes.available", lambda: 3)
    made = []
    monkeypatch.setattr("online.modes.Bank", lambda *given: made.append(given[3]))
    model = replace(random_model(), bank_size=2)
    # Two members, which share what they prepare, and live evidence.
    for register, pace, cores in ((5.0, None, 1), (5.0, 3.0, 1), (5.0, 4.0, 3), (25.0, None, 3)):
        costs = Costs({trial: SetCost(register, 4.0, 0) for trial in model.sets}, 1.0)
        in_real_time = None if pace is None else RealTimeConfig(rate=pace)
        given = setup("bank", size=2, real_time=in_real_time)
        given.instance(of(given, replace(model, costs=costs)).mode("adaptive"))
        assert made.pop() == cores, (register, pace)
    # One that rests nearly always counts for nothing.
    rests = BankSettings(reserve=1)
    given.instance(of(given, replace(model, costs=costs, bank_settings=rests)).mode("adaptive"))
    assert made.pop() == 1
    bank = setup("bank", size=2)
    bank.instance(of(bank, replace(model, costs=None)).mode("adaptive"))
    assert made == [3]


def test_a_larger_bank_than_was_fitted_is_refused():
    model, four = replace(random_model(), bank_size=4), setup("bank", size=4)
    assert list(of(four, model).mode("adaptive").sets) == model.bank  # costs allow no more
    with pytest.raises(ModeError, match="another bank"):
        of(four, replace(model, bank_size=2)).mode("adaptive")
