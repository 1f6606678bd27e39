import io
import logging
import time

import pytest
from rich.console import Console

from adaptune.commands import terminal
from adaptune.commands.terminal import say_next
from adaptune.report import tables

ODD = "my[v2] [/b] :x: [red]"


def test_text_is_printed_as_it_is(capsys):
    terminal.say(ODD)
    terminal.console.print(tables.table(f"title {ODD}", [{f"key {ODD}": ODD}], f"caption {ODD}"))
    terminal.errors.print(ODD)
    out, err = capsys.readouterr()
    assert " ".join(out.split()).count(ODD) == 5
    assert ODD in err


def test_bars_print_names_as_they_are(monkeypatch):
    screen = Console(file=io.StringIO(), force_terminal=True, width=200)
    monkeypatch.setattr(terminal, "errors", screen)
    with terminal.progress() as show:
        show(ODD, 1, 2, f"remark {ODD}")
    text = screen.file.getvalue()
    assert text.count(ODD) >= 2


@pytest.fixture
def clock(monkeypatch):
    """The seconds of a clock, in a program without a terminal."""
    monkeypatch.setattr(terminal, "errors", Console(file=io.StringIO(), force_terminal=False))
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_a_log_has_a_line_of_progress_now_and_then(caplog, clock):
    with caplog.at_level(logging.INFO), terminal.progress() as show:
        for i in range(21):
            clock[0] = 1.5 * i
            show("trials", i / 2, 10, "best rte 1.0")
            # Done already.
            show("bags", 3, 3)
            show("bags", 1, 3)
    assert [record.message for record in caplog.records] == [
        "trials: 2 of 10, about 24 s left, best rte 1.0",
        "trials: 4 of 10, about 18 s left, best rte 1.0",
        "trials: 6 of 10, about 12 s left, best rte 1.0",
        "trials: 8 of 10, about 6 s left, best rte 1.0",
        "trials: 10 of 10, best rte 1.0",
    ]


def test_what_a_resumed_study_has_done_already_does_not_count(caplog, clock):
    with caplog.at_level(logging.INFO), terminal.progress() as show:
        # In the first second 1,000 of 2,000, then one a second.
        for i in range(1100):
            clock[0] = 0.001 * i if i < 1000 else i - 999.0
            show("runs", i, 2000)
    assert caplog.messages[-1].startswith("runs: 1095 of 2000, about 15 min left")


def test_the_next_command_can_be_copied(capsys):
    say_next("why", "offline", "my study.yaml")
    assert capsys.readouterr().out == "Next: adaptune offline 'my study.yaml'    # why\n"
