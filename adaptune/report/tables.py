"""Tables of results: on the terminal, and as CSV and JSON files."""

import csv
import io
import itertools
import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import rich.box
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rich.text import Text

from adaptune.files import write_text

_FEW, _MANY = 0.1, 10.0
_WIDEST = 10_000
"""Letters of width that have room for any table."""


class Listing(NamedTuple):
    """Rows of equal keys, with what they are about.

    Keys that start with an underscore are for files only. ``group: name`` stands below a heading
    that it shares with its neighbours where there is room for it.
    """

    title: str
    rows: Sequence[Mapping[str, Any]]
    caption: str = ""
    # The least number of each row is set in bold, in each group of columns, or that of the columns
    # that are named. Rows with a true ``_in_hindsight`` do not count.
    least: Literal["row"] | tuple[str, ...] = ()

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
    whole = table(*listing[:3])
    if Console(width=_WIDEST).measure(whole).maximum <= width:
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
    keys, cells = _printed(listing)
    lines = [keys, [":--", *["--:"] * (len(keys) - 1)][: len(keys)]]
    lines += [[f"**{text}**" if bold else text for text, bold in row] for row in cells]
    escaped = ([text.replace("|", r"\|") for text in line] for line in lines)
    body = "\n".join(f"| {' | '.join(line)} |" for line in escaped)
    return "\n\n".join(filter(None, (f"**{listing.title}**", body, listing.caption))) + "\n"


def latex(listing: Listing, label: str) -> str:
    """The table as a LaTeX float with rules of booktabs.

    Parameters
    ----------
    listing
        The table.
    label
        Follows ``tab:`` in its label.
    """
    keys, cells = _printed(listing)
    groups, names = zip(*(key.rpartition(": ")[::2] for key in keys), strict=True)
    lines = []
    if any(groups):
        heads, rules, end = [], [], 0
        for group, same in itertools.groupby(groups):
            begin, end = end + 1, end + len(list(same))
            heads.append(rf"\multicolumn{{{end - begin + 1}}}{{c}}{{{_escaped(group)}}}")
            if group:
                rules.append(rf"\cmidrule(lr){{{begin}-{end}}}")
        lines += [" & ".join(heads) + r" \\", " ".join(rules)]
    lines += [" & ".join(map(_escaped, names)) + r" \\", r"\midrule"]
    for row in cells:
        texts = [rf"\textbf{{{_escaped(text)}}}" if bold else _escaped(text) for text, bold in row]
        lines.append(" & ".join(texts) + r" \\")
    caption = _escaped(f"{listing.title}. {listing.caption}").removesuffix(". ")
    rows = "\n".join(lines)
    return rf"""\begin{{table}}
\centering
\caption{{{caption}}}
\label{{tab:{label}}}
\begin{{tabular}}{{l{"r" * (len(keys) - 1)}}}
\toprule
{rows}
\bottomrule
\end{{tabular}}
\end{{table}}
"""


def _printed(listing: Listing) -> tuple[list[str], list[list[tuple[str, bool]]]]:
    """Keys that are printed, and for each row its texts and whether they are set in bold."""
    rows, keys = listing.rows, listing.keys
    numbers = np.full((len(rows), len(keys)), np.nan)
    for i, row in enumerate(rows):
        if not row.get("_in_hindsight"):
            numbers[i] = [row[key] if isinstance(row[key], float) else np.nan for key in keys]
    bold = np.zeros(numbers.shape, bool)
    if listing.least == "row":
        groups = np.array([key.rpartition(": ")[0] for key in keys])
        for group in set(groups.tolist()):
            bold[:, groups == group] = _least(numbers[:, groups == group], axis=1)
    else:
        columns = [key in listing.least for key in keys]
        bold[:, columns] = _least(numbers[:, columns], axis=0)
    texts = [[cell_text(row[key]) for key in keys] for row in rows]
    return keys, [list(zip(*pair, strict=True)) for pair in zip(texts, bold.tolist(), strict=True)]


def _least(numbers: NDArray[np.float64], axis: int) -> NDArray[np.bool_]:
    """Which numbers are the least along an axis, where there is a choice; NaN is none."""
    known = np.isfinite(numbers)
    least = np.where(known, numbers, np.inf).min(axis=axis, keepdims=True, initial=np.inf)
    return np.asarray(known & (numbers == least) & (known.sum(axis=axis, keepdims=True) > 1))


_SPECIAL = str.maketrans(
    {c: rf"\{c}" for c in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
)


def _escaped(text: str) -> str:
    return text.translate(_SPECIAL).replace("`", "")


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
    """Write sentences and tables as ``tables.md``, and the tables as ``tables.tex``.

    Parameters
    ----------
    folder
        Where to.
    name
        What they are about; it begins the labels of the LaTeX tables.
    listings
        The tables.
    words
        Sentences that stand before them.
    """
    text = "\n".join([f"# {name}\n", *(f"- {said}" for said in words), ""])
    write_text(folder / "tables.md", "\n".join([text, *map(markdown, listings)]))
    stem = re.sub(r"[^A-Za-z0-9]+", "-", name)
    floats = [latex(one, f"{stem}-{i + 1}") for i, one in enumerate(listings)]
    write_text(folder / "tables.tex", "\n".join(["% Needs \\usepackage{booktabs}.", *floats]))
