"""What is noted beside the trials of a study, and what is said when it has changed."""

import json
import os
import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from adaptune.archive import Archive, Frames, Trial
from adaptune.strict import ConfigurationError
from adaptune.study.inputs import InputNotes, check_inputs, resume, warn_of_stale
from adaptune.trajectory import write_tum
from offline.config import load_study

CLASS = """
from adaptune.odometry.keyframe import KeyframeGicp


class Mine(KeyframeGicp):
    pass


def describe(scan):
    return [{number}]
"""
PROGRAM = """
odometry:
  name: command
  settings: {command: ["{study}/run.sh", "{input}", "{parameters}"], template: set.yaml}
  parameters: {voxel: {type: float, low: 0.1, high: 2.0, baseline: 1.0}}
"""


@pytest.fixture
def load(study_file, tmp_path, monkeypatch):
    """Load a study with bags, references, a class and a program of its own."""
    for name in ("one", "two", "three"):
        shutil.copyfile(study_file.parent / f"{name}.bag", tmp_path / f"{name}.bag")
    write_tum(tmp_path / "one.tum", load_study(study_file).sequences.open("one").reference())
    (tmp_path / "run.sh").write_text("#!/bin/sh\n")
    (tmp_path / "run.sh").chmod(0o755)
    (tmp_path / "set.yaml").write_text("voxel: 1.0\n")
    # No other test has imported a module of this name.
    module = f"theirs_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(CLASS.replace("{number}", "1"))
    monkeypatch.syspath_prepend(str(tmp_path))
    text = study_file.read_text().replace(
        "{bag: one.bag, points: /points, reference: /truth}",
        "{bag: one.bag, points: /points, reference: one.tum}",
    )
    (tmp_path / "small.yaml").write_text(text)
    program = PROGRAM + text[text.index("sequences:") :]
    (tmp_path / "program.yaml").write_text(program)

    def make(*overrides, file="small.yaml"):
        return load_study(tmp_path / file, overrides, tmp_path / "run")

    yield make
    sys.modules.pop(module, None)


def mine(tmp_path):
    name = f"theirs_{tmp_path.name}"
    settings = ["odometry.parameters=", "odometry.settings={downsampling: 0.5}"]
    return [f"odometry.name={name}:Mine", *settings], tmp_path / f"{name}.py"


def trial(parameters):
    poses, nothing = np.tile(np.eye(4), (3, 1, 1)), np.zeros(3, bool)
    return Trial(parameters, poses, np.ones(3), nothing, ~nothing, np.zeros(3))


def note(study, n=2):
    """Store trials on both training sequences, and frames."""
    archive = Archive(study.folder / "trials", InputNotes(study))
    frames = Frames(np.arange(3), np.tile(np.eye(4), (3, 1, 1)), np.zeros((3, 1)), {}, np.zeros(3))
    for name in study.training:
        archive.write_frames(name, frames)
        for number in range(n):
            archive.write(name, number, trial({"a": number}))


def refused(study, *words):
    with pytest.raises(ConfigurationError) as caught:
        check_inputs(study)
    text = str(caught.value)
    for word in words:
        assert word in text
    assert "`adaptune offline --again`" in text
    return text


def replace_bag(path, offset=0):
    """Put another bag of the same size and time in its place."""
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data + bytes(offset))
    os.utime(path, ns=times)


def test_what_did_not_change_is_not_refused(load):
    note(load())
    check_inputs(load())
    check_inputs(load("sequences.one.cache=false", "offline.trials=3", "online.period=2"))
    about = json.loads((load().folder / "trials/one/inputs.json").read_text())
    assert about["adaptune"]


def test_a_bag_of_the_same_size_and_time(load, tmp_path):
    study = load()
    note(study)
    replace_bag(tmp_path / "two.bag")
    text = refused(study, "two.bag has other content than when two was trained on")
    assert "On this depend 2 trials on two. " in text


def test_a_reference_of_the_same_and_of_another_size(load, tmp_path):
    study, path = load(), tmp_path / "one.tum"
    note(study)
    text = path.read_text()
    for other in (text.replace("1", "2", 1), text + text.splitlines()[-1].replace("17", "27", 1)):
        path.write_text(other)
        refused(study, "one.tum has other content than when one was trained on", "2 trials on one")


def test_a_recording_may_move(load, tmp_path):
    note(load())
    for name in ("one.bag", "one.tum"):
        (tmp_path / name).rename(tmp_path / f"other_{name}")
    check_inputs(
        load("sequences.one.bag=other_one.bag", f"sequences.one.reference={tmp_path}/other_one.tum")
    )


def test_a_class_that_was_edited(load, tmp_path):
    overrides, module = mine(tmp_path)
    study = load(*overrides)
    note(study)
    study.model_path.write_bytes(b"")
    for mode in ("baseline", "adaptive"):
        replay = study.folder / "replays/three" / mode / "replay.json"
        replay.parent.mkdir(parents=True)
        replay.write_text("{}")
    check_inputs(study)
    module.write_text(module.read_text() + "\n# other\n")
    results = "2 trials on one, 2 trials on two, the model, 2 replays."
    refused(study, f"module {module.stem} has other content than when the trials", results)


