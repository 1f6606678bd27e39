import csv
import dataclasses
import math

import drives
import numpy as np
import pytest

from adaptune.archive import Archive
from adaptune.model import ErrorModel
from offline.config import load_study
from offline.search import survivors
from offline.train import train
from offline.validate import validate


def test_what_cannot_win_any_more_is_given_up():
    before = {0: [3.0, 2.0, 2.0, 1.0], 1: [9.0, 9.0, 9.0, 9.0], 2: [0.1, 0.1]}
    assert survivors({4: [7.0, 1.1], 5: [0.0, 0.1]}, before) == [5]
    assert survivors({4: [7.0, 1.1]}, {}) == [4]


def test_what_is_surely_worse_than_the_best_is_given_up():
    rng = np.random.default_rng(0)
    best = rng.uniform(0.5, 1.0, 8)
    before = {0: (best + 1.0).tolist(), 1: best.tolist(), 2: [0.0]}
    batch = {3: (best[:6] + 0.1).tolist(), 4: (best[:6] - 0.1).tolist()}
    assert survivors(batch, before) == [4]
    # Two sequences cannot tell.
    assert survivors({5: (best[:2] + 1.0).tolist()}, before) == [5]


@pytest.fixture(scope="module")
def study_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pruned")
    names = [f"s{i}" for i in range(4)]
    for i, name in enumerate(names):
        drives.write_bag(folder / f"{name}.bag", drives.scans(i, 16))
    bags = "\n".join(f"  {n}: {{bag: {n}.bag, points: /points, reference: /truth}}" for n in names)
    (folder / "pruned.yaml").write_text(
        f"odometry:\n  name: gicp\n  settings: {{downsampling: 0.5, min_range: 0.5}}\n"
        f"  parameters:\n    max_correspondence_distance: {{low: 0.05, high: 5.0, log: true}}\n"
        f"    keyframe_interval: {{low: 0.5, high: 15.0, baseline: 1.0, log: true}}\n"
        f"sequences:\n{bags}\ntraining: [{', '.join(names)}]\nsub_trajectory: 3.0\n"
        f"offline: {{trials: 9, initial: 6, batch: 3, seed: 3, workers: 2, pruning: wilcoxon}}\n"
    )
    return folder / "pruned.yaml"


def test_what_a_pruned_trial_has_seen_feeds_the_model(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    training = train(study)
    archive = Archive(study.folder / "trials")
    seen = [[n in archive.finished(name) for name in study.training] for n in range(9)]
    n_seen = np.sum(seen, axis=1)
    assert (n_seen[:3] == 4).all()
    assert 2 <= n_seen.min() < 4
    model = ErrorModel.load(study.folder / "model.safetensors")
    for s, (row, means) in enumerate(zip(np.transpose(seen), training.means.values(), strict=True)):
        errors = model.errors[model.sequence == s]
        assert (np.isnan(errors).all(axis=0) == ~row).all()
        assert (np.isnan(errors).any(axis=0) == ~row).all()
        assert [math.isnan(mean) for mean in means] == (~row).tolist()
    assert n_seen[training.fixed] == 4
    rows = list(csv.DictReader((study.folder / "trials.csv").open()))
    assert [row["mean"] == "" for row in rows] == (n_seen < 4).tolist()
    validation = validate(study).validation
    assert len(validation.left_out) == 4
    before = (study.folder / "model.safetensors").read_bytes()

    # Some of it lost, as to a killed driver, and made again.
    for number in (4, 7):
        for name in study.training[:2]:
            archive.trial_path(name, number).unlink(missing_ok=True)
    train(dataclasses.replace(study))
    assert (study.folder / "model.safetensors").read_bytes() == before
    again = Archive(study.folder / "trials")
    assert [[n in again.finished(name) for name in study.training] for n in range(9)] == seen
