"""What every command shares: where it prints, its progress, and its exit after an error."""

import logging
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from rich.progress import TaskID

# Text of files is printed as it is: no markup, no emoji.
_literal: Any = {"markup": False, "emoji": False, "highlight": False}
# In a pipe, tables and logs are not wrapped, unless COLUMNS gives a width.
_wide = None if "COLUMNS" in os.environ else 200
console = Console(width=None if sys.stdout.isatty() else _wide, **_literal)
errors = Console(stderr=True, width=None if sys.stderr.isatty() else _wide, **_literal)


class Commands(TyperGroup):
    """Exits with code 2 after an error that the user can correct, and with 130 after Ctrl-C."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except (AdaptuneError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise  # nobody reads the output any more
            errors.print(f"error: {error}", style="red", soft_wrap=True)
            raise typer.Exit(2) from error
        except KeyboardInterrupt as error:
            errors.print("interrupted; run the same command again to resume", style="yellow")
            raise typer.Exit(130) from error


def say(text: str) -> None:
    """Print plain text, on one line however narrow the terminal is."""
    console.print(text, soft_wrap=True)


def begin_work() -> None:
    """From here on, let Ctrl-C raise an exception, so that what is begun is put in order."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


LOG_EVERY = 5.0
"""Seconds between two lines about progress in a log."""

MOST_FINISHED = 8
"""Bars that stay on the screen when they are full."""

Show = Callable[..., None]
"""Called with what is done, how much of it is done, how much there is, and a remark.

How much is done may be a fraction: half a run, say.
"""


@contextmanager
def progress(above: Any = None) -> Iterator[Show]:
    """Show a bar for each thing that is done; without a terminal, write a line now and then.

    In a terminal, `above` stands over the bars: something that rich can render, again and again.
    """
    begin_work()
    if not errors.is_terminal:
        yield _logger()
        return
    from rich.console import Group
    from rich.live import Live
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    bars = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[remark]}", markup=False),
        console=errors,
    )
    tasks: dict[str, TaskID] = {}
    pace, full = _Pace(), _Full()
    shown = bars if above is None else Live(Group(above, bars), console=errors)
    with shown:

        def show(what: str, done: float, total: int, remark: str = "") -> None:
            if full.again(what, done, total):
                return
            if what not in tasks:
                over = [task.id for task in bars.tasks if task.finished]
                for finished in over[:-MOST_FINISHED]:
                    bars.update(finished, visible=False)
                tasks[what] = bars.add_task(what, total=total, remark="")
            words = ", ".join(filter(None, (pace.left(what, done, total), remark)))
            bars.update(tasks[what], completed=done, total=max(total, done), remark=words)

        yield show


def _logger() -> Show:
    log = logging.getLogger("adaptune")
    last = time.monotonic()
    pace, full = _Pace(), _Full()

    def show(what: str, done: float, total: int, remark: str = "") -> None:
        nonlocal last
        if full.again(what, done, total):
            return
        now = time.monotonic()
        left = pace.left(what, done, total, now)
        if now - last > LOG_EVERY:
            last = now
            words = (f"{what}: {int(done)} of {total}", left, remark)
            log.info("%s", ", ".join(filter(None, words)))

    return show


class _Pace:
    """How long each thing will take, by how long it took in the newer half of the time so far.

    What a study that is resumed has done already comes in the first moment, and says nothing.
    """

    def __init__(self) -> None:
        self._begun: dict[str, float] = {}
        self._past: dict[str, deque[tuple[float, float]]] = {}  # when, and how much was done

    def left(self, what: str, done: float, total: int, now: float | None = None) -> str:
        """In words; empty before a first piece is done, and in the first seconds."""
        now = time.monotonic() if now is None else now
        past = self._past.setdefault(what, deque())
        if not past or done < past[0][1] or done == past[-1][1] == past[0][1]:
            self._begun[what] = now
            past.clear()
        elapsed = now - self._begun[what]
        if not past or now - past[-1][0] > 0.01 * elapsed:
            past.append((now, done))
        while len(past) > 1 and past[1][0] <= now - 0.5 * elapsed:
            past.popleft()
        seconds, gained = now - past[0][0], done - past[0][1]
        if gained < 1.0 or elapsed < LOG_EVERY or done >= total:
            return ""
        return _time_left((total - done) * seconds / gained)


class _Full:
    """What was done completely: several workers may read the same, one after the other."""

    def __init__(self) -> None:
        self._totals: dict[str, int] = {}

    def again(self, what: str, done: float, total: int) -> bool:
        """Whether it is done once more."""
        if done >= total:
            self._totals[what] = total
        return done < total == self._totals.get(what)


def _time_left(seconds: float) -> str:
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds > 2.0 * length:
            return f"about {seconds / length:.0f} {unit} left"
    return f"about {seconds:.0f} s left"
