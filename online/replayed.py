"""The replays of a sequence in all modes that there are, as charts need them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import invert
from adaptune.metrics import travelled
from adaptune.model import ErrorModel
from adaptune.reference.judge import Reference
from adaptune.report.charts import Spans
from adaptune.runs.record import Run
from adaptune.space import ParameterSpace, in_words
from adaptune.study.driven import named
from adaptune.study.sequences import StudySequences
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory, read_tum
from online.modes import BASELINE, FIXED, UNTRAINED, Replays
from online.reference import read_reference


def scene_spans(
    legs: Sequence[tuple[str, float]], driven: Trajectory, stamps: NDArray[np.int64]
) -> Spans:
    """The scenes of a drive, as segments of its time.

    `legs` are the name and metres of each scene, in driving order. These become time by the true
    poses that were `driven`: their path is a little longer than the road, because the vehicle
    strays and shakes, and is scaled to the road's length. `stamps`, nanoseconds, are those of the
    scans that are shown, maybe a part of the drive. Edges are seconds since the first of them.
    """
    along = travelled(driven.T_world_sensor)
    names, metres = zip(*legs, strict=True)
    ends = np.cumsum([0.0, *metres])
    path = along / max(float(along[-1]), 1e-9) * ends[-1]
    seconds = (driven.stamps - stamps[0]) * 1e-9
    edges = np.interp(ends, path, seconds)
    edges[-1] = max(edges[-1], seconds[-1])
    begin, end = 0.0, float(stamps[-1] - stamps[0]) * 1e-9
    shown = [i for i in range(len(names)) if edges[i] < end and edges[i + 1] > begin]
    kept = np.clip(edges[[*shown, shown[-1] + 1]], begin, end)
    return Spans(kept, tuple(names[i] for i in shown))


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """A replay in one mode, and its errors: n scans, m selections."""

    run: Run
    errors: NDArray[np.float64]  # sub-trajectory RTE in percent, of shape (n,)
    errors_around: NDArray[np.float64]  # the mean of those through each place
    errors_behind: NDArray[np.float64]  # the mean of those that ended in the last 30 s
    places: NDArray[np.float64]  # (n, 2): metres, by the reference where there is one
    weights: Mapping[str, Sequence[float]]  # in a bank by the name of a member, of shape (m,)
    members: Mapping[str, Sequence[str]]  # what each did, see `Motions`, of shape (n,)

    @cached_property
    def seconds(self) -> NDArray[np.float64]:
        """Since the first scan, of shape (n,)."""
        return self.run.trajectory.seconds

    @property
    def span(self) -> NDArray[np.float64]:
        """When each choice was made, and the end, until which the last one holds."""
        made = (self.run.choice_stamps - self.run.steps[0].stamp) * 1e-9
        return np.append(made, self.seconds[-1])

    @property
    def states(self) -> NDArray[np.str_]:
        """The state of each selection, of shape (m,), see `Selection`."""
        return np.array([choice.selection.state for choice in self.run.choices])

    @property
    def adapts(self) -> bool:
        """Whether anything was selected along the way."""
        return len(self.run.choices) > 1


@dataclass(frozen=True, eq=False)
class ReplayedSequence:
    """The replays of a sequence."""

    name: str
    length: float  # metres of a sub-trajectory
    modes: Mapping[str, JudgedRun]  # in the order in which lines lie on each other
    space: ParameterSpace
    scenes: Spans | None = None  # of a simulated course
    estimated: bool = False  # whether the reference was computed from the recording
    # of banks by name, their sets in words
    members: Mapping[str, str] = field(default_factory=dict)


def read_replays(study: Study, name: str) -> ReplayedSequence:
    """Read the replays of a sequence that are finished and drawn; there may be none.

    There is an AdaptuneError if a file is damaged.
    """
    replays = Replays.of(study)
    read, model = {mode: replays.read(name, mode) for mode in replays.made(name)}, replays.model
    length, space = study.config.sub_trajectory, study.odometry.space
    if not read:
        return ReplayedSequence(name, length, {}, space)
    reference = read_reference(study, name)
    modes = {mode: _judged(mode, run, reference, model) for mode, run in read.items()}
    scenes = scenes_along(study.sequences, name, next(iter(read.values())).trajectory.stamps)
    members = {
        _member(mode, model, number): in_words(model.sets[number])
        for mode, replay in read.items()
        for number in replay.weights
        if model is not None and number in model.sets
    }
    return ReplayedSequence(name, length, modes, space, scenes, reference.estimated, members)


def scenes_along(sequences: StudySequences, name: str, stamps: NDArray[np.int64]) -> Spans | None:
    """The scenes of a simulated course at scans of these stamps; None of another recording."""
    course = sequences.courses.get(name)
    if course is None:
        return None
    path = sequences.recording(name).with_suffix(".tum")
    return scene_spans(course.legs, read_tum(path), stamps) if path.exists() else None


def _judged(mode: str, run: Run, reference: Reference, model: ErrorModel | None) -> JudgedRun:
    """Judge a replay; `model` names the members of a bank."""
    odometry, truth = run.trajectory, reference.trajectory
    stamps, places = odometry.stamps, _seen_from(odometry)
    if truth is not None and len(known := np.flatnonzero(np.isin(stamps, truth.stamps))):
        places = np.full((len(stamps), 2), np.nan)
        places[known] = _seen_from(truth)[np.searchsorted(truth.stamps, stamps[known])]
    names = {number: _member(mode, model, number) for number in run.weights}
    return JudgedRun(
        run,
        reference.errors(odometry),
        reference.errors_around(odometry),
        reference.errors_behind(odometry),
        places,
        {names[number]: weights for number, weights in run.weights.items()},
        {names[n]: [step.states.get(n, "") for step in run.steps] for n in names},
    )


def _member(mode: str, model: ErrorModel | None, number: int) -> str:
    """What a member of a bank is called. Those of a bank without a model are no trials."""
    if mode == UNTRAINED:
        return f"untrained set {number}" if number else BASELINE
    if model is None or number not in model.sets:
        return f"trial {number}"
    if number == model.fixed:
        return FIXED
    return BASELINE if (name := named(model, number)) == "0" else f"trial {name}"


def _seen_from(trajectory: Trajectory) -> NDArray[np.float64]:
    """Positions in the plane of the sensor at the first pose: x forward, y to the left."""
    T = trajectory.T_world_sensor
    return np.asarray((invert(T[0]) @ T)[:, :2, 3])
