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
from fake_odometry import Fake

import adaptune
from adaptune._system import manifest
from adaptune.odometry.tracker import Tracker
from online.gate import judged

FAKE = ("--odometry", "fake_odometry:Fake")
COSTS = ("--cost", "off")
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
    data = json.loads((bags / "out/verdict.json").read_text())
    assert data["verdict"] == data["action"] == "worse"
    assert (data["odometry"], data["mode"]) == ("fake_odometry:Fake", "baseline")
    assert data["ratio"] > data["interval"][0] > 1.0
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
    data = json.loads((bags / "out/verdict.json").read_text())
    assert data["action"] == "pass"
    rows = data["rows"]
    assert {row["ratio"] for row in rows if row["quantity"] == "error"} == {1.0}


@pytest.mark.services
def test_in_python_sides_may_be_objects():
    good, bad = Fake(keyframe_interval=1.0), Fake(keyframe_interval=30.0)
    gate = adaptune.compare(bad, good, ["drive_a.bag", Path("drive_b.bag")], cost=None)
    assert gate.verdict == "worse"
    assert "fake_odometry:Fake (max_correspondence_distance 4, keyframe_interval 30)" in gate.words
    assert adaptune.compare(good, good, "drive_a.bag", cost=None).verdict == "equal"


@pytest.mark.services
def test_recordings_of_several_sensors_compare_and_each_side_is_named_while_it_drives(bags):
    made = drives.scans(5, 60)
    slow = [(stamp + 400_000_000 * i, points, T) for i, (stamp, points, T) in enumerate(made)]
    drives.write_bag(bags / "slow.bag", slow)
    told = []
    both = ["drive_a.bag", "slow.bag"]
    sides = Fake(keyframe_interval=2.0), Fake(keyframe_interval=3.0)
    gate = adaptune.compare(*sides, both, cost=None, progress=lambda *how: told.append(how[0]))
    assert {row.recording for row in gate.rows} == {"drive_a", "slow", "all"}
    for name in ("drive_a", "slow"):
        driving = {text for text in told if text.startswith(f"{name}, fake")}
        assert {text[-3:-1] for text in driving} == {" 2", " 3"}


@pytest.mark.services
def test_nothing_known_is_driven_again_and_folders_are_sides(bags, caplog):
    gate("bad", "good")
    replays = sorted((bags / "runs/compare").glob("*/replays/*/baseline-*/replay.json"))
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
    assert "give both the same with --sub-trajectory" in said


@pytest.mark.services
def test_errors_are_over_the_same_length_for_one_bag_and_for_several(bags):
    """Of a robot; a length that is given holds for folders, too."""
    for recordings in (("drive_a.bag",), ("drive_a.bag", "drive_b.bag", "drive_c.bag")):
        assert "RTE over 2 m" in gate("bad", "good", recordings=recordings).stdout
    assert "RTE over 3 m" in gate("bad", "good", "--sub-trajectory", 3).stdout
    gate("bad", "good")
    bad, good = (next(Path("runs/compare").glob(f"{name}_*/")) for name in ("bad", "good"))
    before = (bad / "study.yaml").read_text()
    done = commands.call("compare", bad, "--against", good, *COSTS, "--sub-trajectory", 4)
    assert "RTE over 4 m" in done.stdout
    assert (bad / "study.yaml").read_text() == before
    drives.write_bag(bags / "car.bag", drives.scans(9, 60, step=0.8))
    assert "RTE over 10 m" in gate("bad", "good", recordings=("car.bag",)).stdout


@pytest.mark.services
def test_for_the_cost_both_are_driven_twice_by_turns_and_that_is_kept(bags, monkeypatch):
    driven = []
    registered = Tracker.register

    def register(tracker, scan):
        driven.append(tracker)
        return registered(tracker, scan)

    monkeypatch.setattr("online.turns.Tracker.register", register)
    gate("same", "good", "--out", "out", "--cost", "1000000", recordings=("drive_a.bag",))
    data = json.loads((bags / "out/verdict.json").read_text())
    (row,) = [row for row in data["rows"] if row["quantity"] == "cost"]
    assert row["new"] > 0.0
    assert row["low"] < row["ratio"] < row["high"]
    # A few scans to begin with, and twice the drive; the sides meet each scan one after the other.
    in_turn = driven[-4 * 150 :]
    assert [one is in_turn[0] for one in in_turn[:8]] == [True, False, False, True] * 2
    for both in (in_turn[:300], in_turn[300:]):
        assert sorted(map(id, both)) == sorted([id(both[0])] * 150 + [id(both[1])] * 150)
    assert in_turn[300] is not in_turn[0]
    n = len(driven)
    gate("same", "good", "--cost", "1000000", recordings=("drive_a.bag",))
    assert len(driven) == n


