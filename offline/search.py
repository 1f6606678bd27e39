"""The search for parameter sets that all training sequences share."""

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from itertools import count, islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adaptune.archive import Summary
from adaptune.files import write_text
from adaptune.space import ParameterSet, ParameterSpace
from offline.config import OfflineConfig
from offline.objective import Verdict, judge, sampler_results, weighted

if TYPE_CHECKING:
    from offline.samplers import Sampler

# Pruning: the first batch runs in full, and shows which sequences are hard. Later trials run on
# these first, and stop where they cannot win any more, or where a signed-rank test finds them worse
# than the best trial on the same sequences, as Optuna's `WilcoxonPruner` does.


SIGNIFICANCE = 0.1
"""A difference counts as more than chance if the test's p is below this."""

Values = Sequence[float]
"""A trial's objective on the sequences on which it was run, in their order."""


def rungs(pruning: bool, batch: int, n: int) -> list[int]:
    """Numbers of sequences after which trials of a batch may stop; the last one is `n`, all."""
    return [*range(2, n), n] if pruning and batch and n > 2 else [n]


def survivors(batch: Mapping[int, Values], before: Mapping[int, Values]) -> list[int]:
    """Numbers of the trials of a batch that continue.

    Values are by trial number, of this batch and of all usable trials before.
    """
    if not before:
        return list(batch)
    n_sequences = max(map(len, before.values()))
    best = min((v for v in before.values() if len(v) == n_sequences), key=sum)
    # Values are never negative: a sum over some sequences is no more than that over all.
    return [n for n, own in batch.items() if sum(own) <= sum(best) and not _worse(own, best)]


def _worse(values: Values, best: Values) -> bool:
    from scipy import stats  # slow to import

    if len(values) < 2 or np.mean(values) <= np.mean(best):
        return False
    differences = np.subtract(values, best[: len(values)])
    test = stats.wilcoxon(differences, alternative="greater", zero_method="zsplit")
    return bool(test.pvalue < SIGNIFICANCE)


def estimate(values: Values, baseline: Values) -> float:
    """Estimate the mean of a stopped trial from its ratio so far to the whole baseline."""
    seen = float(np.mean(baseline[: len(values)]))
    return float(np.mean(values)) * (float(np.mean(baseline)) / seen if seen > 0.0 else 1.0)


TRIALS = 64
"""Trials of a search without a budget."""
BUDGETS = ("trials", "hours", "stagnation")
"""Settings that may change when a study is resumed."""


def max_trials(config: OfflineConfig) -> int | None:
    """Number of trials after which the search stops; None if another budget stops it."""
    if config.budgeted or config.sampler == "grid":
        return config.trials
    return TRIALS


def spent(config: OfflineConfig, trials: Sequence[int], best: int, hours: float) -> str | None:
    """The budget that is used up after a batch, in words; None if the search continues.

    `trials` has the numbers of the trials that are done, in their order, among them the `best`.
    """
    limit = max_trials(config)
    if limit is not None and len(trials) >= limit:
        return f"{limit} trials are done"
    if config.hours is not None and hours >= config.hours:
        return f"{hours:.2f} hours have passed"
    if not trials:
        return None
    since = len(trials) - 1 - trials.index(best)
    if config.stagnation is not None and since >= config.stagnation:
        return f"none of {since} trials was better than trial {best}"
    return None


class Clock:
    """The time that batches took, kept in a file, so that a resumed search continues counting.

    The last batch of a killed process does not count, nor what a damaged file says.
    """

    def __init__(self, path: Path):
        self._path = path
        self._seconds: dict[str, float] = {}
        with suppress(OSError, ValueError, TypeError, AttributeError):
            read = json.loads(path.read_text(encoding="utf-8"))
            self._seconds = {str(int(batch)): float(s) for batch, s in read.items()}

    def hours(self, n_batches: int) -> float:
        """Hours that the first batches took."""
        return sum(s for batch, s in self._seconds.items() if int(batch) < n_batches) / 3600.0

    @contextmanager
    def running(self, batch: int) -> Iterator[None]:
        """Count the time in this block for a batch."""
        begin = time.monotonic()
        try:
            yield
        finally:
            took = time.monotonic() - begin
            self._seconds[str(batch)] = self._seconds.get(str(batch), 0.0) + took
            write_text(self._path, json.dumps(self._seconds) + "\n")


Finished = Mapping[str, Mapping[int, Summary]]
"""By sequence, the finished trials by their numbers."""


