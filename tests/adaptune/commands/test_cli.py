import os
import re
import shlex
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import commands
import drives
import numpy as np
import pytest

from adaptune.commands import online, terminal
from adaptune.commands.cli import app
from offline.config import load_study
from offline.train import train
from online.modes import run_replays


@pytest.fixture
def adaptune(tmp_path, monkeypatch):
    """Call the command line in this process, with a terminal of 80 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(terminal.console, "width", 80)
    return commands.call


def next_words(done):
    """The words of the command that is named as the next one, which is said last."""
    *_, last = done.stdout.splitlines()
    match = re.fullmatch(r"Next: (?:.*; then )?adaptune (.*?)    # .*", last)
    assert match, last
    return shlex.split(match[1])


@pytest.mark.services
def test_one_bag_is_enough_and_every_command_names_the_next(adaptune, study_file, tmp_path):
    (tmp_path / "one.bag").symlink_to(study_file.parent / "one.bag")
    done = adaptune("inspect", "one.bag")
    assert done.exit_code == 0, done.stderr
    begin, end = (done.stdout.index(word) for word in ("sequences:", "Next:"))
    (tmp_path / "one.yaml").write_text(done.stdout[begin:end])
    assert adaptune("inspect", "one.bag", "--study", "same.yaml").exit_code == 0
    same = load_study(tmp_path / "same.yaml").config, load_study(tmp_path / "one.yaml").config
    assert same[0] == same[1]
    assert adaptune("inspect", "one.bag", "--study", "same.yaml").exit_code == 2
    words = [*next_words(done), "-o", "offline.trials=4", "--folder", "my study[v2]"]
    for command in ("offline", "online", "compare"):
        assert words[0] == command
        done = adaptune(*words)
        assert done.exit_code == 0, done.stderr
        words = next_words(done)
        overrides = ["-o", "offline.trials=4"]
        assert words[1:] == ["one.yaml", "--folder", "my study[v2]", *overrides]
        lines = [line for line in done.stdout.splitlines() if line.strip()]
        assert len(set(lines)) == len(lines)
        assert (command != "online") == ("Files: my study[v2]." in " ".join(done.stdout.split()))
        assert (command == "online") == (" replays made: my study[v2]/replays/" in done.stdout)
        trained = "What each choice gives in training, over "
        assert (command == "offline") == (trained in done.stdout)
    assert done.stdout.startswith(("Drive ", "Keep "))
    words = "baseline", "fixed", "adaptive", "paper", "one_60-100"
    assert all(word in done.stdout for word in words)
    table = done.stdout[done.stdout.rindex("RTE over") : done.stdout.index("Next: ")]
    assert max(map(len, table.splitlines())) <= 80
    assert "# find out what adapting gains elsewhere" in done.stdout
    assert (tmp_path / "my study[v2]/report/figures/overview.png").exists()


def test_inspect_proposes_a_study_without_a_reference_too(tmp_path):
    folder = tmp_path / "scans"
    folder.mkdir()
    for i, (_, points, _) in enumerate(drives.scans(n_scans=3)):
        np.save(folder / f"{i}.npy", points)
    done = commands.succeeded("inspect", folder)
    assert "reference: none; adaptune estimates one from the scans" in done.stdout
    begin, end = (done.stdout.index(word) for word in ("sequences:", "Next:"))
    (tmp_path / "one.yaml").write_text(done.stdout[begin:end])
    study = load_study(tmp_path / "one.yaml", [], tmp_path / "run")
    assert study.training == ["scans_0-60"]
    assert study.config.sub_trajectory == 5.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["offline", "none.yaml"], "none.yaml: there is no such file or folder; give the YAML"),
        (["offline", "STUDY", "-o", "offline.sampler=best"], "offline.sampler"),
        (["inspect", "STUDY"], "small.yaml"),
        (["simulate", "STUDY"], "there is none to simulate; add one"),
        (["online", "STUDY"], "model.safetensors: there is no such model"),
        (["compare", "STUDY"], "run `adaptune online`"),
        (["compare", "."], ".: is no study's folder"),
        (["online", "STUDY", "--model", "STUDY"], "is not an error model, or damaged"),
    ],
)
def test_mistakes_are_told_in_a_sentence(study_file, tmp_path, arguments, words, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = commands.refused(*(study_file if word == "STUDY" else word for word in arguments))
    assert words in said


MOST_COMMANDS = 14


def test_help_and_version(adaptune):
    done = adaptune("--help")
    assert done.exit_code == 0
    for command in ("inspect", "simulate", "offline", "validate", "online", "compare"):
        assert command in done.stdout
    commands = {command.name or command.callback.__name__ for command in app.registered_commands}
    assert len(commands) <= MOST_COMMANDS
    assert not app.registered_groups
    assert adaptune("--version").stdout.startswith("adaptune 0.")


@pytest.mark.services
def test_ctrl_c_leaves_a_study_that_resumes(adaptune, study_file, tmp_path):
    given = ["offline", str(study_file), "-o", "odometry.name=gicp"]
    many = ["-o", "offline.trials=400", "-o", "offline.batch=4"]
    campaign = subprocess.Popen(
        [sys.executable, "-m", "adaptune.commands.cli", *given, *many],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # What runs in a shell's background is told to ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    trials = tmp_path / "runs/small/trials"
    while not list(trials.glob("one-*/00003.npz")) and campaign.poll() is None:
        time.sleep(0.02)
    os.killpg(campaign.pid, signal.SIGINT)
    _, said = campaign.communicate(timeout=30)
    assert campaign.returncode == 130
    assert "run the same command again: what is finished is kept" in said
    assert "Traceback" not in said
    # Lines of a log are as long as what they say.
    *log, _ = said.splitlines()
    assert log
    assert all(re.match(r"\[\d\d:\d\d:\d\d\] .*\S$", line) for line in log)
    finished = {p: p.stat().st_mtime_ns for p in trials.glob("*/0000[0-3].npz")}
    assert finished
    assert adaptune(*given).exit_code == 0
    assert {p: p.stat().st_mtime_ns for p in finished} == finished


def test_a_deep_inspection_measures_the_reference(adaptune, study_file, tmp_path):
    bag = study_file.parent / "one.bag"
    shallow, deep = adaptune("inspect", bag), adaptune("inspect", bag, "--deep")
    assert deep.exit_code == 0, deep.stderr
    assert "reference: `--deep` also measures how wrong it is" in shallow.stdout
    assert "reference: wrong by at most" in deep.stdout
    # Wrong by a fifth.
    drive = [
        (stamp, points, T * np.array([[1, 1, 1, 0.8]] + [[1] * 4] * 3))
        for stamp, points, T in drives.scans(0, 60)
    ]
    done = adaptune("inspect", drives.write_bag(tmp_path / "wrong.bag", drive), "--deep")
    assert done.exit_code == 0, done.stderr
    assert re.search(r"sets that\s+differ by less cannot be told apart", done.stdout)
    begin, end = (done.stdout.index(word) for word in ("sequences:", "Next:"))
    (tmp_path / "wrong.yaml").write_text(done.stdout[begin:end])
    assert load_study(tmp_path / "wrong.yaml").training == ["wrong_0-60"]


@pytest.fixture(scope="module")
def finished(study_file, tmp_path_factory):
    """The folder of a study that was trained and replayed."""
    folder = tmp_path_factory.mktemp("run") / "study"
    study = load_study(study_file, ["odometry.name=gicp"], folder)
    train(study)
    run_replays(study, study.model_path)
    return study.folder


def test_a_finished_study_has_a_page_of_everything(finished):
    ended = commands.succeeded("compare", finished)
    assert "report/report.html" in "".join(ended.output.split())
    page = (finished / "report/report.html").read_text()
    for title in ("What adapting gained", "Along three", "What was tried", "Settings"):
        assert f"{title}</h2>" in page
    assert "No validation: run <code>adaptune validate</code>." in page
    figures = {path.stem for path in (finished / "report/figures").glob("*.svg")}
    assert {"overview", "comparison", "three-errors", "three-choices"} <= figures
    assert page.index('id="overview"') < page.index('id="comparison"')
    assert figures == {path.stem for path in (finished / "report/figures").glob("*.png")}
    for mode in ("baseline", "fixed", "adaptive", "paper"):
        assert f">{mode}</td>" in page


def test_trials_of_another_study_are_not_shown_as_this_one_s(finished):
    assert "Best mean" in commands.succeeded("trials", finished).output
    other = commands.succeeded("trials", finished, "-o", "sub_trajectory=4.5").output
    assert "of another study: sub_trajectory changed from 3.0 to 4.5. Run `adaptune offl" in other
    assert "Best mean" not in other


@pytest.mark.parametrize(("rules", "next_one"), [(("adaptive",), "offline"), ((), "record")])
def test_recordings_are_asked_for_only_where_something_adapts(
    adaptune, monkeypatch, rules, next_one
):
    study = SimpleNamespace(
        rules=rules, config=SimpleNamespace(training=("one",), test=("two",), courses={})
    )
    found = SimpleNamespace(rows=[SimpleNamespace(yardstick="fixed")], unfinished=False)
    named = []
    monkeypatch.setattr(online, "load", lambda *_: study)
    monkeypatch.setattr("adaptune.tuning.tuned.write_comparison", lambda _: (found, "page.html"))
    monkeypatch.setattr(online, "say_compared", lambda *_, **__: None)
    monkeypatch.setattr(online, "say_next_of_study", lambda _, command, *__: named.append(command))
    adaptune("compare", "study.yaml")
    assert named == [next_one]


COURSE = """
courses: {c: {scenes: [corridor], length: 10, sensor: vlp16, columns: 16}}
training: [c]
sub_trajectory: 5
"""
IMAGE = """
odometry:
  name: NAME
  settings: {image: nowhere/slam, SETTINGS}
  parameters: {a: {type: float, low: 0.1, high: 1.0, baseline: 0.5}}
