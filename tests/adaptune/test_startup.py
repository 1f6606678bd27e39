"""Configuration models are light to import."""

import subprocess
import sys

import pytest

HEAVY = ("vl_convert", "numba", "open3d", "rosbags", "scipy", "sklearn")


@pytest.mark.parametrize(
    "code",
    [
        "from adaptune.simulation.course import Course\nCourse(scenes=['cave', 'street'], imu=200)",
        "from adaptune.simulation.course import as_sequence",
        "from adaptune.recording.config import SequenceConfig, ViewConfig\n"
        "SequenceConfig(bag='a.bag', views=[ViewConfig(reverse=True)]).model_dump()",
        "from adaptune.recording.scan import origin",
        "from adaptune.study.config import StudyConfig",
        "from adaptune.model.descriptor import check_descriptor\ncheck_descriptor('ndt')",
    ],
)
def test_configuration_imports_nothing_heavy(code: str) -> None:
    code += f"\nimport sys\nprint(*(m for m in {HEAVY} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
