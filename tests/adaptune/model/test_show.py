import dataclasses
import re

import numpy as np
import pytest
from commands import succeeded

from adaptune.model import ErrorModel
from adaptune.model.rules import Costs, SetCost
from adaptune.space import Categorical, Float, ParameterSets, ParameterSpace


@pytest.fixture
def model():
    space = ParameterSpace(
        {
            "distance": Float(low=1.0, high=10.0, baseline=4.0, log=True),
            "kernel": Categorical(choices=("none", "[huber]"), baseline="none"),
        }
    )
    errors = np.array([[4, 1, 3], [4, 1, np.inf], [2, 5, 8], [2, np.nan, 6]], np.float32)
    return ErrorModel(
        odometry={"name": "gicp", "settings": {"downsampling": 0.5}},
        sets=ParameterSets(
            space,
            (0, 1, 2),
            tuple(
                {"distance": d, "kernel": k}
                for d, k in ((4.0, "none"), (2.0, "[huber]"), (9.0, "none"))
            ),
        ),
        fixed=0,
        length=25.0,
        sequences=["cave", "street"],
        blocks={"ndt": 90},
        window=3,
        descriptors=np.zeros((4, 90), np.float32),
        sequence=np.array([0, 0, 1, 1]),
        errors=errors,
        provenance={"adaptune": "0.1.0", "seed": 7},
    )


def shown(model, folder):
    model.save(folder / "model.safetensors")
    return re.sub(r"\s+", " ", succeeded("inspect", folder / "model.safetensors").output)


def test_a_model_is_explained(model, tmp_path):
    text = shown(model, tmp_path)
    for said in (
        "gicp: 3 parameter sets on 4 frames of cave, street, 2 kB",
        "ndt (90 numbers), as a mean over 3 selections in a row",
        "0, fixed 3.000 distance 4, kernel none",
        "1 3.000 distance 2, kernel [huber]",
        "Recommended: fixed.",
    ):
        assert said in text, (said, text)


def test_text_of_a_file_is_shown_literally(model, tmp_path):
    name = "[/b] :x:"
    strange = dataclasses.replace(model, odometry={"name": name}, sequences=["cave", name])
    assert shown(strange, tmp_path).count(name) == 2


def test_a_bank_and_its_costs_are_shown(model, tmp_path):
    costs = Costs({0: SetCost(2.0, 3.0, 0), 1: SetCost(4.0, 3.0, 0)}, 0.5)
    vectors = np.zeros((4, 2, 3), np.float32)
    known = dataclasses.replace(model, costs=costs, bank=[0, 1], vectors=vectors)
    text = shown(known, tmp_path)
    assert "0, fixed, bank 3.000 5.000 distance 4" in text
    assert "1, bank 3.000 7.000 distance 2" in text
    assert "2 11.8 - distance 9" in text  # of unknown cost
    assert "Recommended: fixed. The bank of `adaptive`: trials 0, 1." in text
    assert "cost [ms]" not in shown(model, tmp_path)
