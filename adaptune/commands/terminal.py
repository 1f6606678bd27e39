"""What every command shares: where it prints, its progress, and its exit after an error."""

import logging
import math
import os
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from adaptune.errors import AdaptuneError
from adaptune.progress import Progress

if TYPE_CHECKING:
    from rich.progress import Task, TaskID
    from rich.table import Table

    from adaptune.space import Selection
    from offline.config import OfflineStudy
    from online.replay import ReplayRecord


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
            raise typer.Exit(getattr(error, "exit_code", 2)) from error
        except KeyboardInterrupt as error:
            errors.print("interrupted; run the same command again to resume", style="yellow")
            raise typer.Exit(130) from error


def say(text: str) -> None:
    """Print plain text, on one line however narrow the terminal is."""
    console.print(text, soft_wrap=True)


def show_table(title: str, rows: Sequence[Mapping[str, Any]], caption: str = "") -> None:
    """Print a table, or several below each other where the terminal is narrow."""
    from adaptune.report.tables import Listing, tables_within

    console.print(*tables_within(Listing(title, rows, caption), console.width), sep="\n")


def begin_work() -> None:
    """From here on, let Ctrl-C raise an exception, so that what is begun is put in order."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


LOG_EVERY = 5.0
"""Seconds between two lines about progress in a log."""

MOST_FINISHED = 8
"""Bars that stay on the screen when they are full."""


@contextmanager
def progress(above: Any = None) -> Iterator[Progress]:
    """Show a bar for each thing that is done; without a terminal, write a line now and then.

    In a terminal, `above` stands over the bars: something that rich can render, again and again.
    """
    begin_work()
    from rich import progress as columns
    from rich.console import Group
    from rich.live import Live

    bars = columns.Progress(
        columns.TextColumn("{task.description}", markup=False),
        columns.BarColumn(),
        columns.MofNCompleteColumn(),
        columns.TimeElapsedColumn(),
        columns.TextColumn("{task.fields[remark]}", markup=False),
        console=errors,
        get_time=time.monotonic,
    )
    tasks: dict[str, TaskID] = {}
    log, told = logging.getLogger("adaptune"), time.monotonic()

    def show(what: str, done: float, total: int, remark: str = "", /) -> None:
        nonlocal told
        if what not in tasks:
            over = [task.id for task in bars.tasks if task.finished]
            for finished in over[:-MOST_FINISHED]:
                bars.update(finished, visible=False)
            tasks[what] = bars.add_task(what, total=total, remark="")
        task = bars.tasks[tasks[what]]
        # Several workers may read the same, one after the other.
        if task.finished and task.total == total:
            return
        # What a resumed study has done already comes in the first moment, and says nothing.
        bars.speed_estimate_period = 0.8 * (task.elapsed or 0.0)
        bars.update(task.id, completed=done, total=max(total, done))
        words = ", ".join(filter(None, (_time_left(task), remark)))
        bars.update(task.id, remark=words)
        if not errors.is_terminal and time.monotonic() - told > LOG_EVERY:
            told = time.monotonic()
            log.info("%s: %d of %d%s", what, done, total, words and f", {words}")

    live: AbstractContextManager[object] = nullcontext()
    if errors.is_terminal:
        live = Live(bars if above is None else Group(above, bars), console=errors)
    with live:
        yield show


def _time_left(task: "Task") -> str:
    """In words; empty before a first piece is done, and in the first seconds."""
    seconds = task.time_remaining
    if not seconds or (task.elapsed or 0.0) < LOG_EVERY:
        return ""
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds > 2.0 * length:
            return f"about {seconds / length:.0f} {unit} left"
    return f"about {seconds:.0f} s left"


NEWEST = 1000
"""Scans, and selections, whose milliseconds are shown."""


class Dashboard:
    """Shows what a replay, or a drive, does now; rich renders it as often as it likes."""

    def __init__(self) -> None:
        self._what = ""

    def look(self, what: str, total: int, record: "ReplayRecord") -> None:
        """Take note of a scan.

        Parameters
        ----------
        what
            What is replayed or driven; where it changes, all begins anew.
        total
            How many scans there are; 0 if nobody knows.
        record
            What became of the scans so far.
        """
        step = record.steps[-1]
        if what != self._what:
            self._what, self._begun, self._first = what, time.perf_counter(), step.stamp
            self._restarts = 0
        self._restarts += step.unhealthy is not None
        self._total, self._record = total, record

    def __rich__(self) -> "Table":
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        table.add_column(style="bold")
        table.add_column()
        for name, words, *style in self._lines() if self._what else ():
            table.add_row(Text(name), Text(words, *style))
        return table

    def _lines(self) -> Iterator[tuple[str, ...]]:
        """Names, words and, of some, styles."""
        record = self._record
        # Copies: the replay goes on.
        steps = list(record.steps)[-NEWEST:]
        driven = (steps[-1].stamp - self._first) * 1e-9
        speed = driven / max(time.perf_counter() - self._begun, 1e-9)
        yield self._what, f"{driven:.1f} s driven, {speed:.1f} times as fast as recorded"
        of = f" of {self._total}" if self._total else ""
        restarts = f", restarted {self._restarts} times" if self._restarts else ""
        took = _in_ms(step.prepare_seconds + step.register_seconds for step in steps)
        yield "scans", f"{record.done}{of}{restarts}; {took} a scan"
        if record.rate is not None:
            words = f"pose {_in_ms(list(record.late)[-NEWEST:])} after the scan"
            words += f"; scans dropped: {record.dropped}, selections missed: {record.missed}"
            yield "latency", words, "yellow" if record.dropped + record.missed else ""
        if (choice := record.newest) is None:
            return
        applied, rejected = list(record.choices), list(record.rejected)
        took = _in_ms(one.seconds for one in (applied + rejected)[-NEWEST:])
        yield "selections", f"{took}; not applied: {len(rejected)}"
        yield from _chosen(choice.selection)
        if why := choice.why_not or choice.fallen_back:
            yield "warning", why, "yellow"


def _chosen(selection: "Selection") -> Iterator[tuple[str, ...]]:
    """Of a selection: the set or weights, what is predicted, and what was measured."""
    from adaptune.report.drawing import plain

    if selection.weights is None:
        values = ", ".join(
            f"{name} {plain(value) if isinstance(value, int | float) else value}"
            for name, value in selection.parameters.items()
        )
        yield "chosen", f"trial {selection.trial}: {values}"
    else:
        heaviest = sorted(selection.weights.items(), key=lambda pair: -pair[1])
        yield "weights", ", ".join(f"trial {trial} {100.0 * w:.0f} %" for trial, w in heaviest)
    if math.isfinite(selection.predicted_error):
        fixed = f"{selection.predicted_fixed:.3f} %"
        yield "predicted", f"{selection.predicted_error:.3f} %, of the fixed set {fixed}"
    if math.isfinite(selection.estimated_error):
        low, high = selection.estimated_low, selection.estimated_high
        yield "measured", f"{selection.estimated_error:.3f} % ({low:.3f}-{high:.3f} %)"
    if selection.lost:
        yield "lost", "do not rely on the pose", "bold red"


def _in_ms(seconds: Iterable[float]) -> str:
    """Median and 99th percentile, in milliseconds."""
    import numpy as np

    half, most = 1e3 * np.percentile(list(seconds) or [0.0], (50, 99))
    return f"{half:.1f} ms (99 %: {most:.1f})"


def say_fixed(study: "OfflineStudy", advised: bool = True) -> None:
    """Say where the fixed set is, and where it is as the odometry's own tool reads it."""
    from adaptune.files import Document

    path = study.folder / "fixed.yaml"
    fixed = Document.of_file(path).data if path.exists() else None
    own = None if fixed is None else study.own_file(fixed)
    there = own is not None and own[0].exists()
    more = f"; for the odometry's own tool: {own[0]} ({own[1].use})" if own and there else ""
    what = "The parameters" if advised else "The fixed set, which is not advised here"
    say(f"{what}: {path}{more}.")


