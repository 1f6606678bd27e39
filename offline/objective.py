"""How to judge a trial: metrics, and weighted sums of them.

Metrics of one parameter set on one sequence:

===============  ==================================================================================
``rte``          mean capped error of the sub-trajectories, percent
``kitti``        translation error of KITTI's benchmark, percent
``rpe``          relative pose error from scan to scan as evo gives it, metres
``ape``          absolute pose error after alignment as evo gives it, metres
``ms_per_scan``  milliseconds that the odometry takes for a prepared scan
``cpu``          CPU time over the recording's duration, percent of a core
===============  ==================================================================================

The first four repeat on the same machine, the last two do not.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Frames, Summary
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, invert
from adaptune.metrics import absolute_error, kitti_error, relative_error
from adaptune.model.rules import ROUNDING, Costs
from adaptune.space import ParameterSet
from offline.config import TIMED, Metric, OfflineConfig

UNITS: dict[Metric, str] = {
    "rte": "%",
    "kitti": "%",
    "rpe": "m",
    "ape": "m",
    "ms_per_scan": "ms",
    "cpu": "% of a core",
}
LARGEST_METRIC = 1e6
"""The largest value of a metric, also where it cannot be computed: sums stay finite."""
CANDIDATES = 4
"""So many sets, the best by their trials, are candidates for the fixed set beside the baseline."""
EQUAL_WITHIN = 1.02
"""Whole runs whose values differ by no larger factor count as equal."""
PENALTY = 10.0
"""A set that is not usable has so many times the baseline's value at least: samplers keep away."""


class NothingUsableError(AdaptuneError):
    """No parameter set gives poses."""

    exit_code = 1


UNUSABLE = (
    "odometry: none of {n} parameter sets gives poses for nearly all scans of every training "
    "sequence, so none can be chosen (`adaptune trials` lists their faults): mend the odometry, or "
    "narrow the ranges of the parameters (odometry.parameters)"
)


class Verdict(NamedTuple):
    """How a parameter set did on the sequences on which it was run."""

    parameters: ParameterSet
    value: float  # mean of the objective over the sequences
    # Distance from the value to the upper end of its one-sided 95 % confidence interval; 0
    # unless trials are repeated.
    margin: float = 0.0
    # Whether the set was run on all sequences; if not, its value is an estimate.
    complete: bool = True
    sequences: tuple[str, ...] = ()  # the sequences on which it was run
    usable: bool = True  # see `Summary.usable`; on all sequences

    @property
    def bound(self) -> float:
        """What the value surely is below: the upper end of its interval."""
        return self.value + self.margin


class SamplerResult(NamedTuple):
    """The result of a trial as samplers receive it."""

    parameters: ParameterSet
    value: float  # samplers minimise it


def trajectory_metrics(
    frames: Frames, T_odom_sensor: Poses, lost_steps: Mapping[int, Poses]
) -> dict[str, float]:
    """The metrics of a whole trajectory; KITTI's error if it is long enough."""
    T_ref_sensor, T = frames.T_ref_sensor, joined(T_odom_sensor, lost_steps)
    with np.errstate(over="ignore", invalid="ignore"):
        kitti = kitti_error(T_ref_sensor, T)
        found = {
            **({"kitti": kitti.translation} if kitti.lengths else {}),
            "rpe": relative_error(T_ref_sensor, T),
            "ape": absolute_error(T_ref_sensor, T) if np.abs(T).max() < 1e100 else np.inf,
        }
    return {name: float(np.fmin(value, LARGEST_METRIC)) for name, value in found.items()}


def joined(T_odom_sensor: Poses, lost_steps: Mapping[int, Poses]) -> Poses:
    """Undo restarts at the reference, which would hide the errors that led to them.

    `lost_steps` has by frame of a restart the odometry's motion since the frame before, (4, 4).

    Returns shape (n, 4, 4): the trajectory as it would have continued from the wrong pose.
    """
    T = T_odom_sensor.copy()
    for start, end in pairwise([*sorted(lost_steps), len(T)]):
        T_joined_odom = T[start - 1] @ lost_steps[start] @ invert(T_odom_sensor[start])
        T[start:end] = T_joined_odom @ T_odom_sensor[start:end]
    return T


def judge(config: OfflineConfig, runs: Sequence[Summary]) -> Verdict:
    """Judge a parameter set by its trials on some sequences."""
    metrics = [run.metrics for run in runs]
    value = float(mean_value(np.array([weighted(config.objective, one) for one in metrics])))
    usable = all(run.usable for run in runs)
    above = 0.0
    # Without repeats, nothing is known of the other sets' intervals.
    if config.repeats > 1 and all(run.repeats for run in runs):
        above = float(margin(np.array([repeated(config.objective, r.repeats) for r in runs])))
    return Verdict(runs[0].parameters, value, above, usable=usable)


def weighted(weights: Mapping[Metric, float], metrics: Mapping[str, float]) -> float:
    """A weighted sum of metrics."""
    return sum(weight * metrics[name] for name, weight in weights.items())


def repeated(weights: Mapping[Metric, float], runs: Sequence[Mapping[str, float]]) -> list[float]:
    """The weighted sum of the metrics that can repeat, in every run of a trial."""
    repeatable = {name: w for name, w in weights.items() if name not in TIMED}
    return [weighted(repeatable, run) for run in runs]


