import re

import fuzz
import pytest
from setups import failure

from offline.config import load_study

FOREIGN = re.compile(r"pydantic|https://|Input should|validation|Value error|tuple|dict|None")
"""Words of pydantic's and of Python's."""


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sub_trajectory=true", "sub_trajectory: give a number, not true"),
        ("sub_trajectory=", "sub_trajectory: give a number, not nothing"),
        ("sub_trajectory={a: 1}", "sub_trajectory: give a number, not keys with values"),
        ("odometry.parameters.keyframe_interval={type: [1]}", "keyframe_interval: give its type"),
        ("odometry={settings: {}}", "odometry.name: this key is missing"),
        ("sequences.o@ne={bag: one.bag}", "sequences.o@ne: becomes the name of a file: give"),
        ("sequences.one.bag=~nobodyx/a.bag", "sequences.one.bag: ~nobodyx/a.bag: there is no such"),
        ("sequences.one.bag=''", "sequences.one.bag: give a path, not an empty text"),
        (
            "sequences.one.reference=" + "a" * 300 + ".tum",
            "sequences.one.reference: cannot be reached (File name too long)",
        ),
        (
            "sequences.one.clock_offset=1e300",
            "clock_offset: give a number of at most 3,000,000,000",
        ),
        ("sequences.one.cache=maybe", "sequences.one.cache: give true or false, not 'maybe'"),
        ("sequences.one.extrinsic=abc", "sequences.one.extrinsic: give numbers: x y z qx qy qz"),
        (
            "sequences.one.extrinsic=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]",
            "sequences.one.extrinsic: its last row is not 0 0 0 1; is it transposed?",
        ),
        (
            "courses.x={scenes: [cave], lenght: 3}",
            "courses.x.lenght: unknown key; did you mean 'length'?",
        ),
        ("training=[]", "training: give at least 1, not 0"),
        ("health.max_speed=.nan", "health.max_speed: give a finite number, not NaN"),
        ("health.max_speed=1" + "0" * 400, "health.max_speed: give a number of at most 1"),
        ("descriptor.window=3", "descriptor: give a list, not keys with values"),
        (
            "odometry={name: gicp, parameters: {downsampling: {low: 0.2, log: true}}}",
            "parameters.downsampling: takes choices, not low and log; its own are choices: [0.15,",
        ),
        (
            "odometry.parameters.keyframe_interval={choices: [1, 2]}",
            "keyframe_interval: takes low and high, not choices; its own are low: 1.0, high: ",
        ),
        (
            "odometry.parameters.keyframe_interval={type: categorical, low: 1, baseline: 1}",
            "parameters.keyframe_interval: takes choices, not low",
        ),
        (
            "online.modes=[paired]",
            "online.modes.0: there is no mode 'paired': there is 'adaptive', ",
        ),
        ("offline.objective={rtf: 3}", "offline.objective.rtf: give 'rte', 'kitti', 'rpe', 'ape'"),
        (
            "offline={sampler: grid, sampler_settings: {grid: {keyframe_interval: 3}}}",
            "offline.sampler_settings.grid.keyframe_interval: give keys with values or a list, not",
        ),
    ],
)
def test_a_mistake_is_told_once_in_plain_words(study_file, override, message):
    told = failure(study_file, override)
    first, *others = told.splitlines()
    assert first.startswith("-o: ")
    assert message in first
    assert others == []
    # The words of the test itself are quoted, not said.
    assert not FOREIGN.search(told)
    assert len(told) < 250


def test_all_mistakes_are_told_together(study_file):
    file = study_file.with_name("all.yaml")
    file.write_text(
        study_file.read_text()
        .replace("downsampling: 0.5", "downsampling: true")
        .replace("bag: one.bag", "bag: one.bag, stride: 0")
        .replace("points: /points, reference: /truth}\n  three", "points: /p}\n  three")
        .replace("test: [three]", "test: [threee]")
        .replace("sub_trajectory: 3.0", "sub_trajectory: abc")
        .replace("trials: 10", "trials: 0, sampler_settings: {gama: 1}")
        + "online: {switching: {mechanism: lively, size: 0}}\n"
    )
    lines = failure(file).splitlines()
    assert [re.sub(r".*, line (\d+): ([\w.]+): .*", r"\1 \2", line) for line in lines] == [
        "3 odometry.settings.downsampling",
        "8 sequences.one.stride",
        "9 sequences.two",
        "12 test.0",
        "13 sub_trajectory",
        "14 offline.trials",
        "15 online.switching.mechanism",
        "15 online.switching.size",
    ]


@pytest.mark.parametrize("given", ["abc", "-1", "nan", "inf", "1e400"])
def test_a_wrong_size_of_the_cache_is_told_once(study_file, monkeypatch, given):
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", given)
    with pytest.raises(Exception, match=r"^ADAPTUNE_CACHE_GB is .*; give gigabytes, 0 or more"):
        load_study(study_file)


@pytest.mark.parametrize("kind", ["folder", "device", "large"])
def test_what_cannot_be_a_study_is_not_read(tmp_path, kind):
    path = tmp_path / "study.yaml"
    told = "a study is a file of YAML, of 1 MB at most; with a recording, begin by `adaptune tune`"
    if kind == "folder":
        path.mkdir()
        told = "is no study's folder: there is no study.yaml in it"
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.write_text("a: b\n" * 300_000)
    assert failure(path) == f"{path}: {told}"


def test_damaged_studies_give_a_study_or_an_error(tmp_path):
    counts = fuzz.counted(fuzz.of_studies(tmp_path), 1, range(100))
    assert min(counts["errors"], counts["read"]) > 0