@pytest.mark.services
@pytest.mark.usefixtures("bags")
def test_what_has_changed_since_has_no_cost():
    gate("bad", "good")
    made = (next(Path("runs/compare").glob(f"{name}_*/")) for name in ("bad", "good"))
    bad, good = (
        shutil.copytree(folder, folder.with_name(f"changed_{i}")) for i, folder in enumerate(made)
    )
    choose(bad, good)
    study = bad / "study.yaml"
    study.write_text(re.sub("downsampling: .*", "downsampling: 0.7", study.read_text()))
    commands.call("compare", bad, "--against", good, "--out", "out")
    rows = json.loads(Path("out/verdict.json").read_text())["rows"]
    assert {row["verdict"] for row in rows if row["quantity"] == "cost"} == {"unclear"}
    (why,) = {row["why"] for row in rows if row["quantity"] == "cost" and row["recording"] != "all"}
    assert "has changed since: odometry.settings.downsampling" in why


@pytest.mark.services
def test_too_little_to_tell_is_a_result_of_its_own(bags):
    drives.write_bag(bags / "short.bag", drives.scans(7, 25))
    few = {"recordings": ("short.bag",)}
    done = gate("bad", "good", **few)
    assert "TOO LITTLE TO TELL" in done.stdout
    assert done.exit_code == 0
    assert gate("bad", "good", "--unclear", "fail", **few).exit_code == 3


PROGRAM = """import sys
from pathlib import Path
from adaptune.recording import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.trajectory import Trajectory, write_tum
source, output, left_out = sys.argv[1:]
known = open_sequence(SequenceConfig(bag=source, reference="/truth")).reference()
kept = [i for i in range(len(known)) if (i + 1) % int(left_out)]
write_tum(Path(output), Trajectory(known.stamps[kept], known.T_world_sensor[kept]))
"""


@pytest.mark.services
def test_a_side_that_lacks_poses_is_worse(bags):
    (bags / "program.py").write_text(PROGRAM)
    drives = [f"{sys.executable} program.py {{input}} {{output}} {n}" for n in (12, 1000)]
    given = ("drive_a.bag", "--reference", "/truth", *COSTS)
    done = commands.call("compare", drives[0], *given, "--against", drives[1])
    assert done.exit_code == 3, done.output
    assert "12 scans without a pose instead of 0" in done.stdout
    assert "(scans without a pose)" in done.stdout
    assert commands.call("compare", drives[1], *given, "--against", drives[0]).exit_code == 0


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
        (["bad.yaml", "--against", "good.yaml", "--worse", "off"], "as in --worse 5%"),
        (["bad.yaml", "--against", "good.yaml", "--cost", "none"], "--cost 5%, or `off`"),
        (["bad.yaml", "--against", "good.yaml", "--sub-trajectory", "-1"], "give metres, more"),
        (["bad.yaml", "--sub-trajectory", "3"], "--sub-trajectory: goes with --against"),
        (["bad.yaml", "none.bag", "--against", "good.yaml", *FAKE], "none.bag: there is no such"),
        (
            ["o'hare --x", "drive_a.bag", "--against", "gicp"],
            "o'hare --x: No closing quotation; put",
        ),
        (["no.yaml", "drive_a.bag", "--against", "good.yaml", *FAKE], "no.yaml: there is no such"),
    ],
)
def test_mistakes_are_told_in_a_sentence(arguments, words):
    assert words in commands.refused("compare", *arguments)


def choose(*sides):
    """Let the sets that were driven be chosen ones: these are not driven again."""
    for side in sides:
        inputs = next(side.glob("replays/drive_a/baseline-*/inputs.json"))
        (side / "fixed.yaml").write_text(json.dumps(manifest.recorded(inputs)["parameters"]))


def edited(folder, name, **changed):
    """A copy of a side whose replays are made from something else."""
    copy = shutil.copytree(folder, folder.with_name(name))
    for path in copy.glob("replays/*/baseline-*/inputs.json"):
        manifest.record(path, manifest.recorded(path) | changed)
    return copy


def refused(new, old):
    return commands.refused("compare", new, "--against", old)


@pytest.mark.services
@pytest.mark.usefixtures("bags")
def test_what_does_not_compare_is_refused():
    gate("bad", "good")
    made, before = (next(Path("runs/compare").glob(f"{name}_*/")) for name in ("bad", "good"))
    bad, good = (
        shutil.copytree(one, one.with_name(to)) for one, to in ((made, "x"), (before, "y"))
    )
    other = edited(before, "other", reader=92)
    assert "read it differently: reader changed from" in refused(bad, other)
    study = shutil.copytree(before, before.with_name("judge")) / "study.yaml"
    study.write_text(study.read_text().replace("max_gap: ", "max_gap: 1", 1))
    assert "are judged by different references" in refused(bad, study.parent)
    paced = edited(before, "paced", real_time={"rate": 2.0})
    assert "with other values of online.real_time: " in refused(bad, paced)
    # A set that is no baseline.
    fixed = {"keyframe_interval": 7.0}
    of_fixed = edited(before, "of_fixed", parameters=fixed)
    (of_fixed / "fixed.yaml").write_text(json.dumps(fixed))
    assert "was replayed as `baseline` only, and" in refused(bad, of_fixed)
    # Where one of three was interrupted, the mode that both have counts.
    shutil.copytree(before / "replays/drive_a", of_fixed / "replays/drive_a", dirs_exist_ok=True)
    done = commands.call("compare", bad, "--against", of_fixed, *COSTS)
    assert "1 recording: error" in done.stdout
    choose(bad, good)
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
