"""When a search stops."""

import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from adaptune.archive import OF_SLOT
from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from offline.config import OfflineConfig
from offline.objective import Verdict

TRIALS = 64
"""Trials of a search without a budget."""
BUDGETS = ("trials", "hours", "stagnation", "target")
"""Settings that may change when a study is resumed."""


def max_trials(config: OfflineConfig) -> int | None:
    """Number of trials after which the search stops; None if another budget stops it."""
    if config.budgeted or config.sampler == "grid":
        return config.trials
    return TRIALS


def spent(
    config: OfflineConfig, verdicts: Sequence[Verdict], best: int, hours: float, number: int
) -> str | None:
    """Why a search stops after a batch.

    Parameters
    ----------
    config
        The budgets.
    verdicts
        Verdicts of all its trials.
    best
        Index of the best of them.
    hours
        Hours that their batches took.
    number
        Trial number of the best of them.

    Returns
    -------
    str or None
        The budget that is used up; None if the search continues.
    """
    limit = max_trials(config)
    if limit is not None and len(verdicts) >= limit:
        return f"{limit} trials are done"
    if config.hours is not None and hours >= config.hours:
        return f"{hours:.2f} hours have passed"
    if not verdicts:
        return None
    if config.target is not None and (
        verdicts[best].feasible and verdicts[best].values[0] <= config.target
    ):
        return f"trial {number} has reached the target of {config.target:g}"
    since = len(verdicts) - 1 - best
    if config.stagnation is not None and since >= config.stagnation:
        return f"none of {since} trials was better than trial {number}"
    return None


def all_done(config: OfflineConfig, folder: Path, numbers: Iterable[int]) -> bool:
    """Whether a study has no trials left, and the model is fitted to those that it has.

    Parameters
    ----------
    config
        The budgets.
    folder
        The study's. ``trials.csv``, which a run writes at its end, is newer than all trials then.
    numbers
        Numbers of the finished trials.
    """
    table, limit = folder / "trials.csv", max_trials(config)
    if not table.exists():
        return False
    ended = table.stat().st_mtime_ns
    if any(path.stat().st_mtime_ns > ended for path in (folder / "trials").glob("*/*.npz")):
        return False
    if limit is None or config.sampler == "grid":
        return True
    if any((config.hours, config.stagnation, config.target)):
        return True
    # Every search shares trial 0.
    searches = Counter(n // OF_SLOT for n in numbers if n)
    return min(searches.values(), default=0) + 1 >= limit


def more_trials(config: OfflineConfig, override: Sequence[str]) -> list[str] | None:
    """Values to run as many trials with as without a budget; None if the budget allows as many."""
    limit = max_trials(config)
    if limit is None or limit >= TRIALS or config.sampler == "grid":
        return None
    rest = [text for text in override if not text.startswith("offline.trials=")]
    return rest if len(rest) < len(override) else [*rest, f"offline.trials={TRIALS}"]


class Clock:
    """The time that batches took, kept in a file, so that a resumed search continues counting.

    The last batch of a killed process does not count.

    Raises
    ------
    AdaptuneError
        If the file is damaged.
    """

    def __init__(self, path: Path):
        self._path = path
        self._seconds: dict[str, float] = {}
        if path.exists():
            try:
                read = json.loads(path.read_text(encoding="utf-8"))
                self._seconds = {str(int(batch)): float(s) for batch, s in read.items()}
            except (ValueError, TypeError, AttributeError) as error:
                raise AdaptuneError(
                    f"{path}: is damaged ({error}); remove it, and offline.hours restarts at 0"
                ) from error

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
