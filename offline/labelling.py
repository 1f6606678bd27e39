"""Reads the labelled data set of a study from its archive."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, Frames, Summary
from adaptune.descriptor import averaged
from adaptune.metrics import span
from adaptune.model import ModelError
from adaptune.model.bank_weights import POOL
from adaptune.model.base import mean_errors
from adaptune.model.paired import BASELINE
from adaptune.odometry.pool import Factory
from adaptune.parameter_sets import ParameterSets
from adaptune.sequence.names import origin
from offline.bank_simulation import BankSimulation, error_vectors, motions_from_archive
from offline.config import Metric, OfflineStudyConfig
from offline.labelled import LabelledData, LabelledSequence
from offline.objective import few, repeated, weighted
from offline.search import owner
from offline.stretches import Extent, cut, stretches_of_view
from offline.trial_costs import measured_costs
from offline.whole_runs import read_whole_runs, whole_errors, whole_values


def labelled_data(
    archive: Archive,
    run: Mapping[str, Sequence[int]],
    sets: ParameterSets,
    config: OfflineStudyConfig,
    window: int,
    recorded_in: Callable[[str], str],
    odometry: Factory,
) -> LabelledData:
    """Read the labelled data set of a study.

    Parameters
    ----------
    archive
        The trials.
    run
        For each training sequence, the trials that count there.
    sets
        The sets to read about.
    config
        Of the study.
    window
        Number of descriptors that are averaged.
    recorded_in
        The recording of a sequence, by its name.
    odometry
        Of the study.

    Raises
    ------
    ModelError
        If a trial is missing.
    """
    _check_finished(archive, run)
    read = [_labelled(archive, name, set(run[name]), sets, config, window) for name in run]
    number = np.repeat(np.arange(len(read)), [len(s.errors) for s, _, _ in read])
    means = mean_errors(np.concatenate([s.errors for s, _, _ in read]), number)
    # With a sequence left out, others than now may be among the best. To read the poses of
    # thousands of trials would take long.
    order = np.argsort(means, kind="stable")[: 2 * POOL]
    best = [sets.trials[c] for c in order]
    eligible = {t for t in (BASELINE, *best) if t in sets and np.isfinite(means[sets.column(t)])}
    named = (n if isinstance(n, int) else sets.find(n) for n in config.online.switching.sets or ())
    eligible |= {trial for trial in named if trial is not None}
    slots = archive.slots()
    owners = [owner(slots, trial) for trial in sets]
    labelled = []
    for sequence, frames, known in read:
        name, length = sequence.name, config.sub_trajectory
        vectors = {
            trial: error_vectors(frames, archive.read(name, trial), length)[known]
            for trial in eligible.intersection(sets).intersection(run[name])
        }
        own = [one is not None and origin(one) == origin(name) for one in owners]
        found = replace(sequence, own=np.array(own, bool), vectors=vectors)
        labelled.append(replace(found, recorded_in=recorded_in(name)))
    cut_up = _with_cuts(_with_whole_runs(archive, labelled, sets, config))
    costs = measured_costs(archive, run, sets, odometry)
    return LabelledData(cut_up, sets, costs, config.online.budget)


def _check_finished(archive: Archive, run: Mapping[str, Sequence[int]]) -> None:
    """Refuse an archive that lacks a trial."""
    for name, counted in run.items():
        if missing := set(counted) - set(archive.finished(name)):
            raise ModelError(
                f"{archive.folder}: lacks trial {min(missing)} on {name}, which the model was "
                f"fitted to; run `adaptune offline` again"
            )


def _with_whole_runs(
    archive: Archive,
    labelled: Sequence[LabelledSequence],
    sets: ParameterSets,
    config: OfflineStudyConfig,
) -> list[LabelledSequence]:
    """Add what is known of the whole runs of the candidates for the fixed set."""
    rivals = [*few(LabelledData(labelled, sets).bounds()), *sets.defaults]
    runs = read_whole_runs(archive, [s.name for s in labelled], rivals, config.health)
    whole = whole_values(config.offline, runs)
    # Whether the objective on some frames follows from the errors there.
    by_frames = set(config.offline.objective[0]) == {"rte"}
    found = []
    for s in labelled:
        of = whole[s.name]
        if by_frames and s.extent is not None:
            errors = whole_errors(archive, s.name, of, s.extent.frames)
            found.append(replace(s, whole=of, whole_errors=errors, by_frames=True))
        else:
            found.append(replace(s, whole=of))
    return found


def _with_cuts(sequences: Sequence[LabelledSequence]) -> list[LabelledSequence]:
    """Cut recordings into stretches, and views as their recordings are."""
    cuts: dict[str, NDArray[np.intp]] = {}
    extents: dict[str, Extent] = {}
    for s in sequences:
        if s.extent is not None and s.simulation is not None:
            cuts[s.name] = cut(s.simulation.T_ref_sensor, s.extent)
            extents[s.name] = s.extent
    found = []
    for s in sequences:
        of = origin(s.name)
        if of == s.name or of not in cuts:
            # A view without its recording is cut by itself.
            found.append(replace(s, cuts=cuts.get(s.name)))
        else:
            numbers = stretches_of_view(extents[s.name], extents[of], cuts[of])
            found.append(replace(s, cuts=numbers))
    return found


def _labelled(
    archive: Archive,
    name: str,
    run: Collection[int],
    sets: ParameterSets,
    config: OfflineStudyConfig,
    window: int,
) -> tuple[LabelledSequence, Frames, NDArray[np.bool_]]:
    """A labelled sequence without error vectors, its frames, and which of them are labelled."""
    frames = archive.read_frames(name)
    errors = archive.read_errors(name, list(sets))
    # Trials that were run for another budget do not count.
    errors[:, [trial not in run for trial in sets]] = np.nan
    # Whether there is a sub-trajectory depends on the reference alone.
    known = np.asarray(~np.isnan(errors).all(axis=1))
    period, objective = config.online.period, config.offline.objective[0]
    described = averaged(frames.descriptors, frames.stamps, window, period)
    periods_since = ((frames.stamps - frames.stamps[0]) * 1e-9 // period).astype(np.int64)
    summaries = [archive.finished(name)[trial] if trial in run else None for trial in sets]
    values = [np.inf if s is None else weighted(objective, s.metrics) for s in summaries]
    simulation = BankSimulation(
        frames.stamps,
        frames.T_ref_sensor,
        described,
        periods_since,
        config.sub_trajectory,
        config.lost_track,
        frames.hops,
        motions_from_archive(archive, name, frames),
    )
    labelled = LabelledSequence(
        name,
        periods_since[known],
        described[known],
        errors[known],
        blocks=frames.blocks,
        baseline=archive.read(name, 0).errors[known],
        values=np.array(values),
        repeats=_repeats(summaries, objective, config.offline.repeats),
        block=span(frames.T_ref_sensor, config.sub_trajectory),
        elevation=float(np.nanmedian(frames.elevations)),
        simulation=simulation,
        extent=Extent.of(frames.T_ref_sensor, known, config.sub_trajectory),
    )
    return labelled, frames, known


def _repeats(
    summaries: Sequence[Summary | None], objective: Mapping[Metric, float], n_repeats: int
) -> NDArray[np.float64] | None:
    """The objective in every run of repeated trials, of shape (n_sets, n_repeats), or None."""
    if n_repeats == 1:
        return None
    missing = [np.nan] * n_repeats
    # Of the baseline, there may be more runs.
    rows = [missing if s is None else repeated(objective, s.repeats) for s in summaries]
    return np.array([row[:n_repeats] for row in rows])