class Search:
    """The search, batch by batch.

    Trial 0 is the baseline, and numbers do not depend on a budget. A number keeps its set: one that
    ran on any sequence is not proposed anew where others are added.
    """

    def __init__(
        self,
        config: OfflineConfig,
        space: ParameterSpace,
        sequences: Sequence[str],
        finished: Finished,
        known: Mapping[int, ParameterSet],
    ):
        self.sequences = list(sequences)
        self.done: dict[int, Verdict] = {}  # by number, trials of all batches that are closed
        self.best = 0  # trial number of the best of them
        self.numbers: list[int] = []  # trial numbers of the present batch
        self.order = self.sequences  # in which they are run
        self.end: str | None = None  # why the search has ended
        self._config, self._space = config, space
        self._limit = max_trials(config)
        self._finished, self._known = finished, known
        self._alive: list[int] = []
        self._sets: dict[int, ParameterSet] = {}

    @cached_property
    def _sampler(self) -> "Sampler":
        # Where nothing is to be proposed, it is not needed, and Optuna takes a second to import.
        from offline.samplers import make_sampler

        return make_sampler(self._space, self._config)

    def begin(self, hours: float) -> bool:
        """Begin the next batch after so many hours; False if the search has ended."""
        if self.end is None:
            self.end = spent(self._config, list(self.done), self.best, hours)
        if self.end is not None:
            return False
        first, size = len(self.done), self._config.batch
        stop = first + size if self._limit is None else min(first + size, self._limit)
        # Of a finite space, later ones may have been run before.
        numbers = (n for n in count(first) if n not in self.done)
        self.numbers = list(islice(numbers, stop - first))
        self._sets = {n: self._known[n] for n in self.numbers if n in self._known}
        if first and self._config.pruning == "wilcoxon":
            self.order = self._hardest_first()
        if len(self._sets) < len(self.numbers):
            proposed = self._sampler.propose(sampler_results(list(self.done.values())))
            new = [s for s in proposed if s not in self._sets.values()]
            unknown = [n for n in self.numbers if n not in self._sets]
            self._sets |= zip(unknown, new, strict=False)
            self.numbers = [n for n in self.numbers if n in self._sets]
        if not self.numbers:
            self.end = self._sampler.end
            return False
        self._alive = list(self.numbers)
        return True

    def missing(self, m: int) -> list[tuple[str, dict[int, ParameterSet]]]:
        """Sets by number of the trials still to be run, on each of the first `m` sequences."""
        return [
            (name, {n: self._sets[n] for n in self._alive if n not in self._finished[name]})
            for name in self.order[:m]
        ]

    def prune(self, m: int) -> None:
        """Stop trials that promise little after `m` sequences."""
        if m < len(self.order):
            before = self._values(self.done, self.order)
            batch = self._values(self._alive, self.order[:m])
            self._alive = survivors(batch, before)

    def close(self) -> None:
        """Close the batch, whose trials have all finished or stopped."""
        of = (self._config, self.sequences, self._finished)
        self.done |= {n: assess(n, *of) for n in self.numbers}
        ranks = {n: (not v.complete, bool(v.failure), v.value) for n, v in self.done.items()}
        self.best = min(ranks, key=ranks.__getitem__)
        if len(self.numbers) < self._config.batch and len(self.done) != self._limit:
            self.end = self._sampler.end
        self.numbers = []

    def total(self) -> int:
        """The most runs that the search takes; without a limit, the runs up to this batch."""
        n_trials = len(self.done) if self.end else self._limit
        n_trials = len(self.done) + len(self.numbers) if n_trials is None else n_trials
        return n_trials * len(self.sequences)

    def _hardest_first(self) -> list[str]:
        """The sequences by falling mean of the objective over the first batch."""
        first = list(self.done)[: self._config.batch]
        means = {
            name: np.mean([self._value(self._finished[name][n]) for n in first])
            for name in self.sequences
        }
        return sorted(means, key=lambda name: -means[name])

    def _values(self, numbers: Iterable[int], seen: Sequence[str]) -> dict[int, list[float]]:
        """Values of the usable trials, on the sequences on which they were run."""
        of_numbers = {
            n: [run for name in seen if (run := self._finished[name].get(n))] for n in numbers
        }
        return {
            n: [self._value(run) for run in runs]
            for n, runs in of_numbers.items()
            if not any(run.failure for run in runs)
        }

    def _value(self, run: Summary) -> float:
        return weighted(self._config.objective, run.metrics)


def assess(
    number: int, config: OfflineConfig, sequences: Sequence[str], finished: Finished
) -> Verdict:
    """Judge a trial; estimate its value if it was not run on all sequences."""
    seen = tuple(name for name in sequences if number in finished[name])
    found = judge(config, [finished[name][number] for name in seen])
    if len(seen) == len(sequences):
        return found._replace(sequences=seen)
    order = (*seen, *(name for name in sequences if name not in seen))
    value = estimate(
        [weighted(config.objective, finished[name][number].metrics) for name in seen],
        [weighted(config.objective, finished[name][0].metrics) for name in order],
    )
    return found._replace(value=value, complete=False, sequences=seen)
