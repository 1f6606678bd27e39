"""Trials of several odometries on the courses of `gain.py`, a file for each odometry and course."""

import json
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gain_data import (
    DEFAULTS,
    LOST_TRACK,
    MEMORY,
    NO_SEQUENCES,
    PERIOD,
    WINDOW,
    Simulated,
    in_place,
    training_courses,
    trials_of,
)
from numpy.typing import NDArray

from adaptune._system.files import replacing
from adaptune.live.hops import Hops
from adaptune.model.descriptor import averaged, lowest_elevation
from adaptune.model.ndt import N_FEATURES, ndt_histogram
from adaptune.model.rules import Costs, SetCost
from adaptune.odometry.factory import OdometryFactory, OdometryPool
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.runs.archive import PREPARE_MS, REGISTER_MS, Frames
from adaptune.simulation.record import simulate
from adaptune.space import ODOMETRY, ParameterSet, ParameterSets, ParameterSpace
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

POINTS: dict[str, tuple[int, ...]] = {
    "gicp": tuple(range(16)),
    "vgicp": tuple(range(12)),
    "ndt": tuple(range(10)),
    "kiss_icp": (0,),
    "genz_icp": (0, 2),
    "mad_icp": (0,),
}
"""Numbers of each odometry's sets: 0 is its own, others are points of a Sobol sequence. Sets of the
last three take ten times as long."""
NOT_TUNED = ("max_num_iterations",)
LENGTH = 60.0
"""Metres of a course."""


def tuned(odometry: str) -> ParameterSpace:
    """The parameters of an odometry that are tuned here."""
    own = odometry_class(odometry).space.parameters  # type: ignore[union-attr]
    return ParameterSpace({name: p for name, p in own.items() if name not in NOT_TUNED})


def pool() -> OdometryPool:
    """All odometries."""
    return OdometryPool({o: OdometryFactory(o, {}, tuned(o), Limits()) for o in POINTS})


def sets_of(odometry: str, seed: int, more: Path) -> list[ParameterSet]:
    """The sets of an odometry; `more` may be a file with more of them, by odometry."""
    space = tuned(odometry)
    points = [space.baseline, *sobol_points(space, seed, range(1, max(POINTS[odometry]) + 1))]
    searched = json.loads(more.read_text()).get(odometry, []) if more.exists() else []
    return [points[i] for i in POINTS[odometry]] + searched


def course_files(folder: Path, seed: int, name: str) -> dict[str, Path]:
    """By odometry, the files of a course."""
    return {odometry: folder / f"{odometry}-{seed}-{name}.npz" for odometry in POINTS}


def run_course(folder: Path, seed: int, name: str) -> None:
    """Run what is missing on a course."""
    more, files = folder / f"more-{seed}.json", course_files(folder, seed, name)
    due = {o: path for o, path in files.items() if _n_sets(path) < len(sets_of(o, seed, more))}
    if not due:
        return
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    scans = list(simulate(training_courses(seed, LENGTH)[name]))
    frames = Frames(
        np.array([scan.stamp for scan in scans]),
        np.array([scan.T_world_sensor for scan in scans]),
        np.array([ndt_histogram(scan.points) for scan in scans], np.float32),
        {"ndt": N_FEATURES},
        np.array([lowest_elevation(scan) for scan in scans], np.float32),
    )
    frames = with_measured_hops(scans, frames)
    for odometry, path in due.items():
        sets = sets_of(odometry, seed, more)
        _write(path, odometry, sets, frames, Simulated(name, scans))


def _n_sets(path: Path) -> int:
    if not path.exists():
        return 0
    with np.load(path) as found:
        return len(json.loads(str(found["parameters"])))


def _write(
    path: Path, odometry: str, sets: list[ParameterSet], frames: Frames, read: Simulated
) -> None:
    """Run sets of an odometry, and keep their errors, motions and costs."""
    setup = TrialSetup(DEFAULTS, pool().factories[odometry], NO_SEQUENCES)
    trials = trials_of(setup, sets, read.name, frames, read, memory=MEMORY)
    T_ref_sensor, length = frames.T_ref_sensor, DEFAULTS.sub_trajectory
    vectors = [error_vectors(T_ref_sensor, trial, length) for trial in trials]
    motions = recorded_motions(trials)[..., :3, :]
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            stamps=frames.stamps,
            T_world_sensor=frames.T_ref_sensor,
            histograms=frames.descriptors.astype(np.uint16),
            parameters=json.dumps(sets),
            errors=np.stack([trial.errors for trial in trials], axis=1).astype(np.float32),
            vectors=np.stack(vectors, axis=1),
            motions=motions.astype(np.float32),
            register_ms=[trial.others[REGISTER_MS] for trial in trials],
            prepare_ms=[trial.others[PREPARE_MS] for trial in trials],
            evidence_ms=frames.evidence_ms,
            **{f"hops_{name}": array for name, array in frames.hops._asdict().items()},
        )
    print(f"{path.stem}: {len(sets)} sets", flush=True)


def pooled_data(folder: Path, seed: int, budget: float | None = None) -> LabelledData:
    """The labelled data set of a world, with the costs of its sets."""
    made, sequences, costs = pool(), [], []
    for name in training_courses(seed, LENGTH):
        found = {o: dict(np.load(path)) for o, path in course_files(folder, seed, name).items()}
        sequences.append(_labelled(name, list(found.values())))
        costs.append([np.concatenate([d[key] for d in found.values()]) for key in _COSTS])
        evidence = [float(d["evidence_ms"]) for d in found.values()]
    parameters: tuple[ParameterSet, ...] = tuple(
        {ODOMETRY: odometry, **one}
        for odometry, d in found.items()
        for one in json.loads(str(d["parameters"]))
    )
    sets = ParameterSets(made.space, tuple(range(len(parameters))), parameters)
    numbers: dict[Any, int] = {}
    by = [numbers.setdefault(made(one).preparation, len(numbers)) for one in parameters]
    register, prepare = np.mean(costs, axis=0).tolist()
    each = zip(sets, map(SetCost, register, prepare, by), strict=True)
    return LabelledData(sequences, sets, Costs(dict(each), float(np.mean(evidence))), budget)


_COSTS = ("register_ms", "prepare_ms")


def _labelled(name: str, found: list[dict[str, NDArray[Any]]]) -> LabelledSequence:
    """A sequence of the labelled data set, from the arrays in the files of all odometries."""
    first = found[0]
    errors, vectors, few = (
        np.concatenate([d[key] for d in found], axis=1) for key in ("errors", "vectors", "motions")
    )
    stamps, known = first["stamps"], ~np.isnan(errors).any(axis=1)
    period = (stamps - stamps[0]) // 10**9
    described = averaged(first["histograms"].astype(np.float32), stamps, WINDOW, PERIOD / 10)
    motions: NDArray[np.float64] = np.tile(np.eye(4), (*few.shape[:2], 1, 1))
    motions[..., :3, :] = few
    simulation = BankSimulation(
        stamps,
        first["T_world_sensor"],
        first["T_world_sensor"],
        described,
        period,
        DEFAULTS.sub_trajectory,
        LOST_TRACK,
        Hops(*(first[f"hops_{key}"] for key in Hops._fields)),
        partial(np.take, motions, axis=1),
    )
    return in_place(name, simulation, errors[known], vectors[known], known)
