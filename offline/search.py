"""The search for parameter sets that all training sequences share."""

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from adaptune._system.files import write_text
from adaptune.runs.archive import TrialSummary
from adaptune.space import ParameterSet, ParameterSpace
from offline.config import OfflineConfig
from offline.objective import JudgedSet, judge, sampler_results

if TYPE_CHECKING:
    from offline.samplers import Sampler

BUDGETS = ("trials", "hours", "stagnation")
"""Settings that may change when a study is resumed."""


TIME_IS_UP = "no more sets fit into the time"
"""Why a search ends."""
ELAPSED = "elapsed.json"
"""What a `Stopwatch` keeps, in a study's folder."""


class Stopwatch:
    """The time that a search took, kept in a file, so that a resumed one continues counting.

    What a damaged file says does not count. Of the time that is allowed, also the `replays` of the
    test may have to come.
    """

    def __init__(self, path: Path, replays: bool = False):
        self._path, self._begin, self.replays = path, time.monotonic(), replays

    @cached_property
    def _before(self) -> float:
        with suppress(OSError, ValueError, TypeError, KeyError):
            return float(json.loads(self._path.read_text(encoding="utf-8"))["seconds"])
        return 0.0

    @property
    def hours(self) -> float:
        """Hours that it took so far."""
        return (self._before + time.monotonic() - self._begin) / 3600.0

    def save(self, least: float = 0.0) -> None:
        """Keep the time so far, at least so many hours."""
        seconds = 3600.0 * max(self.hours, least)
        write_text(self._path, json.dumps({"seconds": seconds}) + "\n")


Finished = Mapping[str, Mapping[int, TrialSummary]]
"""By sequence, the finished trials by their numbers."""


class Search:
    """The search, trial by trial.

    Trial 0 is the baseline; the `first` sets follow. `OfflineConfig.batch` trials run at a time: a
    set follows from the results of all trials but the last ones before it. So it does not matter
    when each of them finished, nor how often the search was stopped. A number keeps its set: one
    that ran on any sequence is not proposed anew where others are added.
    """

    def __init__(
        self,
        config: OfflineConfig,
        space: ParameterSpace,
        finished: Finished,
        known: Mapping[int, TrialSummary],
        first: Sequence[ParameterSet] = (),
    ):
        self.sets: dict[int, ParameterSet] = {}  # by number, in the order in which they began
        self.sources: dict[int, str] = {}  # what proposed each, see `Proposal`
        self.done: dict[int, JudgedSet] = {}  # by number, those that are finished everywhere
        self.end: str | None = None  # why no more trials begin
        self._config, self._space, self._limit = config, space, config.most_trials
        self._finished, self._known, self._first = finished, dict(known), first

    @cached_property
    def _sampler(self) -> "Sampler":
        # Where nothing is to be proposed, it is not needed, and Optuna takes a second to import.
        from offline.samplers import make_sampler

        return make_sampler(self._space, self._config, self._first)

    @property
    def best(self) -> int:
        """Number of the best trial that is done."""
        return min(self.done, key=lambda n: (bool(self.done[n].failure), self.done[n].value))

    @property
    def total(self) -> int:
        """The most trials of the search; without a limit, those that began."""
        return len(self.sets) if self.end or self._limit is None else self._limit

    def begin(self, hours: float) -> int | None:
        """Begin a trial with which all is done after so many hours, unless these are too many.

        Returns its number, None if none can begin now.
        """
        for number in [n for n in self.sets if n not in self.done]:
            if all(number in of for of in self._finished.values()):
                trials = {name: of[number] for name, of in self._finished.items()}
                self.done[number] = judge(self._config, trials)
        order = list(self.sets)
        seen = order[: max(0, len(order) - self._config.batch + 1)]
        if self.end is not None or any(n not in self.done for n in seen):
            return None
        self.end = self._spent([self.done[n] for n in seen])
        return None if self.end else self._next(order, seen, hours)

    def _spent(self, seen: Sequence[JudgedSet]) -> str | None:
        """The budget that is used up, in words."""
        if self._limit is not None and len(self.sets) >= self._limit:
            return f"{self._limit} trials are done"
        if not seen or self._config.stagnation is None:
            return None
        best = min(range(len(seen)), key=lambda i: (bool(seen[i].failure), seen[i].value))
        if (since := len(seen) - 1 - best) < self._config.stagnation:
            return None
        return f"none of {since} trials was better than the best before"

    def _next(self, order: Sequence[int], seen: Sequence[int], hours: float) -> int | None:
        """Begin the next trial; None if there is none, for the reason in `end`."""
        number = next(n for n in count() if n not in self.sets)
        if number not in self._known:
            over = self._config.hours is not None and hours >= self._config.hours
            over &= number >= len(self._space.baselines)
            end = TIME_IS_UP if over else self._sampler.end
            proposal = None
            if not over:
                results = sampler_results([self.done[n] for n in seen])
                running = [self.sets[n] for n in order[len(seen) :]]
                proposal = self._sampler.propose(results, running)
            # Of a finite space, later ones may have been run before.
            left = [n for n in self._known if n not in self.sets]
            if proposal is None:
                if not left:
                    self.end = end
                    return None
                number = min(left)
            elif same := [n for n in left if self._known[n].parameters == proposal.parameters]:
                number = same[0]
            else:
                self.sets[number], self.sources[number] = proposal
                return number
        self.sets[number] = self._known[number].parameters
        self.sources[number] = self._known[number].source
        return number
