"""What tuning and adapting give on recorded data, trained on some recordings, tested on others.

    python benchmarks/recorded.py FOLDER [--odometries gicp ndt kiss_icp] [--sets 16] [--seed 0]
                                         [--directions town campus_1 ...]

ADAPTUNE_TEST_DATA names the folder of the recordings. Each direction and odometry is a study in
FOLDER: a Sobol sequence of so many sets, one after the other on one core. The same command resumes.
A row is a test sequence: the mean error of each mode in percent, its ratio to the fixed set's, and
95 % intervals of the ratios. *untrained* is a bank that knows nothing of the study.

References of town, road and city are a car's GPS and inertial unit: right to about 1 % over 25 m.
Differences below that are no evidence there.
"""

import argparse
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adaptune import cores, yaml
from adaptune.errors import AdaptuneError
from offline.offline_study import OfflineStudy, load_study
from offline.train import train
from online.run_replays import run_replays, run_untrained
from online.statistics import ComparisonRow, Reference, compare_modes
from online.stored_replays import StoredReplay

ODOMETRIES = ("gicp", "ndt", "kiss_icp")
MODES = ("baseline", "fixed", "paired", "untrained")
TOPICS = {"points": "/velodyne_points", "reference": "/gt_poses"}
# An HDL-64E turns on while the car drives: a scan is distorted by up to two metres. KISS-ICP
# compensates by itself.
COMPENSATING = ("kiss_icp",)
# Keyframes once a second: a gap of 39 s, steps of 1.2 m at most.
CAMPUS = {"health": {"max_speed": 5.0, "max_freeze": 10.0}, "lost_track": 0.5}


@dataclass(frozen=True)
class Direction:
    """Where to tune, and where to test: recordings, or parts of them."""

    training: tuple[str, ...]
    test: tuple[str, ...]
    sub_trajectory: float


DIRECTIONS = {
    "town": Direction(("town",), ("city", "road"), 25.0),
    "city_road": Direction(("city", "road"), ("town",), 25.0),
    "campus_1": Direction(("campus: 0-50%",), ("campus: 50-100%",), 25.0),
    "campus_2": Direction(("campus: 50-100%",), ("campus: 0-50%",), 25.0),
    "hall_1": Direction(("hall: 0-50%",), ("hall: 50-100%",), 5.0),
    "hall_2": Direction(("hall: 50-100%",), ("hall: 0-50%",), 5.0),
}
"""The studies of each odometry; each recording is tuned on once and tested on once."""


def definition(direction: Direction, odometry: str, n_sets: int, seed: int) -> dict[str, object]:
    """The study of a direction, as the data of its YAML."""
    roles = (*direction.training, *direction.test)
    recordings = dict.fromkeys(role.partition(":")[0] for role in roles)
    given: dict[str, object] = {
        "odometry": {"name": odometry},
        "sequences": {name: recording(name, odometry) for name in recordings},
        "training": [role_of(role) for role in direction.training],
        "test": [role_of(role) for role in direction.test],
        "sub_trajectory": direction.sub_trajectory,
        "offline": {"sampler": "sobol", "trials": n_sets, "seed": seed, "workers": 1},
        # All modes but `paper`, with a bank, though the benchmark is bound to one core.
        "online": {"rules": ["paired"], "switching": {"mechanism": "bank"}},
    }
    return given | CAMPUS if "campus" in recordings else given


def recording(name: str, odometry: str) -> dict[str, object]:
    """The entry of a recording in a study."""
    entry: dict[str, object] = {"bag": f"${{ADAPTUNE_TEST_DATA}}/{name}.bag", **TOPICS}
    if name in ("town", "city", "road") and odometry not in COMPENSATING:
        entry["compensate"] = "constant_velocity"
    if name == "campus":
        entry["max_gap"] = 60.0
    return entry


def role_of(text: str) -> str | dict[str, str]:
    """A sequence by its name, or a part of it as a study's YAML has it."""
    name, _, part = text.partition(": ")
    return {name: part} if part else name


def run(study: OfflineStudy) -> list[ComparisonRow]:
    """Train, replay in all modes and compare, as far as that was not done before."""
    train(study)
    run_replays(study, study.model_path)
    run_untrained(study)
    rows: list[ComparisonRow] = []
    for name in study.config.test:
        folder = study.folder / "replays" / name
        replays = {mode: StoredReplay.read(folder / mode) for mode in MODES}
        reference = Reference.read(folder, study.config.sub_trajectory)
        rows += compare_modes(name, replays, reference)
    return rows


def table_lines(rows: Sequence[ComparisonRow]) -> list[str]:
    """A line for every test sequence: errors and ratios of all modes."""
    lines = []
    for name in dict.fromkeys(row.sequence for row in rows):
        cells = [f"  {name:14}"]
        for row in (row for row in rows if row.sequence == name):
            if row.rte is None or row.ratio is None:
                cells.append(f"{row.mode} unknown")
                continue
            low, high = row.ratio_interval or (np.nan, np.nan)
            times = "" if row.mode == "fixed" else f" = {row.ratio:.2f} ({low:.2f}-{high:.2f})"
            restarts = f", {row.restarts} restarts" if row.restarts else ""
            cells.append(f"{row.mode} {row.rte:.3f} %{times}{restarts}")
        lines.append("   ".join(cells))
    return lines


def summary(ratios: Mapping[str, Sequence[float]]) -> list[str]:
    """For every mode the geometric mean of its ratios to the fixed set, and the worst."""
    return [
        f"  {mode:10} geometric mean {np.exp(np.mean(np.log(found))):.2f}   worst {max(found):.2f}"
        f"   of {len(found)} test sequences"
        for mode, found in ratios.items()
        if mode != "fixed" and found
    ]


def main() -> None:
    """Run the studies that were asked for, and print what they gave and took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--odometries", nargs="+", default=ODOMETRIES, choices=ODOMETRIES)
    parser.add_argument("--directions", nargs="+", default=list(DIRECTIONS), choices=DIRECTIONS)
    parser.add_argument("--sets", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if "ADAPTUNE_TEST_DATA" not in os.environ:
        sys.exit("ADAPTUNE_TEST_DATA does not name the folder of the recordings")
    cores.pin(os.getpid())
    given.folder.mkdir(parents=True, exist_ok=True)
    for odometry in given.odometries:
        ratios: dict[str, list[float]] = {mode: [] for mode in MODES}
        for name in given.directions:
            stem = f"{odometry}-{name}-{given.sets}-{given.seed}"
            path = given.folder / f"{stem}.yaml"
            path.write_text(
                yaml.dump(definition(DIRECTIONS[name], odometry, given.sets, given.seed))
            )
            begin = time.perf_counter()
            try:
                rows = run(load_study(path, folder=given.folder / stem))
            except AdaptuneError as error:
                print(f"{odometry}, {name}: not possible: {error}", flush=True)
                continue
            print(f"{odometry}, tuned on {name}: {time.perf_counter() - begin:.0f} s")
            print(*table_lines(rows), sep="\n", flush=True)
            for row in rows:
                if row.ratio is not None:
                    ratios[row.mode].append(row.ratio)
        print(f"{odometry}, ratios to the fixed set:", *summary(ratios), sep="\n", flush=True)


if __name__ == "__main__":
    main()
