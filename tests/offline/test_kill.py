"""What a campaign leaves whose processes are killed; ``benchmarks/kill.py`` kills more of them."""

import kills
import numpy as np


def test_killed_campaigns_end_as_undisturbed_ones(study_file, tmp_path):
    rng = np.random.default_rng(1)
    kills.disturb(study_file, tmp_path / "a" / "study", 0, 0, rng)
    n_files = len(kills.files(tmp_path / "a" / "study"))
    killed = kills.disturb(study_file, tmp_path / "b" / "study", 4, n_files, rng)
    assert sum(killed) >= 2
    assert kills.contents(tmp_path / "b" / "study") == kills.contents(tmp_path / "a" / "study")
    kills.check_once(tmp_path / "b" / "study", 10, ["one", "two"])
