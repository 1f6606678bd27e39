"""Files of error models, and changes to them."""

import dataclasses
import json

import numpy as np
import pytest
from random_models import random_model
from safetensors import safe_open
from safetensors.numpy import save_file

from adaptune.model import ErrorModel, ModelError
from adaptune.model.error_model import digest


def assert_same(a, b):
    for field in dataclasses.fields(ErrorModel):
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
