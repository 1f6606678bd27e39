import os
import shutil
import signal
import time

import numpy as np
import pytest
from kills import contents

from adaptune.archive import Archive
from adaptune.model import ErrorModel
from adaptune.model.descriptor import averaged
from offline.config import load_study
from offline.train import train
from offline.workers import WorkerError, Workers


@pytest.fixture(scope="module")
def trained(study_file, trained_folder, tmp_path_factory):
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("run") / "study")
    study = load_study(study_file, [], folder)
    return study, train(study)


def test_the_fixed_set_is_the_best_of_the_candidates_in_whole_runs(trained):
    study, training = trained
    means = np.mean([training.means["one"], training.means["two"]], axis=0)
    assert means.min() < means.max() / 1.5
    archive = Archive(study.folder / "trials")
    candidates = {0, *np.argsort(means)[:4].tolist()}
    runs = [archive.folder.glob(f"{name}/*-whole.npz") for name in ("one", "two")]
    assert [{int(path.name[:5]) for path in of} for of in runs] == [candidates] * 2
    whole = {
        n: np.mean([archive.read(name, n, whole=True).mean_error for name in ("one", "two")])
        for n in candidates
    }
    near = [n for n in candidates if whole[n] <= 1.02 * min(whole.values())]
    assert training.model.fixed == min(near, key=lambda n: means[n])
    shown = [row["fixed, whole run"] for row in training.rows]
    assert np.mean(shown) == pytest.approx(whole[training.fixed])


def test_whole_runs_are_made_again_with_another_health_check(trained, study_file, tmp_path):
    study, _ = trained
    folder = shutil.copytree(study.folder, tmp_path / "study")
    before = {path: path.stat().st_mtime_ns for path in folder.glob("trials/*/*.npz")}
    train(load_study(study_file, ["health.max_speed=30"], folder))
    made = {path for path in before if path.stat().st_mtime_ns != before[path]}
    assert made == set(folder.glob("trials/*/*-whole.npz"))
    assert all(path.stat().st_mtime_ns == before[path] for path in set(before) - made)


def test_the_model_is_that_of_the_trials(trained):
    study, training = trained
    model = ErrorModel.load(study.folder / "model.safetensors")
    assert model.sets.parameters == training.model.sets.parameters
    assert model.sequences == ["one", "two"]
    assert model.errors.shape == (58, 10)
    frames = Archive(study.folder / "trials").read_frames("two")
    described = averaged(frames.descriptors, frames.stamps, 3, 1.0)
    np.testing.assert_array_equal(model.descriptors[29:], described[:29])


def test_number_of_workers_changes_nothing(trained, study_file, tmp_path):
    study, _ = trained
    alone = load_study(study_file, ["offline.workers=1"], tmp_path / "study")
    train(alone)
    assert contents(alone.folder) == contents(study.folder)


def test_more_trials_go_on_where_fewer_stopped(trained, study_file, tmp_path):
    study, _ = trained
    folder = tmp_path / "study"
    train(load_study(study_file, ["offline.trials=5"], folder))
    before = {p: p.stat().st_mtime_ns for p in folder.glob("trials/*/0000?.npz")}
    assert len(before) == 10
    train(load_study(study_file, [], folder))
    assert {p: p.stat().st_mtime_ns for p in before} == before
    # The whole runs of the smaller study's fixed set are not the larger one's.
    ours, theirs = contents(folder), contents(study.folder)
    assert {k: ours[k] for k in theirs} == theirs


@pytest.mark.usefixtures("processes")
def test_a_killed_worker_is_replaced(trained, study_file, tmp_path, monkeypatch):
    study, _ = trained
    again = load_study(study_file, [], tmp_path / "study")
    spawned = []
    spawn = Workers._spawn

    def remember(self, w):
        worker = spawn(self, w)
        spawned.append(worker.process)
        return worker

    monkeypatch.setattr(Workers, "_spawn", remember)

    def kill(_what, done, *_):
        if done and len(spawned) == 2 and spawned[0].is_alive():
            os.kill(spawned[0].pid, signal.SIGKILL)
            time.sleep(0.05)

    train(again, kill)
    assert len(spawned) > 2
    assert contents(again.folder) == contents(study.folder)


@pytest.mark.usefixtures("processes")
def test_a_task_that_kills_every_worker_is_told(study_file, tmp_path, monkeypatch):
    study = load_study(study_file, ["offline.workers=1"], tmp_path / "study")
    spawn = Workers._spawn

    def doomed(self, w):
        worker = spawn(self, w)
        worker.process.kill()
        worker.process.join()
        return worker

    monkeypatch.setattr(Workers, "_spawn", doomed)
    with pytest.raises(WorkerError, match=r"died \(its process was ended by SIGKILL\) on one"):
        train(study)


def test_views_are_trained_on_beside_their_origin(gicp_study_file, tmp_path):
    overrides = [
        "offline.augment=[{noise: {sigma: 0.02}}, {reverse: true}, {noise: {sigma: 0.1}}]",
        "offline.trials=2",
        "training=[one]",
    ]
    study = load_study(gicp_study_file, overrides, tmp_path / "study")
    names = ["one", "one+noise", "one+reverse", "one+noise2"]
    training = train(study)
    assert training.model.sequences == names
    assert [row["sequence"] for row in training.rows] == names
    archive = Archive(study.folder / "trials")
    frames = [archive.read_frames(name).T_ref_sensor for name in names]
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_allclose(frames[0], frames[2][::-1], atol=1e-9)
    errors = [training.means[name][0] for name in names]
    assert len(set(errors)) == 4