def mean_value(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the sequences of values of shape (..., n_sequences)."""
    return np.asarray(np.ascontiguousarray(values).mean(axis=-1))


def margin(repeats: NDArray[np.float64]) -> NDArray[np.float64]:
    """From a mean over sequences to the upper end of its one-sided 95 % confidence interval.

    The interval is Student's. Runs of a set vary, the sequences do not. `repeats` has the shape
    (..., n_sequences, n_repeats). A single run does not show how they vary: then it is 0.
    """
    from scipy import stats

    n_sequences, n_repeats = repeats.shape[-2:]
    if n_repeats < 2:
        return np.zeros(repeats.shape[:-2])
    variance = repeats.var(axis=-1, ddof=1).sum(axis=-1)
    error = np.sqrt(variance / n_repeats) / n_sequences
    return np.asarray(stats.t.ppf(0.95, n_sequences * (n_repeats - 1)) * error)


def sampler_results(verdicts: Sequence[Verdict]) -> list[SamplerResult]:
    """The results of trials as samplers receive them; the first one is the baseline's."""
    worst = PENALTY * (verdicts[0].value or 1.0) if verdicts else 0.0
    return [SamplerResult(v.parameters, max(v.value, 0.0 if v.usable else worst)) for v in verdicts]


def best_by_trials(verdicts: Mapping[int, Verdict]) -> int:
    """Trial number of the first of `candidates`."""
    return candidates(verdicts)[0]


def candidates(verdicts: Mapping[int, Verdict]) -> list[int]:
    """Trial numbers of the candidates for the fixed set, the best by their trials first.

    These are the `CANDIDATES` usable sets with the least objective, and the baseline if it is
    usable. If trials are repeated, the upper end of the confidence interval counts. Of equal sets,
    the first one comes first.

    Raises
    ------
    NothingUsableError
        If no set is usable.
    """
    complete = [n for n, verdict in verdicts.items() if verdict.complete and verdict.usable]
    if not complete:
        raise NothingUsableError(UNUSABLE.format(n=len(verdicts)))
    return best_candidates({n: verdicts[n].bound for n in complete})


def best_candidates(bounds: Mapping[int, float]) -> list[int]:
    """The `CANDIDATES` trials with the least values, the least first, and the baseline."""
    finite = [n for n, bound in bounds.items() if np.isfinite(bound)]
    best = sorted(finite, key=lambda n: bounds[n])[:CANDIDATES]
    return best if 0 in best or 0 not in bounds else [*best, 0]


def affordable(costs: Costs, trials: Sequence[int], budget: float) -> list[int]:
    """The trials whose sets alone cost no more milliseconds of CPU time a scan.

    Raises
    ------
    AdaptuneError
        If there is none.
    """
    few = [n for n in trials if costs.alone(n) <= budget + ROUNDING]
    if not few:
        cheapest = min(trials, key=costs.alone)
        raise AdaptuneError(
            f"online.budget: {budget:g} ms of CPU time a scan is less than the cheapest of "
            f"{len(trials)} parameter sets takes, {costs.alone(cheapest):.1f} ms (trial "
            f"{cheapest}); allow more, or add cheaper sets (a coarser downsampling, fewer "
            f"iterations, another odometry)"
        )
    return few


def choose_fixed(whole: Mapping[int, float], trials: Mapping[int, float]) -> int:
    """Trial number of the fixed set: the candidate with the least value in whole runs.

    Of candidates that are nearly as good, the one with the best trials is chosen: the best of a few
    runs owes something to chance.

    `whole` has by trial number the objective in whole runs, its mean over the sequences, and
    `trials` the same in trials, see `Verdict.bound`.
    """
    most = EQUAL_WITHIN * min(whole.values())
    return min((n for n, value in whole.items() if value <= most), key=lambda n: trials[n])


def label(weights: Mapping[Metric, float], units: bool = False) -> str:
    """A weighted sum in words, on request with units."""
    return " + ".join(
        ("" if weight == 1.0 else f"{weight:g} ") + name + (f" [{UNITS[name]}]" if units else "")
        for name, weight in weights.items()
    )


def failed_in_words(verdicts: Mapping[int, Verdict]) -> list[str]:
    """A sentence about the sets that are not usable, if there are any."""
    if not (failed := sum(not verdict.usable for verdict in verdicts.values())):
        return []
    return [
        f"{failed} of {len(verdicts)} parameter sets are never chosen: the odometry gave no pose "
        f"for a tenth of a sequence's scans, or gave up (see faults in `adaptune trials`)."
    ]


def baseline_words(config: OfflineConfig, runs: Sequence[Summary]) -> list[str]:
    """A sentence about the spread of the baseline over its runs, if it was run several times."""
    objective = config.objective
    if not all(run.repeats for run in runs) or set(objective) <= set(TIMED):
        return []
    found = np.mean([repeated(objective, run.repeats) for run in runs], axis=0)
    return [
        f"The baseline ran {len(found)} times: {label(objective, units=True)} {found.mean():.4g} "
        f"in the mean, {found.min():.4g} to {found.max():.4g}, "
        f"standard deviation {found.std(ddof=1):.2g}."
    ]
