"""Whether an estimated reference would have judged the trials as the given one does."""

import logging
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, Frames
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.metrics import cap, sub_trajectory_rte, window_ends
from adaptune.recording.config import ESTIMATED, NO_REFERENCE, SequenceConfig
from adaptune.recording.opening import open_sequence
from adaptune.reference.check import MeasuredReference, common_poses, mean_difference
from adaptune.reference.stored import CHECK, EstimateError, StoredEstimate
from adaptune.study.references import estimated_at
from offline.config import OfflineStudy
from offline.trial import episodes

Show = Callable[[str, int, int], None]
"""Called with a sequence, how many of its scans are done, and about how many there are."""

FEWEST = 3
"""Sets between which a rank correlation says something."""

_log = logging.getLogger(__name__)


class Run(NamedTuple):
    """What a trial left of its drive."""

    T_odom_sensor: Poses  # (n, 4, 4)
    restarted: NDArray[np.bool_]  # (n,)


class Judged(NamedTuple):
    """Mean errors of the same trials by two references, in percent, each of shape (n_trials,)."""

    given: NDArray[np.float64]
    estimated: NDArray[np.float64]


class SetChoice(NamedTuple):
    """What the trials' errors by two references have in common."""

    rank: float  # Spearman's correlation; NaN with few sets, or sets that are all alike
    picked: float  # percent by the given reference, of the set that the estimated one picks
    best: float  # and of the set that the given one picks

    @property
    def ratio(self) -> float:
        """How much worse the picked set is."""
        return self.picked / self.best if self.best else float("nan")


def judge_by_both(
    T_given: Poses,
    T_estimated: Poses,
    runs: Iterable[Run],
    length: float,
    begins: Sequence[int] = (),
) -> Judged:
    """Judge trials by two references, on the sub-trajectories that both of them know.

    Parameters
    ----------
    T_given, T_estimated
        References of shape (n, 4, 4), NaN where they are unknown.
    runs
        The trials.
    length
        Metres of a sub-trajectory.
    begins
        Frames at which trials in pieces begin anew. No sub-trajectory leads over them.
    """
    references = common_poses(T_given, T_estimated)
    pieces = np.zeros(len(T_given), np.intp)
    pieces[list(begins)] = 1
    piece = np.cumsum(pieces)
    known = np.ones(len(T_given), bool)
    for T in references:
        ends = window_ends(T, length)
        known &= (ends >= 0) & (piece[ends] == piece)
    found = [
        [
            cap(sub_trajectory_rte(T, run.T_odom_sensor, length, run.restarted)[known])
            for T in references
        ]
        for run in runs
    ]
    if not known.any():
        return Judged(*np.full((2, len(found)), np.nan))
    return Judged(*np.array(found).reshape(len(found), 2, -1).mean(axis=2).T)


def choose(judged: Judged) -> SetChoice:
    """Compare what two references choose.

    Of sets that are equally good, the first one counts.
    """
    given, estimated = judged
    if not len(given) or not np.isfinite(given).all():
        return SetChoice(np.nan, np.nan, np.nan)
    picked = float(given[np.argmin(estimated)])
    return SetChoice(rank_correlation(given, estimated), picked, float(given.min()))


def rank_correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Spearman's rank correlation; NaN with few values, or values that are all the same."""
    if len(one) < FEWEST or min(np.ptp(one), np.ptp(other)) == 0.0:
        return float("nan")
    from scipy import stats

    return float(stats.spearmanr(one, other).statistic)


def over_all(of_sequences: Sequence[tuple[Sequence[int], Judged]]) -> Judged:
    """Mean errors over all sequences, of the trials that were run on every one of them.

    Parameters
    ----------
    of_sequences
        For each sequence the trial numbers, and their errors.
    """
    known = [(n, judged) for n, judged in of_sequences if np.isfinite(judged.given).all()]
    if not known:
        return Judged(np.empty(0), np.empty(0))
    everywhere = sorted(set.intersection(*(set(numbers) for numbers, _ in known)))
    errors = [
        [[of[list(numbers).index(n)] for n in everywhere] for of in judged]
        for numbers, judged in known
    ]
    given, estimated = np.array(errors, np.float64).reshape(len(known), 2, -1).mean(axis=0)
    return Judged(given, estimated)


