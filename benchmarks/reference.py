"""What tuning without ground truth is worth, on the simulated courses of `gain.py`.

    python benchmarks/reference.py runs/gain --seeds 51 52 53 --length 90    # hours; resumes

A reference is estimated from the scans of every course. The recorded motions of all parameter sets
are judged by it and by the ground truth. The script prints how well the two agree course by course,
which sets they pick, and what a bank gains that is trained on either of them: each course is left
out in turn, the bank is trained on the estimated references of the others, and judged by truth. The
same bank judged by the estimate shows whether that flatters who averages motions.
"""

import argparse
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gain_data import factory_of, labelled, labelled_sequence, training_courses, trials
from gain_modes import print_summary
from numpy.typing import NDArray
from scipy.stats import spearmanr

from adaptune._system.files import replacing
from adaptune.metrics import cap, sub_trajectory_rte, sub_trajectory_vectors
from adaptune.model.registry import ADAPTIVE
from adaptune.reference.estimate import VERSION, estimated
from adaptune.reference.estimated import EstimateError
from adaptune.reference.graph import pass_over
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from offline import validate as validation
from offline.bank_choice import choose
from offline.labelled import LabelledData, chained
from offline.validate import LeftOut, Validation

LENGTH = 25.0


def reference(path: Path, course: Course) -> None:
    """Estimate the reference of a course, and keep it."""
    scans = list(simulate(course))
    begin = time.process_time()
    found = estimated(path.stem, pass_over(scans), scans=scans)
    seconds = (time.process_time() - begin) / len(scans)
    T = np.where(found.known[:, None, None], found.T_world_sensor, np.nan)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            T_world_sensor=T,
            error=found.error(LENGTH),
            unknown=found.unknown_share(),
            seconds=seconds,
            truth=np.array([scan.T_world_sensor for scan in scans]),
        )


def references(folder: Path, courses: Mapping[str, Course], seed: int) -> dict[str, Path]:
    """Estimate what is missing, and return the files; courses that are refused have none."""
    paths = {}
    for name, course in courses.items():
        path = folder / f"reference-{VERSION}-{seed}-{course.length:.0f}-{name}.npz"
        try:
            if not path.exists():
                reference(path, course)
        except EstimateError as error:
            print(error)
            continue
        paths[name] = path
        with np.load(path) as found:
            errors = sub_trajectory_rte(found["T_world_sensor"], found["truth"], LENGTH)
            wrong = cap(errors[~np.isnan(errors)]).mean()
            print(
                f"{seed} {name:8} wrong by {wrong:.3f} %, says {float(found['error']):.3f} %; "
                f"unknown for {100 * float(found['unknown']):.1f} % of the scans, "
                f"{1e3 * float(found['seconds']):.0f} ms a scan",
                flush=True,
            )
    return paths


class Judged(NamedTuple):
    """A course as the truth and the estimate judge it."""

    name: str
    errors: NDArray[np.float64]  # (2, n_sets): mean clipped errors by truth, by the estimate
    wrong: float  # mean error of the estimate
    says: float  # what it says of that
    arrays: dict[str, Any]  # of the file of trials, with the estimate in place of the truth


def judge(name: str, of_trials: Path, of_reference: Path) -> Judged:
    """Compute the errors of all sets under the estimate, from their recorded motions."""
    with np.load(of_trials) as found, np.load(of_reference) as its:
        arrays = {key: found[key] for key in found.files}
        T, says = its["T_world_sensor"], float(its["error"])
    truth, by_truth = arrays["T_world_sensor"], arrays["errors"]
    few = arrays["motions"]
    motions = np.tile(np.eye(4), (*few.shape[:2], 1, 1))
    motions[..., :3, :] = few
    poses = chained(np.nan_to_num(motions))
    vectors = [sub_trajectory_vectors(T, poses[:, k], LENGTH) for k in range(few.shape[1])]
    by_estimate = np.stack([np.linalg.norm(v, axis=1) for v in vectors], axis=1)
    # A lost track is one whoever judges.
    lost = np.isinf(by_truth) & ~np.isnan(by_estimate)
    by_estimate[lost] = np.inf
    arrays["T_world_sensor"], arrays["errors"] = T, by_estimate.astype(np.float32)
    arrays["vectors"] = np.where(lost[..., None], np.inf, np.stack(vectors, axis=1)).astype("f4")
    both = ~np.isnan(by_estimate).any(axis=1) & ~np.isnan(by_truth).any(axis=1)
    of_all = ~np.isnan(by_truth).any(axis=1)
    means = [cap(by_truth[of_all]).mean(axis=0), cap(by_estimate[both]).mean(axis=0)]
    wrong = sub_trajectory_rte(T, truth, LENGTH)
    return Judged(name, np.array(means), float(cap(wrong[~np.isnan(wrong)]).mean()), says, arrays)


