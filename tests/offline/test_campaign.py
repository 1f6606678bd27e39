import logging
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
from kills import contents
from setups import setup_of

from adaptune.archive import Archive, Trial
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.model.descriptor import averaged
from offline import campaign
from offline.campaign import BaselineError, check_baseline, run_baseline
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
    means = np.array([row["mean"] for row in training.trials])
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
    assert np.mean(shown) == pytest.approx(whole[training.model.fixed])


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


@pytest.mark.services
@pytest.mark.usefixtures("processes")
def test_a_killed_worker_is_replaced(trained, study_file, tmp_path, monkeypatch):
    study, _ = trained
    again = load_study(study_file, [], tmp_path / "study")
    spawned = []
    spawn = Workers._spawn

    def remember(self, w):
        worker = spawn(self, w)
        spawned.append(worker[0])
        return worker

    monkeypatch.setattr(Workers, "_spawn", remember)

    def kill(_what, done, *_):
        if done and len(spawned) == 2 and spawned[0].is_alive():
            os.kill(spawned[0].pid, signal.SIGKILL)
            spawned[0].join()

    train(again, kill)
    assert len(spawned) > 2
    assert contents(again.folder) == contents(study.folder)


@pytest.mark.usefixtures("processes")
def test_a_task_that_kills_every_worker_is_told(study_file, tmp_path, monkeypatch):
    study = load_study(study_file, ["offline.workers=1"], tmp_path / "study")
    spawn = Workers._spawn

    def doomed(self, w):
        worker = spawn(self, w)
        worker[0].kill()
        worker[0].join()
        return worker

    monkeypatch.setattr(Workers, "_spawn", doomed)
    with pytest.raises(WorkerError, match=r"died \(its process was ended by SIGKILL\) on one"):
        train(study)


def test_views_are_trained_on_beside_their_origin(study_file, tmp_path):
    overrides = [
        "offline.augment=[{noise: 0.02}, {reverse: true}, {noise: 0.1}]",
        "offline.trials=2",
        "training=[one]",
        "odometry.name=gicp",
    ]
    study = load_study(study_file, overrides, tmp_path / "study")
    names = ["one", "one+noise", "one+reverse", "one+noise2"]
    training = train(study)
    assert training.model.sequences == names
    assert [row["sequence"] for row in training.rows] == names
    archive = Archive(study.folder / "trials")
    frames = [archive.read_frames(name).T_ref_sensor for name in names]
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_allclose(frames[0], frames[2][::-1], atol=1e-9)
    errors = [training.trials[0][name] for name in names]
    assert len(set(errors)) == 4


FEW = ["offline.trials=3", "offline.initial=3", "offline.workers=1"]


def study_of(study_file, folder, *given, name="Stumbling", **settings):
    """The study with a stumbling odometry."""
    text = ", ".join(f"{name}: {value}" for name, value in settings.items())
    odometry = f"odometry={{name: 'faulty:{name}', settings: {{{text}}}}}"
    return load_study(study_file, [odometry, *FEW, *given], folder)


@pytest.mark.parametrize("name", ["Stumbling", "Apart"])
@pytest.mark.parametrize("fault", ["init", "prepare", "start", "register", "nothing", "shape"])
def test_a_baseline_that_fails_stops_the_campaign(study_file, tmp_path, name, fault):
    study = study_of(study_file, tmp_path / "study", name=name, fault=fault)
    reason = {"nothing": "returned None", "shape": "pose"}.get(fault, "no planes")
    with pytest.raises(AdaptuneError, match=rf"sequences\.(one|two): .*baseline.*{reason}.*again"):
        train(study)
    assert not list(study.folder.rglob("*.npz"))
    assert not study.model_path.exists()
    if fault == "register":
        # Once it is mended, the same command works, and nothing has stayed.
        train(study_of(study_file, tmp_path / "study", name=name))
        assert not Archive(study.folder / "trials").read("one", 0).faults


def test_a_single_fault_does_no_harm():
    n = 40
    run = Trial({}, np.tile(np.eye(4), (n, 1, 1)), *np.zeros((4, n)), ("hm",))
    check_baseline("mine", "one", replace(run, unhealthy={"no_pose": 3}))
    for failed in ({"unhealthy": {"no_pose": 4}}, {"faults": ("hm",) * 10}):
        with pytest.raises(BaselineError, match=r"sequences\.one: mine fails .*; hm; nothing"):
            check_baseline("mine", "one", replace(run, **failed))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"step": 0.375}, None),
        ({}, "0.79"),
        ({"axis": 1}, "like those of other axes"),
        ({"step": -0.3}, "or inverted"),
    ],
)
def test_an_odometry_that_contradicts_the_scans_is_told(
    study_file, tmp_path, caplog, settings, words
):
    study = study_of(study_file, tmp_path / "study", **settings)
    with caplog.at_level(logging.WARNING, "offline.baseline"):
        train(study)
    told = [r.getMessage() for r in caplog.records if "contradict" in r.getMessage()]
    if words is None:
        assert not told
        return
    assert len(told) == 2
    assert told[0].startswith("sequences.one, faulty:Stumbling: the odometry's poses contradict")
    assert words in told[0]


def test_the_baseline_wins_where_trials_flatter(study_file, tmp_path):
    study = study_of(study_file, tmp_path / "study", "offline.trials=6")
    training = train(study)
    best = int(np.argmin([row["mean"] for row in training.trials]))
    assert best != 0
    assert training.model.fixed == 0
    assert "the fixed set is the baseline" in training.words[-2]
    for row in training.rows:
        assert (
            row["baseline, whole run"] == row["fixed, whole run"] == pytest.approx(row["baseline"])
        )


@pytest.mark.services
def test_the_baseline_of_every_odometry_is_run_once(study_file, tmp_path, monkeypatch):
    second = "{name: 'faulty:Apart', label: apart, settings: {step: 0.31}}"
    odometries = f"odometry=[{{name: 'faulty:Stumbling'}}, {second}]"
    study = load_study(study_file, [odometries], tmp_path / "study")
    archive = Archive(study.folder / "trials")

    def run_baselines():
        with Workers(setup_of(study), 1, 1e9) as workers:
            run_baseline(study, archive, workers, lambda *_: None)

    run_baselines()
    for name in ("one", "two"):
        for number, parameters in enumerate(study.odometry.space.baselines):
            assert archive.read(name, number, whole=True).parameters == parameters
        assert len(archive.read_frames(name).stamps) == 40
    # One that is lacking is run alone.
    monkeypatch.setattr(campaign, "check_baseline", lambda *told: ran.append(told[:2]))
    ran = []
    archive.trial_path("two", 1, whole=True).unlink()
    run_baselines()
    assert ran == [("apart", "two")]
