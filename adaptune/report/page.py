"""One HTML file that opens without a network: words, tables and charts."""

import json
import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from adaptune._system.files import write_text
from adaptune._system.forking import processes
from adaptune.report.charts import Chart
from adaptune.report.drawing import draw_chart, spec
from adaptune.report.tables import Listing, cell_text

FIGURES, KINDS = "figures", ("png", "svg", "pdf", "csv")
"""The folder beside a page that holds its charts, and their kinds of files."""


@dataclass(frozen=True)
class PageSection:
    """A heading, and what is below it in this order."""

    title: str
    notes: tuple[str, ...] = ()  # what must be known, and what is not there and why
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
    """Write a page, and its charts with their data into the folder `FIGURES` beside its HTML file.

    The keys of its charts are distinct and names of files. There is a FullError without room.
    """
    charts = [chart for section in page.sections for chart in section.charts]
    with processes(len(charts), [__name__]) as pool:
        figures = [path.parent / FIGURES / chart.key for chart in charts]
        files = ([f"{figure}.{kind}" for figure in figures] for kind in KINDS)
        drawn = pool.map(draw_chart, charts, *(map(Path, of_kind) for of_kind in files))
        text = page_text(page)
        list(drawn)  # raises what went wrong
    write_text(path, text)


def page_text(page: Page) -> str:
    """A page as HTML."""
    import jinja2
    import vl_convert
    from markupsafe import Markup, escape

    here = files("adaptune.report")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters |= {
        # Names between backticks are code, and long ones may be broken.
        "prose": lambda text: Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text)))),
        "breakable": lambda key: Markup(str(escape(key)).replace("_", "_<wbr>")),
        "cell": cell_text,
        "sorted_by": _sorted_by,
    }
    return environment.from_string(here.joinpath("page.html").read_text("utf-8")).render(
        page=page,
        css=here.joinpath("page.css").read_text("utf-8"),
        figures=FIGURES,
        kinds=KINDS,
        charts={c.key: spec(c, titled=False) for part in page.sections for c in part.charts},
        columns=_columns,
        vega=vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;"),
    )


def _columns(table: Listing) -> dict[str, str]:
    """The keys that are shown, and of which kind they are."""

    def number(value: Any) -> bool:
        return value is None or (isinstance(value, int | float) and not isinstance(value, bool))

    return {k: "number" if all(number(row[k]) for row in table.rows) else "" for k in table.keys}


def _sorted_by(value: Any) -> str:
    """By what a cell is sorted: the whole number, and nothing for one that is missing."""
    if cell_text(value) == "-":
        return ""
    return json.dumps(value) if isinstance(value, float) else str(value)
