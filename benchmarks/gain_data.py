"""The courses of `gain.py`, and what odometries do on them with several parameter sets."""

import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

from made_drives import trials_of

from adaptune._system.files import replacing
from adaptune.live.hops import Hops
from adaptune.model.descriptor import averaged, lowest_elevation
from adaptune.model.ndt import N_FEATURES, ndt_histogram
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.recording.scan import Scan
from adaptune.runs.archive import Frames
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from adaptune.space import ParameterSets, ParameterSpace
from adaptune.study.config import OdometryConfig
from adaptune.study.sequences import StudySequences
from offline.config import OfflineStudyConfig
from offline.drive import TrialSetup
from offline.frames import with_measured_hops
from offline.labelled import (
    BankSimulation,
    LabelledData,
    LabelledSequence,
    error_vectors,
    recorded_motions,
)
from offline.samplers import sobol_points

MEMORY = 3e9
"""Bytes of prepared scans."""
ODOMETRIES = ("gicp", "ndt")
N_SETS = 16
KINDS = ("cave", "street", "open", "garden")
PER_KIND = 4
WINDOW = 3
"""Selections whose descriptors are averaged."""
PERIOD = 10
"""Scans from one selection to the next."""
LOST_TRACK = 3.0  # metres a second by which members of a bank may differ
DEFAULTS = OfflineStudyConfig(odometry=OdometryConfig(name="gicp"), training=("one",))
"""The settings of drives are those of every study."""
NO_SEQUENCES = StudySequences({}, {}, Path())
"""Of a study: the courses are in no study."""


def training_courses(seed: int, length: float) -> dict[str, Course]:
    """All courses by name; no world is shared with another seed's."""
    single = {
        f"{kind}{i}": Course(scenes=(kind,), length=length, seed=1000 * seed + 10 * k + i)
        for k, kind in enumerate(KINDS)
        for i in range(PER_KIND)
    }
    orders: tuple[tuple[str, ...], ...] = (
        ("cave", "open", "street"),
        ("street", "garden", "cave"),
        ("open", "cave", "garden"),
        ("garden", "street", "open"),
    )
    orders += tuple(scenes[::-1] for scenes in orders)
    mixed = {
        f"mixed{i}": Course(scenes=scenes, length=0.4 * length, seed=1000 * seed + 100 + i)
        for i, scenes in enumerate(orders)
    }
    return single | mixed


def factory_of(name: str) -> OdometryFactory:
    """An odometry with the settings of the published experiments; two parameters are tuned."""
    cls: Any = odometry_class(name)
    settings = cls.settings_type(downsampling=0.5, iterations=30 if name == "ndt" else 20)
    return OdometryFactory(name, settings, cls.describe(settings).space, Limits())


class Simulated:
    """The scans of a course, in place of a recording."""

    def __init__(self, name: str, scans: Sequence[Scan]):
        self.name, self.scans = name, scans

    def since(self, _stamp: int) -> Iterator[Scan]:
        """All of them."""
        return iter(self.scans)


def run(
    path: Path,
    course: Course,
    odometry: str,
    seed: int,
    config: OfflineStudyConfig = DEFAULTS,
    read_as: Callable[[Iterator[Scan]], Iterator[Scan]] = iter,
) -> None:
    """Run all sets of an odometry on a course, and keep the errors."""
    scans: Any = list(read_as(simulate(course)))
    frames = Frames(
        np.array([scan.stamp for scan in scans]),
        np.array([scan.T_world_sensor for scan in scans]),
        np.array([ndt_histogram(scan.points) for scan in scans], np.float32),
        {"ndt": N_FEATURES},
        np.array([lowest_elevation(scan) for scan in scans], np.float32),
    )
    factory = factory_of(odometry)
    sets = [factory.space.baseline, *sobol_points(factory.space, seed, range(1, N_SETS))]
    frames, read = with_measured_hops(scans, frames), Simulated(path.stem, scans)
    setup = TrialSetup(config, factory, NO_SEQUENCES)
    trials = trials_of(setup, sets, path.stem, frames, read, memory=MEMORY)
    length = config.sub_trajectory
    vectors = [error_vectors(frames.T_ref_sensor, trial, length) for trial in trials]
    motions = recorded_motions(trials)[..., :3, :]
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            stamps=frames.stamps,
            T_world_sensor=frames.T_ref_sensor,
            histograms=frames.descriptors.astype(np.uint16),
            sets=factory.space.to_unit(sets),
            errors=np.stack([trial.errors for trial in trials], axis=1).astype(np.float32),
            vectors=np.stack(vectors, axis=1),
            motions=motions.astype(np.float32),
            **{f"hops_{name}": array for name, array in frames.hops._asdict().items()},
        )


def trials(folder: Path, odometry: str, courses: dict[str, Course], seed: int) -> list[Path]:
    """Run what has not been run yet, and return the files."""
    paths = []
    for name, course in courses.items():
        path = folder / f"{odometry}-{seed}-{course.length:.0f}-{name}.npz"
        paths.append(path)
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
    return paths


def labelled(paths: list[Path], space: ParameterSpace) -> LabelledData:
    """The labelled data set; columns of the files are the trial numbers."""
    sequences = []
    for path in paths:
        with np.load(path) as found:
            sequences.append(labelled_sequence(path.stem.rsplit("-", 1)[1], found))
            unit = found["sets"]
    sets = ParameterSets(space, tuple(range(len(unit))), tuple(space.from_unit(unit)))
    return LabelledData(sequences, sets)


def labelled_sequence(
    name: str, found: Any, config: OfflineStudyConfig = DEFAULTS
) -> LabelledSequence:
    """A sequence of the labelled data set, from the arrays in its file."""
    errors, stamps, few = found["errors"], found["stamps"], found["motions"]
    known = ~np.isnan(errors).any(axis=1)
    period = (stamps - stamps[0]) // 10**9
    described = averaged(found["histograms"].astype(np.float32), stamps, WINDOW, 1.0)
    motions: NDArray[np.float64] = np.tile(np.eye(4), (*few.shape[:2], 1, 1))
    motions[..., :3, :] = few
    simulation = BankSimulation(
        stamps,
        found["T_world_sensor"],
        found["T_world_sensor"],
        described,
        period,
        config.sub_trajectory,
        LOST_TRACK,
        Hops(*(found[f"hops_{name}"] for name in Hops._fields)),
        partial(np.take, motions, axis=1),
        health=config.health,
    )
    return in_place(name, simulation, errors[known], found["vectors"][known], known)


def in_place(
    name: str,
    simulation: BankSimulation,
    errors: NDArray[np.float32],
    vectors: NDArray[np.float32],
    known: NDArray[np.bool_],
) -> LabelledSequence:
    """A recording of one segment, with the errors of all sets on its known frames."""
    frames = np.flatnonzero(known)
    of = (name, name, simulation, frames, np.zeros(len(frames), np.intp), errors)
    of_sets = dict(enumerate(np.moveaxis(vectors, 1, 0)))
    return LabelledSequence(*of, {"ndt": N_FEATURES}, of_sets)
