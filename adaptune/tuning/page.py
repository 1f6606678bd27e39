"""The page of a study."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from adaptune.errors import AdaptuneError
from adaptune.report.charts import Chart, Charts
from adaptune.report.page import Page, PageSection, write_page
from adaptune.report.tables import Listing
from adaptune.runs.archive import Archive
from adaptune.tuning.verdict import front_table
from offline.charts import charts_of_trials, charts_of_validation
from offline.config import OfflineStudy, OfflineStudyConfig
from offline.trial_table import rows, select, with_units
from online.charts import charts_of_comparison, charts_of_replays
from online.compare import Comparison
from online.modes import sequences_without_model
from online.replayed import ReplayedSequence, read_replays
from online.tables import modes_in_words, tables


def write_study_page(study: OfflineStudy, found: Comparison | str) -> Path:
    """Write all that is known of a study as one page; `found` may be why nothing is compared."""
    read = cache(partial(read_replays, study))

    def along(name: str) -> Charts:
        return charts_of_replays(read(name))

    config = study.config
    # Without a test, some may have been replayed without a model.
    others = sequences_without_model(config)
    replayed = [name for name in others if (study.folder / "replays" / name).exists()]
    sections = [_comparison(found, config.sub_trajectory, read)]
    names = config.test or replayed
    sections += [_of_charts(f"Along {name}", partial(along, name)) for name in names]
    sections.append(_search(study))
    validation = partial(charts_of_validation, study.folder)
    sections += [_of_charts("With recordings left out", validation), _settings(config)]
    n = len(config.training)
    subtitle = (
        f"{', '.join(config.odometries)}: trained on {n} sequence{'s' * (n != 1)}, tested on "
        f"{len(config.test)}, errors over {config.sub_trajectory:g} m, seed {config.offline.seed}"
    )
    words = () if isinstance(found, str) else tuple(found.verdict)
    if not isinstance(found, str) and found.front:
        sections.insert(0, PageSection("What to drive", tables=(front_table(study, found.front),)))
    path = study.folder / "report" / "report.html"
    write_page(path, Page(study.name, subtitle, words, tuple(sections)))
    return path


def _comparison(
    found: Comparison | str, length: float, read: Callable[[str], ReplayedSequence]
) -> PageSection:
    title = "What adapting gained"
    if isinstance(found, str):
        return PageSection(title, notes=(found,))
    made = *tables(found.rows, length), modes_in_words(found.rows)
    charts = partial(charts_of_comparison, found.rows, read)
    section = _of_charts(title, charts)
    return replace(section, notes=(*section.notes, *found.details), tables=made)


def _search(study: OfflineStudy) -> PageSection:
    section = _of_charts("What was tried", partial(charts_of_trials, study))
    try:
        finished = rows(Archive(study.folder / "trials"), study.training)
    except AdaptuneError as error:
        return replace(section, notes=(*section.notes, f"{error}."))
    if not finished:
        return section
    best = select([row for row in finished if row["mean"] is not None], "mean", top=50)
    title = f"The best {len(best)} of {len(finished)} trials, in training"
    listed = with_units(best, study.training, study.odometry.space.labels)
    return replace(section, tables=(Listing(title, listed),))


def _settings(config: OfflineStudyConfig) -> PageSection:

    def leaves(value: object, key: str) -> Iterator[tuple[str, object]]:
        if isinstance(value, dict) and value:
            for name, inner in value.items():
                yield from leaves(inner, f"{key}.{name}" if key else str(name))
        elif value is not None:
            yield key, value

    every = [{"key": key, "value": str(v)} for key, v in leaves(config.resolved(), "")]
    return PageSection("Settings", tables=(Listing("The study's YAML, with its defaults", every),))


def _of_charts(title: str, make: Callable[[], Charts]) -> PageSection:
    """A section of charts; an error is told in their place."""
    try:
        found = [*make()]
    except AdaptuneError as error:
        return PageSection(title, notes=(f"{error}.",))
    notes = tuple(one for one in found if isinstance(one, str))
    return PageSection(title, notes, tuple(one for one in found if isinstance(one, Chart)))
