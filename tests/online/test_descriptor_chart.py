import shutil

import numpy as np
from random_models import random_model

from offline.config import load_study
from online.descriptor_chart import (
    MOST_FRAMES,
    charts_of_descriptors,
    descriptor_chart,
    descriptors_along,
    moving_mean,
)


def test_training_and_test_scans_lie_on_the_same_axes():
    model = random_model(n_frames=1500)
    tests = {"new": model.descriptors[:40] + 1000.0}
    chart = descriptor_chart(model, "ndt", tests)
    training, test = chart.panels
    assert [points.name for points in training.drawn] == ["cave", "Straße"]
    assert all(len(points.x) <= MOST_FRAMES for points in training.drawn)
    assert training.x == test.x
    behind, new = test.drawn
    assert (behind.name, behind.faint, new.name) == ("all training", True, "new")
    # All features are larger there: the scans lie far from all training.
    middle = np.array([np.mean(behind.x), np.mean(behind.y)])
    radius = max(np.hypot(np.array(behind.x) - middle[0], np.array(behind.y) - middle[1]))
    assert (np.hypot(np.array(new.x) - middle[0], np.array(new.y) - middle[1]) > radius).all()
    # Descriptors of another size are left out.
    assert len(descriptor_chart(model, "ndt", {"new": np.zeros((4, 7))}).panels) == 1


def test_the_mean_is_over_the_last_selections():
    rows = np.arange(8.0).reshape(4, 2)
    np.testing.assert_allclose(moving_mean(rows, 1), rows)
    np.testing.assert_allclose(moving_mean(rows, 2)[:, 0], [0.0, 1.0, 3.0, 5.0])
    np.testing.assert_allclose(moving_mean(rows, 9)[-1], rows.mean(axis=0))


def test_scans_are_described_once_a_second_and_kept(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    found = descriptors_along(study, "three", "ndt")
    assert found.shape == (4, 90)  # of four seconds
    path = study.folder / "described" / "three.npz"
    before = path.stat().st_mtime_ns
    np.testing.assert_array_equal(descriptors_along(study, "three", "ndt"), found)
    assert path.stat().st_mtime_ns == before
    # Of another period, they are described again.
    other = load_study(study_file, ["online.period=2.0"], tmp_path / "study")
    assert len(descriptors_along(other, "three", "ndt")) == 2


def test_what_is_missing_is_said(study_file, tmp_path):
    for file in study_file.parent.glob("*.*"):
        shutil.copy(file, tmp_path)
    study = load_study(tmp_path / study_file.name, [], tmp_path / "study")
    assert charts_of_descriptors(study) == ([], ["No model: run `adaptune offline`."])
    random_model().save(study.model_path)
    (tmp_path / "three.bag").unlink()
    charts, notes = charts_of_descriptors(study)
    assert [chart.key for chart in charts] == ["descriptors"]
    assert len(notes) == 1
    assert notes[0].startswith("No descriptors of three: ")
