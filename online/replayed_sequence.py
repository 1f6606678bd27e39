"""The replays of a sequence in all modes that there are, as charts need them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.charts.chart import Spans
from adaptune.charts.course_scenes import scene_spans
from adaptune.model import ErrorModel
from adaptune.space import ParameterSpace
from adaptune.study.study import Study
from adaptune.trajectory import read_tum
from online.remarks import of_lengths, short_replays
from online.replay_picture import FEW, Track, drawn_modes
from online.stale_replays import current_modes
from online.statistics import Reference
from online.stored_replays import StoredReplay, damaged, read_applied, read_columns
from online.tracks import reference_of, seen_from, track_of


class ModeReplay(NamedTuple):
    """A replay in one mode, with what was measured on the way."""

    track: Track
    places: NDArray[np.float64]  # (n, 2): metres, by the reference where there is one
    familiarity: NDArray[np.float64]  # (m,): of each selection, see `Selection`; NaN if unknown
    selection_ms: NDArray[np.float64]  # (m,): that it took; empty where none was made
    scan_ms: NDArray[np.float64]  # (n,): to prepare and register a scan
    late_ms: NDArray[np.float64]  # (n,): from a scan to its pose, in real time; empty otherwise

    def selection_at(self) -> NDArray[np.intp]:
        """Number of the selection that holds at each frame, of shape (n,)."""
        after = np.searchsorted(self.track.choice_seconds, self.track.seconds, side="right")
        return np.maximum(after - 1, 0)

    @property
    def adapts(self) -> bool:
        """Whether anything was selected along the way."""
        return len(self.track.choice_seconds) > 1


@dataclass(frozen=True, eq=False)
class ReplayedSequence:
    """The replays of a sequence."""

    name: str
    length: float  # metres of a sub-trajectory
    modes: Mapping[str, ModeReplay]  # in the order in which lines lie on each other
    space: ParameterSpace
    scenes: Spans | None = None  # of a simulated course
    estimated: bool = False  # whether the reference was computed from the recording
    refused: Sequence[str] = ()  # sentences about replays that are not among them


def read_replays(study: Study, name: str) -> ReplayedSequence:
    """Read the replays of a sequence that are finished and drawn; there may be none.

    Those that `compare` refuses are not, see `online.stale_replays.current_modes`, and neither are
    those that are too short. Of many modes on demand, none is drawn, see
    `online.replay_picture.drawn_modes`.

    Raises
    ------
    AdaptuneError
        If a file is damaged, or if `compare` refuses all of them.
    """
    folder = study.folder / "replays" / name
    space, reference = study.odometry.space, reference_of(study, name)
    model = None
    # Of a single odometry, numbers name the members of a bank.
    if len(space.baselines) > 1 and study.model_path.exists():
        model = ErrorModel.load(study.model_path)
    current = current_modes(study, name)
    drawn = drawn_modes(current.modes)
    replays = {mode: StoredReplay.read(folder / mode) for mode in drawn}
    replays, short = _whole(name, replays)
    modes = {
        mode: _read_mode(folder / mode, replay, reference, model)
        for mode, replay in replays.items()
    }
    scenes = None
    if replays:
        scenes = scenes_along(study, name, next(iter(replays.values())).trajectory.stamps)
    return ReplayedSequence(
        name,
        study.config.sub_trajectory,
        modes,
        space,
        scenes,
        reference.estimated,
        [*current.refused, *short, *_undrawn(name, [m for m in current.modes if m not in drawn])],
    )


def _undrawn(name: str, modes: Sequence[str]) -> list[str]:
    """A sentence about modes that are left out so that charts can be read, if there are some."""
    listed = ", ".join(f"`{mode}`" for mode in modes)
    why = f"nobody could read charts of more than {FEW} modes on demand"
    return [f"No lines of {listed} along {name}: {why}."] if modes else []


def _whole(
    name: str, replays: Mapping[str, StoredReplay]
) -> tuple[dict[str, StoredReplay], list[str]]:
    """The replays of a sequence that are not too short, and a sentence about the others."""
    # In real time, the scans that are dropped tell something.
    scans = {
        mode: len(replay.trajectory)
        for mode, replay in replays.items()
        if replay.summary.about.real_time is None
    }
    short = short_replays(scans)
    whole = {mode: replay for mode, replay in replays.items() if mode not in short}
    return whole, [of_lengths(name, scans, short)] if short else []


def scenes_along(study: Study, name: str, stamps: NDArray[np.int64]) -> Spans | None:
    """The scenes of a simulated course at scans of these stamps; None of another recording."""
    course = study.config.courses.get(name)
    if course is None:
        return None
    path = study.sequences.recording(name).with_suffix(".tum")
    return scene_spans(course.legs, read_tum(path), stamps) if path.exists() else None


def _read_mode(
    folder: Path, replay: StoredReplay, reference: Reference, model: ErrorModel | None
) -> ModeReplay:
    track = track_of(replay, reference, model)
    applied, frames = read_applied(folder / "selections.csv"), read_columns(folder / "frames.csv")
    try:
        familiarity = _numbers(applied.get("familiarity", []))
        selection_ms = _numbers(applied.get("ms", []))
        scan_ms = _numbers(frames["prepare_ms"]) + _numbers(frames["register_ms"])
        late_ms = _numbers(frames.get("late_ms", []))
    except (KeyError, ValueError) as error:
        raise damaged(folder, error) from error
    if not len(familiarity):
        familiarity = np.full(len(track.choice_seconds), np.nan)
    places = track.xy
    if reference.trajectory is not None:
        stamps = replay.trajectory.stamps
        known = np.flatnonzero(np.isin(stamps, reference.trajectory.stamps))
        if len(known):
            seen = seen_from(reference.trajectory)
            places = np.full((len(stamps), 2), np.nan)
            places[known] = seen[np.searchsorted(reference.trajectory.stamps, stamps[known])]
    return ModeReplay(track, places, familiarity, selection_ms, scan_ms, late_ms)


def _numbers(texts: Collection[str]) -> NDArray[np.float64]:
    return np.array([float(text or "nan") for text in texts])
