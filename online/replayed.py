"""The replays of a sequence in all modes that there are, as charts need them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import invert
from adaptune.metrics import travelled
from adaptune.model import ErrorModel
from adaptune.reference.judge import Reference
from adaptune.report.charts import Spans
from adaptune.space import ParameterSpace, in_words
from adaptune.study.driven import named
from adaptune.study.sequences import StudySequences
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory, read_tum
from online.modes import BASELINE, FIXED, UNTRAINED, Replays
from online.record import StoredReplay
from online.reference import read_reference


def scene_spans(
    legs: Sequence[tuple[str, float]], driven: Trajectory, stamps: NDArray[np.int64]
) -> Spans:
    """The scenes of a drive, as stretches of its time.

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


class ModeReplay(NamedTuple):
    """Errors and selections of one mode along a sequence: n scans, m selections."""

    seconds: NDArray[np.float64]  # since the first scan, of shape (n,)
    errors: NDArray[np.float64]  # sub-trajectory RTE in percent, of shape (n,)
    errors_around: NDArray[np.float64]  # the mean of those through each place
    errors_behind: NDArray[np.float64]  # the mean of those that ended in the last 30 s
    restarted: NDArray[np.bool_]  # of shape (n,)
    choice_seconds: NDArray[np.float64]  # of shape (m,)
    choices: Mapping[str, Sequence[Any]]  # for every parameter its values, of shape (m,)
    weights: Mapping[str, Sequence[float]]  # in a bank by member instead, of shape (m,)
    # Of shape (m, 3): percent, the error that was estimated while driving, and the ends of its
    # interval; NaN where there is none.
    estimated: NDArray[np.float64]
    states: NDArray[np.str_]  # of shape (m,), see `Selection`
    places: NDArray[np.float64]  # (n, 2): metres, by the reference where there is one

    @property
    def span(self) -> NDArray[np.float64]:
        """When each choice was made, and the end, until which the last one holds."""
        return np.append(self.choice_seconds, self.seconds[-1])

    @property
    def adapts(self) -> bool:
        """Whether anything was selected along the way."""
        return len(self.choice_seconds) > 1


@dataclass(frozen=True, eq=False)
class ReplayedSequence:
    """The replays of a sequence."""

    name: str
    length: float  # metres of a sub-trajectory
    modes: Mapping[str, ModeReplay]  # in the order in which lines lie on each other
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
    modes = {mode: _read_mode(mode, replay, reference, model) for mode, replay in read.items()}
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


def _read_mode(
    mode: str, replay: StoredReplay, reference: Reference, model: ErrorModel | None
) -> ModeReplay:
    """Read a replay; `model` names the members of a bank."""
    stamps, truth = replay.trajectory.stamps, reference.trajectory
    places = _seen_from(replay.trajectory)
    if truth is not None and len(known := np.flatnonzero(np.isin(stamps, truth.stamps))):
        places = np.full((len(stamps), 2), np.nan)
        places[known] = _seen_from(truth)[np.searchsorted(truth.stamps, stamps[known])]
    return ModeReplay(
        (stamps - stamps[0]) * 1e-9,
        reference.errors(replay.trajectory),
        reference.errors_around(replay.trajectory),
        reference.errors_behind(replay.trajectory),
        replay.restarted,
        np.asarray((replay.choice_stamps - stamps[0]) * 1e-9),
        replay.choices,
        {_member(mode, model, number): weights for number, weights in replay.weights.items()},
        replay.estimated,
        replay.states,
        places,
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
