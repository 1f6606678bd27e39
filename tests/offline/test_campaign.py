import logging
import os
import re
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
from drives import FIRST_STAMP
from kills import contents

import offline.train
from adaptune._system import yaml12
from adaptune.errors import AdaptuneError, Finding
from adaptune.metrics import window_ends
from adaptune.model import ErrorModel
from adaptune.model.descriptor import averaged
from adaptune.odometry.portfolio import read_portfolio
from adaptune.runs.archive import Archive, Trial
from offline import campaign
from offline.campaign import BaselineError, check_baseline
from offline.config import load_study
from offline.train import train
from offline.workers import WorkerError, Workers


@pytest.fixture(scope="module")
def trained(study_file, trained_folder, tmp_path_factory):
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("run") / "study")
    study = load_study(study_file, [], folder)
    return study, train(study)


def test_the_fixed_set_is_the_best_of_all_where_whole_recordings_are_driven(trained):
    study, training = trained
    means = np.array([row["mean"] for row in training.trials])
    assert means.min() < means.max() / 1.5
    assert not list(study.folder.glob("trials/*/*-whole.npz"))
    near = np.flatnonzero(means <= 1.02 * means.min())
    assert training.model.fixed == min(near, key=lambda n: means[n])
    assert {row["state"] for row in training.trials} == {"complete"}


LONG = ["sub_trajectory=0.3", "offline.segments=4", "training=[one]", "offline.trials=8"]


def test_finalists_are_driven_along_the_whole_of_long_recordings(study_file, tmp_path, monkeypatch):
    study = load_study(study_file, LONG, tmp_path / "study")
    training = train(study)
    archive, means = Archive(study.folder / "trials"), [row["mean"] for row in training.trials]
    files = list(archive.folder.glob("one-*/*-whole.npz"))
    finalists = {int(path.name[:5]) for path in files}
    assert {0, int(np.argmin(means)), training.model.fixed} <= finalists
    assert len(finalists) < len(means)
    whole = {n: archive.read("one", n, kind="whole").mean_error for n in finalists}
    assert training.rows[0]["fixed, whole"] == whole[training.model.fixed]
    # All sets are driven on the same scans, about half of them.
    driven = np.isfinite(archive.read("one", 3).T_odom_sensor[:, 0, 0])
    assert 0.3 < driven.mean() < 0.7
    assert np.isfinite(archive.read("one", 0, kind="whole").T_odom_sensor).all()
    again = {path: path.stat().st_mtime_ns for path in files}
    train(study)
    assert {path: path.stat().st_mtime_ns for path in files} == again
    # All drive beside one that is lacking, so that their costs compare, also after Ctrl-C.
    archive.trial_path("one", max(finalists), kind="whole").unlink()
    write, written = Archive.write, []

    def interrupted(self, name, number, trial, kind=""):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(number)
        write(self, name, number, trial, kind)

    with monkeypatch.context() as patch:
        patch.setattr(Archive, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(study)
    first = archive.trial_path("one", written[0], kind="whole")
    assert [path for path in files if path.exists()] == [first]
    again[first] = first.stat().st_mtime_ns
    train(study)
    assert not [path for path in files if path.stat().st_mtime_ns == again[path]]


def test_another_health_check_makes_other_trials(trained, study_file, tmp_path):
    study, _ = trained
    folder = shutil.copytree(study.folder, tmp_path / "study")
    before = {path: path.stat().st_mtime_ns for path in folder.glob("trials/*/*.npz")}
    train(load_study(study_file, ["health.max_speed=30"], folder))
    after = {path: path.stat().st_mtime_ns for path in folder.glob("trials/*/*.npz")}
    assert after.items() > before.items()
    assert len(after) == 2 * len(before)


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


def test_nor_does_it_where_segments_are_driven(study_file, tmp_path):
    found = []
    for workers in (1, 3):
        given = [*LONG, f"offline.workers={workers}"]
        study = load_study(study_file, given, tmp_path / f"{workers}" / "study")
        train(study)
        found.append(contents(study.folder))
    assert found[0] == found[1]


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


def test_the_sets_of_a_portfolio_recommend_before_the_search_goes_on(
    study_file, tmp_path, caplog, monkeypatch
):
    caplog.set_level(logging.INFO)
    base = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0}
    sets = [base, {**base, "max_correspondence_distance": 1.0}, {**base, "keyframe_interval": 9.0}]
    data = {"odometry": "fake_odometry:Fake", "sets": [{"parameters": one} for one in sets]}
    (path := tmp_path / "mine.yaml").write_text(yaml12.dump(data))
    given = f"offline.portfolio={{{path}: {read_portfolio(str(path)).digest}}}"

    def said(*more):
        caplog.clear()
        trials = train(load_study(study_file, [given, *more], tmp_path / "study")).trials
        return trials, [t for t in caplog.messages if t.startswith("after ")]

    trials, told = said("offline.trials=3")
    assert [row["proposed by"] for row in trials] == ["baseline", "portfolio", "portfolio"]
    assert [row["max_correspondence_distance"] for row in trials] == [2.0, 1.0, 2.0]
    assert told == []  # the verdict says it
    shutil.rmtree(tmp_path / "study")
    trials, (told,) = said()
    assert len(trials) == 10
    pattern = r"after 3 sets: so far, trial 1 is the best \(.*\), with 0\.\d+ times .* goes on"
    assert re.fullmatch(pattern, told)
    assert said("offline.trials=12")[1] == []

    def none(_):
        raise AdaptuneError("less than the cheapest takes")

    shutil.rmtree(tmp_path / "study")
    monkeypatch.setattr(offline.train, "in_short", none)
    trials, (told,) = said()
    assert len(trials) == 10
    assert "none can be recommended (less than the cheapest takes); the search goes on" in told


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


