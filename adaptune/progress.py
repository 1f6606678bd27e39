"""Progress of a command: bars on a terminal, else lines in the log."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

LOG_EVERY = 5.0
"""Seconds between two lines of the log."""

Show = Callable[..., None]
"""Called with what is done, how much of it is done, how much there is, and a remark."""


@contextmanager
def show_progress(console: Console) -> Iterator[Show]:
    """Show a bar for each thing that is done; without a terminal, write a line now and then."""
    if not console.is_terminal:
        yield _logger()
        return
    bars = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[remark]}"),
        console=console,
    )
    tasks: dict[str, TaskID] = {}
    with bars:

        def show(what: str, done: int, total: int, remark: str = "") -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total, remark="")
            bars.update(tasks[what], completed=done, total=total, remark=remark)

        yield show


def _logger() -> Show:
    log = logging.getLogger("adaptune")
    last = time.monotonic()

    def show(what: str, done: int, total: int, remark: str = "") -> None:
        nonlocal last
        if done >= total or time.monotonic() - last > LOG_EVERY:
            last = time.monotonic()
            log.info("%s: %d of %d%s", what, done, total, remark and f", {remark}")

    return show
