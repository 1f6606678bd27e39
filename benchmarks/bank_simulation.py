"""Whether a bank drives as the bank simulation says, where members are restarted.

    python benchmarks/bank_simulation.py runs/bank_simulation

It makes courses with narrow caves: eight of a quick robot, eight of a car that is often lost there.
Each is left out in turn. On the others of its kind, a bank of four of 16 sets of GICP is chosen:
for the car those whose errors cancel; for the robot two of these, and the two that the health check
restarted most often. The script prints the bank's error over 10 m on what is left out, with even
weights and with those of the rule: as it is simulated from the motions that its members made alone,
and as it is driven, with the health check. Limit: a ratio of 0.8 to 1.25 on nine of ten.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gain_data import N_SETS, WINDOW, factory_of, labelled_sequence, run
from numpy.typing import NDArray

from adaptune.bank.bank import Bank
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.recording.compensation import compensate_neighbours
from adaptune.runs.loop import replay
from adaptune.selector import Selector
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from adaptune.space import ParameterSets
from adaptune.study.config import OdometryConfig
from offline.bank_choice import BANK_SETTINGS, bank_errors, cancelling_members
from offline.config import OfflineStudyConfig
from offline.labelled import LabelledData, LabelledSequence, periods
from offline.samplers import sobol_points
from offline.train import fit
from online.modes import EvenSelector


class Kind(NamedTuple):
    """Courses of one robot."""

    motion: str
    rate: float  # scans a second
    max_speed: float  # metres a second
    seeds: Sequence[int]
    daring: bool  # whether half of a bank is of those restarted most often

    def course(self, seed: int) -> Course:
        """A course of 75 m."""
        scenes = tuple(ORDERS[seed % len(ORDERS)].split())
        return Course(scenes=scenes, length=25.0, motion=self.motion, rate=self.rate, seed=seed)

    @property
    def config(self) -> OfflineStudyConfig:
        """The settings of a study of such courses."""
        told: Any = {
            "odometry": OdometryConfig(name="gicp"),
            "training": ("x",),
            "sub_trajectory": 10.0,
        }
        return OfflineStudyConfig(**told, health={"max_speed": self.max_speed})


KINDS = {
    "robot": Kind("agile", 7.0, 8.0, range(921, 929), True),
    "car": Kind("car", 14.0, 20.0, range(931, 939), False),
}
ORDERS = ("mine street cave", "cave open mine", "street mine open", "open cave street")
FACTORY, SIZE, SEED = factory_of("gicp"), 4, 5
SPACE = FACTORY.space
SETS = (SPACE.baseline, *sobol_points(SPACE, SEED, range(1, N_SETS)))
TABLE = ParameterSets(SPACE, tuple(range(N_SETS)), SETS)


def labelled(folder: Path, kind: str, seed: int) -> LabelledSequence:
    """The trials of all sets on a course, which are run unless they were."""
    path = folder / f"{kind}-{seed}.npz"
    if not path.exists():
        config, course = KINDS[kind].config, KINDS[kind].course(seed)
        run(path, course, "gicp", SEED, config, compensate_neighbours)
    with np.load(path) as found:
        sequence = labelled_sequence(path.stem, found, KINDS[kind].config)
        restarts = np.isnan(found["motions"][..., 0, 0]).sum(axis=0).astype(np.float64)
    return replace(sequence, restarts=restarts)


def bank_of(kind: Kind, others: LabelledData) -> list[int]:
    """The members of a bank that is chosen on other courses."""
    members = cancelling_members(others, others.fixed(), SIZE)
    if kind.daring:
        often = np.sum([s.restarts for s in others.sequences], axis=0)
        order = np.argsort(-often, kind="stable").tolist()
        members[2:] = [n for n in order if n not in members[:2]][:2]
    return members


def simulated(
    left: LabelledSequence, others: LabelledData, members: Sequence[int]
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Errors of a bank on what is left out, by its weights."""
    even = np.full((len(periods(left.simulation.period)[0]), SIZE), 1.0 / SIZE)
    yield "even", left.simulation.errors(tuple(members), even)[left.known]
    fitted = others.training_data()
    yield "chosen", next(bank_errors(left, others, fitted, members, BANK_SETTINGS))[0]


def drive(kind: Kind, seed: int, others: LabelledData, members: list[int], way: str) -> list[float]:
    """Error of a bank that is driven, and how often its members and the whole were restarted."""
    scans: Any = list(compensate_neighbours(simulate(kind.course(seed))))
    model = fit(others, others.fixed(), FACTORY.identity, 10.0, WINDOW, {})
    vectors, settings = others.vectors(members), BANK_SETTINGS[0]
    model = replace(model, bank=members, vectors=vectors, bank_settings=settings)
    even, chosen = EvenSelector(TABLE, members), Selector(model, "adaptive", members)
    selector = even if way == "even" else chosen
    with closing(Bank(FACTORY, {n: TABLE[n] for n in members})) as bank:
        fixed = selector.fall_back()
        record = replay(scans, bank, kind.config.health, selector, fallback=fixed)
        restarts = bank.restarts
    T_ref_sensor = np.array([scan.T_world_sensor for scan in scans])
    errors = sub_trajectory_rte(T_ref_sensor, record.trajectory.T_world_sensor, 10.0)
    return [float(np.nanmean(cap(errors))), restarts, int(record.restarted.sum())]


def main() -> None:
    """Print the table."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    print("course, weights: simulated, driven, ratio; restarts of members, of the bank; members")
    ratios: list[float] = []
    for name, kind in KINDS.items():
        sequences = [labelled(folder, name, seed) for seed in kind.seeds]
        folds = LabelledData(sequences, TABLE).folds(by_recording=True)
        for seed, (left, others) in zip(kind.seeds, folds, strict=True):
            members = bank_of(kind, others)
            for way, errors in simulated(left, others, members):
                path = folder / f"{left.name}-{way}-{'-'.join(map(str, members))}.json"
                if not path.exists():
                    path.write_text(json.dumps(drive(kind, seed, others, members, way)))
                driven, *restarts = json.loads(path.read_text())
                ratios.append(float(errors.mean()) / driven)
                row = f"{left.name:10} {way:7}{errors.mean():7.3f}{driven:7.3f}{ratios[-1]:6.2f}"
                print(row, *restarts, members, flush=True)
    held = sum(0.8 <= ratio <= 1.25 for ratio in ratios)
    print(f"{held} of {len(ratios)} hold, geometric mean {np.exp(np.log(ratios).mean()):.2f}")


if __name__ == "__main__":
    main()
