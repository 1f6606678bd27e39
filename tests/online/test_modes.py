"""The modes of a replay."""

from dataclasses import replace

import numpy as np
import pytest
from random_models import random_model

from adaptune.model import BankSettings, PairedSettings
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.space import ParameterSpace
from adaptune.study.config import ALSO, SwitchingConfig
from adaptune.study.study import ModeError
from online.modes import ReplaySetup


def setup(budget=None):
    gicp = odometry_class("gicp")
    factory = OdometryFactory("gicp", {}, gicp.space, Limits())
    return ReplaySetup(
        factory,
        ("adaptive", "paper"),
        SwitchingConfig(mechanism="live"),
        "live",
        factory.description.warm_up,
        25.0,
        3.0,
        ("ndt",),
        budget,
    )


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
    assert setup().parameters("equal_cost", both) == both.sets[6]
    assert setup().parameters("best_default", both) == both.sets[2]
    assert setup().parameters("fixed", both) == both.sets[4]
    assert setup().parameters("adaptive", both) is None
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
    driven = setup().start("equal_cost", replace(model, sets=sets, rivals={"equal_cost": 6}))
    assert driven.selector is None
    assert driven.odometry.odometry.parameters == sets[6]


def test_a_model_for_another_budget_is_refused(tmp_path):
    model = random_model()
    setup().check(model, tmp_path)
    setup(9.0).check(replace(model, budget=9.0), tmp_path)
    for given, fitted in ((9.0, None), (None, 9.0), (9.0, 8.0)):
        with pytest.raises(ModeError, match=r"online\.budget: .* run `adaptune offline` again"):
            setup(given).check(replace(model, budget=fitted), tmp_path)


def test_what_is_pinned_has_its_value_in_all_sets():
    model = random_model()
    pinning = replace(setup(), pins={"points": 7})
    held = pinning.pinned(model)
    assert {of["points"] for of in held.sets.parameters} == {7}
    assert [of | {"points": 0} for of in held.sets.parameters] == [
        of | {"points": 0} for of in model.sets.parameters
    ]
    assert held.digest != model.digest
    assert setup().pinned(model) is model
    gicp = replace(pinning, pins={"keyframe_interval": 2.5})
    members = gicp.untrained_sets().parameters
    assert {of["keyframe_interval"] for of in members} == {2.5}
    assert len({of["max_correspondence_distance"] for of in members}) == len(members)


def test_a_mode_on_demand_that_is_another_one_is_not_replayed_again():
    model = random_model()
    asked = replace(setup(), also=("one_set", "bank", "even", "random"))
    demand = ("bank", "even", "random")
    # One set at a time is what `adaptive` drives.
    assert asked.modes(model) == ("baseline", "fixed", "adaptive", *demand, "paper")
    fixed = replace(model, paired=PairedSettings(adapt=False))
    assert asked.modes(fixed)[3:5] == ("one_set", "bank")
    with_bank = replace(asked, mechanism="bank")
    assert with_bank.modes(model)[3:6] == ("one_set", "even", "random")
    assert with_bank.twin("bank", model) == "adaptive"
    unpaying = replace(fixed, bank_settings=BankSettings(adapt=False))
    assert with_bank.modes(unpaying)[3:5] == ("one_set", "bank")
    # The bank that is driven may rest, the one on demand does not.
    assert with_bank.identity("adaptive", unpaying)["switching"]["mechanism"] == "bank"
    # Controls have no reserve, and `adaptive` has one.
    bank, vectors = [*model.bank, 0], np.zeros((len(model.errors), 3, 3), np.float32)
    reserve = replace(model, bank=bank, vectors=vectors, bank_settings=BankSettings(reserve=1))
    few = replace(with_bank, switching=SwitchingConfig(size=2))
    assert list(few.members("adaptive", reserve)) == reserve.bank
    assert list(few.members("even", reserve)) == reserve.bank[:-1]
    # Without `adaptive`, nothing is.
    alone = replace(asked, rules=("paper",))
    assert alone.modes(model) == ("baseline", "fixed", "one_set", *demand, "paper")
    assert all(alone.identity(mode, model, "of it")["model"] == "of it" for mode in demand)
    assert alone.identity("random", model)["switching"]["seed"] == 0


def test_a_bank_of_one_member_is_not_compared_with():
    model = replace(random_model(), bank=[4], vectors=np.zeros((50, 1, 3), np.float32))
    asked = replace(setup(), also=("one_set", "bank", "even", "random", "untrained"))
    assert asked.modes(replace(model, paired=PairedSettings(adapt=False)))[3:] == (
        *("untrained", "one_set", "paper"),
    )
    assert "no other member" in asked.obstacle("even", model)


def test_a_program_that_runs_whole_recordings_has_none():
    whole = {"command": ["sh", "{input}", "{output}"]}
    program = OdometryFactory("command", whole, ParameterSpace({}), Limits())
    asked = replace(setup(), odometry=program, rules=(), also=ALSO)
    assert asked.modes(random_model()) == ("baseline", "fixed")
    assert "whole recordings" in asked.obstacle("even", random_model())
