import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from small_bag import replace_bag

from adaptune import manifest
from adaptune.archive import Frames, Trial
from adaptune.strict import ConfigurationError
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


def run(study, n=2):
    """Store trials on both training sequences, and frames."""
    archive = study.archive()
    moved = archive.renew(study.training)
    frames = Frames(np.arange(3), np.tile(np.eye(4), (3, 1, 1)), np.zeros((3, 1)), {}, np.zeros(3))
    for name in study.training:
        archive.write_frames(name, frames)
        for number in range(n):
            if number not in archive.finished(name):
                archive.write(name, number, trial({"a": number}))
    return moved


def files(study, folder="trials"):
    return sorted(f"{p.parent.name}/{p.stem}" for p in (study.folder / folder).rglob("*.npz"))


def renewed(study, caplog):
    """What is said when a study is resumed, and the trials that are left."""
    caplog.clear()
    study.archive().renew(study.training)
    said = [m for m in caplog.messages if " again: " in m]
    return " ".join(said), [name for name in files(study) if "frames" not in name]


ONE, TWO = ["one/00000", "one/00001"], ["two/00000", "two/00001"]


@pytest.mark.parametrize(
    ("before", "now", "words"),
    [
        ({"a": {"b": 0.5}}, {"a": {"b": 0.25}}, ["a.b changed from 0.5 to 0.25"]),
        ({"a": {}}, {"a": {"b": 1}}, ["a.b is new"]),
        ({"content": {"module x": "0"}}, {"content": {}}, ["module x is gone"]),
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
        assert renewed(study, caplog) == ("", ONE + TWO)
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
    said, found = renewed(again(), caplog)
    told = rf"{4 - len(left)} trials are run again: .*{path.stem}.* has other content"
    assert re.fullmatch(told, said)
    assert found == left
    moved = [name for name in files(again(), "earlier") if "frames" not in name]
    assert moved == [name for name in ONE + TWO if name not in left]


def test_a_recording_may_move(load, tmp_path, caplog):
    run(load())
    for name in ("one.bag", "one.tum"):
        (tmp_path / name).rename(tmp_path / f"other_{name}")
    moved = load(
        "sequences.one.bag=other_one.bag", f"sequences.one.reference={tmp_path}/other_one.tum"
    )
    assert renewed(moved, caplog) == ("", ONE + TWO)


def test_earlier_trials_count_again(load, caplog):
    run(load())
    other = "odometry.settings.downsampling=0.7"
    said, left = renewed(load(other), caplog)
    assert said == "4 trials are run again: odometry.settings.downsampling changed from 0.5 to 0.7"
    assert left == []
    run(load(other), 1)
    assert run(load())
    assert files(load()) == sorted([*ONE, *TWO, "one/frames", "two/frames"])
    assert run(load(other), 1)
    assert renewed(load(other), caplog) == ("", ["one/00000", "two/00000"])


def test_earlier_trials_whose_numbers_mean_other_sets_stay_away(load, tmp_path, caplog):
    run(load())
    bag = (tmp_path / "two.bag").read_bytes()
    replace_bag(tmp_path / "two.bag", 7)
    run(load("training=[one]"))
    load().archive().renew(["one", "two"])
    for name in ("00000", "00001"):
        (load().folder / f"trials/one/{name}.npz").unlink()
    load().archive().write("one", 0, trial({"a": "another"}))
    (tmp_path / "two.bag").write_bytes(bag)
    assert renewed(load(), caplog)[1] == ["one/00000"]


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
    said, left = renewed(load(override, file="program.yaml"), caplog)
    assert words in said
    assert left == (TWO if "one" in override else [])


def test_another_version_of_a_package(load, monkeypatch, caplog):
    run(load())
    monkeypatch.setattr("importlib.metadata.version", lambda _: "99.0")
    said, _ = renewed(load(), caplog)
    assert re.search(r"the version of fake_odometry changed from .* to 99\.0", said)


def test_of_sequences_that_are_not_trained_on_only_the_odometry_counts(load, tmp_path, caplog):
    run(load())
    replace_bag(tmp_path / "two.bag")
    assert renewed(load("training=[one]"), caplog) == ("", ONE + TWO)
    other = load("training=[one]", "odometry.settings.downsampling=0.7")
    assert renewed(other, caplog)[1] == []


@pytest.mark.parametrize("text", ["", "{}", "[]", "\xff", '{"digest": "", "inputs": {}}'])
def test_a_damaged_record_is_named(load, text):
    run(load())
    (load().folder / "trials/two/inputs.json").write_text(text, encoding="latin-1")
    with pytest.raises(ConfigurationError, match=r"two/inputs\.json: is damaged .*; remove .*two "):
        load().archive().renew(["one", "two"])


def test_a_descriptor_that_was_edited_describes_again(load, tmp_path, caplog):
    _, module = mine(tmp_path)
    overrides = [f"descriptor=[ndt, '{module.stem}:describe']"]
    run(load(*overrides))
    module.write_text(CLASS.replace("{number}", "2"))
    said, left = renewed(load(*overrides), caplog)
    assert said == f"2 sequences are described again: module {module.stem} has other content"
    assert left == ONE + TWO
    assert not any("frames" in name for name in files(load()))


def test_what_changes_while_it_is_read_is_not_recorded(load, tmp_path):
    study = load()
    archive = study.archive()
    archive.renew(study.training)
    poses = tmp_path / "one.tum"
    poses.write_text(poses.read_text().replace(" 0.3", " 0.4", 1) + "\n")
    with pytest.raises(ConfigurationError, match=r"one\.tum: has changed while one was read"):
        archive.write("one", 0, trial({"a": 0}))
    assert not (study.folder / "trials/one/inputs.json").exists()
    archive.write("two", 0, trial({"a": 0}))
    load().archive().write("one", 0, trial({"a": 0}))


def test_trials_with_faults_depend_on_the_limits(load, tmp_path, caplog):
    overrides, _ = mine(tmp_path)
    archive = load(*overrides).archive()
    for number, faults in ((0, ()), (1, ("late",))):
        archive.write("one", number, replace(trial({"x": number}), faults=faults))
    archive.write("two", 0, trial({"x": 0}))
    said, left = renewed(load(*overrides, "isolation.seconds=20"), caplog)
    assert re.fullmatch(r"1 trials are run again: limits\.seconds changed from .* to 20\.0", said)
    assert left == ["one/00000", "two/00000"]
