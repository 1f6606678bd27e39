"""Tables of results: on the terminal, and as CSV and JSON files."""

import csv
import io
import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rich.box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from adaptune._system.files import write_text

_FEW, _MANY = 0.1, 10.0


class Listing(NamedTuple):
    """Rows of equal keys, with what they are about.

    Keys that start with an underscore are for files only.
    """

    title: str
    rows: Sequence[Mapping[str, Any]]
    caption: str = ""

    @property
    def keys(self) -> list[str]:
        """The keys that are shown."""
        return [key for key in (self.rows[0] if self.rows else {}) if not key.startswith("_")]


def table(title: str, rows: Sequence[Mapping[str, Any]], caption: str = "") -> Table:
    """A listing as a table that fits 80 columns where it can.

    Numbers are aligned to the right. A gap separates groups of equal first columns.
    """
    keys = Listing(title, rows).keys
    space: Any = {"box": rich.box.SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
    # As texts, names are printed literally.
    made = Table(title=Text(title, "table.title"), caption=Text(caption, "table.caption"), **space)
    made.title_justify = made.caption_justify = "left"
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
        made.add_row(*(Text(cell_text(row[key])) for key in keys))
    return made


def tables_within(listing: Listing, width: int) -> list[Table | Text]:
    """A listing as tables of at most so many letters of width, in which no number is broken.

    Where the columns have no room, they go on in a next table, below the first column again.
    """
    whole = table(*listing)
    roomy = Console(width=10_000)  # has room for any table
    if roomy.measure(whole).maximum <= width:
        return [whole]
    headings, needed = {}, {}
    for key in listing.keys:
        cells = [cell_text(row[key]) for row in listing.rows]
        needed[key] = max(map(len, (*re.split(r"(?<=_)|\s", key), *cells)))
        headings[key] = textwrap.fill(key, needed[key], break_long_words=False)
    first, *others = headings
    tables = [[first]]
    for key in others:
        # Between columns are two letters, and one at each end.
        if sum(needed[k] + 2 for k in (*tables[-1], key)) > width and len(tables[-1]) > 1:
            tables.append([first])
        tables[-1].append(key)
    titles = [listing.title, *("" for _ in tables[1:])]
    made: list[Table | Text] = [
        table(title, [{headings[key]: row[key] for key in keys} for row in listing.rows])
        for title, keys in zip(titles, tables, strict=True)
    ]
    return [*made, Text(listing.caption, "table.caption")] if listing.caption else made


def cell_text(value: Any) -> str:
    """A value as it stands in a table; "-" for one that is missing."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    if isinstance(value, float):
        digits = 1 if abs(value) >= _MANY else 3 if abs(value) >= _FEW or not value else 4
        return f"{value:.{digits}f}"
    return str(value)


def markdown(listing: Listing) -> str:
    """The table in Markdown, with its title and caption."""
    keys = listing.keys
    lines = [keys, [":--", *["--:"] * (len(keys) - 1)][: len(keys)]]
    lines += [[cell_text(row[key]) for key in keys] for row in listing.rows]
    escaped = ([text.replace("|", r"\|") for text in line] for line in lines)
    body = "\n".join(f"| {' | '.join(line)} |" for line in escaped)
    return "\n\n".join(filter(None, (f"**{listing.title}**", body, listing.caption))) + "\n"


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


def write_tables(
    folder: Path, name: str, listings: Sequence[Listing], words: Sequence[str] = ()
) -> None:
    """Write tables as ``tables.md``, below the name of what they are about and sentences."""
    text = "\n".join([f"# {name}\n", *(f"- {said}" for said in words), ""])
    write_text(folder / "tables.md", "\n".join([text, *map(markdown, listings)]))
