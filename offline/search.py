"""Searches for parameter sets: one over all training sequences, one for each, or both."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from adaptune.archive import Summary
from adaptune.space import ParameterSet, ParameterSpace
from offline.budget import max_trials, spent
from offline.config import OfflineConfig
from offline.objective import Verdict, best_by_trials, judge, sampler_results, weighted
from offline.pruning import estimate, survivors
from offline.samplers import make_sampler
from offline.samplers.base import Sampler

Finished = Mapping[str, Mapping[int, Summary]]
"""By sequence, the finished trials by their numbers."""


class Search:
    """One search, batch by batch.

    Several searches of a study number their trials in turn: all of them share trial 0, the
    baseline, and trial i > 0 of search j of n is trial 1 + (i - 1) n + j of the study. So numbers
    do not depend on a budget.

    Attributes
    ----------
    sequences : list of str
    verdicts : list of Verdict
        Verdicts of the trials of all batches that are closed.
    best : int
        Index of the best of them.
    numbers : list of int
        Trial numbers of the present batch.
    order : list of str
        The sequences in the order in which they are run.
    end : str, optional
        Why the search has ended.
    """

    def __init__(
        self, sampler: Sampler, sequences: Sequence[str], finished: Finished, place: tuple[int, int]
    ):
        self.sequences = list(sequences)
        self.verdicts: list[Verdict] = []
        self.best = 0
        self.numbers: list[int] = []
        self.order = self.sequences
        self.end: str | None = None
        self._sampler = sampler
        self._config = sampler.config
        self._limit = max_trials(sampler.config)
        self._finished = finished
        self._place = place
        self._alive: list[int] = []
        self._sets: dict[int, ParameterSet] = {}

    def number(self, i: int) -> int:
        """Trial number in the study of trial `i` of this search."""
        j, n = self._place
        return 1 + (i - 1) * n + j if i else 0

    @property
    def done(self) -> dict[int, Verdict]:
        """The verdicts by trial number."""
        return {self.number(i): verdict for i, verdict in enumerate(self.verdicts)}

    def begin(self, hours: float) -> bool:
        """Begin the next batch after so many hours; False if the search has ended."""
        if self.end is None:
            best = self.number(self.best)
            self.end = spent(self._config, self.verdicts, self.best, hours, best)
        if self.end is not None:
            return False
        first, size = len(self.verdicts), self._config.batch
        stop = first + size if self._limit is None else min(first + size, self._limit)
        self.numbers = [self.number(i) for i in range(first, stop)]
        self._sets = {}
        if first and self._config.pruning != "none":
            self.order = self._hardest_first()
        if any(n not in self._finished[self.order[0]] for n in self.numbers):
            self._propose()
            self.numbers = self.numbers[: len(self._sets)]
        if not self.numbers:
            self.end = self._sampler.end
            return False
        self._alive = list(self.numbers)
        return True

    def missing(self, m: int) -> dict[str, list[int]]:
        """Trials of the batch still to be run, for each of the first `m` sequences."""
        return {
            name: [n for n in self._alive if n not in self._finished[name]]
            for name in self.order[:m]
        }

    def parameters(self, number: int) -> ParameterSet:
        """The set of a trial of the batch."""
        if not self._sets:
            self._propose()
        return self._sets[number]

    def prune(self, m: int) -> None:
        """Stop trials that promise little after `m` sequences."""
        if m < len(self.order):
            before = self._values(self.done, self.order)
            batch = self._values(self._alive, self.order[:m])
            self._alive = survivors(self._config.pruning, m, batch, before)

    def close(self) -> None:
        """Close the batch, whose trials have all finished or stopped."""
        first = len(self.verdicts)
        of = (self._config, self.sequences, self._finished)
        self.verdicts += [assess(n, self.sequences, *of) for n in self.numbers]
        candidates = (self.best, *range(first, len(self.verdicts)))
        self.best = min(candidates, key=lambda i: _rank(self.verdicts[i]))
        if len(self.numbers) < self._config.batch and len(self.verdicts) != self._limit:
            self.end = self._sampler.end
        self.numbers = []

    def total(self) -> int:
        """The most runs that the search takes; without a limit, the runs up to this batch."""
        n_trials = len(self.verdicts) if self.end else self._limit
        n_trials = len(self.verdicts) + len(self.numbers) if n_trials is None else n_trials
        return n_trials * len(self.sequences)

    def _propose(self) -> None:
        sets = self._sampler.propose(sampler_results(self.verdicts))
        self._sets = dict(zip(self.numbers, sets, strict=False))

    def _hardest_first(self) -> list[str]:
        """The sequences by falling mean of the first objective over the first batch."""
        first = [self.number(i) for i in range(min(self._config.batch, len(self.verdicts)))]
        means = {
            name: np.mean([self._value(self._finished[name][n]) for n in first])
            for name in self.sequences
        }
        return sorted(means, key=lambda name: -means[name])

    def _values(self, numbers: Iterable[int], seen: Sequence[str]) -> dict[int, list[float]]:
        """Values of the trials that keep the limits, on the sequences on which they were run."""
        of_numbers = {
            n: [run for name in seen if (run := self._finished[name].get(n))] for n in numbers
        }
        return {
            n: [self._value(run) for run in runs]
            for n, runs in of_numbers.items()
            if judge(self._config, runs).feasible
        }

    def _value(self, run: Summary) -> float:
        return weighted(self._config.objective[0], run.metrics)


def assess(
    number: int,
    counted: Sequence[str],
    config: OfflineConfig,
    sequences: Sequence[str],
    finished: Finished,
) -> Verdict:
    """Judge a trial; estimate its values if it was not run on all sequences."""
    seen = tuple(name for name in sequences if name in counted and number in finished[name])
    found = judge(config, [finished[name][number] for name in seen])
    if len(seen) == len(sequences):
        return found._replace(sequences=seen)
    order = (*seen, *(name for name in sequences if name not in seen))
    values = tuple(
        estimate(
            [weighted(weights, finished[name][number].metrics) for name in seen],
            [weighted(weights, finished[name][0].metrics) for name in order],
        )
        for weights in config.objective
    )
    return found._replace(values=values, complete=False, sequences=seen)


def _rank(verdict: Verdict) -> tuple[bool, float, float]:
    return not verdict.complete, verdict.excess, verdict.values[0]


class Stage(NamedTuple):
    """Searches that run side by side."""

    searches: list[Search]
    alone: bool  # whether each search uses one sequence alone


def make_stages(
    config: OfflineConfig, space: ParameterSpace, names: list[str], finished: Finished
) -> list[Stage]:
    """Make the searches of a study, in their order."""
    shared = [names] if config.sets != "own" else []
    own = [[name] for name in names] if config.sets != "shared" else []
    searches = []
    for j, sequences in enumerate([*shared, *own]):
        seed = config.seed
        if j >= len(shared):
            seed = int(np.random.SeedSequence((seed, j - len(shared))).generate_state(1)[0])
        sampler = make_sampler(space, config.model_copy(update={"seed": seed}))
        searches.append(Search(sampler, sequences, finished, (j, len(shared) + len(own))))
    n = len(shared)
    return [Stage(s, alone) for s, alone in ((searches[:n], False), (searches[n:], True)) if s]


def best_of_each(config: OfflineConfig, stage: Stage) -> dict[int, Verdict]:
    """The best set of each search that keeps the limits, by trial number."""
    best = {}
    for search in stage.searches:
        if any(verdict.feasible for verdict in search.verdicts):
            number = best_by_trials(config, search.done)
            best[number] = search.done[number]
    return best


def owner(config: OfflineConfig, sequences: Sequence[str], number: int) -> str | None:
    """The sequence whose own search proposed a trial's set; None for a shared search."""
    n_shared = 0 if config.sets == "own" else 1
    if config.sets == "shared" or number == 0:
        return None
    j = (number - 1) % (len(sequences) + n_shared) - n_shared
    return sequences[j] if j >= 0 else None
