"""The charts of a study's trials and of its validation, from its folder."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from adaptune.archive import OF_SLOT, Archive
from adaptune.errors import AdaptuneError
from adaptune.recording.scan import OF_VIEW
from adaptune.report.charts import (
    Axis,
    Band,
    Chart,
    Charts,
    Drawn,
    Line,
    Panel,
    Points,
    charts_of,
)
from adaptune.study.study import Study
from offline import trial_charts
from offline.config import OfflineStudy
from offline.objective import sampler_results
from offline.search import Search, assess, make_searches
from offline.trial_charts import TrialTable, importance_chart, importances, read_trials
from offline.tuning import figures

# Charts of what `adaptune validate` found.


MOST_NAMED = 8
"""With more recordings, stretches do not show of which they are."""
RATIO = "error over the fixed set's [-]"
_FACTS = ("recording", "stretch", "fixed [%]")


def stretch_chart(rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Ratio to the fixed set's error on every stretch left out, sorted: a panel for each mode.

    Parameters
    ----------
    rows
        Of ``stretches.json``.
    """
    recordings = [str(row["recording"]) for row in rows]
    panels = []
    for mode in (key for key in (rows[0] if rows else {}) if key not in _FACTS):
        ratios = np.array([row.get(mode, np.nan) for row in rows], float)
        # One that is the fixed set everywhere says nothing.
        if not np.isfinite(ratios).all() or (np.abs(ratios - 1.0) < 1e-9).all():
            continue
        panels.append(_stretch_panel(mode, ratios, recordings))
    if not panels:
        return None
    return Chart(
        "stretches",
        "Ratio to the fixed set's error on every stretch left out",
        tuple(panels),
        "Each point is a stretch that nothing was trained on, sorted by its ratio; below 1 the "
        "mode beats the fixed set. The band is the 95 % interval of the geometric mean over all "
        "stretches. Oracles know the errors in advance: they bound what choosing one set can gain.",
        columns=min(2, len(panels)),
    )


def _stretch_panel(mode: str, ratios: np.ndarray[Any, Any], recordings: Sequence[str]) -> Panel:
    order = np.argsort(ratios, kind="stable")
    rank = np.empty(len(ratios))
    rank[order] = np.arange(1, len(ratios) + 1)
    of = figures(np.log(ratios), recordings)
    ends = np.array([0.5, len(ratios) + 0.5])
    drawn: list[Drawn] = []
    if np.isfinite([of.low, of.high]).all() and of.low > 0.0:
        drawn.append(Band(ends, [of.low] * 2, [of.high] * 2, "95 % interval of the mean"))
    drawn += [
        Line(ends, [of.geometric] * 2, "geometric mean", dashed=True),
        Line(ends, [1.0, 1.0], "fixed", faint=True),
    ]
    named = dict.fromkeys(recordings)
    few = len(named) <= MOST_NAMED
    for name in named if few else ("stretch",):
        mine = [i for i, own in enumerate(recordings) if own == name or not few]
        texts = [recordings[i] for i in mine]
        drawn.append(Points(rank[mine], ratios[mine], name, texts=texts))
    title = f"{mode}: {of.geometric:.2f} ({of.low:.2f}-{of.high:.2f})"
    x = Axis("stretch, by rising ratio [-]", limits=(0.5, float(ends[1])))
    return Panel(x, Axis(RATIO, log=True), tuple(drawn), title)


def charts_of_trials(study: OfflineStudy) -> Charts:
    """Charts of the finished trials, and what is missing; it reads no trial's frames."""
    table = read_trials(study)
    if not len(table):
        return Charts([], ["No trials: run `adaptune offline`."])
    return charts_of(_of_trials(study, table))


