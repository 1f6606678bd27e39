"""How the modes of a study compare on each test sequence, and whether their own errors were right.

    python benchmarks/driven.py runs/mine_gicp    # after adaptune online configs/mine_gicp.yaml

Of the replays of baseline, fixed, even and what adapts, the script prints a line for each sequence,
the mean RTE, geometric means of ratios, and the worst ratio to the best of fixed, even and
baseline. Then, at how many selections the interval of the error that a mode estimated while driving
held the truth: the mean RTE of the sub-trajectories that ended in the last 30 s.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptune.study.study import Study
from offline.config import load_study
from online.modes import Replays
from online.reference import read_reference

MODES = ("baseline", "fixed", "even", "adaptive", "untrained")


def geometric(ratios: NDArray[np.float64]) -> float:
    """Geometric mean."""
    return float(np.exp(np.log(ratios).mean()))


def driven(study: Study, mode: str) -> tuple[list[float], NDArray[np.float64]]:
    """Mean RTE on each test sequence, and of each selection its truth, estimate, low and high."""
    errors, told = [], []
    for name in study.config.test:
        reference = read_reference(study, name)
        replay = Replays.of(study).read(name, mode)
        errors.append(float(np.nanmean(reference.errors(replay.trajectory))))
        at = np.searchsorted(replay.trajectory.stamps, replay.choice_stamps)
        true = reference.errors_behind(replay.trajectory)[
            np.minimum(at, len(replay.trajectory) - 1)
        ]
        told.append(np.column_stack([true, replay.estimated]))
    every = np.concatenate(told)
    return errors, every[np.isfinite(every).all(axis=1)]


def main() -> None:
    """Print the tables."""
    study = load_study(Path(sys.argv[1]) / "study.yaml", folder=Path(sys.argv[1]), needed=False)
    first = Replays.of(study).made(study.config.test[0])
    found = {mode: driven(study, mode) for mode in MODES if mode in first}
    errors = {mode: np.array(of) for mode, (of, _) in found.items()}
    for i, name in enumerate(study.config.test):
        print(f"{name:12s}", *(f"{mode} {of[i]:.3f} %" for mode, of in errors.items()), sep="  ")
    single = (
        errors["fixed"] if "even" not in errors else np.minimum(errors["fixed"], errors["even"])
    )
    best = np.minimum(single, errors["baseline"])
    for mode, of in errors.items():
        to = ", ".join(
            f"to {m} {geometric(of / errors[m]):.2f}" for m in ("fixed", "even") if m in errors
        )
        print(
            f"{mode:10s} {of.mean():.3f} %, {to}, to the better of these "
            f"{geometric(of / single):.2f}, of means {of.mean() / single.mean():.2f}, "
            f"worst to the best {(of / best).max():.2f}"
        )
    for mode, (_, told) in found.items():
        if len(told):
            true, _, low, high = told.T
            held = 100.0 * ((low <= true) & (true <= high)).mean()
            print(f"{mode}: its interval holds the truth at {held:.0f} % of {len(told)} selections")


if __name__ == "__main__":
    main()