def agreement(courses: Sequence[Judged]) -> None:
    """Print how well the estimate agrees with the truth on each course, and over all of them."""
    mean = [int(sum(c.errors[by] for c in courses).argmin()) for by in (0, 1)]
    print("course    error %  says %  rank correlation  picked / best")
    rows = []
    for c in courses:
        true, by_estimate = c.errors
        rank = float(spearmanr(true, by_estimate).statistic)
        pick = true[by_estimate.argmin()] / true.min()
        rows.append((c.wrong, c.says, rank, pick, true[mean[0]]))
        print(f"{c.name:9}{c.wrong:8.3f}{c.says:8.3f}{rank:12.2f}{pick:17.2f}")
    wrong, says, rank, pick, of_fixed = np.array(rows).T
    ratio = says / wrong
    means = np.array([[c.errors[0][m] for m in mean] for c in courses]).mean(axis=0)
    print(
        f"rank correlation: median {np.median(rank):.2f}, least {rank.min():.2f}; picked / best: "
        f"median {np.median(pick):.2f}, worst {pick.max():.2f}; fixed set without truth / with: "
        f"{means[1] / means[0]:.3f}\nerror of the reference / of the fixed set: "
        f"{wrong.mean() / of_fixed.mean():.2f} (geometric "
        f"{np.exp(np.log(wrong / of_fixed).mean()):.2f}); says / is: median "
        f"{np.median(ratio):.2f}, within 1.5: {np.mean(np.abs(np.log(ratio)) < np.log(1.5)):.0%}, "
        f"of the means {says.mean() / wrong.mean():.2f}",
        flush=True,
    )


def trained(data: LabelledData, estimates: LabelledData, size: int) -> None:
    """Leave each course out: banks trained on the truth, and on the estimates, judged by truth."""
    found: dict[str, list[LeftOut]] = {"truth": [], "estimate": [], "circular": []}
    # What is chosen on the estimates does not depend on who judges it.
    validation.choose = lru_cache(maxsize=1)(choose)
    for i, (of_truth, of_estimate) in enumerate(
        zip(data.sequences, estimates.sequences, strict=True)
    ):
        with_truth, without = (
            Others([s for j, s in enumerate(d.sequences) if j != i], d.sets)
            for d in (data, estimates)
        )
        for name, left, others in (
            ("truth", of_truth, with_truth),
            ("estimate", of_truth, without),
            ("circular", of_estimate, without),
        ):
            found[name].append(validation.leave_out(left, others, size, True))
    for name, what in (
        ("truth", "trained with truth, judged by truth"),
        ("estimate", "trained without truth, judged by truth"),
        ("circular", "trained without truth, judged by the estimate"),
    ):
        print(f"bank {what}: ", end="")
        print_summary(Validation(found[name]), [ADAPTIVE])
    tuned = np.array([left.errors["fixed"].mean() for left in found["truth"]])
    without_truth = np.array([left.errors[ADAPTIVE].mean() for left in found["estimate"]])
    gain = Validation(found["truth"]).summary(ADAPTIVE)["geometric"]
    ratios = without_truth / tuned
    kept = float(np.exp(np.log(ratios).mean()))
    print(
        f"bank trained without truth / the fixed set tuned with truth: {kept:.3f}, worst "
        f"{ratios.max():.2f}; trained with truth {gain:.3f}: keeps "
        f"{np.log(kept) / np.log(gain):.0%} of the logarithmic gain",
        flush=True,
    )


class Others(LabelledData):
    """Labelled data that is known by its identity, so that choices on it can be remembered."""

    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other


def of_odometry(
    folder: Path, odometry: str, courses: dict[str, Course], seed: int, size: int
) -> list[Judged]:
    """Everything about one odometry in one world."""
    estimates = references(folder, courses, seed)
    paths = trials(folder, odometry, courses, seed)
    by_name = {path.stem.rsplit("-", 1)[1]: path for path in paths}
    judged = [judge(name, by_name[name], path) for name, path in estimates.items()]
    print(f"{odometry}, seed {seed}:")
    agreement(judged)
    if size:
        data = labelled([by_name[c.name] for c in judged], factory_of(odometry).space)
        sequences = [labelled_sequence(c.name, c.arrays) for c in judged]
        trained(data, data._replace(sequences=sequences), size)
    return judged


def pooled(worlds: Iterable[Sequence[Judged]]) -> list[Judged]:
    """The same courses with the sets of all odometries side by side."""
    by_course = zip(*worlds, strict=True)
    return [
        of[0]._replace(errors=np.concatenate([c.errors for c in of], axis=1)) for of in by_course
    ]


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[51, 52, 53])
    parser.add_argument("--length", type=float, default=90.0, help="metres of a course")
    parser.add_argument("--odometries", nargs="+", default=["gicp"])
    parser.add_argument("--courses", nargs="+", help="only these")
    parser.add_argument("--bank", type=int, default=4, help="members; 0 for no bank")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    # Open3D's NDT differs in its last bits from run to run on more than one core.
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    for seed in arguments.seeds:
        courses = training_courses(seed, arguments.length)
        if arguments.courses:
            courses = {name: courses[name] for name in arguments.courses}
        of = [
            of_odometry(arguments.folder, odometry, courses, seed, arguments.bank)
            for odometry in arguments.odometries
        ]
        if len(of) > 1:
            print(f"all {len(of)} odometries side by side, seed {seed}:")
            agreement(pooled(of))


if __name__ == "__main__":
    main()
