"""Error models of random numbers, their files, and changes to them."""

import dataclasses
import json

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from adaptune.model import ErrorModel, ModelError
from adaptune.model.error_model import digest
from adaptune.space import Categorical, Float, Integer, ParameterSets, ParameterSpace

SPACE = ParameterSpace(
    {
        "distance": Float(low=1.0, high=10.0, baseline=4.0, log=True),
        "points": Integer(low=1, high=50, baseline=20),
        "kernel": Categorical(choices=("none", 1, True), baseline="none"),
    }
)


def random_model():
    """A model of 50 frames and 6 sets."""
    rng = np.random.default_rng(0)
    errors = rng.gamma(1.0, 2.0, (50, 6)).astype(np.float32)
    errors[rng.random(errors.shape) < 0.05] = np.inf
    sets = tuple(SPACE.from_unit(rng.random((6, 3))))
    return ErrorModel(
        odometry={"name": "gicp", "settings": {"downsampling": 0.1 + 0.2}},
        sets=ParameterSets(SPACE, tuple(range(0, 12, 2)), sets),
        fixed=4,
        length=25.0,
        sequences=["cave", "Straße"],
        blocks={"ndt": 90},
        window=1,
        descriptors=rng.integers(0, 500, (50, 90)).astype(np.float32),
        sequence=rng.integers(0, 2, 50),
        errors=errors,
        bank=[4, 10],
        vectors=rng.normal(0.0, 1.0, (50, 2, 3)).astype(np.float32),
        provenance={"seed": 6, "note": None},
        elevations=[-30.7, -15.0],
    )


def assert_same(a, b):
    """All that two models, trials or frames hold is the same."""
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        elif field.name == "sets":
            assert (x.space, x.trials) == (y.space, y.trials)
            assert repr(x.parameters) == repr(y.parameters)
        else:
            assert repr(x) == repr(y)


def saved(folder, **changes):
    path = folder / "model.safetensors"
    dataclasses.replace(random_model(), **changes).save(path)
    return path


def rewrite(path, arrays=None, text=None, **header):
    """Change parts of a file as somebody could who knows the format."""
    with safe_open(path, "np") as file:
        said = json.loads(file.metadata()["adaptune"]) | (text or {})
        parts = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    parts |= arrays or {}
    said["header"] |= header
    said["digest"] = digest(said["header"], parts)
    parts = {name: np.ascontiguousarray(part) for name, part in parts.items()}
    save_file(parts, path, {"adaptune": json.dumps(said)})


def refused(path):
    """The message, which must name the file."""
    with pytest.raises(ModelError) as caught:
        ErrorModel.load(path)
    assert str(path) in str(caught.value)
    return str(caught.value)