@pytest.mark.parametrize("file", ["run.sh", "set.yaml"])
def test_a_program_or_template_that_was_edited(load, tmp_path, file):
    study = load(file="program.yaml")
    note(study)
    check_inputs(study)
    (tmp_path / file).write_text((tmp_path / file).read_text() + "# other\n")
    refused(study, f"{file} has other content than when the trials were run", "2 trials on two")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("odometry.settings.version=b", "odometry.settings.version has another value"),
        ("odometry.parameters.voxel.high=3", "odometry.parameters.voxel.high has another value"),
        ("sequences.one.stop=3", "sequences.one.stop has another value"),
        ("sequences.one.clock_offset=0.1", "sequences.one.clock_offset has another value"),
        ("odometry={name: gicp}", "odometry.name is gicp, and was command"),
    ],
)
def test_a_key_that_has_another_value(load, override, words):
    note(load(file="program.yaml"))
    refused(load(override, file="program.yaml"), words)


def test_another_version_of_a_package(load, monkeypatch):
    study = load()
    note(study)
    monkeypatch.setattr("importlib.metadata.version", lambda _: "99.0")
    refused(study, "the version of fake_odometry is 99.0, and was ")


def test_a_sequence_that_is_not_trained_on_may_change(load, tmp_path):
    study = load()
    note(study)
    replace_bag(tmp_path / "two.bag")
    check_inputs(load("training=[one]"))
    refused(load("training=[two]"), "two.bag has other content")


def test_trials_of_an_older_adaptune(load):
    study = load()
    note(study)
    (study.folder / "trials/two/inputs.json").unlink()
    refused(study, "trials/two holds trials of an older adaptune")


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"odometry": 3}', "\xff"])
def test_a_damaged_note_is_named(load, text):
    study = load()
    note(study)
    (study.folder / "trials/two/inputs.json").write_text(text, encoding="latin-1")
    with pytest.raises(ConfigurationError, match=r"two/inputs\.json: is damaged .*; remove"):
        check_inputs(study)


def test_a_descriptor_that_was_edited_describes_again(load, tmp_path):
    overrides, module = mine(tmp_path)
    overrides = [f"descriptor=[ndt, '{module.stem}:describe']"]
    study = load(*overrides)
    note(study)
    resume(study)
    frames = [study.folder / "trials" / name / "frames.npz" for name in ("one", "two")]
    assert all(path.exists() for path in frames)
    module.write_text(CLASS.replace("{number}", "2"))
    check_inputs(study)
    resume(study)
    assert not any(path.exists() for path in frames)
    assert len(list(study.folder.glob("trials/*/0000?.npz"))) == 4
    note(study, 0)
    resume(study)
    assert all(path.exists() for path in frames)


def test_the_refusal_is_one_sentence_after_the_other(load, tmp_path):
    study = load()
    note(study)
    replace_bag(tmp_path / "one.bag", 7)
    assert re.fullmatch(
        r".*/run: .*/one\.bag has other content than when one was trained on\. On this depend 2 "
        r"trials on one\. `adaptune offline --again` with this study computes them again, and "
        r"nothing else; or give this study another folder \(--folder\)",
        refused(study),
    )


def test_what_changes_while_it_is_read_is_not_noted(load, tmp_path):
    study = load()
    note = InputNotes(study)
    poses = tmp_path / "one.tum"
    poses.write_text(poses.read_text().replace(" 0.3", " 0.4", 1) + "\n")
    with pytest.raises(ConfigurationError, match=r"one\.tum: has changed while one was read"):
        note("one")
    assert not (study.folder / "trials/one/inputs.json").exists()
    note("two")
    InputNotes(study)("one")


def test_trials_with_faults_depend_on_the_limits(load, tmp_path):
    overrides, _ = mine(tmp_path)
    study = load(*overrides)
    archive = Archive(study.folder / "trials", InputNotes(study))
    for number, faults in ((0, ()), (1, ("late",))):
        archive.write("one", number, replace(trial({"x": number}), faults=faults))
    archive.write("two", 0, trial({"x": 0}))
    other = load(*overrides, "isolation.seconds=20")
    words = r"isolation\.seconds has another value\. On this depend 1 trials with faults on one\."
    with pytest.raises(ConfigurationError, match=words):
        check_inputs(other)
    resume(other, again=True)
    assert sorted(Archive(study.folder / "trials").finished("one")) == [0]
    check_inputs(other)


def test_the_table_of_stale_trials_says_so(load, tmp_path, caplog):
    study = load()
    archive = Archive(study.folder / "trials", InputNotes(study))
    archive.write("one", 0, trial({"x": 0}))
    warn_of_stale(study)
    assert not caplog.messages
    (tmp_path / "one.tum").write_text((tmp_path / "one.tum").read_text() + "\n")
    warn_of_stale(study)
    assert "one.tum has other content" in caplog.text
