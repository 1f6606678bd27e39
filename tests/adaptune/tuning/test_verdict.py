"""The verdict as a table and as a file."""

import csv
import json
import shutil

import pytest

from adaptune.tuning.verdict import front_table, write_verdict
from offline.config import load_study
from online.compare import compare
from online.modes import run_replays


@pytest.fixture(scope="module")
def study(study_file, trained_folder, tmp_path_factory):
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("verdict") / "study")
    return load_study(study_file, [], folder)


@pytest.fixture(scope="module")
def found(study):
    run_replays(study, study.model_path)
    return compare(study)


def written(study, found):
    write_verdict(study, found)
    return json.loads((study.folder / "verdict.json").read_text("utf-8"))


def test_the_file_says_what_the_front_and_the_sentences_say(study, found):
    data = written(study, found)
    assert data["why"] == found.verdict
    assert data["action"] == ("keep" if found.verdict[0].startswith("Keep ") else "drive")
    (row,) = (row for row in data["front"] if row["recommended"])
    assert (data["set"], data["file"], data["mode"]) == (row["trial"], row["file"], row["mode"])
    assert data["mode"] == found.advised
    assert data["on_another_drive"] == [row["low"], row["high"]]
    assert data["ratio"] > 0.0
    assert data["odometry"] == next(iter(study.config.odometries))
    assert data["budget"] == "2x"


def test_the_file_agrees_with_the_front_of_training(study, found):
    with (study.folder / "front.csv").open() as file:
        rows = {row["trial"]: row for row in csv.DictReader(file)}
    front = written(study, found)["front"]
    assert 0 < len(front) <= 5
    for row in front:
        trained = rows["" if row["trial"] is None else str(row["trial"])]
        assert row["what"] == trained["what"].split(", ")[0]
        for key in ("low", "high", "another drive"):
            assert row[key] == float(trained[key])
        for key in ("file", "parameters", "left out"):
            assert row[key] == trained[key]
        if row["driven on"] == "training":
            assert (row["error [%]"], row["cost [ms]"]) == tuple(
                float(trained[key]) for key in ("error [%]", "cost [ms]")
            )
        if row["file"]:
            assert (study.folder / row["file"]).exists()
    if found.advised == found.model.recommended:
        of_training = next(row["trial"] for row in rows.values() if row["recommended"] == "True")
        assert [str(row["trial"]) for row in front if row["recommended"]] == [of_training]


def test_where_nothing_is_advised_the_action_says_so(study, found):
    none = [row | {"recommended": False} for row in found.front]
    data = written(study, found._replace(front=none, advised="none"))
    assert [data[key] for key in ("action", "mode", "set", "ratio")] == ["none", None, None, None]
    assert written(study, found._replace(front=[], advised=""))["action"] == "unknown"


def test_the_table_says_what_each_choice_gives_and_how_to_drive_it(study, found):
    table = front_table(study, found.front)
    assert f"Files: {study.folder}." in table.caption
    assert f"`adaptune online {study.folder} --ros2 --mode adaptive`" in table.caption
    assert "*" not in table.caption.replace("`", "")
    row = found.front[0] | {"what": "any CPU time", "trial": 9, "file": "any_cost.yaml"}
    row |= {"low": 0.3, "high": 0.8, "recommended": False, "driven on": "training"}
    own = row | {"what": "own parameters", "trial": 0, "low": 1.0, "high": 1.0}
    own["in training"] = 0.67, 11.84
    bank = row | {"what": "adaptive", "trial": None, "file": "model.safetensors", "low": None}
    few = [own, row | {"odometry": "ndt"}, bank | {"recommended": True, "driven on": "test"}]
    table = front_table(study, few, "Here")
    assert table.title.startswith("Here over ")
    where = "of training, where own parameters have 0.67 % at 11.8 ms."
    assert f"* Error and cost are {where}" in table.caption
    shown = ("choice", "another drive", "to drive it")
    assert [[row[key] for key in shown] for row in table.rows] == [
        ["own parameters*", "1", "change nothing"],
        ["any CPU time: trial 9 (ndt)*", "0.30-0.80", "load any_cost.yaml"],
        ["-> adaptive", None, "run model.safetensors"],
    ]
    more = front_table(study, [row | {"99 % [ms]": 9.0, "memory [MB]": 5.0}]).rows[0]
    assert (more["99 % [ms]"], more["memory [MB]"]) == (9.0, 5.0)
