"""Campaigns whose driver or workers are killed at random moments, against an undisturbed one.

    python benchmarks/kill.py [KILLS] [SEED]

The script sends SIGKILL to a driver or to one of its two workers, with equal chance, shortly after
a random number of trials has finished since the last kill. Then it starts the driver again.
Whenever a driver has ended, no finished trial may be missing or written again. At the end archive,
model and fixed set must equal those of the undisturbed campaign byte for byte, except for times,
with every trial once in the index. Fifty kills take several campaigns.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

import drives
import kills

N_TRIALS = 32
OVERRIDES = (f"offline.trials={N_TRIALS}", "offline.workers=2")


def main(n_kills: int, seed: int) -> None:
    """Kill until `n_kills` processes have been killed."""
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        study_file = drives.write_study(folder)
        begin = time.monotonic()
        kills.disturb(study_file, folder / "undisturbed", 0, 0, rng, *OVERRIDES)
        print(f"undisturbed: {time.monotonic() - begin:.1f} s", flush=True)
        expected = kills.contents(folder / "undisturbed")
        n_files = len(kills.files(folder / "undisturbed"))
        killed = np.zeros(2, int)
        campaigns = 0
        while killed.sum() < n_kills:
            disturbed = folder / f"disturbed-{campaigns}" / "undisturbed"
            left = n_kills - int(killed.sum())
            killed += kills.disturb(study_file, disturbed, left, n_files, rng, *OVERRIDES)
            assert kills.contents(disturbed) == expected, f"{disturbed} is not the same"
            kills.check_once(disturbed, N_TRIALS, ["one", "two"])
            campaigns += 1
            print(
                f"{campaigns} campaigns the same; {killed[0]} drivers and {killed[1]} workers "
                f"killed, {time.monotonic() - begin:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main(*(int(word) for word in [*sys.argv[1:], *("50", "0")[len(sys.argv) - 1 :]]))
