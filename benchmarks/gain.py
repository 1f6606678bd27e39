"""What selection gains on simulated sequences that were left out.

    python benchmarks/gain.py runs/gain --seeds 1 2 3    # hours on one core; resumes
    python benchmarks/gain.py runs/gain --seeds 1 --odometries gicp

Each seed is another world: 16 sequences (3 caves, 3 streets, 3 open, 3 gardens, 4 mixed) on which
keyframe GICP and NDT run the same parameter sets. One sequence after the other is left out, and
the fixed set, the rules and their settings are fitted on the other 15. What is printed are ratios
to the fixed set's error. No setting was chosen on seeds other than 0.
"""

import argparse
import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

from adaptune.archive import Frames
from adaptune.descriptor.ndt import N_FEATURES, ndt_histogram
from adaptune.files import replacing
from adaptune.simulation import Course, simulate
from adaptune.study import Study, StudyConfig
from offline.samplers import make_sampler
from offline.trial import run_trials
from offline.validation import LabelledSequence, leave_one_out

ODOMETRIES = ("gicp", "ndt")
N_SETS = 28
KINDS = ("cave", "street", "open", "garden")


def training_courses(seed: int) -> dict[str, Course]:
    """Sixteen courses by name; no world is shared with another seed's."""
    single = {
        f"{kind}{i}": Course(scenes=(kind,), length=60.0, seed=1000 * seed + 10 * k + i)
        for k, kind in enumerate(KINDS)
        for i in range(3)
    }
    orders = (
        ("cave", "open", "street"),
        ("street", "garden", "cave"),
        ("open", "cave", "garden"),
        ("garden", "street", "open"),
    )
    mixed = {
        f"mixed{i}": Course(scenes=scenes, length=35.0, seed=1000 * seed + 100 + i)
        for i, scenes in enumerate(orders)
    }
    return single | mixed


def study_of(odometry: str) -> Study:
    """A study of nothing but defaults."""
    config = StudyConfig.model_validate({"odometry": {"name": odometry}, "training": ["-"]})
    return Study(config, Path("-"))


class Prepared:
    """What `run_trials` passes over."""

    def __init__(self, prepared: list[Any], frames: Frames):
        self._prepared, self.frames = prepared, frames

    def __iter__(self) -> Any:
        return iter(self._prepared)


def run(path: Path, course: Course, odometry: str, seed: int) -> None:
    """Drive a course with all sets of an odometry, and keep the errors."""
    scans = list(simulate(course))
    frames = Frames(
        np.array([scan.stamp for scan in scans]),
        np.array([scan.T_world_sensor for scan in scans]),
        np.array([ndt_histogram(scan.points) for scan in scans], np.float32),
        {"ndt": N_FEATURES},
    )
    study = study_of(odometry)
    offline = study.config.offline.model_copy(
        update={"sampler": "sobol", "batch": N_SETS, "seed": seed}
    )
    sets = make_sampler(study.space, offline).propose([])
    box = study.odometry()
    sequence: Any = Prepared([box.prepare(scan) for scan in scans], frames)
    errors = [trial.errors for trial in run_trials(study, sequence, sets)]
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez_compressed(
            file,
            stamps=frames.stamps,
            T_world_sensor=frames.T_ref_sensor,
            histograms=frames.descriptors.astype(np.uint16),
            sets=study.space.to_unit(sets),
            errors=np.stack(errors, axis=1).astype(np.float32),
        )


def trials(folder: Path, odometry: str, seed: int) -> None:
    """Run what has not been run yet."""
    for name, course in training_courses(seed).items():
        path = folder / f"{odometry}-{seed}-{name}.npz"
        if not path.exists():
            run(path, course, odometry, seed)
        with np.load(path) as found:
            errors = found["errors"]
            means = np.minimum(errors[~np.isnan(errors).any(axis=1)], 30.0).mean(axis=0)
            print(
                f"{odometry} {seed} {name:8} {len(errors):4} scans   "
                f"best {means.min():6.3f}  median {np.median(means):6.3f} %",
                flush=True,
            )


def validate(folder: Path, odometry: str, seed: int) -> None:
    """Leave each sequence out in turn, and print what came of it."""
    sequences, sets = [], np.empty(0)
    for name in training_courses(seed):
        with np.load(folder / f"{odometry}-{seed}-{name}.npz") as found:
            labelled = ~np.isnan(found["errors"]).any(axis=1)
            seconds = (found["stamps"] - found["stamps"][0])[labelled] // 10**9
            descriptors = found["histograms"][labelled].astype(np.float32)
            sets = found["sets"]
            sequences.append(
                LabelledSequence(name, seconds, descriptors, found["errors"][labelled])
            )
    validation = leave_one_out(sequences, sets)
    print(f"\n{odometry}, seed {seed}: geometric, arithmetic, worst ratio to the fixed set's error")
    for mode in validation.ratios:
        s = validation.summary(mode)
        print(
            f"{mode:20}{s['geometric']:8.3f}{s['arithmetic']:8.3f}{s['worst']:8.2f}"
            f"   (95 % {s['low']:.2f}-{s['high']:.2f})"
        )
    known = " ".join(f"{ratio:.3f}" for ratio in validation.portfolio())
    print(f"if the best of 1, 2, ... complementary sets were known: {known}", flush=True)


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--odometries", nargs="+", default=ODOMETRIES, choices=ODOMETRIES)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    # Open3D's NDT differs in its last bits from run to run on more than one core.
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    for seed, odometry in itertools.product(arguments.seeds, arguments.odometries):
        trials(arguments.folder, odometry, seed)
        validate(arguments.folder, odometry, seed)


if __name__ == "__main__":
    main()
