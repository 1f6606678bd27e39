"""What the sets of a study cost, as it was measured in their trials."""

from collections.abc import Hashable, Iterable, Mapping

import numpy as np

from adaptune.archive import PREPARE_MS, REGISTER_MS, Archive
from adaptune.model.costs import Costs, SetCost
from adaptune.odometry.pool import Factory
from adaptune.parameter_sets import ParameterSets


def measured_costs(
    archive: Archive, run: Mapping[str, Iterable[int]], sets: ParameterSets, odometry: Factory
) -> Costs:
    """Mean costs of sets over the sequences on which they were run.

    Parameters
    ----------
    archive
        The trials.
    run
        For each sequence, the trials that count there.
    sets
        The sets.
    odometry
        It tells which sets share prepared scans.

    Returns
    -------
    Costs
        Not a number where an older adaptune ran the trials, which did not measure them.
    """
    numbers: dict[Hashable, int] = {}
    found: dict[int, SetCost] = {}
    counted = {name: set(trials) for name, trials in run.items()}
    for trial in sets:
        where = [name for name, trials in counted.items() if trial in trials]
        runs = [archive.finished(name)[trial] for name in where]
        register, prepare = (
            float(np.mean([one.others.get(key, np.nan) for one in runs])) if runs else np.nan
            for key in (REGISTER_MS, PREPARE_MS)
        )
        key = odometry(sets[trial]).preparation
        found[trial] = SetCost(register, prepare, numbers.setdefault(key, len(numbers)))
    evidence = [archive.read_frames(name).evidence_ms for name in counted]
    return Costs(found, float(np.mean(evidence)))
