"""What the command line and the configuration import before they do anything."""

import subprocess
import sys

import pytest

HEAVY = ("scipy", "numba", "open3d", "optuna", "vl_convert", "rosbags", "sklearn", "small_gicp")


def imported(code):
    """Modules that a fresh process has imported after running some code."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_help_imports_neither_numpy_nor_a_stage():
    code = (
        "from typer.testing import CliRunner\n"
        "from adaptune.commands.cli import app\n"
        "assert CliRunner().invoke(app, ['--help']).exit_code == 0"
    )
    names = imported(code)
    assert not names & {"numpy", "pydantic", "offline", "online", *HEAVY}


@pytest.mark.parametrize("module", ["adaptune.study.config", "offline.config"])
def test_configuration_models_import_nothing_heavy(module):
    names = imported(f"import {module}")
    assert not names & set(HEAVY)
    assert not names & {"adaptune.simulation.record", "adaptune.simulation.world"}
