"""What selection gains in replays: on courses that no rule has seen.

    python benchmarks/replays.py runs/gain --seed 8    # after benchmarks/gain.py --seeds 8

Rules are fitted on the 24 sequences of `benchmarks/gain.py`, and eight mixed courses of other
worlds are replayed with keyframe GICP (or NDT), each with the health check. The script prints the
mean of min(RTE, 30 %) over 25 m, in brackets how often the health check restarted the odometry, and
ratios to the fixed set's error. Below the errors are the odometry's own estimates, where it made
any. The rivals: the defaults; the set that is fixed by the geometric mean of the training
sequences' errors; a bank whose members always have the same weight; a bank without a model.
"""

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from gain_data import ODOMETRIES, WINDOW, factory_of, labelled, training_courses, trials
from numpy.typing import NDArray

from adaptune.bank.bank import Bank
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.model import ErrorModel
from adaptune.model.rules import ERROR_FLOOR
from adaptune.model.weights import weighted_selection
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.health import HealthCheck
from adaptune.recording.scan import Scan
from adaptune.runs.loop import replay
from adaptune.runs.record import Run
from adaptune.selector import AnySelector, Selector, UntrainedSelector, untrained_sets
from adaptune.simulation import Course
from adaptune.simulation.record import SimulatedScan, simulate
from adaptune.space import Selection
from offline.bank_choice import Policy, choose
from offline.labelled import LabelledData
from offline.train import fit

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


Way = tuple[Callable[[], OdometryInstance], AnySelector | None]
"""What makes the odometry, and what chooses its parameters."""


class Constant:
    """Always selects the same."""

    def __init__(self, selection: Selection):
        self._selection = selection

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See `adaptune.selector.Selector.observe`."""

    def select(self) -> Selection:
        """See `adaptune.selector.Selector.select`."""
        return self._selection

    def measure(self) -> None:
        """See `adaptune.selector.Selector.measure`."""


def geometric(data: LabelledData) -> int:
    """The set with the least geometric mean of the sequences' errors."""
    of = [cap(s.errors).mean(axis=0) for s in data.sequences]
    return data.sets.trials[int(np.argmin(np.log(np.array(of) + ERROR_FLOOR).mean(axis=0)))]


def model_of(odometry: str, data: LabelledData) -> ErrorModel:
    """The error model."""
    return fit(data, data.fixed(), factory_of(odometry).identity, 25.0, WINDOW, {})


def untrained(factory: OdometryFactory) -> Way:
    """A bank of which nothing is known."""
    sets = untrained_sets(factory.space)
    members = dict(zip(sets.trials, sets.parameters, strict=True))
    return lambda: Bank(factory, members), UntrainedSelector(sets, SUB_TRAJECTORY)


def bank_of(
    data: LabelledData, model: ErrorModel, factory: OdometryFactory, size: int
) -> tuple[Policy, Way]:
    """A bank that is chosen on sequences, and what chose it."""
    chosen = choose(data, size)
    members = {trial: model.sets[trial] for trial in chosen.members}
    of_bank = replace(
        model,
        bank=chosen.members,
        vectors=data.vectors(chosen.members),
        bank_settings=chosen.bank,
    )
    selector = Selector(of_bank, "adaptive", chosen.members)
    return chosen, (lambda: Bank(factory, members), selector)


def ways(odometry: str, data: LabelledData, modes: Sequence[str]) -> dict[str, Way]:
    """Ways to replay a course, by name."""
    model = model_of(odometry, data)
    factory, sets = factory_of(odometry), model.sets

    def alone(trial: int | None) -> Way:
        return lambda: factory(None if trial is None else sets[trial]), None

    def live(rule: str) -> Way:
        return lambda: factory(sets[model.fixed]), Selector(model, rule, ())

    def bank(size: int, even: bool = False) -> Way:
        chosen, (make, selector) = bank_of(data, model, factory, size)
        print(f"bank of {size}: trials {chosen.members}, {chosen.bank}", flush=True)
        if even:
            weights = dict.fromkeys(chosen.members, 1.0 / size)
            selector = Constant(weighted_selection(sets, weights))
        return make, selector

    made: dict[str, Callable[[], Way]] = {
        "baseline": lambda: alone(None),
        "fixed": lambda: alone(model.fixed),
        "fixed, geometric": lambda: alone(geometric(data)),
        "paper": lambda: live("paper"),
        "adaptive": lambda: live("adaptive"),
        "bank of 2": lambda: bank(2),
        "bank of 3": lambda: bank(3),
        "bank of 4": lambda: bank(4),
        "4, even weights": lambda: bank(4, even=True),
        "untrained": lambda: untrained(factory),
    }
    return {name: make() for name, make in made.items() if name == "fixed" or name in modes}