def test_a_baseline_with_a_fault_or_without_poses_is_refused():
    n = 40
    run = Trial.of({}, np.tile(np.eye(4), (n, 1, 1)), *np.zeros((2, n)), 0.0)
    check_baseline("mine", "one", run)
    with pytest.raises(BaselineError, match=r"sequences\.one: mine fails .*baseline: hm: mend"):
        check_baseline("mine", "one", replace(run, reasons=("hm",)))
    failed = replace(run, reasons=("hm",), failure="no pose for 4 of 40 scans")
    with pytest.raises(BaselineError, match=r"sequences\.one: mine fails .*: no pose .*; hm: mend"):
        check_baseline("mine", "one", failed)


@pytest.mark.parametrize("name", ["Stumbling", "Apart"])
def test_a_baseline_with_a_fault_drives_once_more(study_file, tmp_path, caplog, name):
    """A node may die by chance: where it does not do so again, all is as if it never had."""
    falls = {"fault": "raise", "at": FIRST_STAMP + 500_000_000}
    stumble = falls | {"once": f"'{tmp_path}/stumbled'"}
    train(study_of(study_file, tmp_path / "study", name=name, **stumble))
    train(study_of(study_file, tmp_path / "sound", name=name))
    archives = [Archive(tmp_path / folder / "trials") for folder in ("study", "sound")]
    once, sound = (archive.read("one", 0) for archive in archives)
    assert not once.faults
    np.testing.assert_array_equal(once.errors, sound.errors)
    words = r"has a fault with its own parameters, so once more: .*no planes here"
    assert len(re.findall(words, caplog.text)) == 1
    with pytest.raises(BaselineError, match=r"fails with its own parameters.*: .*no planes here"):
        train(study_of(study_file, tmp_path / "twice", name=name, **falls))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"step": 0.375}, None),
        ({}, "0.79"),
        ({"axis": 1, "step": 0.375}, "like those of other axes"),
        ({"step": -0.375}, "or inverted"),
        ({"axis": 1}, None),
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


def test_where_scans_stand_and_the_reference_moves_nothing_counts(
    study_file, tmp_path, monkeypatch, caplog
):
    asked = []

    def carried(_, name, *__):
        asked.append(name)
        return [Finding((), f"{name} is carried", seconds=(1.0, 1.5), of="reference")]

    monkeypatch.setattr(campaign, "contradictions_of", carried)
    study = load_study(study_file, ["offline.trials=2"], tmp_path / "study")
    with caplog.at_level(logging.WARNING, "offline.campaign"):
        train(study)
    assert "Fake: one is carried, from 1.0 to 1.5 s" in caplog.text
    archive = Archive(study.folder / "trials")
    for name in study.training:
        frames = archive.read_frames(name)
        seconds = (frames.stamps - frames.stamps[0]) * 1e-9
        lost = (seconds >= 1.0) & (seconds <= 1.5)
        assert lost.any()
        np.testing.assert_array_equal(np.isnan(frames.T_ref_sensor[:, 0, 0]), lost)
        known = window_ends(frames.T_ref_sensor, study.config.sub_trajectory) >= 0
        for number in (0, 1):
            errors = archive.read(name, number).errors
            np.testing.assert_array_equal(np.isfinite(errors), known)
    train(study)
    assert asked == study.training  # what was stored is not asked again
