import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from small_bag import replace_bag

from adaptune._system import manifest
from adaptune._system.strict import ConfigurationError
from adaptune.runs.archive import Archive, Frames, Trial
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
        # Else the number of sequences says how many segments of each are driven.
        given = [*overrides, "offline.segments=all"]
        return load_study(tmp_path / file, given, tmp_path / "run")

    yield make
    sys.modules.pop(module, None)


def mine(tmp_path):
    name = f"theirs_{tmp_path.name}"
    settings = ["odometry.parameters=", "odometry.settings={downsampling: 0.5}"]
    return [f"odometry.name={name}:Mine", *settings], tmp_path / f"{name}.py"


def trial(parameters):
    poses, nothing = np.tile(np.eye(4), (3, 1, 1)), np.zeros(3, bool)
    return Trial.of(parameters, poses, np.ones(3), nothing, 0.0)


def run(study, n=2):
    """Store trials on both training sequences, and frames."""
    archive = study.archive()
    archive.begin()
    frames = Frames(np.arange(3), np.tile(np.eye(4), (3, 1, 1)), np.zeros((3, 1)), {}, np.zeros(3))
    for name in study.training:
        archive.write_frames(name, frames)
        for number in range(n):
            if number not in archive.finished(name):
                archive.write(name, number, trial({"a": number}))


def finished(archive, names=("one", "two")):
    return [f"{name}/{number:05d}" for name in names for number in sorted(archive.finished(name))]


def begun(study, caplog):
    """What is said when a study is resumed, and the trials that count."""
    caplog.clear()
    archive = study.archive()
    archive.begin()
    said = [m for m in caplog.messages if "again: " in m or "since" in m]
    return " ".join(said), finished(archive)


ONE, TWO = ["one/00000", "one/00001"], ["two/00000", "two/00001"]


@pytest.mark.parametrize(
    ("before", "now", "words"),
    [
        ({"a": {"b": 0.5}}, {"a": {"b": 0.25}}, ["a.b changed from 0.5 to 0.25"]),
        ({"a": {}}, {"a": {"b": 1}}, ["a.b is new"]),
        ({"content": {"module x": "0"}}, {"content": {}}, ["module x is gone"]),
        (
            {"courses": {"b": 1}, "recording": {"b": "0"}, "reference": {"b": "0"}},
            {"courses": {}, "recording": {}, "reference": {}},
            ["courses.b is gone", "b is gone"],
        ),
        ({"content": {"x.sh": "0"}}, {"content": {"x.sh": "1"}}, ["x.sh has other content"]),
        ({"a": [1, 2]}, {"a": (1, 2)}, []),
        (None, {}, ["an older adaptune did not record what it depends on"]),
    ],
)
def test_what_differs_is_said(before, now, words):
    assert manifest.changes(before, now) == words


def test_what_did_not_change_is_not_run_again(load, caplog):
    run(load())
    more = ["sequences.one.cache=false", "offline.trials=3", "online.period=2"]
    for study in (load(), load(*more), load("training=[two, one]")):
        assert begun(study, caplog) == ("", ONE + TWO)
    assert load("training=[two, one]").model_inputs == load().model_inputs


@pytest.mark.parametrize(
    ("edited", "study", "left"),
    [
        ("two.bag", "small", ONE),
        ("one.tum", "small", TWO),
        ("class", "small", []),
        ("run.sh", "program", []),
        ("set.yaml", "program", []),
    ],
)
def test_what_was_edited_is_run_again(load, tmp_path, caplog, edited, study, left):
    overrides, path = mine(tmp_path) if edited == "class" else ([], tmp_path / edited)

    def again():
        return load(*overrides, file=f"{study}.yaml")

    run(again())
    if edited == "two.bag":
        replace_bag(path)
    else:
        path.write_text(path.read_text() + "\n# other\n")
    said, found = begun(again(), caplog)
    told = rf"{4 - len(left)} trials are run again: .*{path.stem}.* has other content"
    assert re.fullmatch(told, said)
    assert found == left
    # Nothing is lost.
    assert len(list((again().folder / "trials").glob("*/0000*.npz"))) == 4


def test_a_recording_may_move(load, tmp_path, caplog):
    run(load())
    for name in ("one.bag", "one.tum"):
        (tmp_path / name).rename(tmp_path / f"other_{name}")
    moved = load(
        "sequences.one.bag=other_one.bag", f"sequences.one.reference={tmp_path}/other_one.tum"
    )
    assert begun(moved, caplog) == ("", ONE + TWO)


def test_earlier_trials_count_again(load, caplog):
    run(load())
    other = "odometry.settings.downsampling=0.7"
    said, left = begun(load(other), caplog)
    assert said == "4 trials are run again: odometry.settings.downsampling changed from 0.5 to 0.7"
    assert left == []
    run(load(other), 1)
    said, left = begun(load(), caplog)
    assert said == "since the last run: odometry.settings.downsampling changed from 0.7 to 0.5"
    assert left == ONE + TWO
    assert begun(load(), caplog) == ("", ONE + TWO)
    assert begun(load(other), caplog)[1] == ["one/00000", "two/00000"]
    assert len(Archive(load().folder / "trials").sets()) == 1


