"""Replays and models whose recordings, odometry or reference have changed since they were made."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from made_replays import folder_of
from small_bag import replace_bag

from adaptune._system.progress import unseen
from adaptune.errors import AdaptuneError
from adaptune.model import BankSettings, ErrorModel
from adaptune.runs.files import StoredReplayError
from adaptune.trajectory import Trajectory, write_tum
from offline.config import load_study
from offline.train import train
from offline.validate import validate
from online.charts import charts_of_replays
from online.compare import compare
from online.modes import Replays, replay_modes, run_replays
from online.reference import CONTRADICTIONS, reference_folder
from online.replayed import read_replays


@pytest.fixture(scope="module")
def replayed(study_file, trained_folder, tmp_path_factory):
    """A folder with recordings, a study, and its run and replays; not to be changed."""
    folder = tmp_path_factory.mktemp("replayed")
    shutil.copytree(study_file.parent, folder, dirs_exist_ok=True)
    shutil.copytree(trained_folder, folder / "run")
    truth = load_study(study_file).sequences.open("three").reference()
    write_tum(folder / "three.tum", truth)
    text = study_file.read_text().replace(
        "{bag: three.bag, points: /points, reference: /truth}",
        "{bag: three.bag, points: /points, reference: three.tum}",
    )
    (folder / "small.yaml").write_text(text + "online: {modes: [adaptive]}\n")
    run(load_at(folder))
    return folder


def load_at(folder, *overrides):
    return load_study(folder / "small.yaml", overrides, folder / "run")


def run(study, **given):
    return run_replays(study, study.model_path, **given)


@pytest.fixture
def load(replayed, tmp_path, caplog):
    caplog.set_level("INFO")
    folder = shutil.copytree(replayed, tmp_path / "copy")
    return lambda *overrides: load_at(folder, *overrides)


def test_a_test_recording_that_was_replaced(load, caplog):
    study = load()
    assert run(study) == 0
    compare(study)
    bag = study.folder.parent / "three.bag"
    before = bag.read_bytes()
    replace_bag(bag)
    with pytest.raises(StoredReplayError, match=r"three\.bag has other content; run `adaptune on"):
        compare(study)
    assert read_replays(study, "three").modes == {}
    assert run(study) == 3
    assert "three, adaptive: replayed again: " in caplog.text
    assert "three.bag has other content" in caplog.text
    compare(study)
    # Nothing is lost: each has a folder of its own.
    bag.write_bytes(before)
    assert run(study) == 0
    compare(study)


def test_another_reference_replays_nothing(load):
    study = load()
    before = {row.mode: row.rte for row in compare(study).rows}
    path = study.folder.parent / "three.tum"
    truth = study.sequences.open("three").reference()
    T = truth.T_world_sensor.copy()
    T[:, 0, 3] *= 1.1
    write_tum(path, Trajectory(truth.stamps, T))
    with pytest.raises(StoredReplayError, match=r"three: was judged by another reference; run"):
        compare(study)
    assert run(study) == 0
    after = {row.mode: row.rte for row in compare(study).rows}
    assert all(abs(after[mode] - before[mode]) > 1.0 for mode in before)
    shifted = load("sequences.three.clock_offset=0.05")
    with pytest.raises(StoredReplayError, match="another reference"):
        compare(shifted)
    assert run(shifted) == 0


def test_a_training_recording_that_was_replaced(load):
    study = load()
    replace_bag(study.folder.parent / "one.bag")
    for use in (run, validate):
        with pytest.raises(AdaptuneError, match=r"one\.bag has other content; run `adaptune off"):
            use(study)
    train(study)
    validate(study)
    run(study)
    compare(study)


def test_another_version_of_the_odometry(load, monkeypatch):
    study = load()
    monkeypatch.setattr("importlib.metadata.version", lambda _: "99.0")
    for use in (run, validate, compare):
        with pytest.raises(
            AdaptuneError, match=r"version of fake_odometry changed from .* to 99\.0"
        ):
            use(study)


def test_a_model_of_other_training_sequences(load):
    fewer = load("training=[one]")
    for use in (run, validate):
        with pytest.raises(AdaptuneError, match=r"recording\.two is gone|two is gone.* run"):
            use(fewer)
    # A model of another study is the user's choice.
    other = shutil.copy(fewer.model_path, fewer.folder / "other.safetensors")
    assert run_replays(fewer, fewer.folder / other) == 0
    # It is the study's own, however it is spelt.
    with pytest.raises(AdaptuneError, match="two is gone"):
        run_replays(fewer, Path(os.path.relpath(fewer.model_path)))


def test_replays_with_another_model_are_others(load, caplog):
    study = load()
    path = study.folder / "other.safetensors"
    settings = BankSettings(sharpness=7.0)
    replace(ErrorModel.load(study.model_path), bank_settings=settings).save(path)
    assert run_replays(study, path) == 1  # that which adapts
    other = replace(study, model_file=path)
    assert folder_of(other, "adaptive") != folder_of(study, "adaptive")
    assert folder_of(other, "fixed") == folder_of(study, "fixed")
    for one in (study, other):
        assert [row.mode for row in compare(one).rows] == ["baseline", "fixed", "adaptive"]
    shutil.rmtree(folder_of(study, "adaptive"))
    caplog.clear()
    assert [row.mode for row in compare(study).rows] == ["baseline", "fixed"]
    said = "three: the last replay of `adaptive` was made from other inputs: model changed from "
    assert said in caplog.text
    path.unlink()
    with pytest.raises(AdaptuneError, match=r"other\.safetensors"):
        compare(other)


def test_a_set_is_driven_once_whatever_it_is_called(load):
    study = load()
    shutil.rmtree(study.folder / "replays")
    own = replace(ErrorModel.load(study.model_path), fixed=0)
    assert replay_modes(study, ["three"], ["baseline", "fixed"], unseen, own) == 1
    replays = Replays(study, own)
    assert replays.made("three") == ("baseline", "fixed")
    assert replays.folder("three", "fixed") == replays.folder("three", "baseline")


def test_another_part_has_no_replays(load):
    study = load("sequences.three.stop=3")
    (said,) = charts_of_replays(read_replays(study, "three"))
    assert said == "No replays of three: run `adaptune online`."


def test_a_model_whose_inputs_are_not_known(load):
    study = load()
    model = ErrorModel.load(study.model_path)
    model.provenance["inputs"] = "of other trials"
    model.save(study.model_path)
    with pytest.raises(AdaptuneError, match=r"did not record .*; run `adaptune offline`"):
        run(study)


def test_a_reference_that_was_begun_is_made_again(load):
    study = load()
    (reference_folder(study, "three") / CONTRADICTIONS).unlink()
    with pytest.raises(StoredReplayError, match="judged by another reference"):
        compare(study)
    assert run(study) == 0
    compare(study)


@pytest.mark.parametrize("file", ["trajectory.tum", "frames.csv"])
def test_a_file_that_was_removed_is_made_again(load, file):
    study = load()
    (folder_of(study, "fixed") / file).unlink()
    with pytest.raises(StoredReplayError, match=rf"{file}.*; remove .* and run `adaptune online`"):
        compare(study)
    assert run(study) == 1
    compare(study)
