"""Tables of results: on the terminal, and as CSV and JSON files."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rich.box
from rich.table import Table
from rich.text import Text

from adaptune.files import write_text

_FEW, _MANY = 0.1, 10.0


def table(title: str, rows: Sequence[Mapping[str, Any]], caption: str = "") -> Table:
    """Rows of equal keys as a table that fits 80 columns where it can.

    Numbers are aligned to the right. A gap separates groups of equal first columns. Keys that
    start with an underscore are for files only.
    """
    space: Any = {"box": rich.box.SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
    # As texts, names are printed literally.
    made = Table(title=Text(title, "table.title"), caption=Text(caption, "table.caption"), **space)
    made.title_justify = made.caption_justify = "left"
    keys = [key for key in (rows[0] if rows else {}) if not key.startswith("_")]
    for key in keys:
        numbers = all(isinstance(row[key], int | float | None) for row in rows)
        side: Any = "right" if numbers else "left"
        # Folding would break long names inside words.
        heading = Text(key.replace("_", "_\n"))
        made.add_column(heading, justify=side, no_wrap=key == keys[0], overflow="fold")
    grouped = bool(rows) and len({row[keys[0]] for row in rows}) < len(rows)
    for i, row in enumerate(rows):
        if i and grouped and rows[i - 1][keys[0]] != row[keys[0]]:
            made.add_row()
        made.add_row(*(Text(_cell(row[key])) for key in keys))
    return made


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    if isinstance(value, float):
        digits = 1 if abs(value) >= _MANY else 3 if abs(value) >= _FEW or not value else 4
        return f"{value:.{digits}f}"
    return str(value)


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of equal keys as CSV, with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_rows(folder: Path, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of equal keys as ``<name>.csv`` and ``<name>.json``."""
    # JSON knows no NaN, and in CSV its cells are empty.
    finite = [
        {
            k.lstrip("_"): None if isinstance(v, float) and not np.isfinite(v) else v
            for k, v in row.items()
        }
        for row in rows
    ]
    write_text(folder / f"{name}.csv", csv_text(finite))
    write_text(folder / f"{name}.json", json.dumps(finite, indent=2) + "\n")