# The command to run next, which every command names at its end.


def say_next(why: str, *words: object, first: str = "") -> None:
    """Print a command, ready to copy, what it is for, and what to do first."""
    called = Path(sys.argv[0])
    typed = called.name == "adaptune" and shutil.which("adaptune") is None
    program = str(called) if typed else "adaptune"
    say(f"Next: {first}{shlex.join([program, *map(str, words)])}    # {why}")


_study_words: list[object] = []
"""Words for the study that was loaded last."""


def say_next_of_study(why: str, command: str, first: str = "") -> None:
    """Name a command on the study that was loaded, with the same options."""
    say_next(why, command, *_study_words, first=first)


def say_next_online(study: "OfflineStudy") -> None:
    """Name the replay of the test sequences, if there are any."""
    first = f"name sequences for the `test` of {_study_words[0]}; then "
    why = "replay the test sequences in every mode"
    say_next_of_study(why, "online", "" if study.config.test else first)


def say_next_of_trained(study: "OfflineStudy", enough: bool) -> None:
    """Name what follows training: nothing can be left out of a single stretch."""
    if enough:
        say_next_of_study("what does adapting gain elsewhere?", "validate")
    else:
        say_next_online(study)


# Arguments that all commands on a study share.


StudyFile = Annotated[
    Path,
    typer.Argument(metavar="STUDY", help="The study's YAML, or its folder.", show_default=False),
]


Override = Annotated[
    list[str],
    typer.Option(
        "-o",
        "--override",
        metavar="KEY=VALUE",
        help="Replace a value of the YAML, as in `-o offline.trials=128`. May be repeated.",
        show_default=False,
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        help="The study's folder.", show_default="the YAML's name, under runs/", file_okay=False
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run the trials on a Dask cluster, as tcp://scheduler:8786.",
        show_default="processes of this machine",
    ),
]


def load(
    path: Path, overrides: list[str], folder: Path | None, *, runs: bool = False
) -> "OfflineStudy":
    """Load the study of a YAML file, or of the folder of a study that has begun.

    `say_next_of_study` names it then. Only a command that `runs` the odometry needs it installed.
    """
    from offline.config import load_study

    if not path.exists():
        what = "give the YAML of a study, or the folder of one that has begun"
        raise AdaptuneError(f"{path}: there is no such file or folder; {what}")
    of_folder = [] if folder is None else ["--folder", folder]
    _study_words[:] = [path, *of_folder, *(word for text in overrides for word in ("-o", text))]
    if path.is_dir():
        if not (path / "study.yaml").exists():
            raise AdaptuneError(f"{path}: is no study's folder: there is no study.yaml in it")
        path, folder = path / "study.yaml", folder or path
    return load_study(path, overrides, folder, needed=runs)
