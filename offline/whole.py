"""Drives of whole recordings by finalists: with the health check, and what it hides."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune._system.progress import Progress
from adaptune.metrics import FAILURE, sub_trajectory_turns
from adaptune.model.rules import BASELINE, Costs, SetCost
from adaptune.runs.archive import Archive, Kind, Trial, TrialSummary
from adaptune.space import ParameterSet
from offline.campaign import Schedule, checked, labels_of
from offline.choice import LOST, PER_BLOCK, BlockErrors, surely_worse
from offline.config import OfflineConfig, OfflineStudy
from offline.labelled import LabelledData, LabelledSequence, mean_cost, segments
from offline.objective import weighted
from offline.search import Finished
from offline.workers import Pool


def drive_whole(
    study: OfflineStudy,
    sets: Mapping[int, ParameterSet],
    archive: Archive,
    workers: Pool[Any],
    progress: Progress,
) -> None:
    """Drive sets along whole training sequences, unless that was done before.

    Where one is lacking, all drive again: costs compare where they were measured side by side.
    Where the health check acts, it may hide that a set fails without it. So those sets, and the
    baseline, drive such sequences once more, bare.
    """
    names, labels = study.training, labels_of(study)

    def drive(on: Mapping[str, Collection[int]], what: str, kind: Kind = "whole") -> None:
        schedule = Schedule(study, archive, what, progress, kind)
        there, bare = archive.summaries(names, sets, kind), kind == "bare"
        for name, numbers in on.items():
            if lacking := {*numbers} - {*there[name]}:
                for n in sorted(lacking) if bare else numbers:
                    archive.trial_path(name, n, kind).unlink(missing_ok=True)
                    schedule.add(name, n, sets[n])
        for name, n, trial in checked(schedule, workers, [] if bare else labels):
            schedule.store(name, n, trial)

    drive(dict.fromkeys(names, sets), "whole drives")
    whole = archive.summaries(names, sets)
    restarts = {n: sum(of[n].restarts for of in whole.values()) for n in sets}
    helped = [n for n in sets if restarts[n] > 0]
    if not {*helped} - {BASELINE}:
        return
    on = {name: [n for n in helped if of[n].restarts] for name, of in whole.items()}
    drive(on, "drives without health check", "bare")


MOST_ROUNDS = 3
"""How often other finalists take the place of those that fail without the health check."""


def in_whole_drives(
    data: LabelledData,
    archive: Archive,
    config: OfflineConfig,
    drive: Callable[[LabelledData], None] = lambda _: None,
) -> LabelledData:
    """The same with the drives of finalists along whole recordings, see `with_whole_drives`.

    Those that are surely worse than the baseline without the health check, or lose track more
    often, are left out, and others take their place. `drive` makes the drives that are lacking.
    """
    names = [s.name for s in data.sequences]
    for _ in range(MOST_ROUNDS):
        drive(data)
        driven = with_whole_drives(data, archive, config)
        asked = [*driven.finalists(), *driven.sets.defaults]
        bare = archive.summaries(names, asked, "bare")
        if not any(bare.values()):
            return driven
        # Where the health check did not act, a drive is bare as it is.
        blocks = with_whole_drives(driven, archive, config, bare).whole_blocks(asked)
        worse = np.array(blocks.trials)[worse_without(blocks)].tolist()
        if not worse:
            return driven
        data = data.subset([n for n in data.sets if n not in worse])
    # Only those that were driven.
    data = data.subset([n for n in data.sets if n in driven.driven])
    return with_whole_drives(data, archive, config)


def worse_without(blocks: BlockErrors) -> NDArray[np.bool_]:
    """Which sets are surely worse than the baseline, or lost in more blocks than it."""
    lost = (blocks.errors >= LOST * FAILURE).sum(axis=0)
    return np.asarray(surely_worse(blocks) | (lost > lost[blocks.baseline]))


def bare_in_words(
    archive: Archive, whole: Finished, fixed: int, dropped: Sequence[int]
) -> tuple[list[str], list[int]]:
    """What fixed set and baseline do without the health check, if that is another thing.

    Beside it: which of the sets that were `dropped` are surely worse so. Others did not drive.
    """
    bare = archive.summaries(whole, [BASELINE, fixed, *dropped], "bare")
    if not any(bare.values()):
        return [], []
    base, of_fixed = (
        np.mean([bare[name].get(n, of[n]).mean_error for name, of in whole.items()])
        for n in (BASELINE, fixed)
    )
    without = "Without the health check, as in your launch file"
    said = f"{without}, the baseline has {base:.3f} % in training"
    driven = all(fixed in bare[name] or not of[fixed].restarts for name, of in whole.items())
    if fixed != BASELINE and driven:
        said += f", the fixed set {of_fixed:.3f} %"
    if worse := [n for n in dropped if any(n in of for of in bare.values())]:
        said += f"; surely worse, and not recommended: trial {', '.join(map(str, worse))}"
    return [f"{said}."], worse


def with_whole_drives(
    data: LabelledData,
    archive: Archive,
    config: OfflineConfig,
    bare: Mapping[str, Collection[int]] = MappingProxyType({}),
) -> LabelledData:
    """The same with finalists' drives of whole recordings; of those in `bare`, the bare ones.

    What finalists cost over the baseline is what they cost side by side in these drives.
    """
    asked = [*data.finalists(), *data.sets.defaults]
    drives = archive.summaries([s.name for s in data.sequences], asked)
    if not (known := sorted(set.intersection(*map(set, drives.values())))):
        return data
    sequences = []
    for s in data.sequences:
        without = bare.get(s.name, ())
        trials = [archive.read(s.name, n, "bare" if n in without else "whole") for n in known]
        sequences.append(replace(s, whole=_whole(s, trials, config)))
    if not all(archive.is_uncut(s.name) for s in sequences):
        runs = {n: [of[n] for of in drives.values()] for n in known}
        data = data._replace(beside=side_by_side(data.costs, runs))
    return data._replace(sequences=sequences, driven=known)


def side_by_side(costs: Costs, runs: Mapping[int, Sequence[TrialSummary]]) -> Costs:
    """The same, where some sets cost as much more than the baseline as in these runs beside it.

    In the trials, the machine may have been busier with one set than with another.
    """
    beside = {n: mean_cost(of, costs.sets[n].preparation) for n, of in runs.items()}
    own = beside[BASELINE].alone if BASELINE in beside else np.nan
    scale = costs.alone(BASELINE) / own if own > 0.0 else np.nan
    found = {
        n: SetCost(scale * c.register, scale * c.prepare, c.preparation) for n, c in beside.items()
    }
    known = {n: cost for n, cost in found.items() if np.isfinite(cost.alone) and scale > 0.0}
    return replace(costs, sets={**costs.sets, **known})


def _whole(s: LabelledSequence, trials: Sequence[Trial], config: OfflineConfig) -> LabelledSequence:
    T_ref_sensor, length = s.simulation.T_ref_sensor, s.simulation.length
    everywhere = replace(s.simulation, T_ref_counted=T_ref_sensor)
    errors = np.stack([trial.errors for trial in trials], axis=1).astype(np.float32)
    turns = [sub_trajectory_turns(T_ref_sensor, trial.T_odom_sensor, length) for trial in trials]
    frames = np.flatnonzero(~np.isnan(errors).any(axis=1))
    block = segments(everywhere, frames, PER_BLOCK)
    values = [weighted(config.objective, trial.metrics) for trial in trials]
    return replace(
        s,
        simulation=everywhere,
        known=frames,
        segment=block,
        errors=errors[frames],
        vectors={},
        block=block,
        values=None if s.values is None else np.array(values),
        restarts=np.array([np.inf if trial.failure else trial.restarts for trial in trials]),
        turns=np.stack(turns, axis=1)[frames],
    )
