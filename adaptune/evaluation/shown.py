"""What an evaluation shows: sentences, tables, and a page with charts."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adaptune.evaluation.judged import Judged
from adaptune.metrics import FAILURE, absolute_errors
from adaptune.paired import Interval, Ratio, in_cell
from adaptune.reference.diagnosis import OWN_ERROR
from adaptune.reference.judge import columns_of
from adaptune.report.charts import Axis, Chart, Line, Panel, Points
from adaptune.report.page import Page, PageSection, write_page
from adaptune.report.tables import Listing, write_rows

_SENTENCES, _SAID = 5, 2
"""Of the summary; and faults, and trajectories, that are told one by one in it."""
_NONE = 0.005  # percent of an error that is none
_PLACES, _PATHS = 400, 6  # points of a path, and paths, that are drawn
_ALIKE = "what all registrations of these scans get wrong alike, as a scale of the ranges"
_CAPTION = (
    "RTE: mean error of sub-trajectories, in percent of their length; 30 stands for 30 or more. "
    "Worst: where and when the sub-trajectories had the greatest error. Unknown: share of the time "
    "without a reference."
)


class Compared(NamedTuple):
    """Two trajectories, over the recordings that have both."""

    better: str
    other: str
    ratio: Ratio  # of the error of the better one to that of the other


def in_words(judged: Sequence[Judged], pairs: Sequence[Compared]) -> list[str]:
    """What to do, how wrong the trajectories are, and how surely, in five sentences at most."""
    doubts = (f"{one.judge.name} {one.judge.doubt}." for one in judged if one.judge.doubt)
    said = list(dict.fromkeys(doubts))
    causes = [(f"{one.title}: {one.cause}.", one.cause) for one in judged if one.cause]
    said += [text for text, cause in causes if cause.mend != OWN_ERROR][:_SAID]
    main = next(one for one in judged if not pairs or one.name == pairs[0].better)
    said.append(("Best: " if pairs else "Worst: " if judged[1:] else "") + _error(main))
    for pair in pairs[:_SAID]:
        times = f"{pair.ratio.value:.2f} times {pair.other}'s error"
        ends = pair.ratio.interval
        surely = ends is not None and ends[1] < 1.0
        first = "It surely" if surely else "Not sure that it is better: it"
        said.append(f"{first} has {times} ({_sure(ends)}).")
    row = main.row
    where = f"{row['at [s]']:.1f} s, x {row['x [m]']:.1f} y {row['y [m]']:.1f} m"
    drift = f"{row['drift [m/100 m]']:.2g} m in a hundred, measured over {row['_drift_over_m']:g} m"
    begin = "It was" if main.bounded else f"It drifts by {drift}; it was"
    more = " or more" * (row["worst [%]"] > FAILURE - _NONE)
    said.append(f"{begin} worst at {where}: {row['worst [%]']:.2g} %{more}.")
    said += [f"{one.title}: {_listed(one.faults)}." for one in judged if one.faults][:_SAID]
    unknown = max(judged, key=lambda one: one.unknown_share)
    if unknown.unknown_share > 0.005:
        gaps = unknown.judge.unknown[:_SAID]
        why = "; ".join(f"{begin:.1f} to {end:.1f} s, {why}" for begin, end, why in gaps)
        share = f"{100.0 * unknown.unknown_share:.0f} % of {unknown.title}"
        said.append(f"Nobody can judge {share}" + f" ({why})" * bool(why) + ".")
    return [*said, *(text for text, cause in causes if cause.mend == OWN_ERROR)][:_SENTENCES]


def _error(one: Judged) -> str:
    """The error of a trajectory, how sure it is, and who says so."""
    reference, ends, own = one.judge.reference, one.interval, "whose own error "
    if reference.error is None:
        own += "is not known"
    elif reference.estimated:
        own += f"is in the interval, about {reference.error:.2g} %, but not {_ALIKE}"
    elif reference.error < _NONE:
        own += "registrations do not show"
    else:
        own += f"is in the interval as far as registrations show it, {reference.error:.2g} %"
    by = f"over {reference.length:g} m, by {one.judge.name}, {own}."
    if one.blind:
        most = max(ends[1] if ends else 0.0, one.rte)
        return f"{one.title} is better than can be told here: below {most:.2g} % {by}"
    if one.bounded:
        what = f"{one.title} is wrong by {one.rte:.3g} % or more over {reference.length:g} m"
        return f"{what}, by {one.judge.name}."
    return f"{one.title} is wrong by {one.rte:.2f} % ({_sure(ends)}) {by}"


def _sure(ends: Interval) -> str:
    return f"95 % interval {ends[0]:.2f} to {ends[1]:.2f}" if ends else "too short for an interval"


def _listed(findings: Sequence[object]) -> str:
    more = f"; and {len(findings) - _SAID} more" * (len(findings) > _SAID)
    return "; ".join(map(str, findings[:_SAID])) + more


def tables(judged: Sequence[Judged], pairs: Sequence[Compared]) -> list[Listing]:
    """What was found; the errors that other tools give; and the best against each other one."""
    title = f"Errors over {judged[0].judge.reference.length:g} m, the worst first"
    of_others = [
        {"recording": one.judge.recording, "trajectory": one.name}
        | columns_of(one.judge.reference.standard(one.odometry))
        for one in judged
    ]
    rows = [
        {"trajectory": best, "against": other, "ratio": of.value, "95 %": in_cell(of.interval)}
        for best, other, of in pairs
    ]
    found = [
        Listing(title, [one.row for one in judged], _CAPTION),
        Listing("Errors as evo and KITTI's benchmark have them", of_others),
        Listing("The best against each other one", rows),
    ]
    return found if pairs else found[:2]


def write_evaluation(out: Path, judged: Sequence[Judged], pairs: Sequence[Compared]) -> Path:
    """Write the page, its charts, and the table as CSV and JSON; returns the page."""
    notes = [f"{one.title}: {f}." for one in judged for f in (one.cause, *one.faults) if f]
    made = tuple(_charts(judged)), tuple(tables(judged, pairs))
    section = PageSection("Errors", tuple(notes), *made)
    by = f"Judged by {', '.join(dict.fromkeys(one.judge.name for one in judged))}"
    path = out / "evaluation.html"
    write_page(path, Page("Evaluation", by, tuple(in_words(judged, pairs)), (section,)))
    write_rows(out, "evaluation", [one.row for one in judged])
    return path


def _charts(judged: Sequence[Judged]) -> Iterator[Chart]:
    about = "Colour: mean error of the sub-trajectories through each place. Grey: not known."
    paths = tuple(map(_path, judged[:_PATHS]))
    yield Chart("paths", "Paths by error", paths, about, columns=min(len(paths), 2))
    for name in dict.fromkeys(one.judge.recording for one in judged):
        of = [one for one in judged if one.judge.recording == name]
        time, length = Axis("time [s]"), of[0].judge.reference.length
        error = Axis(f"RTE over {length:g} m [%]", log=True)
        around = tuple(Line(one.seconds, one.around, one.name) for one in of)
        apart = tuple(
            Line(one.seconds, absolute_errors(one.truth, one.odometry.T_world_sensor), one.name)
            for one in of
        )
        panels = Panel(time, error, around), Panel(time, Axis("from the judge [m]"), apart)
        about = "Above: as in the paths. Below: distance of the paths, aligned as a whole."
        yield Chart(f"{name}-errors", f"{name}: error over time", panels, about, shared_x=True)


def _path(one: Judged) -> Panel:
    x, y = one.truth[:, :2, 3].T
    some = np.unique(np.linspace(0, len(x) - 1, _PLACES).astype(int))
    some = some[np.isfinite(one.around[some])]
    drawn = Line(x, y, "", faint=True), Points(x[some], y[some], "", one.around[some], "error [%]")
    return Panel(Axis("x [m]"), Axis("y [m]"), drawn, one.title, equal=True)
