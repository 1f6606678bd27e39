"""What selection gains where it really drives: courses that no rule has seen.

    python benchmarks/replays.py runs/gain --seed 8    # after benchmarks/gain.py --seeds 8

Rules are fitted on the 24 sequences of `benchmarks/gain.py`, and eight mixed courses of other
worlds are replayed with keyframe GICP (or NDT), each with the health check. Printed are the mean of
min(RTE, 30 %) over 25 m, in brackets how often the odometry was started anew, and ratios to the
fixed set's error. The rivals: the defaults; the set that is fixed by the geometric mean of the
training sequences' errors; a bank whose members always have the same weight.
"""

import argparse
import os
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from adaptune.model.fusion import Steady
from gain import ODOMETRIES, WINDOW, factory_of, labelled, training_courses, trials
from numpy.typing import NDArray
from offline.validation import choose_bank, training_data, tune, tune_bank

from adaptune.descriptor.ndt_histogram import ndt_histogram
from adaptune.descriptor.pca import ScaledPCA
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.model import RULES, PairedFusion, Rule, Selection, TrainingData
from adaptune.model.paired import ERROR_FLOOR
from adaptune.odometry import OdometryInstance, WarmUp
from adaptune.odometry.bank import Bank
from adaptune.odometry.health import HealthCheck
from adaptune.sequence import Scan
from adaptune.simulation import Course
from adaptune.simulation.simulate import simulate
from adaptune.space import ParameterSet
from online.replay import Policy, replay

ORDERS = (
    ("cave", "open", "street"),
    ("street", "cave", "open"),
    ("open", "street", "cave"),
    ("cave", "street", "open"),
    ("street", "garden", "cave"),
    ("garden", "cave", "open"),
    ("open", "garden", "street"),
    ("garden", "open", "cave"),
)
LENGTH, SUB_TRAJECTORY = 60.0, 25.0


def asking(rule: Rule, pca: ScaledPCA) -> Policy:
    """A policy that asks a rule."""
    current: int | None = None
    last: deque[NDArray[Any]] = deque(maxlen=WINDOW)
    steadied = Steady()

    def select(scan: Scan, *_: object) -> Selection:
        nonlocal current
        last.append(ndt_histogram(scan.points))
        selection = rule.select(pca.transform(np.mean(last, axis=0)[None])[0], current)
        current = selection.set_index
        if isinstance(rule, PairedFusion):
            return steadied(selection, rule.candidates_.tolist())
        return selection

    return select


def geometric(data: TrainingData) -> int:
    """The set with the least geometric mean of the sequences' errors."""
    of = [cap(data.errors[data.sequence == s]).mean(axis=0) for s in np.unique(data.sequence)]
    return int(np.argmin(np.log(np.array(of) + ERROR_FLOOR).mean(axis=0)))


Way = tuple[Callable[[], OdometryInstance], Policy | None, list[int] | None]
"""What makes the odometry, what chooses its parameters, and the members of a bank."""


def ways(odometry: str, paths: list[Path]) -> tuple[list[ParameterSet], dict[str, Way]]:
    """The sets that were tried, and all ways to drive, by name."""
    sequences, units = labelled(paths)
    data, pca = training_data(sequences, units)
    settings = tune(sequences, units)
    print(f"settings of the paired rule: {settings}")
    factory = factory_of(odometry)
    sets = factory.space.from_unit(units)

    def alone(number: int | None) -> Way:
        return lambda: factory(None if number is None else sets[number]), None

    def live(name: str) -> Way:
        rule = RULES[name](settings, 0.0).fit(data)
        return lambda: factory(sets[data.fixed]), asking(rule, pca)

    def bank(size: int, even: bool = False) -> Way:
        members = choose_bank(sequences, data.fixed, size)
        found = tune_bank(sequences, units, members, data.fixed)
        print(f"bank of {size}: sets {members}, {found}", flush=True)
        vectors = np.concatenate(
            [s.vectors[:, members] for s in sequences if s.vectors is not None]
        )
        rule = PairedFusion(found).fit(replace(data, candidates=members, vectors=vectors))
        weights = tuple(1.0 / size for _ in members)
        policy = asking(rule, pca)
        if even:
            policy = lambda *_: Selection(data.fixed, 0.0, 0.0, weights=weights)  # noqa: E731
        return lambda: Bank(factory, [sets[i] for i in members], WarmUp()), policy

    return sets, {
        "baseline": alone(None),
        "fixed": alone(data.fixed),
        "fixed, geometric": alone(geometric(data)),
        "paper": live("paper"),
        "paired": live("paired"),
        "bank of 2": bank(2),
        "bank of 3": bank(3),
        "bank of 4": bank(4),
        "4, even weights": bank(4, even=True),
    }


def main() -> None:
    """Drive all courses in all ways."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--odometry", default="gicp", choices=ODOMETRIES)
    parser.add_argument("--modes", nargs="+", help="to drive, besides fixed; all if left out")
    parser.add_argument("--length", type=float, default=120.0, help="of the training courses")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    courses = training_courses(arguments.seed, arguments.length)
    odometry, modes = arguments.odometry, arguments.modes
    sets, driven = ways(odometry, trials(arguments.folder, odometry, courses, arguments.seed))
    if modes:
        driven = {name: way for name, way in driven.items() if name == "fixed" or name in modes}
    print(f"{'mean RTE [%]':32}" + "".join(f"{name:>18}" for name in driven))
    means: list[list[float]] = []
    for i, scenes in enumerate(ORDERS):
        course = Course(scenes=scenes, length=LENGTH, seed=1000 * arguments.seed + 500 + i)
        scans = list(simulate(course))
        T_world_sensor = np.array([scan.T_world_sensor for scan in scans])
        means.append([])
        row = f"{' '.join(scenes):32}"
        for make, policy, members in driven.values():
            result = replay(scans, make(), HealthCheck(), policy, sets, members=members)
            errors = sub_trajectory_rte(
                T_world_sensor, result.trajectory.T_world_sensor, SUB_TRAJECTORY
            )
            means[-1].append(float(cap(errors[~np.isnan(errors)]).mean()))
            row += f"{means[-1][-1]:12.3f} ({result.restarted.sum():3})"
        print(row, flush=True)
    table, fixed = np.array(means), list(driven).index("fixed")
    ratio = table / table[:, [fixed]]
    for what, values in (
        ("arithmetic mean", table.mean(axis=0)),
        ("geometric mean", np.exp(np.log(table).mean(axis=0))),
        ("ratio of arithmetic means", table.mean(axis=0) / table[:, fixed].mean()),
        ("geometric mean ratio", np.exp(np.log(ratio).mean(axis=0))),
        ("worst ratio", ratio.max(axis=0)),
    ):
        print(f"{what:32}" + "".join(f"{value:12.3f}      " for value in values))


if __name__ == "__main__":
    main()
