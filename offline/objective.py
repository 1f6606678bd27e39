"""Judge a trial by metrics, see ``docs/reference-study.md``, and by weighted sums of them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from adaptune.geometry import Poses
from adaptune.metrics import FAILURE, absolute_error, kitti_error, relative_error
from adaptune.runs.archive import TrialSummary
from adaptune.space import ODOMETRY, ParameterSet
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
PENALTY = 10.0
"""A set that is not usable has so many times the baseline's value at least: samplers keep away."""


class JudgedSet(NamedTuple):
    """How a parameter set did on some sequences."""

    parameters: ParameterSet
    value: float  # mean of the objective over the sequences
    failure: str = ""  # why it is never chosen; empty if it may be
    by_sequence: Mapping[str, float] = MappingProxyType({})  # the objective
    cost: float = np.nan  # milliseconds of CPU time a scan, NaN if unknown

    @property
    def state(self) -> str:
        """What became of it: `complete`, or `failed`, and why."""
        return f"failed: {self.failure}" if self.failure else "complete"


def trajectory_metrics(T_ref_sensor: Poses, T_odom_sensor: Poses) -> dict[str, float]:
    """The metrics where the reference is known; KITTI's error if it is long enough."""
    known = ~np.isnan(T_ref_sensor[:, 0, 0])
    if not known.any():
        return {}
    T = np.where(known[:, None, None], T_odom_sensor, np.eye(4))
    with np.errstate(over="ignore", invalid="ignore"):
        kitti = kitti_error(T_ref_sensor, T)
        found = {
            **({"kitti": kitti.translation} if kitti.lengths else {}),
            "rpe": relative_error(T_ref_sensor, T),
            "ape": absolute_error(T_ref_sensor, T) if np.abs(T).max() < 1e100 else np.inf,
        }
    return {name: float(np.fmin(value, LARGEST_METRIC)) for name, value in found.items()}


def judge(config: OfflineConfig, trials: Mapping[str, TrialSummary]) -> JudgedSet:
    """Judge a parameter set by its trials on some sequences."""
    every = list(trials.values())
    by_sequence = {name: weighted(config.objective, one.metrics) for name, one in trials.items()}
    value, cost = np.mean([*by_sequence.values()]), np.mean([trial.cost for trial in every])
    failure = next((trial.failure for trial in every if trial.failure), "")
    return JudgedSet(every[0].parameters, float(value), failure, by_sequence, float(cost))


def weighted(weights: Mapping[Metric, float], metrics: Mapping[str, float]) -> float:
    """A weighted sum of metrics; one that could not be measured counts as the largest."""
    return sum(weight * metrics.get(name, LARGEST_METRIC) for name, weight in weights.items())


def sampler_results(judged: Sequence[JudgedSet]) -> list[tuple[ParameterSet, float]]:
    """Parameters and values of trials as samplers get them; the first one is the baseline's."""
    worst = PENALTY * (judged[0].value or 1.0) if judged else 0.0
    return [(v.parameters, max(v.value, worst if v.failure else 0.0)) for v in judged]


def label(weights: Mapping[Metric, float], units: bool = False) -> str:
    """A weighted sum in words, on request with units."""
    return " + ".join(
        ("" if weight == 1.0 else f"{weight:g} ") + name + (f" [{UNITS[name]}]" if units else "")
        for name, weight in weights.items()
    )


def failed_in_words(judged: Mapping[int, JudgedSet]) -> list[str]:
    """A sentence about the sets that are not usable, if there are any."""
    failures = Counter(one.failure for one in judged.values() if one.failure)
    if not failures:
        return []
    (why, n), *others = failures.most_common()
    often = f" ({n} of them)" * bool(others)
    return [
        f"{failures.total()} of {len(judged)} parameter sets failed and are never chosen: "
        f"{why}{often}; `trials.csv` has all reasons."
    ]


def unread_in_words(finished: Mapping[str, Mapping[int, TrialSummary]]) -> list[str]:
    """A sentence for each odometry whose sets all gave the same poses, by sequence and trial."""
    errors: dict[str, list[tuple[float, ...]]] = {}
    for number, trial in next(iter(finished.values())).items():
        if not trial.failure:
            each = tuple(of[number].mean_error for of in finished.values())
            errors.setdefault(str(trial.parameters.get(ODOMETRY, "")), []).append(each)
    return [
        f"All {len(every)} sets {f'of {label} ' * bool(label)}gave the same poses, to the last "
        f"digit: no parameter has an effect; look whether they reach the program."
        for label, every in errors.items()
        # Where track is always lost, nobody knows.
        if len(every) > len({*every}) == 1 and min(every[0]) < FAILURE
    ]


def baseline_words(config: OfflineConfig, trials: Sequence[TrialSummary]) -> list[str]:
    """A sentence about the spread of the baseline over its runs, if it was run several times."""
    objective = config.objective
    # Times never repeat.
    weights = {name: weight for name, weight in objective.items() if name not in TIMED}
    if not all(trial.repeats for trial in trials) or not weights:
        return []
    values = np.mean([[weighted(weights, m) for m in trial.repeats] for trial in trials], axis=0)
    return [
        f"The baseline ran {len(values)} times: {label(objective, units=True)} {values.mean():.4g} "
        f"in the mean, {values.min():.4g} to {values.max():.4g}, "
        f"standard deviation {values.std(ddof=1):.2g}."
    ]