def check_reference(study: OfflineStudy, show: Show = lambda *_: None) -> list[dict[str, Any]]:
    """Compare the given references of a study with estimated ones by its finished trials.

    Estimates are kept in the study's folder, as ``references/NAME.check.tum``.

    Returns
    -------
    list of dict
        A row for every training sequence that has a given reference and finished trials; with
        several, another one for all.

    Raises
    ------
    AdaptuneError
        If there is no such sequence, or no recording allows an estimate. Where some do not, a
        warning says so.
    """
    archive, rows, found, refused = Archive(study.folder / "trials"), [], [], list[str]()
    names = _given_names(study, archive)
    if not names:
        raise AdaptuneError(
            f"{study.folder}: no training sequence with a given reference has finished trials; "
            f"name a reference for one, and run `adaptune offline` first"
        )
    for name in names:
        frames, numbers = archive.read_frames(name), sorted(archive.finished(name))
        try:
            stored = _estimate(study, name, show)
        except EstimateError as error:
            refused.append(str(error))
            continue
        T = _poses(study, name, stored.path, frames)
        judged = _judge_trials(study, archive, name, frames, T)
        found.append((numbers, judged))
        rows.append(_row(study, name, frames, T, stored) | _choice_cells(len(numbers), judged))
    if not rows:
        raise EstimateError("\n".join(refused))
    for said in refused:
        _log.warning("%s; it is not in the table", said)
    if len(rows) > 1:
        judged = over_all(found)
        named = dict.fromkeys(rows[0]) | {"sequence": "all: fixed set"}
        rows.append(named | _choice_cells(len(judged.given), judged))
    return rows


def _given_names(study: OfflineStudy, archive: Archive) -> list[str]:
    """The training sequences that have a given reference and finished trials."""
    found = [n for n in dict.fromkeys(study.config.training) if archive.finished(n)]
    # A simulated course is none of the recordings, and its reference is the truth.
    # A file that adaptune estimated is none that was given.
    given = [name for name in found if not study.sequences.is_estimated(name)]
    recorded = {name: study.sequences.recordings.get(name) for name in given}
    return [name for name, config in recorded.items() if config is None or _is_given(config)]


def _is_given(config: SequenceConfig) -> bool:
    if config.reference is not None:
        return config.reference not in (ESTIMATED, NO_REFERENCE)
    return open_sequence(config).reference() is not None


def _estimate(study: OfflineStudy, name: str, show: Show) -> StoredEstimate:
    """The estimated reference of a sequence, made if it is not there or of other scans."""
    path = study.folder / "references" / f"{name}{CHECK}.tum"
    return estimated_at(study, name, path, partial(show, name))


def _poses(study: OfflineStudy, name: str, path: Path, frames: Frames) -> Poses:
    """The estimated poses of the scans that the trials have seen."""
    trajectory = open_sequence(study.sequences.by_estimate(name, path)).reference()
    assert trajectory is not None
    return trajectory.at(frames.stamps)


def _judge_trials(
    study: OfflineStudy, archive: Archive, name: str, frames: Frames, T_estimated: Poses
) -> Judged:
    """Judge all finished trials on a sequence."""
    length, begins = study.config.sub_trajectory, [0]
    if study.config.offline.runs == "episodes":
        begins = [begin for begin, _ in episodes(frames.T_ref_sensor, length)]
    trials = (archive.read(name, number) for number in sorted(archive.finished(name)))
    runs = (Run(trial.T_odom_sensor, trial.restarted) for trial in trials)
    return judge_by_both(frames.T_ref_sensor, T_estimated, runs, length, begins)


def _row(
    study: OfflineStudy, name: str, frames: Frames, T_estimated: Poses, stored: StoredEstimate
) -> dict[str, Any]:
    """What is known of both references, in percent."""
    length = study.config.sub_trajectory
    given = MeasuredReference(frames.stamps, frames.T_ref_sensor, frames.hops).error(length)
    return {
        "sequence": name,
        "estimate, by the given [%]": mean_difference(frames.T_ref_sensor, T_estimated, length),
        "by itself [%]": stored.error(length),
        "unknown [%]": 100.0 * stored.unknown_share,
        "given, by scans [%]": None if given is None else given.mean,
    }


def _choice_cells(n: int, judged: Judged) -> dict[str, Any]:
    choice = choose(judged)
    return {
        "sets": n,
        "rank corr.": choice.rank,
        "picked [%]": choice.picked,
        "best [%]": choice.best,
        "ratio": choice.ratio,
    }