def replays_of(scans: list[SimulatedScan], compared: Mapping[str, Way]) -> list[Run]:
    """Replay a course in all ways."""
    replays = []
    for make, selector in compared.values():
        if isinstance(selector, Selector | UntrainedSelector):
            selector.reset()
        replays.append(replay(scans, make(), HealthCheck(), selector))
    return replays


def mean_error(scans: list[SimulatedScan], result: Run) -> float:
    """Mean clipped error of a replay in percent."""
    T_world_sensor = np.array([scan.T_world_sensor for scan in scans])
    errors = sub_trajectory_rte(T_world_sensor, result.trajectory.T_world_sensor, SUB_TRAJECTORY)
    return float(cap(errors[~np.isnan(errors)]).mean())


def of_world(text: str | None) -> argparse.ArgumentParser:
    """What is given about a world of `gain.py`: the folder of its trials, its seed, its courses."""
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--odometry", default="gicp", choices=ODOMETRIES)
    parser.add_argument("--length", type=float, default=120.0, help="of the training courses")
    return parser


def print_table(names: list[str], means: NDArray[np.float64]) -> None:
    """Print means over the courses, and ratios to the fixed set's error."""
    fixed = means[:, [names.index("fixed")]]
    ratio = means / fixed
    for what, values in (
        ("arithmetic mean", means.mean(axis=0)),
        ("geometric mean", np.exp(np.log(means).mean(axis=0))),
        ("ratio of arithmetic means", means.mean(axis=0) / fixed.mean()),
        ("geometric mean ratio", np.exp(np.log(ratio).mean(axis=0))),
        ("worst ratio", ratio.max(axis=0)),
    ):
        print(f"{what:32}" + "".join(f"{value:12.3f}      " for value in values))


def main() -> None:
    """Replay all courses in all ways."""
    parser = of_world(__doc__)
    parser.add_argument(
        "--modes", nargs="+", default=["baseline", "bank of 4", "untrained"], help="besides fixed"
    )
    parser.add_argument("--without", nargs="+", default=[], help="scenes that are not trained on")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    odometry, seed = arguments.odometry, arguments.seed
    courses = {
        name: course
        for name, course in training_courses(seed, arguments.length).items()
        if not set(course.scenes) & set(arguments.without)
    }
    paths = trials(arguments.folder, odometry, courses, seed)
    data = labelled(paths, factory_of(odometry).space)
    compared = ways(odometry, data, arguments.modes)
    print(f"{'mean RTE [%]':32}" + "".join(f"{name:>18}" for name in compared))
    means: list[list[float]] = []
    for i, scenes in enumerate(ORDERS):
        if arguments.without and not set(scenes) & set(arguments.without):
            continue
        course = Course(scenes=scenes, length=LENGTH, seed=1000 * seed + 500 + i)
        scans = list(simulate(course))
        means.append([])
        row, estimated = f"{' '.join(scenes):32}", ""
        for result in replays_of(scans, compared):
            means[-1].append(mean_error(scans, result))
            row += f"{means[-1][-1]:12.3f} ({result.restarted.sum():3})"
            own = [choice.selection.estimated_error for choice in result.choices]
            known = not np.isnan(own).all()
            estimated += f"{np.nanmean(own):12.3f}      " if known else " " * 18
        print(row, f"{'  its own estimate':32}{estimated}".rstrip(), sep="\n", flush=True)
    print_table(list(compared), np.array(means))


if __name__ == "__main__":
    main()
