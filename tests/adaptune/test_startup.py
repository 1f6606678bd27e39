import os
import shutil
import signal
import subprocess
import sys

import pytest

import adaptune.__main__
from adaptune.errors import hidden

HEAVY = {"scipy", "numba", "open3d", "optuna", "vl_convert", "rosbags", "sklearn", "small_gicp"}


def imported(code):
    """Modules that a fresh process has imported after running some code."""
    command = [sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


def test_help_imports_neither_numpy_nor_a_stage():
    code = (
        "from typer.testing import CliRunner\n"
        "from adaptune.commands.cli import app\n"
        "assert CliRunner().invoke(app, ['--help']).exit_code == 0"
    )
    names = imported(code)
    assert not names & {"numpy", "pydantic", "offline", "online", *HEAVY}


@pytest.mark.parametrize(
    "code",
    [
        "from adaptune.simulation.course import Course\nCourse(scenes=['cave', 'street'], imu=200)",
        "from adaptune.recording.config import SequenceConfig\n"
        "SequenceConfig(bag='a.bag').model_dump()",
        "import offline.config",
        "from adaptune.model.descriptor import check_descriptor\ncheck_descriptor('ndt')",
    ],
)
def test_configuration_imports_nothing_heavy(code):
    assert not imported(code) & {"adaptune.simulation.record", "adaptune.simulation.world", *HEAVY}


ZSH = {
    "_ADAPTUNE_COMPLETE": "complete_zsh",
    "_TYPER_COMPLETE_ARGS": "adaptune offline my.yaml --over",
}
BASH = {
    "_ADAPTUNE_COMPLETE": "complete_bash",
    "COMP_WORDS": "adaptune offline my.yaml --over",
    "COMP_CWORD": "3",
}


@pytest.mark.parametrize("shell", [BASH, ZSH], ids=["bash", "zsh"])
def test_the_shell_is_answered(shell, tmp_path):
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "adaptune"],
        cwd=tmp_path,
        env=os.environ | shell,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "--override" in done.stdout
    imported = {line.rpartition("|")[2].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert "typer" in imported
    assert not imported & HEAVY


@pytest.mark.parametrize(
    "module", ["typer.core", "rich.console", "pydantic", "numpy", "offline.config"]
)
def test_ctrl_c_while_importing_ends_without_a_traceback(study_file, tmp_path, module):
    # Python names every module to standard error once it is imported.
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "adaptune", "offline", str(study_file)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # What runs in a shell's background is told to ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    assert any(line.rpartition("|")[2].strip() == module for line in process.stderr)
    os.kill(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said.endswith("interrupted\n")
    assert "Traceback" not in said
    assert not (tmp_path / "runs").exists()


def test_a_checkout_runs_its_own_stages(tmp_path):
    """Another one is installed, as where somebody compares two versions."""
    for package in ("adaptune", "adaptune/commands", "offline"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    shutil.copy(adaptune.__main__.__file__, tmp_path / "adaptune")
    code = "import offline\n\n\ndef main():\n    print(offline.__file__)\n"
    (tmp_path / "adaptune/commands/cli.py").write_text(code)
    command = [sys.executable, "-m", "adaptune"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == f"{tmp_path / 'offline/__init__.py'}\n"


def test_a_package_that_pythonpath_hides_is_named(tmp_path, monkeypatch):
    (tmp_path / "dist/numpy").mkdir(parents=True)
    (tmp_path / "dist/numpy/__init__.py").write_text("raise ImportError('for another Python')")
    (tmp_path / "dist/kiss_icp").mkdir()
    (tmp_path / "dist/kiss_icp/__init__.py").touch()
    (tmp_path / "a.bag").touch()
    command = [sys.executable, "-m", "adaptune", "inspect", tmp_path / "a.bag"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path / "dist"), "/none"))}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    where = f"numpy comes from PYTHONPATH ({tmp_path}/dist/numpy/__init__.py)"
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"error: for another Python: {where}, before the installed one")
    # An older kiss_icp lacks a module; what is not installed is not hidden.
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "dist"))
    assert "kiss_icp comes from PYTHONPATH" in hidden(ImportError("x", name="kiss_icp.config"))
    (tmp_path / "dist/theirs.py").touch()
    assert hidden(ImportError("x", name="theirs")) == ""
    monkeypatch.delenv("PYTHONPATH")
    assert hidden(ImportError("x", name="kiss_icp.config")) == ""
