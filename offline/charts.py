"""Charts of the offline stage: of trials, and of what was left out."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.report.charts import (
    Axis,
    Band,
    Chart,
    Charts,
    Drawn,
    Line,
    Panel,
    Points,
    Words,
)
from adaptune.space import Categorical, Parameter
from adaptune.space import label as parameter_label
from offline.bank_choice import figures
from offline.config import OfflineStudy
from offline.trial_table import FEW, TrialTable, importances, read_trials

MOST_PANELS = 12
"""Panels of a chart; further sequences are not shown."""
_COLOURED = 4.0
"""Colours say errors of up to so many times the least."""


def scatter_chart(table: TrialTable, parameters: Sequence[str], odometry: str) -> Chart | None:
    """Two parameters of all trials, coloured by the error: on each sequence, and in the mean.

    `odometry` is that of the trials; "" if there is only one.
    """
    if len(parameters) != 2:
        return None
    x_axis, y_axis = (parameter_axis(name, table.space.parameters[name]) for name in parameters)
    xy = [on_axis(table.column(name), table.space.parameters[name]) for name in parameters]
    values = {name: table.on(name) for name in table.names[: MOST_PANELS - 1]}
    left_out = len(table.names) - len(values)
    if len(table.names) > 1:
        values["mean over all sequences"] = table.values
    panels = []
    for title, of in values.items():
        kept = np.isfinite(of)
        if kept.sum() < 2:
            continue
        x, y = xy[0][kept], xy[1][kept]
        # The worst would take nearly all colours.
        most = _COLOURED * of[kept].min() if (of[kept] > 0.0).all() else np.inf
        top = f"\ntop: ≥ {most:.3g}" * bool((of[kept] > most).any())
        best = [int(of[kept].argmin())]
        drawn = [
            Points(x, y, "trial", np.minimum(of[kept], most), table.objective + top),
            Points(x[best], y[best], "best trial here", shape="diamond"),
        ]
        for mode, number in (("baseline", 0), ("fixed", table.fixed)):
            at = table.numbers == number
            drawn += [Points(xy[0][at], xy[1][at], mode)] if at.any() else []
        panels.append(Panel(x_axis, y_axis, tuple(drawn), title))
    if not panels:
        return None
    more = f" {left_out} more sequences are not shown." if left_out > 0 else ""
    title = f"Error of the trials over {parameters[0]} and {parameters[1]}"
    return Chart(
        f"parameter-scatter-{odometry}" if odometry else "parameter-scatter",
        f"{odometry}: {title}" if odometry else title,
        tuple(panels),
        f"Each point is a trial; its colour is its error, and each panel has colours of its own; "
        f"they end at {_COLOURED:g} times the least error there. "
        "Where the good region lies elsewhere from panel to panel, adapting can gain." + more,
        columns=2 if len(panels) in (2, 4) else min(3, len(panels)),
    )


def iteration_chart(table: TrialTable) -> Chart | None:
    """Error of each trial, and the least so far, over the trial's number."""
    table = table.some(np.isfinite(table.values))
    number, errors = table.numbers, table.values
    if len(number) < 2:
        return None
    allowed = np.where([not trial.failure for trial in table.trials.values()], errors, np.inf)
    least = np.minimum.accumulate(allowed)
    drawn: list[Drawn] = [
        Points(number, errors, "trial", texts=[f"trial {n}" for n in number]),
        Line(number, np.where(np.isfinite(least), least, np.nan), "best so far", steps=True),
    ]
    first = number == 0
    drawn += [Points(number[first], errors[first], "baseline")] if first.any() else []
    log = bool((errors > 0.0).all())
    return Chart(
        "iterations",
        "The search for parameters",
        (Panel(Axis("trial [-]"), Axis(table.objective, log), tuple(drawn)),),
        "Error of each trial in the order of the search, and the least so far. "
        "A flat end means that more trials promise little.",
    )


def front_chart(table: TrialTable) -> Chart | None:
    """Error over CPU time of what may be chosen, and the front: less error only at more cost."""
    every = table.trials.values()
    table = table.some(not t.failure and t.cost > 0.0 and 0.0 < t.value < np.inf for t in every)
    if len(table) < 2:
        return None
    costs, errors = np.array([(trial.cost, trial.value) for trial in table.trials.values()]).T
    order = np.lexsort((errors, costs))
    least = np.minimum.accumulate(errors[order])
    front = order[np.diff(least, prepend=np.inf) < 0.0]
    names = {table.fixed: "fixed", 0: "baseline"}
    texts = np.array([names.get(n, f"trial {n}") for n in table.numbers.tolist()], object)
    marked = {
        mode: at for mode in ("fixed", "baseline") if len(at := np.flatnonzero(texts == mode))
    }
    drawn: list[Drawn] = [
        Points(costs, errors, "tried", texts=texts, faint=True),
        Line(costs[front], errors[front], "front", steps=True),
    ]
    for mode, at in marked.items():
        drawn.append(Points(costs[at], errors[at], mode, texts=texts[at]))
    named = np.array([*marked.values()], int).ravel()
    drawn.append(Words(costs[named], errors[named], texts[named]))
    x, y = Axis("CPU time a scan [ms]", log=True), Axis(table.objective, log=True)
    return Chart(
        "front",
        "Error over cost of all that was tried",
        (Panel(x, y, tuple(drawn), height=1.3),),
        "Nothing that was tried has both less error and less cost than what lies on the front. "
        "Where the front is flat, more CPU time buys nothing. Errors are those of `trials.csv`, of "
        "segments; `front.csv` has those of whole drives, which only the best sets drive.",
    )


