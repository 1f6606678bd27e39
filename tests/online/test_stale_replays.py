"""Replays and models whose recordings, odometry or reference have changed since they were made."""

import json
import os
import shutil
from pathlib import Path

import pytest
from small_bag import replace_bag

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.trajectory import Trajectory, write_tum
from offline.config import load_study
from offline.train import train
from offline.validate import validate
from online.charts import charts_of_replays
from online.compare import compare, current_replays
from online.modes import run_replays
from online.record import StoredReplayError
from online.reference import check_reference
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
    for path in folder.glob("run/replays/*/*/replay.json"):
        path.write_text(path.read_text().replace(str(replayed), str(folder)))
    return lambda *overrides: load_at(folder, *overrides)


def rewrite(folder, **inputs):
    """Change what a replay was made from."""
    path = folder / manifest.FILE
    manifest.record(path, manifest.recorded(path) | inputs)


def test_a_test_recording_that_was_replaced(load, caplog):
    study = load()
    assert run(study) == 0
    compare(study)
    replace_bag(study.folder.parent / "three.bag")
    with pytest.raises(StoredReplayError, match=r"three\.bag has other content; run `adaptune on"):
        compare(study)
    # All that is refused for one reason is told at once.
    (said,) = charts_of_replays(read_replays(study, "three"))
    assert said == (
        f"{study.folder / 'replays/three'}: baseline, fixed, adaptive were made from other "
        f"inputs: {study.folder.parent / 'three.bag'} has other content; run `adaptune online` "
        f"with this study."
    )
    assert run(study) == 3
    assert "three.bag has other content" in caplog.text
    compare(study)


def test_another_reference_replays_nothing(load, caplog):
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
    assert "three: the reference has changed; no replay depends on it" in caplog.text
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


def test_replays_with_two_models_are_not_compared(load):
    study = load()
    path = study.folder / "replays/three/adaptive/replay.json"
    stored = json.loads(path.read_text()) | {"model_file": "/gone/model.safetensors"}
    path.write_text(json.dumps(stored))
    rewrite(path.parent, model="another")
    # Only one mode is adaptive here: it is of a model that is gone, and nothing else is known.
    compare(study)
    twice = study.folder / "replays/three/paper"
    shutil.copytree(path.parent, twice)
    rewrite(twice, mode="paper", model="a third")
    both = load("online.modes=[adaptive, paper]")
    with pytest.raises(StoredReplayError, match=r"model changed from another to .*; run `adaptune"):
        compare(both)
    both.model_path.unlink()
    with pytest.raises(StoredReplayError, match=r"different models .*run `adaptune online` again"):
        compare(both)


def test_what_is_refused_is_told_and_not_drawn(load):
    study = load()
    assert current_replays(study, ["three"])[1:] == (("baseline", "fixed", "adaptive"), ())
    assert current_replays(study, ["one"])[1:] == ((), ())
    # What is left of a mode that the study does not have any more is not looked at.
    folder = study.folder / "replays/three"
    shutil.copytree(folder / "adaptive", folder / "paper")
    assert "paper" not in current_replays(study, ["three"]).modes
    other = load("online.switching.mechanism=bank", "online.switching.size=2")
    _, modes, refused = current_replays(other, ["three"])
    assert modes == ("baseline", "fixed")
    with pytest.raises(StoredReplayError, match="made from other inputs: switching") as caught:
        compare(other)
    assert refused == (f"{caught.value}.",)
    said, of_errors, _ = charts_of_replays(read_replays(other, "three"))
    assert said == refused[0]
    lines = {line.name for panel in of_errors.panels for line in panel.drawn}
    assert {"baseline", "fixed"} <= lines
    assert "adaptive" not in lines
    assert run(other) == 1
    compare(other)


def test_of_replays_with_different_models_those_with_the_own_one_are_drawn(load):
    study = load("online.modes=[adaptive, even]")
    run(study)
    rewrite(study.folder / "replays/three/even", model="another")
    with pytest.raises(StoredReplayError, match="even: was made from other inputs: model changed"):
        compare(study)
    _, modes, (said,) = current_replays(study, ["three"])
    assert modes == ("baseline", "fixed", "adaptive")
    assert "three/even: was made from other inputs: model changed from another to " in said


def test_replays_of_another_rate_or_reference_are_not_drawn(load):
    study = load()
    folder = study.folder / "replays/three/adaptive"
    rewrite(folder, real_time={"rate": 1.0})
    with pytest.raises(StoredReplayError, match="some were made in real time"):
        read_replays(study, "three")
    rewrite(folder, real_time=None)
    with pytest.raises(StoredReplayError, match="judged by another reference"):
        read_replays(load("sequences.three.clock_offset=0.05"), "three")


@pytest.mark.parametrize("note", ["", "[]", "{}", '{"inputs": {}}'])
def test_a_damaged_note_of_the_reference_is_no_note(tmp_path, note):
    (tmp_path / "reference.inputs.json").write_text(note)
    with pytest.raises(StoredReplayError, match="was judged by another reference; run `adaptune"):
        check_reference(tmp_path, {})


def test_a_model_whose_inputs_are_not_known(load):
    study = load()
    model = ErrorModel.load(study.model_path)
    model.provenance["inputs"] = "of other trials"
    model.save(study.model_path)
    with pytest.raises(AdaptuneError, match=r"did not record .*; run `adaptune offline`"):
        run(study)


@pytest.mark.parametrize("file", ["trajectory.tum", "frames.csv"])
def test_a_file_that_was_removed_is_made_again(load, file):
    study = load()
    (study.folder / "replays/three/fixed" / file).unlink()
    with pytest.raises(StoredReplayError, match=rf"{file}.*; remove .* and run `adaptune online`"):
        compare(study)
    assert run(study) == 1
    compare(study)
