"""How far a long task is, and how that is shown."""

import logging
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Task, TaskID

T = TypeVar("T")


class Progress(Protocol):
    """Takes note of how far a task is."""

    def __call__(self, text: str, done: float, of: int, remark: str = "", /) -> None:
        """Note what is done, how much of it, and how much there is; half a run is a fraction."""


def unseen(text: str, done: float, of: int, remark: str = "", /) -> None:
    """Take no note."""


def watched(scans: Iterable[T], n: int, what: str, progress: Progress) -> Iterator[T]:
    """The same, and note how many of `n` are done."""
    done = 0
    for done, scan in enumerate(scans, start=1):
        yield scan
        progress(what, min(done, n), n)
    progress(what, done, done)


LOG_EVERY, BRIEF = 5.0, 2.0
"""Seconds between two lines about progress in a log, and of a task that gets none."""
MOST_FINISHED = 8
"""Bars that stay on the screen when they are full."""


@contextmanager
def bars(console: "Console") -> Iterator[Progress]:
    """Show a bar for each thing that is done; without a terminal, write a line now and then."""
    from rich import progress as columns

    shown = columns.Progress(
        columns.TextColumn("{task.description}", markup=False),
        columns.BarColumn(),
        columns.MofNCompleteColumn(),
        columns.TimeElapsedColumn(),
        columns.TextColumn("{task.fields[remark]}", markup=False),
        console=console,
        get_time=time.monotonic,
    )
    tasks: dict[str, TaskID] = {}
    log, logged = logging.getLogger("adaptune"), time.monotonic()

    def show(what: str, done: float, total: int, remark: str = "", /) -> None:
        nonlocal logged
        if what not in tasks:
            over = [task.id for task in shown.tasks if task.finished]
            for finished in over[:-MOST_FINISHED]:
                shown.update(finished, visible=False)
            tasks[what] = shown.add_task(what, total=total, remark="")
        task = shown.tasks[tasks[what]]
        # Several workers may read the same, one after the other.
        if task.finished and task.total == total:
            return
        # What a resumed study has done already comes in the first moment, and says nothing.
        shown.speed_estimate_period = 0.8 * (task.elapsed or 0.0)
        shown.update(task.id, completed=done, total=max(total, done))
        words = ", ".join(filter(None, (_time_left(task), remark)))
        shown.update(task.id, remark=words)
        due = time.monotonic() - logged > LOG_EVERY and (task.elapsed or 0.0) > BRIEF
        if due and not console.is_terminal:
            logged = time.monotonic()
            log.info("%s: %d of %d%s", what, done, total, words and f", {words}")

    with shown if console.is_terminal else nullcontext():
        yield show


@contextmanager
def bars_and_words() -> Iterator[Progress]:
    """The same, and what is logged meanwhile, for a session that has set up no logging."""
    from rich.console import Console
    from rich.highlighter import NullHighlighter
    from rich.logging import RichHandler

    # A notebook asks for colours, and stores all that is written.
    live = sys.stderr.isatty()
    console = Console(
        stderr=True, force_terminal=live, force_jupyter=False, emoji=False, highlight=False
    )
    with bars(console) as show, ExitStack() as stack:
        if not logging.getLogger().handlers:
            handler = RichHandler(
                console=console, show_level=False, show_path=False, highlighter=NullHighlighter()
            )
            for log in map(logging.getLogger, ("adaptune", "offline", "online")):
                stack.callback(log.setLevel, log.level)
                stack.callback(log.removeHandler, handler)
                log.setLevel(logging.INFO)
                log.addHandler(handler)
        yield show


def _time_left(task: "Task") -> str:
    """In words; empty before a first piece is done, and in the first seconds."""
    seconds = task.time_remaining
    return about(seconds) + " left" if seconds and (task.elapsed or 0.0) >= LOG_EVERY else ""


def about(seconds: float) -> str:
    """A time in words."""
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds > 2.0 * length:
            return f"about {seconds / length:.0f} {unit}"
    return f"about {seconds:.0f} s"