def _of_trials(study: OfflineStudy, table: TrialTable) -> Iterator[Chart | str | None]:
    names = [name for name in study.training if OF_VIEW not in name]
    if (n := len(table.space.parameters)) > trial_charts.MOST_PANELS:
        yield f"Of {n} parameters, the charts show the first {trial_charts.MOST_PANELS}."
    found = {name: importances(of) for name, of in table.shared().odometries().items()}
    yield trial_charts.iteration_chart(table, reannealings(study))
    yield importance_chart(found) or (
        f"No importance of parameters: it takes {trial_charts.FEW} finished trials and two "
        f"parameters."
    )
    yield trial_charts.density_chart(table) or (
        f"No densities of parameters: they take {trial_charts.FEW} finished trials."
    )
    kind, groups = sequence_groups(study, names)
    yield trial_charts.density_by_group_chart(table, groups, kind)
    yield trial_charts.sensitivity_chart(table)
    for odometry, of in table.odometries().items():
        pair = most_important(of, found.get(odometry, {}))
        chart = trial_charts.scatter_chart(of, pair, names)
        if chart is not None and odometry:
            key, title = f"{chart.key}-{odometry}", f"{odometry}: {chart.title}"
            chart = replace(chart, key=key, title=title)
        yield chart
    yield trial_charts.cost_chart(table) or (
        "No costs of trials: they are of an older adaptune, or of an odometry that does not "
        "measure them."
    )


def most_important(table: TrialTable, shares: Mapping[str, float]) -> list[str]:
    """Names of two parameters: those that matter most, or the first that all sets have."""
    every = [n for n in table.space.parameters if all(v is not None for v in table.column(n))]
    return [*shares, *(name for name in every if name not in shares)][:2]


def sequence_groups(study: Study, names: Sequence[str]) -> tuple[str, dict[str, list[str]]]:
    """Groups of training sequences: by scene where courses share theirs, else each alone."""
    courses = study.config.courses
    if all(name in courses for name in names):
        scenes: dict[str, list[str]] = {}
        for name in names:
            kinds = sorted({scene for scene, _ in courses[name].legs})
            scenes.setdefault(", ".join(kinds), []).append(name)
        if 1 < len(scenes) < len(names):
            return "scene", scenes
    return "sequence", {name: [name] for name in names}


def reannealings(study: OfflineStudy) -> dict[int, list[int]]:
    """By the slot of a search, the numbers in it of the trials after which it was heated again.

    There are none where the sampler does not anneal.
    """
    if study.config.offline.sampler != "annealing":
        return {}
    archive = Archive(study.folder / "trials")
    config, space = study.config.offline, study.odometry.space
    finished = {name: archive.finished(name) for name in study.training}
    found = {}
    for search in make_searches(config, space, study.training, archive):
        slot = search.number(1) // OF_SLOT
        found[slot] = _reannealed(search, study, finished)
    return found


def _reannealed(search: Search, study: OfflineStudy, finished: Mapping[str, Any]) -> list[int]:
    from offline.samplers import AskedSampler

    config, batch = study.config.offline, study.config.offline.batch
    of_search = {n for name in search.sequences for n in finished[name]}
    numbers: list[int] = []
    while (number := search.number(len(numbers))) in of_search:
        numbers.append(number)
    numbers = numbers[: len(numbers) // batch * batch]
    sampler = search.make_sampler()
    if not numbers or not isinstance(sampler, AskedSampler):
        return []
    runs = {name: finished[name] for name in search.sequences}
    verdicts = [assess(n, search.sequences, config, search.sequences, runs) for n in numbers]
    return sampler.reannealed(sampler_results(verdicts))


def charts_of_validation(study: Study) -> Charts:
    """Charts of what `adaptune validate` found, and what is missing."""
    return charts_of(_of_validation(study))


def _of_validation(study: Study) -> Iterator[Chart | str | None]:
    stretches = _rows(study, "stretches")
    if not stretches:
        yield "No validation: run `adaptune validate`."
        return
    with _damage_told(study, "stretches"):
        yield stretch_chart(stretches)


def _rows(study: Study, name: str) -> list[dict[str, Any]]:
    """Rows that `adaptune.report.write_rows` wrote, with NaN where numbers are missing."""
    path = study.folder / f"{name}.json"
    if not path.exists():
        return []
    with _damage_told(study, name):
        rows = json.loads(path.read_text("utf-8"))
        return [{k: np.nan if v is None else v for k, v in row.items()} for row in rows]


@contextmanager
def _damage_told(study: Study, name: str) -> Iterator[None]:
    """Name the file whose rows are not as `adaptune validate` wrote them."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        path = study.folder / f"{name}.json"
        raise AdaptuneError(f"{path}: is damaged ({error!r}); run `adaptune validate`") from error
