"""What a campaign leaves whose processes are killed; ``benchmarks/kill.py`` kills more of them."""

import kills
import numpy as np
import pytest

from offline.config import load_study
from offline.train import train

pytestmark = pytest.mark.services

GICP = "odometry.name=gicp"


def test_killed_campaigns_end_as_undisturbed_ones(study_file, tmp_path):
    train(load_study(study_file, [GICP], tmp_path / "undisturbed"))
    rng = np.random.default_rng(1)
    n_files = len(kills.files(tmp_path / "undisturbed"))
    killed = kills.disturb(study_file, tmp_path / "study", 4, n_files, rng, GICP)
    assert sum(killed) >= 2
    assert kills.contents(tmp_path / "study") == kills.contents(tmp_path / "undisturbed")
    kills.check_once(tmp_path / "study", 10, ["one", "two"])