def parameter_axis(name: str, parameter: Parameter) -> Axis:
    """The axis of a parameter: logarithmic as its range is, or with the names of its choices."""
    if isinstance(parameter, Categorical):
        return Axis(parameter_label(name, parameter), names=tuple(map(str, parameter.choices)))
    return Axis(parameter_label(name, parameter), log=parameter.log)


def on_axis(values: Sequence[Any], parameter: Parameter) -> NDArray[np.float64]:
    """Where values of a parameter are on its axis, of shape (n,); NaN where a set has none."""
    at = parameter.index if isinstance(parameter, Categorical) else float
    return np.array([np.nan if value is None else at(value) for value in values], np.float64)


def importance_chart(by_odometry: Mapping[str, Mapping[str, float]]) -> Chart | None:
    """What `importances` found, a panel for each odometry; "" if there is only one."""
    panels = []
    for odometry, shares in by_odometry.items():
        if not shares:
            continue
        rising = list(shares.items())[::-1]
        names = tuple(f"{name} ({100.0 * share:.0f}\u00a0%)" for name, share in rising)
        ends = [(0.0, 100.0 * share, np.nan) for _, share in rising]
        bars = Line(np.ravel(ends), np.repeat(range(len(names)), 3), "", width=24.0)
        x = Axis("share of the error's variance [%]", limits=(0.0, 100.0))
        panels.append(Panel(x, Axis("", names=names), (bars,), odometry))
    if not panels:
        return None
    return Chart(
        "importance",
        "Which parameters matter",
        tuple(panels),
        "How much of the variance of the error (of its logarithm) over all trials a parameter "
        "explains (functional ANOVA). Where the search has hardly varied a parameter, it seems "
        "less important than it is. Few trials say little.",
    )


_FACTS = ("recording", "segment", "fixed [%]")


def segment_chart(rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Ratio to the fixed set's error on every segment left out, sorted: a panel for each mode."""
    recordings = [str(row["recording"]) for row in rows]
    panels = []
    for mode in (key for key in (rows[0] if rows else {}) if key not in _FACTS):
        ratios = np.array([row.get(mode, np.nan) for row in rows], float)
        # One that is the fixed set everywhere says nothing.
        if not np.isfinite(ratios).all() or (np.abs(ratios - 1.0) < 1e-9).all():
            continue
        panels.append(_segment_panel(mode, ratios, recordings))
    if not panels:
        return None
    return Chart(
        "segments",
        "Ratio to the fixed set's error on every segment left out",
        tuple(panels),
        "Each point is a segment that nothing was trained on, sorted by its ratio; below 1 the "
        "mode beats the fixed set. The band is the 95 % interval of the geometric mean over all "
        "segments. The oracle knows the errors in advance: the best set of each sequence.",
        columns=min(2, len(panels)),
    )


def _segment_panel(mode: str, ratios: np.ndarray[Any, Any], recordings: Sequence[str]) -> Panel:
    rank = 1 + np.argsort(np.argsort(ratios, kind="stable"))
    of = figures(np.log(ratios), recordings)
    ends = np.array([0.5, len(ratios) + 0.5])
    drawn: list[Drawn] = []
    if np.isfinite([of.low, of.high]).all() and of.low > 0.0:
        drawn.append(Band(ends, [of.low] * 2, [of.high] * 2, "95 % interval of the mean"))
    drawn += [
        Line(ends, [of.geometric] * 2, "geometric mean", dashed=True),
        Line(ends, [1.0, 1.0], "fixed", faint=True),
    ]
    drawn.append(Points(rank, ratios, "segment", texts=recordings))
    title = f"{mode}: {of.geometric:.2f} ({of.low:.2f}-{of.high:.2f})"
    x = Axis("segment, by rising ratio [-]", limits=(0.5, float(ends[1])))
    return Panel(x, Axis("error over the fixed set's [-]", log=True), tuple(drawn), title)


def charts_of_trials(study: OfflineStudy) -> Charts:
    """Charts of the finished trials; it reads no trial's frames."""
    table = read_trials(study)
    if not len(table):
        yield "No trials: run `adaptune offline`."
        return
    found = {name: importances(of) for name, of in table.odometries().items()}
    yield iteration_chart(table)
    yield importance_chart(found) or (
        f"No importance of parameters: it takes {FEW} finished trials and two parameters."
    )
    for odometry, of in table.odometries().items():
        yield scatter_chart(of, most_important(of, found[odometry]), odometry)
    yield front_chart(table)


def most_important(table: TrialTable, shares: Mapping[str, float]) -> list[str]:
    """Names of two parameters: those that matter most, or the first that all sets have."""
    every = [n for n in table.space.parameters if all(v is not None for v in table.column(n))]
    return [*shares, *(name for name in every if name not in shares)][:2]


def charts_of_validation(folder: Path) -> Charts:
    """The chart of what `adaptune validate` found.

    An AdaptuneError says that its file is not as `adaptune validate` wrote it.
    """
    path = folder / "segments.json"
    if not path.exists():
        yield "No validation: run `adaptune validate`."
        return
    try:
        yield segment_chart(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise AdaptuneError(f"{path}: is damaged ({error!r}); run `adaptune validate`") from error