"""


def test_a_recording_of_another_course_is_refused(adaptune, tmp_path):
    (study := tmp_path / "one.yaml").write_text("odometry: gicp\n" + COURSE)
    adaptune("simulate", study)
    for command in (["simulate", study], ["offline", study]):
        refused = adaptune(*command, "-o", "courses.c.seed=9")
        assert refused.exit_code == 2
        told = " ".join(refused.stderr.split())
        assert "c.bag is of another course: seed is 0 there, and 9 in the study; remove" in told
    same = ("-o", "courses.c.rate=10")
    assert "Recorded 0 of 1" in adaptune("simulate", study, *same).stdout
    reads = ("-o", "courses.c.compensate=constant_velocity")
    assert "Recorded 0 of 1" in adaptune("simulate", study, *reads).stdout
    again = adaptune("simulate", study, "-o", "courses.c.seed=9", "--overwrite")
    assert "Recorded 1 of 1" in again.stdout
    (damaged := tmp_path / "runs/one/recordings/c.json").write_text("{")
    refused = adaptune("simulate", study)
    assert refused.exit_code == 2
    assert f"{damaged.name}: is damaged, or of another adaptune; remove" in refused.stderr


def test_a_recording_of_a_course_that_was_cut_short_is_told(adaptune, tmp_path):
    (study := tmp_path / "one.yaml").write_text("odometry: gicp\n" + COURSE)
    adaptune("simulate", study)
    bag = tmp_path / "runs/one/recordings/c.bag"
    os.truncate(bag, bag.stat().st_size // 2)
    for command in (["simulate", study], ["offline", study], ["inspect", bag]):
        refused = adaptune(*command)
        assert refused.exit_code == 2
        told = " ".join(refused.stderr.split())
        assert "a simulated course is recorded anew by `adaptune simulate --overwrite`" in told
    assert "Recorded 1 of 1" in adaptune("simulate", study, "--overwrite").stdout
    assert "Recorded 0 of 1" in adaptune("simulate", study).stdout


@pytest.mark.parametrize(
    ("odometry", "lacking"),
    [
        (IMAGE.replace("NAME", "rustle"), "docker"),
        (IMAGE.replace("NAME", "docker_process"), "docker"),
        ("odometry: kiss_icp\n", "kiss_icp"),
    ],
)
def test_only_what_runs_an_odometry_needs_it(adaptune, tmp_path, monkeypatch, odometry, lacking):
    for name in [name for name in sys.modules if name.partition(".")[0] == lacking]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, lacking, None)
    monkeypatch.setitem(sys.modules, f"{lacking}.errors", None)
    monkeypatch.delitem(sys.modules, "adaptune.odometry.kiss_icp", raising=False)
    (tmp_path / "p.yaml").write_text("a: 0.5\n")
    study = tmp_path / "lean.yaml"
    settings = "template: p.yaml, odometry: /odom" if "rustle" in odometry else "command: [slam]"
    study.write_text(odometry.replace("SETTINGS", settings) + COURSE)
    assert "Recorded 1 of 1 courses" in adaptune("simulate", study).stdout
    assert "Recorded 0 of 1 courses" in adaptune("simulate", study).stdout
    unfinished = adaptune("trials", study)
    assert "no trial is finished yet" in unfinished.stderr
    told = " ".join(adaptune("offline", study).stderr.split())
    assert f"{lacking} cannot be imported" in told
    assert "run `pip install" in told
