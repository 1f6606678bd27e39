import os
import signal
import subprocess
import sys
import time

import pytest
from typer.testing import CliRunner

from adaptune.archive import Archive
from adaptune.cli import app


def adaptune(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", "adaptune.cli", *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=os.environ | {"COLUMNS": "80"},
    )


def test_the_whole_way(study_file, tmp_path):
    done = adaptune("offline", study_file, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Fixed: max_correspondence_distance" in done.stdout
    done = adaptune("online", study_file, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "4 replays made" in done.stdout
    done = adaptune("compare", study_file, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for mode in ("baseline", "fixed", "paired", "paper"):
        assert mode in done.stdout
    assert all(name in done.stdout for name in ("APE [m]", "RPE [m]", "KITTI [%]", "[deg/100 m]"))
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert (tmp_path / "runs/small/comparison/three.svg").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["offline", "none.yaml"], "none.yaml: there is no such file"),
        (["offline", "STUDY", "-o", "offline.sampler=best"], "offline.sampler"),
        (["simulate", "STUDY"], "there is none to simulate"),
        (["online", "STUDY"], "model.safetensors: there is no such model"),
        (["compare", "STUDY"], "run `adaptune online`"),
        (["online", "STUDY", "--model", "STUDY"], "is not an error model, or damaged"),
    ],
)
def test_mistakes_are_told_in_a_sentence(study_file, tmp_path, arguments, words, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, [str(study_file) if a == "STUDY" else a for a in arguments])
    assert done.exit_code == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_a_process_ends_with_a_sentence_too(tmp_path):
    done = adaptune("offline", "none.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert "none.yaml: there is no such file" in done.stderr
    assert "Traceback" not in done.stderr


def test_inspect_and_cache(study_file, tmp_path):
    done = adaptune("inspect", study_file.parent / "one.bag", "--png", "one.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "/points" in done.stdout
    assert "sequences:" in done.stdout
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")
    done = adaptune("inspect", study_file, cwd=tmp_path)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert adaptune("cache", cwd=tmp_path).returncode == 0
    assert adaptune("cache", "clear", cwd=tmp_path).stdout.startswith("Freed")


def test_help_and_version(tmp_path):
    done = adaptune("--help", cwd=tmp_path)
    assert done.returncode == 0
    for command in (
        "inspect",
        "simulate",
        "offline",
        "validate",
        "online",
        "switching",
        "compare",
        "cache",
    ):
        assert command in done.stdout
    assert adaptune("--version", cwd=tmp_path).stdout.startswith("adaptune 0.")


def test_ctrl_c_leaves_a_study_that_resumes(study_file, tmp_path):
    command = [sys.executable, "-m", "adaptune.cli", "offline", str(study_file)]
    many = ["-o", "offline.trials=400", "-o", "offline.batch=4"]
    process = subprocess.Popen(
        command + many,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # What runs in a shell's background is told to ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    archive = Archive(tmp_path / "runs/small/trials")
    deadline = time.monotonic() + 60
    while not archive.trial_path("one", 3).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "run the same command again" in said
    assert "Traceback" not in said
    finished = {p: p.stat().st_mtime_ns for p in archive.folder.glob("*/0000[0-3].npz")}
    assert adaptune("offline", study_file, cwd=tmp_path).returncode == 0
    assert {p: p.stat().st_mtime_ns for p in finished} == finished
