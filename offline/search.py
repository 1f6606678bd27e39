"""Searches for parameter sets: one over all training sequences together, one for each, or both."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from adaptune.archive import Summary
from adaptune.space import ParameterSet
from adaptune.study import OfflineConfig, Study
from offline.budget import max_trials, spent
from offline.objective import Verdict, choose_fixed, judge, told, weighted
from offline.pruning import estimate, survivors
from offline.samplers import Sampler, make_sampler

Finished = Mapping[str, Mapping[int, Summary]]
"""The finished trials on every sequence, by number."""


class Search:
    """One search, batch by batch.

    Several searches of a study number their trials in turn: trial 0, the baseline, is of all of
    them, and trial i > 0 of search j of n is trial 1 + (i - 1) n + j of the study. So numbers
    depend on no budget.

    Parameters
    ----------
    sampler
        Proposes the sets.
    sequences
        On which they are run.
    finished
        All trials of the study.
    place
        j and n.

    Attributes
    ----------
    sequences : list of str
    verdicts : list of Verdict
        Of all trials up to the last border of a batch.
    best : int
        Which of them is best.
    numbers : list of int
        Of the trials of the batch at hand.
    order : list of str
        The sequences as they are to be run one after the other.
    end : str, optional
        Why the search is over.
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
        """Number in the study of a trial of this search."""
        j, n = self._place
        return 1 + (i - 1) * n + j if i else 0

    @property
    def done(self) -> dict[int, Verdict]:
        """The verdicts by the trials' numbers in the study."""
        return {self.number(i): verdict for i, verdict in enumerate(self.verdicts)}

    def begin(self, hours: float) -> bool:
        """Begin the next batch, and tell whether there is one.

        Parameters
        ----------
        hours
            What all batches before took.
        """
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
        """On each of the first `m` sequences, trials of the batch that are still to be run."""
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
        """Give up trials that promise little after `m` sequences."""
        if m < len(self.order):
            before = self._values(self.done, self.order)
            batch = self._values(self._alive, self.order[:m])
            self._alive = survivors(self._config.pruning, m, batch, before)

    def close(self) -> None:
        """End the batch, whose trials are all finished or given up."""
        first = len(self.verdicts)
        of = (self._config, self.sequences, self._finished)
        self.verdicts += [assess(n, self.sequences, *of) for n in self.numbers]
        candidates = (self.best, *range(first, len(self.verdicts)))
        self.best = min(candidates, key=lambda i: _rank(self.verdicts[i]))
        if len(self.numbers) < self._config.batch and len(self.verdicts) != self._limit:
            self.end = self._sampler.end
        self.numbers = []

    def total(self) -> int:
        """How many runs it will take at most, or has taken up to the end of this batch."""
        n_trials = len(self.verdicts) if self.end else self._limit
        n_trials = len(self.verdicts) + len(self.numbers) if n_trials is None else n_trials
        return n_trials * len(self.sequences)

    def _propose(self) -> None:
        sets = self._sampler.propose(told(self.verdicts))
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
        """Of those that keep the limits, values on the sequences that they were run on."""
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
    """What a trial came to on some sequences, or would have if it had been run on all of them.

    Parameters
    ----------
    number
        Of the trial.
    counted
        Sequences that count, if it was run there.
    config
        Objectives and limits.
    sequences
        All of them.
    finished
        The trials of the study.
    """
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
    """Searches that go on side by side.

    Attributes
    ----------
    searches : list of Search
    alone : bool
        Whether each is of one sequence.
    """

    searches: list[Search]
    alone: bool


def make_stages(study: Study, finished: Finished) -> list[Stage]:
    """What a study searches for, in its order.

    Parameters
    ----------
    study
        The study.
    finished
        Its trials, on every training sequence.
    """
    config, names = study.config.offline, study.training
    shared = [names] if config.sets != "own" else []
    own = [[name] for name in names] if config.sets != "shared" else []
    searches = []
    for j, sequences in enumerate([*shared, *own]):
        seed = config.seed
        if j >= len(shared):
            seed = int(np.random.SeedSequence((seed, j - len(shared))).generate_state(1)[0])
        sampler = make_sampler(study.space, config.model_copy(update={"seed": seed}))
        searches.append(Search(sampler, sequences, finished, (j, len(shared) + len(own))))
    n = len(shared)
    return [Stage(s, alone) for s, alone in ((searches[:n], False), (searches[n:], True)) if s]


def best_of_each(config: OfflineConfig, stage: Stage) -> dict[int, Verdict]:
    """The best sets of a stage's searches that keep the limits, by number.

    Parameters
    ----------
    config
        Of the study.
    stage
        Searches that are over.
    """
    best = {}
    for search in stage.searches:
        if any(verdict.feasible for verdict in search.verdicts):
            number = choose_fixed(config, search.done)
            best[number] = search.done[number]
    return best


def owner(config: OfflineConfig, sequences: Sequence[str], number: int) -> str | None:
    """The sequence that a trial's set was searched for on, if on one alone.

    Parameters
    ----------
    config
        Of the study.
    sequences
        All that are trained on.
    number
        Of the trial.
    """
    n_shared = 0 if config.sets == "own" else 1
    if config.sets == "shared" or number == 0:
        return None
    j = (number - 1) % (len(sequences) + n_shared) - n_shared
    return sequences[j] if j >= 0 else None
