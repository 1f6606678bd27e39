"""The modes of a replay."""

from dataclasses import replace

import numpy as np
import pytest
from random_models import random_model

from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.isolation import Limits
from adaptune.odometry.registry import odometry_class
from adaptune.study.config import SwitchingConfig
from adaptune.study.driven import ModeError
from online.modes import ReplaySetup


def setup(budget=None):
    gicp = odometry_class("gicp")
    factory = OdometryFactory("gicp", {}, gicp.space, Limits())
    return ReplaySetup(
        factory,
        ("paired", "paper"),
        SwitchingConfig(mechanism="live"),
        "live",
        factory.description.warm_up,
        25.0,
        3.0,
        0.0,
        ("ndt",),
        budget,
    )


def test_rivals_are_driven_where_the_model_has_some():
    model = random_model()
    assert setup().modes(model) == ("baseline", "fixed", "paired", "paper")
    one = replace(model, rivals={"equal_cost": 6})
    assert setup().modes(one) == ("baseline", "equal_cost", "fixed", "paired", "paper")
    both = replace(model, rivals={"equal_cost": 6, "best_default": 2})
    assert setup().modes(both)[:4] == ("baseline", "best_default", "equal_cost", "fixed")
    # One that is the fixed set is not replayed again.
    same = replace(model, rivals={"equal_cost": model.fixed, "best_default": 2})
    assert setup().modes(same)[:3] == ("baseline", "best_default", "fixed")
    assert setup().parameters("equal_cost", both) == both.sets[6]
    assert setup().parameters("best_default", both) == both.sets[2]
    assert setup().parameters("fixed", both) == both.sets[4]
    assert setup().parameters("paired", both) is None
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
