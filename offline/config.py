"""The configuration of a study with the settings of the offline stage."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BeforeValidator, Field, model_validator

from adaptune.errors import nearest
from adaptune.recording.config import MOST_VIEWS, ViewConfig
from adaptune.space import ParameterSpace
from adaptune.strict import Mistake, StrictModel, validated
from adaptune.study.config import StudyConfig
from adaptune.study.study import Study
from offline.sampler_settings import (
    NAMES,
    SETTINGS,
    SINGLE_OBJECTIVE,
    STATELESS,
    SamplerError,
    check_class,
    check_sampler,
)

Metric = Literal["rte", "kitti", "rpe", "ape", "ms_per_scan", "cpu", "memory"]
"""What a trial can be judged by; `offline.objective` explains each."""
TIMED = ("ms_per_scan", "cpu", "memory")
"""Metrics that differ from run to run and from machine to machine."""
_Weighted = Annotated[dict[Metric, Annotated[float, Field(gt=0, le=1e9)]], Field(min_length=1)]


def _weighted(given: Any) -> Any:
    """Write every objective, a metric or a weighted sum of metrics, as a weighted sum."""
    objectives = given if isinstance(given, list | tuple) else [given]
    weighted = tuple({one: 1.0} if isinstance(one, str) else one for one in objectives)
    metrics = get_args(Metric)
    for weights in weighted:
        for metric in weights if isinstance(weights, dict) else ():
            if metric not in metrics:
                raise ValueError(f"there is no metric {metric!r}: {nearest(str(metric), metrics)}")
    if any(weights in weighted[:i] for i, weights in enumerate(weighted)):
        raise ValueError("names an objective twice")
    return weighted


class Limit(StrictModel):
    """What a metric may not exceed, on any training sequence."""

    max: float = Field(gt=0, le=1e9)


_GONE = {
    "halving": "wilcoxon, which saved more",
    "hyperband": "wilcoxon, which saved more",
    "both": "shared, or own",
    "episodes": "restart, or whole",
}
"""Values of earlier versions, and what to give instead."""


def _present(value: Any) -> Any:
    if isinstance(value, str) and value in _GONE:
        raise ValueError(f"{value} is gone; give {_GONE[value]}")
    return value


class OfflineConfig(StrictModel):
    """How to search for parameter sets; ``docs/reference-study.md`` describes every key."""

    sampler: str = "tpe"
    sampler_settings: dict[str, Any] = Field(default_factory=dict)
    sets: Annotated[Literal["shared", "own"], BeforeValidator(_present)] = "shared"
    trials: int | None = Field(None, ge=1, le=10**6)
    hours: float | None = Field(None, gt=0, le=1e5)
    stagnation: int | None = Field(None, ge=1, le=10**6)
    initial: int = Field(32, ge=1, le=10_000)
    batch: int = Field(16, ge=1, le=1000)
    seed: int = Field(0, ge=0, lt=2**32)
    workers: int | None = Field(None, ge=1, le=256)
    objective: Annotated[tuple[_Weighted, ...], BeforeValidator(_weighted), Field(min_length=1)] = (
        {"rte": 1.0},
    )
    limits: dict[Metric, Limit] = Field(default_factory=dict)
    runs: Annotated[Literal["restart", "whole"], BeforeValidator(_present)] = "restart"
    repeats: int = Field(1, ge=1, le=100)
    baseline_runs: int | None = Field(None, ge=1, le=1000)
    augment: Annotated[tuple[ViewConfig, ...], Field(max_length=MOST_VIEWS)] = ()
    pruning: Annotated[Literal["none", "wilcoxon"], BeforeValidator(_present)] = "none"

    @model_validator(mode="after")
    def _check_pruning(self) -> Self:
        if self.pruning != "none" and len(self.objective) > 1:
            raise ValueError("pruning goes by one objective; give one, or set pruning: none")
        if self.pruning != "none" and self.sets == "own":
            raise ValueError(
                "pruning spares trials further sequences, and with sets: own each runs on one; "
                "set pruning: none, or sets: shared"
            )
        return self

    @model_validator(mode="after")
    def _check_baseline_runs(self) -> Self:
        if self.baseline_runs is not None and self.baseline_runs < self.repeats:
            raise ValueError(f"baseline_runs must be {self.repeats} (repeats) or more")
        return self

    @property
    def metrics(self) -> set[str]:
        """All metrics that a trial is judged by."""
        return {*self.limits, *(metric for weights in self.objective for metric in weights)}

    @property
    def budgeted(self) -> bool:
        """Whether the study sets a budget."""
        return any((self.trials, self.hours, self.stagnation))

    def mistakes(self, space: ParameterSpace | None) -> Iterable[Mistake]:
        """Find mistakes in the sampler and its settings."""
        yield from self._search_mistakes(space)
        key = ("sampler_settings",)
        if len(self.objective) > 1 and self.sampler in SINGLE_OBJECTIVE:
            others = ", ".join(sorted(set(NAMES) - set(SINGLE_OBJECTIVE)))
            message = f"{self.sampler} minimises one objective only; choose one of {others}"
            yield Mistake(("sampler",), message)
        if self.sampler in SETTINGS:
            found: list[Mistake] = []
            validated(SETTINGS[self.sampler], self.sampler_settings, key, found)
            if found:
                yield from found
                return
        elif self.sampler != "tpe":  # which is always there, and need not be imported
            try:
                check_class(self.sampler)
            except SamplerError as error:
                yield Mistake(("sampler",), str(error))
                return
        below = check_sampler(self.sampler, self.sampler_settings, space, self.budgeted)
        yield from (mistake.below(key) for mistake in below)

    def _search_mistakes(self, space: ParameterSpace | None) -> Iterable[Mistake]:
        """Find samplers that cannot search among several odometries."""
        n = 1 if space is None else len(space.baselines)
        grid = "grid" in self.sampler_settings
        if n > 1 and (self.sampler not in (*STATELESS, "random") or grid):
            message = "with several odometries, choose tpe, gp or random, without a grid"
            yield Mistake(("sampler",), message)
        if self.trials is not None and self.trials < n:
            message = f"{n} odometries need {n} trials at least, to try the parameters of each"
            yield Mistake(("trials",), message)


_SEARCH = (
    *("sampler", "sampler_settings", "sets", "initial", "batch", "seed"),
    *("objective", "limits", "runs", "repeats", "baseline_runs", "pruning"),
)
"""Settings by which a search differs from another."""


class OfflineStudyConfig(StudyConfig):
    """The whole YAML of a study."""

    offline: OfflineConfig = OfflineConfig()

    @property
    def views(self) -> Mapping[str, ViewConfig]:
        """See `StudyConfig.views`."""
        views: dict[str, ViewConfig] = {}
        for view in self.offline.augment:
            same = sum(other.name == view.name for other in views.values())
            views[f"{view.name}{same + 1}" if same else view.name] = view
        return views

    def mistakes(self, space: ParameterSpace | None) -> Iterable[Mistake]:
        """See `StudyConfig.mistakes`."""
        return (mistake.below(("offline",)) for mistake in self.offline.mistakes(space))

    def resolved(self) -> dict[str, Any]:
        """See `StudyConfig.resolved`."""
        resolved, offline = super().resolved(), self.offline
        if settings := SETTINGS.get(offline.sampler):
            given = settings.model_validate(offline.sampler_settings)
            whole = given.model_dump(mode="json", exclude_none=True)
            resolved["offline"]["sampler_settings"] = whole
        return resolved

    @property
    def search_inputs(self) -> dict[str, Any]:
        """What makes the trials of a study those that they are: another search has others."""
        offline = self.resolved()["offline"]
        return {key: value for key in _SEARCH if (value := offline.get(key))}


# A study with the settings of the offline stage.


OfflineStudy = Study[OfflineStudyConfig]
"""A study with the settings of the offline stage."""


def load_study(
    path: Path | str,
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    runs: Path = Path("runs"),
) -> OfflineStudy:
    """Read and check the whole YAML of a study, see `adaptune.study.loading.read_study`."""
    from adaptune.study.loading import read_study  # which opens recordings

    return read_study(Path(path), OfflineStudyConfig, overrides, folder, runs)
