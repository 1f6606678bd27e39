import dataclasses

import numpy as np
from random_models import random_model

from adaptune.model import ErrorModel


def test_evidence_is_of_stretches():
    model = random_model()
    assert model.training_data(model.pca()).sequence.max() == 1
    stretch = np.arange(50) // 25
    cut = dataclasses.replace(model, stretch=stretch)
    number = cut.training_data(cut.pca()).sequence
    np.testing.assert_array_equal(number, 2 * model.sequence + stretch)
    # A view shares the stretches of its recording.
    view = dataclasses.replace(cut, sequences=["b", "b+mirrored"])
    np.testing.assert_array_equal(view.training_data(view.pca()).sequence, stretch)


def test_stretches_are_kept_in_the_file(tmp_path):
    expected = {"bank": {"loss": -0.2, "n_stretches": 4.0}}
    model = dataclasses.replace(random_model(), stretch=np.arange(50) // 7, expected=expected)
    model.save(tmp_path / "m")
    again = ErrorModel.load(tmp_path / "m")
    np.testing.assert_array_equal(again.stretch, model.stretch)
    assert again.expected == expected
    assert again.digest == model.digest != random_model().digest
