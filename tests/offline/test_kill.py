"""What a campaign leaves whose processes are killed; ``benchmarks/kill.py`` kills more of them."""

import kills
import numpy as np


def test_killed_campaigns_end_as_undisturbed_ones(study_file, trained_folder, tmp_path):
    rng = np.random.default_rng(1)
    n_files = len(kills.files(trained_folder))
    killed = kills.disturb(study_file, tmp_path / "study", 4, n_files, rng)
    assert sum(killed) >= 2
    assert kills.contents(tmp_path / "study") == kills.contents(trained_folder)
    kills.check_once(tmp_path / "study", 10, ["one", "two"])
