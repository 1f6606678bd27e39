import os
import subprocess
import sys

import pytest

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
        "from adaptune.recording.config import SequenceConfig, ViewConfig\n"
        "SequenceConfig(bag='a.bag', views=[ViewConfig(reverse=True)]).model_dump()",
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
