"""When a search has had enough."""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.sampling import TRIALS
from adaptune.study import OfflineConfig
from offline.objective import Verdict

BUDGETS = ("trials", "hours", "stagnation", "target")
"""Settings that may change from run to run."""


def max_trials(config: OfflineConfig) -> int | None:
    """Number of trials after which to stop; none if only something else says when."""
    if config.budgeted or config.sampler == "grid":
        return config.trials
    return TRIALS


def spent(
    config: OfflineConfig, verdicts: Sequence[Verdict], best: int, hours: float, number: int
) -> str | None:
    """Tell why a search stops at the border of a batch.

    Parameters
    ----------
    config
        The budgets.
    verdicts
        Of all trials up to the border.
    best
        Number of the best of them.
    hours
        What their batches took.
    number
        By which users know the best.

    Returns
    -------
    str or None
        The budget that is used up; none if the search goes on.
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


class Clock:
    """How long batches took, kept in a file, so that a search that is resumed goes on counting.

    What a process that was killed had spent on its last batch is not counted.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    AdaptuneError
        If it is not what this class wrote.
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
                    f"{path}: is damaged ({error}); remove it, and offline.hours counts anew"
                ) from error

    def hours(self, n_batches: int) -> float:
        """What the first batches took."""
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
