"""The report of a study: one page of everything that is known."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import repeat
from typing import TYPE_CHECKING

from adaptune.commands.terminal import Folder, Override, StudyFile, begin_work, load, progress, say
from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from adaptune.report.charts import Charts
    from adaptune.report.page import Page, PageSection
    from offline.config import OfflineStudy

    _Maker = Callable[[OfflineStudy], PageSection]


_BEST = 50
"""Trials of the report's table: the best ones."""
_NEEDED = ("adaptune.report.page", "offline.study_charts", "online.comparison")
"""What the processes that make the sections import."""


def report(study: StudyFile, override: Override = [], folder: Folder = None) -> None:  # noqa: B006
    """Write all that is known of a study as one HTML page with charts and tables.

    It opens without a network. Every chart also lies beside it as PNG and SVG. What is missing is
    named, with the command that makes it: a study that still runs has a report, too.
    """
    loaded = load(study, override, folder)
    from adaptune.report.page import write_page

    begin_work()
    if not (loaded.folder / "study.yaml").exists():
        raise AdaptuneError(
            f"{loaded.folder}: there is nothing yet; run `adaptune offline {study}`"
        )
    loaded.check()
    path = loaded.folder / "report" / "report.html"
    with progress() as show:
        page = study_page(loaded, lambda done, total: show("report", done, total))
        write_page(path, page)
    for said in page.words:
        say(said)
    for missing in (text for section in page.sections for text in section.missing):
        say(f"Not in it: {missing}")
    megabytes = path.stat().st_size / 1e6
    say(f"Report: {path} ({megabytes:.1f} MB); its charts as PNG and SVG: {path.parent}/figures/")


def study_page(
    study: "OfflineStudy", progress: Callable[[int, int], None] = lambda *_: None
) -> "Page":
    """All that is known of a study.

    Parameters
    ----------
    study
        Finished, or as far as it is.
    progress
        Called with the number of sections that are made, and with how many there will be.
    """
    from adaptune.processes import processes
    from adaptune.report.page import Page
    from online.modes import sequences_without_model

    makers: list[_Maker] = [_comparison]
    # Without a test, some may have been replayed without a model.
    others = sequences_without_model(study.config)
    replayed = [name for name in others if (study.folder / "replays" / name).exists()]
    names = study.config.test or replayed
    makers += [partial(_along, sequence=name) for name in names]
    makers += [_search, _surroundings, _validation, _settings]
    sections: list[PageSection] = []
    with processes(len(makers), _NEEDED) as pool:
        for section in pool.map(_made, makers, repeat(study)):
            sections.append(section)
            progress(len(sections), len(makers))
    config = study.config
    subtitle = (
        f"{', '.join(config.odometries)}: trained on {len(config.training)} sequences, tested on "
        f"{len(config.test)}, errors over {config.sub_trajectory:g} m, seed {config.offline.seed}"
    )
    # The summary is that of the comparison.
    words, sections[0] = sections[0].words, replace(sections[0], words=())
    return Page(study.name, subtitle, words, tuple(sections))


def _made(make: "_Maker", study: "OfflineStudy") -> "PageSection":
    return make(study)


def _comparison(study: "OfflineStudy") -> "PageSection":
    from adaptune.report.page import PageSection
    from online.charts import charts_of_comparison
    from online.compare import compare
    from online.tables import modes_in_words, tables

    title = "What adapting gained"
    try:
        rows, said, _ = compare(study, write=False)
    except AdaptuneError as error:
        words = _so_far(study)
        return PageSection(title, tuple(words), (f"No comparison: {error}.",))
    found = charts_of_comparison(rows)
    made = [*tables(rows, study.config.sub_trajectory), modes_in_words(rows)]
    return PageSection(title, tuple(said), tuple(found.notes), tuple(found.charts), tuple(made))


def _so_far(study: "OfflineStudy") -> Iterator[str]:
    """What can be said without a comparison."""
    from adaptune.model import ErrorModel
    from adaptune.study.study import driven

    if not study.model_path.exists():
        yield "There is no error model yet: `adaptune offline` has not finished."
        return
    try:
        yield driven(study, ErrorModel.load(study.model_path)).words
    except AdaptuneError as error:
        yield f"{error}."


def _along(study: "OfflineStudy", sequence: str) -> "PageSection":
    """The section of a test sequence."""
    from online.charts import charts_of_replays

    return _of_charts(f"Along {sequence}", lambda: charts_of_replays(study, sequence))


def _search(study: "OfflineStudy") -> "PageSection":
    from adaptune import archive
    from adaptune.archive import Archive
    from adaptune.report.tables import Listing
    from offline.charts import charts_of_trials

    section = _of_charts("What was tried", lambda: charts_of_trials(study))
    try:
        finished = archive.rows(Archive(study.folder / "trials"), study.training)
    except AdaptuneError as error:
        return replace(section, missing=(*section.missing, f"{error}."))
    if not finished:
        return section
    best = archive.select([row for row in finished if row["mean"] is not None], [], "mean", _BEST)
    title = f"The best {len(best)} of {len(finished)} trials, in training"
    listed = archive.with_units(best, study.training, study.odometry.space.labels)
    return replace(section, tables=(Listing(title, listed),))


def _surroundings(study: "OfflineStudy") -> "PageSection":
    from online.descriptor_chart import charts_of_descriptors

    return _of_charts("Surroundings, trained and tested", lambda: charts_of_descriptors(study))


def _validation(study: "OfflineStudy") -> "PageSection":
    from offline.charts import charts_of_validation

    return _of_charts("With recordings left out", lambda: charts_of_validation(study))


def _settings(study: "OfflineStudy") -> "PageSection":
    """The study's settings, a row each."""
    from adaptune.report.page import PageSection
    from adaptune.report.tables import Listing

    def leaves(value: object, key: str) -> Iterator[tuple[str, object]]:
        if isinstance(value, dict) and value:
            for name, inner in value.items():
                yield from leaves(inner, f"{key}.{name}" if key else str(name))
        elif value is not None:
            yield key, value

    rows = [{"key": key, "value": str(v)} for key, v in leaves(study.config.resolved(), "")]
    return PageSection("Settings", tables=(Listing("The study's YAML, with its defaults", rows),))


def _of_charts(title: str, make: Callable[[], "Charts"]) -> "PageSection":
    """A section of charts; an error is told in their place."""
    from adaptune.report.page import PageSection

    try:
        charts, notes = make()
    except AdaptuneError as error:
        return PageSection(title, missing=(f"{error}.",))
    return PageSection(title, missing=tuple(notes), charts=tuple(charts))
