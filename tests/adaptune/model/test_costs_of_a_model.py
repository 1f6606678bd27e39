import dataclasses
import json

import pytest
from model_files import assert_same, refused, rewrite, saved
from random_models import random_model
from safetensors import safe_open
from safetensors.numpy import save_file

from adaptune.model import ErrorModel
from adaptune.model.error_model import checksum
from adaptune.model.rules import Costs, SetCost
from adaptune.space import ODOMETRY, ParameterSets, PooledSpace


def test_costs_rivals_and_a_budget_survive(tmp_path):
    model = random_model()
    costs = Costs({n: SetCost(n + 0.1, 2.5, n % 2) for n in model.sets}, 0.25)
    given = {"costs": costs, "rivals": {"equal_cost": 6, "best_default": 2}, "budget": 9.0}
    path = saved(tmp_path, **given)
    loaded = ErrorModel.load(path)
    assert_same(loaded, dataclasses.replace(model, **given))
    # Live evidence included, but for the fixed set.
    assert loaded.allowed() == (0, 2, 4, 6)
    assert loaded.training_data(loaded.pca()).allowed == (0, 2, 4, 6)
    # A model of an older adaptune has none of them.
    with safe_open(path, "np") as file:
        said = json.loads(file.metadata()["adaptune"])
        parts = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    for key in given:
        del said["header"][key]
    said["checksum"] = checksum(said["header"], parts)
    save_file(parts, path, {"adaptune": json.dumps(said)})
    old = ErrorModel.load(path)
    assert_same(old, model)
    assert (old.costs, old.rivals, old.budget, old.allowed()) == (None, {}, None, None)


def test_a_model_of_several_odometries_survives(tmp_path):
    model = random_model()
    pooled = PooledSpace({"a": model.sets.space, "b": model.sets.space})
    sets = tuple({ODOMETRY: "ab"[i % 2]} | own for i, own in enumerate(model.sets.parameters))
    pool = {"sets": ParameterSets(pooled, model.sets.trials, sets)}
    loaded = ErrorModel.load(saved(tmp_path, **pool))
    assert_same(loaded, dataclasses.replace(model, **pool))
    assert isinstance(loaded.sets.space, PooledSpace)


@pytest.mark.parametrize(
    "damage",
    [
        {"costs": {"evidence": 0.0}},
        {"costs": {"evidence": 0.0, "sets": [[0, 1.0]]}},
        {"rivals": {"equal_cost": 99}},
    ],
)
def test_damaged_costs_and_rivals_are_refused(tmp_path, damage):
    path = saved(tmp_path)
    rewrite(path, **damage)
    refused(path)
