import shutil

import numpy as np
import pytest

from offline.config import load_study
from online.charts import charts_of_replays
from online.modes import run_replays
from online.replayed import read_replays, scenes_along

COURSE = """\
odometry: {name: gicp}
courses:
  a: {scenes: [cave, street], length: 20}
  b: {scenes: [cave]}
training: [b]
test: [a: 50-100%]
"""


@pytest.fixture(scope="module")
def study(study_file, trained_folder, tmp_path_factory):
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("run") / "study")
    made = load_study(study_file, [], folder)
    run_replays(made, made.folder / "model.safetensors")
    return made


def test_replays_are_read_with_what_was_measured(study):
    replayed = read_replays(study, "three")
    assert list(replayed.modes) == ["baseline", "fixed", "adaptive", "paper"]
    assert replayed.scenes is None
    for mode, of in replayed.modes.items():
        assert of.places.shape == (len(of.seconds), 2)
        assert of.adapts == (mode in ("adaptive", "paper"))
        # The reference goes straight on; the odometry nearly so.
        assert abs(of.places[:, 1]).max() < 1e-6
        assert (np.isfinite(of.errors_around) >= np.isfinite(of.errors)).all()
    assert read_replays(study, "one").modes == {}


def test_all_charts_are_made(study):
    charts = [*charts_of_replays(read_replays(study, "three"))]
    assert [chart.key for chart in charts] == ["three-errors", "three-choices"]
    assert all(chart.caption and chart.title.startswith("three: ") for chart in charts)


def test_scenes_of_a_part_of_a_course_are_those_of_that_part(tmp_path):
    (tmp_path / "course.yaml").write_text(COURSE, "utf-8")
    study = load_study(tmp_path / "course.yaml", [], tmp_path / "study")
    (name,) = study.config.test
    recording = study.sequences.recording(name).with_suffix(".tum")
    stamps = 10**9 * np.arange(41)
    assert scenes_along(study.sequences, name, stamps) is None  # it is not recorded yet
    recording.parent.mkdir(parents=True)
    recording.write_text("".join(f"{i}.000000000 {i}.0 0 0 0 0 0 1\n" for i in range(41)), "utf-8")
    spans = scenes_along(study.sequences, name, stamps[15:])
    assert spans.names == ("cave", "street")
    np.testing.assert_allclose(spans.edges, [0.0, 5.0, 25.0])
    assert scenes_along(study.sequences, "unknown", stamps) is None
