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