def test_a_number_means_one_set_everywhere(load, tmp_path):
    run(load())
    bag = (tmp_path / "two.bag").read_bytes()
    replace_bag(tmp_path / "two.bag", 7)
    archive = load().archive()
    for number in (0, 1):
        archive.trial_path("one", number).unlink()
    load().archive().write("one", 0, trial({"a": "another"}))
    (tmp_path / "two.bag").write_bytes(bag)
    archive = load().archive()
    assert finished(archive) == ["one/00000", "two/00001"]
    assert archive.sets() == {0: {"a": "another"}, 1: {"a": 1}}
    archive.write("two", 0, trial({"a": "another"}))
    assert (
        finished(archive) == finished(load().archive()) == ["one/00000", "two/00000", "two/00001"]
    )


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("odometry.settings.version=b", "odometry.settings.version "),
        ("odometry.parameters.voxel.high=3", "voxel.high changed from 2.0 to 3.0"),
        ("sequences.one.stop=3", "sequences.one.stop is new"),
        ("sequences.one.clock_offset=0.1", "sequences.one.clock_offset changed from 0.0 to 0.1"),
        ("odometry={name: gicp}", "odometry.name changed from command to gicp"),
        ("sub_trajectory=7", "sub_trajectory changed from 3.0 to 7.0"),
    ],
)
def test_a_key_that_has_another_value(load, override, words, caplog):
    run(load(file="program.yaml"))
    said, left = begun(load(override, file="program.yaml"), caplog)
    assert words in said
    assert left == (TWO if "one" in override else [])


def test_another_version_of_a_package(load, monkeypatch, caplog):
    run(load())
    monkeypatch.setattr("importlib.metadata.version", lambda _: "99.0")
    said, _ = begun(load(), caplog)
    assert re.search(r"the version of fake_odometry changed from .* to 99\.0", said)


def test_of_sequences_that_are_not_trained_on_only_the_odometry_counts(load, tmp_path):
    run(load())
    replace_bag(tmp_path / "two.bag")
    load().archive().trial_path("one", 1).unlink()
    assert [*load("training=[one]").archive().known()] == [0, 1]
    assert not load("training=[one]", "odometry.settings.downsampling=0.7").archive().known()


@pytest.mark.parametrize("text", ["", "{}", "[]", "\xff", '{"digest": "", "inputs": {}}'])
def test_a_damaged_record_of_another_study_is_named(load, text):
    run(load())
    path = load().archive().of("two") / "inputs.json"
    path.write_text(text, encoding="latin-1")
    what = r"two-\w+/inputs\.json: is damaged .*; remove .*two-\w+ "
    with pytest.raises(ConfigurationError, match=what):
        load("odometry.settings.downsampling=0.7").archive().begin()
    # What it has to hold is known where the study is the same.
    load().archive().begin()
    assert load().archive().known()


def test_a_descriptor_that_was_edited_describes_again(load, tmp_path, caplog):
    _, module = mine(tmp_path)
    overrides = [f"descriptor=[ndt, '{module.stem}:describe']"]
    run(load(*overrides))
    assert load(*overrides).archive().has_frames("one", [])
    module.write_text(CLASS.replace("{number}", "2"))
    assert not load(*overrides).archive().has_frames("one", [])
    said, left = begun(load(*overrides), caplog)
    assert said == f"since the last run: module {module.stem} has other content"
    assert left == ONE + TWO


def test_what_changes_while_it_is_read_is_not_recorded(load, tmp_path):
    study = load()
    archive = study.archive()
    archive.begin()
    poses = tmp_path / "one.tum"
    poses.write_text(poses.read_text().replace(" 0.3", " 0.4", 1) + "\n")
    with pytest.raises(ConfigurationError, match=r"one\.tum: has changed while one was read"):
        archive.write("one", 0, trial({"a": 0}))
    assert not list(study.folder.glob("trials/one-*"))
    archive.write("two", 0, trial({"a": 0}))
    load().archive().write("one", 0, trial({"a": 0}))


def test_trials_with_faults_depend_on_the_limits(load, tmp_path, caplog):
    overrides, _ = mine(tmp_path)
    archive = load(*overrides).archive()
    for number, faults in ((0, ()), (1, ("late",))):
        archive.write("one", number, replace(trial({"x": number}), faults=len(faults)))
    archive.write("two", 0, trial({"x": 0}))
    said, left = begun(load(*overrides, "isolation.seconds=20"), caplog)
    assert re.fullmatch(r"1 trials are run again: limits\.seconds changed from .* to 20\.0", said)
    assert left == ["one/00000", "two/00000"]
    assert begun(load(*overrides), caplog)[1] == ["one/00000", "one/00001", "two/00000"]
