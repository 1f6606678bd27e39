"""Two sides of the same recordings: is the new one worse?"""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as Xml

import commands
import drives
import pytest

from adaptune import manifest
from online.gate import judged

FAKE = ("--odometry", "fake_odometry:Fake")
COSTS = ("--cost", "1000000")
"""Nobody knows what else the machine does."""


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    for seed, name in enumerate("abc"):
        drives.write_bag(folder / f"drive_{name}.bag", drives.scans(seed, 150))
    for name, interval in {"good": 1.0, "same": 1.0, "bad": 30.0}.items():
        (folder / f"{name}.yaml").write_text(f"keyframe_interval: {interval}\n")
    return folder


@pytest.fixture(autouse=True)
def here(bags, monkeypatch):
    """What one test has driven, the others find."""
    monkeypatch.chdir(bags)


def gate(new, old, *options, recordings=("drive_a.bag", "drive_b.bag", "drive_c.bag")):
    given = (f"{new}.yaml", *recordings, "--against", f"{old}.yaml", *FAKE, *COSTS)
    return commands.call("compare", *given, *options)


@pytest.mark.services
def test_a_worse_set_fails_and_the_same_one_does_not(bags):
    done = gate("bad", "good", "--out", "out")
    assert done.exit_code == 3, done.output
    assert "WORSE: bad.yaml against good.yaml, 3 recordings: error x" in done.stdout
    data = json.loads((bags / "out/gate.json").read_text())
    assert data["verdict"] == "worse"
    errors = [row for row in data["rows"] if row["quantity"] == "error"]
    assert [row["recording"] for row in errors] == ["drive_a", "drive_b", "drive_c", "all"]
    assert all(row["ratio"] > 1.05 for row in errors)
    suite = Xml.parse(bags / "out/junit.xml").getroot()
    assert int(suite.get("failures")) == len(suite.findall("testcase/failure")) >= 1
    assert "| drive_a | RTE [%] |" in (bags / "out/summary.md").read_text()
    assert gate("good", "bad").exit_code == 0
    # Another file of the same values is driven anew, and equal bit by bit.
    done = gate("same", "good", "--out", "out")
    assert done.exit_code == 0, done.output
    rows = json.loads((bags / "out/gate.json").read_text())["rows"]
    assert {row["ratio"] for row in rows if row["quantity"] == "error"} == {1.0}


@pytest.mark.services
def test_nothing_known_is_driven_again_and_folders_are_sides(bags, caplog):
    gate("bad", "good")
    replays = sorted((bags / "runs/compare").glob("*/replays/*/baseline/replay.json"))
    times = [path.stat().st_mtime_ns for path in replays]
    caplog.clear()
    with caplog.at_level("INFO"):
        gate("bad", "good")
    assert [path.stat().st_mtime_ns for path in replays] == times
    for name in ("good", "bad"):
        assert re.search(rf"{name}.yaml: its replays of [\d-]+ [\d:]+ are compared", caplog.text)
    bad, good = (next(Path("runs/compare").glob(f"{name}_*/")) for name in ("bad", "good"))
    assert commands.call("compare", bad, "--against", good, *COSTS).exit_code == 3
    study = good / "study.yaml"
    text = study.read_text()
    study.write_text(text.replace("sub_trajectory: ", "sub_trajectory: 1"))
    said = commands.refused("compare", bad, "--against", study)
    study.write_text(text)
    assert "sub_trajectory: errors over" in said


@pytest.mark.services
def test_too_little_to_tell_is_a_result_of_its_own(bags):
    drives.write_bag(bags / "short.bag", drives.scans(7, 25))
    few = {"recordings": ("short.bag",)}
    done = gate("bad", "good", **few)
    assert "TOO LITTLE TO TELL" in done.stdout
    assert done.exit_code == 0
    assert gate("bad", "good", "--unclear", "fail", **few).exit_code == 3


@pytest.mark.parametrize(
    ("ratio", "ends", "verdict"),
    [
        (1.1, (1.02, 1.2), "worse"),
        (1.03, (1.02, 1.04), "equal"),
        (1.0, (0.9, 1.2), "unclear"),
        (1.1, (0.99, 1.2), "unclear"),
        (0.9, (0.8, 0.99), "better"),
        (1.0, (1.0, 1.0), "equal"),
    ],
)
def test_the_interval_decides(ratio, ends, verdict):
    assert judged(ratio, ends, 0.05) == verdict


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none", "--against", "good.yaml"], "none: there is no such study"),
        (["bad.yaml", "--against", "good.yaml"], "bad.yaml: is no study"),
        (["bad.yaml", "drive_a.bag", "--against", "good.yaml"], "name its --odometry"),
        (["bad.yaml", "drive_a.bag"], "BAG: goes with --against"),
        (["bad.yaml", "--points", "/a"], "--points: goes with --against"),
        (["bad.yaml", "--against", "good.yaml", "--as", "one"], "--as: goes with the bags"),
        (["bad.yaml", "--against", "good.yaml", "--details"], "--details go with one study"),
        (["bad.yaml", "--against", "good.yaml", "--worse", "much"], "--worse much: give a perce"),
        (["bad.yaml", "none.bag", "--against", "good.yaml", *FAKE], "none.bag: there is no such"),
        (["no.yaml", "drive_a.bag", "--against", "good.yaml", *FAKE], "no.yaml: there is no such"),
    ],
)
def test_mistakes_are_told_in_a_sentence(arguments, words):
    assert words in commands.refused("compare", *arguments)


def copied(folder, name, file="", **changed):
    """A copy of a side as replays of a fixed set; one file of the first drive has a change."""
    copy = shutil.copytree(folder, folder.with_name(name))
    for path in (copy / "replays").iterdir():
        (path / "baseline").rename(path / "fixed")
    if file:
        path = copy / "replays/drive_a" / file
        manifest.record(path, manifest.recorded(path) | changed)
    return copy


def refused(new, old):
    return commands.refused("compare", new, "--against", old)


@pytest.mark.services
@pytest.mark.usefixtures("bags")
def test_what_does_not_compare_is_refused():
    gate("bad", "good")
    made = (next(Path("runs/compare").glob(f"{name}_*/")) for name in ("bad", "good"))
    bad, good = (copied(folder, name) for folder, name in zip(made, "xy", strict=True))
    before = next(Path("runs/compare").glob("good_*/"))
    other = copied(before, "other", "fixed/inputs.json", reader=92)
    assert "read it differently: reader changed from" in refused(bad, other)
    judged_by = copied(before, "judge", "reference.inputs.json", reference={"drive_a": ["x"]})
    assert "are judged by different references" in refused(bad, judged_by)
    old = copied(before, "old")
    (old / "replays/drive_a/fixed/inputs.json").unlink()
    assert "an older adaptune did not record what this replay was made from" in refused(bad, old)
    code = "import fcntl, sys, time; f = open(sys.argv[1], 'a'); fcntl.flock(f, fcntl.LOCK_EX)"
    with subprocess.Popen(
        [sys.executable, "-c", f"{code}; print(flush=True); time.sleep(600)", good / ".lock"],
        stdout=subprocess.PIPE,
    ) as holder:
        holder.stdout.readline()
        try:
            assert "another adaptune writes to it" in refused(bad, good)
        finally:
            holder.kill()
    for name in ("drive_b", "drive_c"):
        shutil.rmtree(bad / "replays" / name)
    shutil.rmtree(good / "replays/drive_a")
    assert "no recording is in both, by content and part: " in refused(bad, good)
