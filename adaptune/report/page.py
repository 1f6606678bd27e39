"""One HTML file that opens without a network: words, tables and charts."""

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

from adaptune.files import write_text
from adaptune.processes import processes
from adaptune.report.chart import Chart
from adaptune.report.interactive import figure
from adaptune.report.paper import draw_chart
from adaptune.report.tables import Listing, cell_text

FIGURES = "figures"
"""The folder beside a page that holds its charts as PNG and SVG."""
_WIDE = 14
"""A table with more columns is printed smaller, so that it does not make the whole page smaller."""
_LONG = 40
"""Letters from which on a cell has several lines."""
# Nothing may be fetched, whatever a name in the page says.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)


@dataclass(frozen=True)
class PageSection:
    """A heading, and what is below it in this order."""

    title: str
    words: tuple[str, ...] = ()  # paragraphs
    missing: tuple[str, ...] = ()  # what is not there, and why
    charts: tuple[Chart, ...] = ()
    tables: tuple[Listing, ...] = ()


@dataclass(frozen=True)
class Page:
    """A page: its summary, and its sections."""

    title: str
    subtitle: str
    words: tuple[str, ...]  # the summary, a list of sentences
    sections: tuple[PageSection, ...]


def write_page(path: Path, page: Page) -> None:
    """Write a page, and its charts as PNG and SVG into the folder `FIGURES` beside it.

    Parameters
    ----------
    path
        Of the HTML file.
    page
        What it says. The keys of its charts name the files, as far as names of files may.

    Raises
    ------
    FullError
        If there is no room for it.
    """
    charts = _named(page)
    with processes(len(charts), [__name__]) as pool:
        pictures = [path.parent / FIGURES / f"{name}.png" for name in charts]
        drawn = pool.map(draw_chart, pictures, charts.values())
        text = page_text(page)
        list(drawn)  # raises what went wrong
    write_text(path, text)


def page_text(page: Page) -> str:
    """A page as HTML."""
    from plotly.offline import get_plotlyjs

    here = files("adaptune.report")
    charts = {name: figure(chart) for name, chart in _named(page).items()}
    # A name in the data does not end the script.
    data = json.dumps(charts, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    names = iter(charts)
    sections = "".join(
        _section(i, section, [(next(names), chart) for chart in section.charts])
        for i, section in enumerate(page.sections, start=1)
    )
    contents = "".join(
        f'<li><a href="#page-section-{i}">{escape(section.title)}</a></li>'
        for i, section in enumerate(page.sections, start=1)
    )
    without = f"The charts need JavaScript. As PNG and SVG, they lie in the folder {FIGURES}."
    scripts = get_plotlyjs(), here.joinpath("page.js").read_text("utf-8")
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(page.title)}</title>
<style>
{here.joinpath("page.css").read_text("utf-8")}</style>
</head>
<body>
<a class="skip" href="#page-content">Skip to the content</a>
<div class="page">
<header>
<h1>{escape(page.title)}</h1>
<p class="subtitle">{escape(page.subtitle)}</p>
</header>
<nav aria-label="Sections"><ol>{contents}</ol></nav>
<main id="page-content">
{_listed("words", page.words)}
<noscript><p>{without}</p></noscript>
{sections}</main>
</div>
<script type="application/json" id="page-charts">{data}</script>
<script>{scripts[0]}</script>
<script>
{scripts[1]}</script>
</body>
</html>
"""


def _named(page: Page) -> dict[str, Chart]:
    """The charts of a page by the names of their files, which are their anchors, too."""
    named: dict[str, Chart] = {}
    for chart in (chart for section in page.sections for chart in section.charts):
        name = base = re.sub(r"[^\w.-]+|^\.", "_", chart.key) or "chart"
        again = count(2)
        while name.lower() in map(str.lower, named):
            name = f"{base}-{next(again)}"
        named[name] = chart
    return named


def _listed(kind: str, words: Iterable[str]) -> str:
    items = "".join(f"<li>{_prose(sentence)}</li>" for sentence in words)
    return f'<ul class="{kind}">{items}</ul>' if items else ""


def _prose(text: str) -> str:
    """A text as HTML, with names between backticks set as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def _section(i: int, section: PageSection, named: Iterable[tuple[str, Chart]]) -> str:
    words = "".join(f"<p>{_prose(paragraph)}</p>\n" for paragraph in section.words)
    missing = ""
    if section.missing:
        items = _listed("", section.missing)
        missing = f'<div class="missing" role="note"><p>Missing</p>{items}</div>\n'
    charts = "".join(_chart(name, chart) for name, chart in named)
    tables = "".join(map(_table, section.tables))
    heading = f'<h2 id="page-section-{i}">{escape(section.title)}</h2>'
    return f"<section>{heading}\n{words}{missing}{charts}{tables}</section>\n"


def _chart(name: str, chart: Chart) -> str:
    title, caption = escape(chart.title), escape(chart.caption)
    links = ", ".join(
        f'<a href="{FIGURES}/{quote(name)}.{kind}">{kind.upper()}</a>' for kind in ("png", "svg")
    )
    return f"""<figure id="{name}">
<h3>{title}</h3>
<div class="drawing" data-chart="{name}" role="img" aria-label="{title}. {caption}"></div>
<figcaption>{caption} <span class="files">Figure as {links}</span></figcaption>
</figure>
"""


def _table(table: Listing) -> str:
    keys = [key for key in (table.rows[0] if table.rows else {}) if not key.startswith("_")]
    numeric = {key for key in keys if all(_is_number(row[key]) for row in table.rows)}
    headings = "".join(_heading(key, key in numeric) for key in keys)
    rows = "".join(
        f"<tr>{''.join(_cell(row[key], key in numeric) for key in keys)}</tr>\n"
        for row in table.rows
    )
    note = f'<p class="note">{_prose(table.caption)}</p>' if table.caption else ""
    title = escape(table.title)
    body = f"<table><thead><tr>{headings}</tr></thead>\n<tbody>{rows}</tbody></table>"
    # The box scrolls, and so has to be reached by the keyboard.
    box = f'<div class="box" role="region" tabindex="0" aria-label="{title}">{body}</div>'
    kind = "wide table" if len(keys) > _WIDE else "table"
    return (
        f'<div class="{kind}"><h3>{title}</h3>\n{box if keys else "<p>No rows.</p>"}{note}</div>\n'
    )


def _heading(key: str, number: bool) -> str:
    # Long names may be broken, and stay what they are.
    words = escape(key)
    on_paper, on_screen = (words.replace("_", f"_{cut}") for cut in ("\u200b", "<wbr>"))
    return (
        f'<th scope="col" aria-sort="none" data-heading="{on_paper}"{_kind(number)}>'
        f'<button type="button" aria-label="{words}"><span>{on_screen}</span></button></th>'
    )


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _kind(number: bool, long: bool = False) -> str:
    return ' class="number"' if number else ' class="long"' if long else ""


def _cell(value: Any, number: bool) -> str:
    """A cell, and by what it is sorted: the whole number, and nothing for one that is missing."""
    shown = cell_text(value)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        sorted_by = ""
    elif isinstance(value, float) and math.isinf(value):
        sorted_by = "Infinity" if value > 0 else "-Infinity"
    else:
        sorted_by = str(value)
    kind = _kind(number, len(shown) > _LONG)
    return f'<td data-value="{escape(sorted_by)}"{kind}>{escape(shown)}</td>'
