"""The page of an evaluation, and its tables."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptune.evaluation.judged import Judged
from adaptune.evaluation.words import ALIKE, in_words
from adaptune.geometry import nearest_rotation
from adaptune.report.charts import Axis, Chart, Line, Panel, Points
from adaptune.report.page import Page, PageSection, write_page
from adaptune.report.tables import Listing, write_rows

if TYPE_CHECKING:
    from adaptune.evaluation.evaluated import Compared

_MOST_PLACES, _MOST_PATHS = 400, 6
_TIME = Axis("time [s]")
CAPTION = (
    "RTE: mean error of sub-trajectories, in percent of their length. Worst: the place that "
    "sub-trajectories with the greatest error go through, and when. Unknown: share of the time in "
    "which the judge has no pose."
)


def tables(judged: Sequence[Judged], pairs: Sequence["Compared"]) -> list[Listing]:
    """What was found; the errors that other tools give; how trajectories compare."""
    first = judged[0].judge.reference.length
    made = [
        Listing(f"Errors over {first:g} m, the worst first", [o.row for o in judged], CAPTION),
        Listing("Errors as evo and KITTI's benchmark have them", [o.standard for o in judged]),
    ]
    rows = [
        {"better": p.better, "other": p.other, "ratio": p.ratio.value}
        | {"95 %": p.ratio.interval and "{:.2f}-{:.2f}".format(*p.ratio.interval)}
        for p in pairs
    ]
    return [*made, Listing("The best against each other one", rows)] if rows else made


def write_evaluation(out: Path, judged: Sequence[Judged], pairs: Sequence["Compared"]) -> Path:
    """Write the page, its charts, and the table as CSV and JSON; returns the page."""
    notes = [ALIKE] * any(one.judge.reference.estimated for one in judged)
    notes += [f"{one.title}: {f}." for one in judged for f in (*one.causes, *one.faults)]
    made = tuple(tables(judged, pairs))
    section = PageSection("Errors", tuple(notes), tuple(_charts(judged)), made)
    subtitle = f"Judged by {', '.join(dict.fromkeys(one.judge.name for one in judged))}"
    path = out / "evaluation.html"
    write_page(path, Page("Evaluation", subtitle, tuple(in_words(judged, pairs)), (section,)))
    write_rows(out, "evaluation", [one.row for one in judged])
    return path


def _charts(judged: Sequence[Judged]) -> Iterator[Chart]:
    yield Chart(
        "paths",
        "The paths from above, by error",
        tuple(map(_path, judged[:_MOST_PATHS])),
        "Colour: mean error of the sub-trajectories through each place. Grey: not known.",
        columns=2 if len(judged) > 1 else 1,
    )
    by_recording: dict[str, list[Judged]] = {}
    for one in judged:
        by_recording.setdefault(one.judge.recording, []).append(one)
    for name, of in by_recording.items():
        length = of[0].judge.reference.length
        errors = [Line(o.seconds, o.around, o.name) for o in of]
        apart = [Line(o.seconds, _apart(o), o.name) for o in of]
        yield Chart(
            f"{name}-errors",
            f"{name}: error over time",
            (
                Panel(_TIME, Axis(f"RTE over {length:g} m [%]", log=True), tuple(errors)),
                Panel(_TIME, Axis("from the judge [m]"), tuple(apart)),
            ),
            "Above: mean error of the sub-trajectories through each moment. Below: distance from "
            "the judge's path, after both were aligned as a whole.",
            shared_x=True,
        )


def _path(one: Judged) -> Panel:
    x, y = one.truth[:, :2, 3].T
    some = np.unique(np.linspace(0, len(x) - 1, _MOST_PLACES).astype(int))
    some = some[np.isfinite(one.around[some])]
    points = Points(x[some], y[some], "", one.around[some], "error [%]")
    return Panel(
        Axis("x [m]"), Axis("y [m]"), (Line(x, y, "", faint=True), points), one.title, True
    )


def _apart(one: Judged) -> NDArray[np.float64]:
    """Metres from the judge's path after alignment, of shape (n,); NaN where it is unknown."""
    ref, own = one.truth[:, :3, 3], one.odometry.T_world_sensor[:, :3, 3]
    known = np.isfinite(ref[:, 0])
    means = ref[known].mean(axis=0), own[known].mean(axis=0)
    R = nearest_rotation(own[known] - means[1], ref[known] - means[0])
    return np.asarray(np.linalg.norm(ref - means[0] - (own - means[1]) @ R.T, axis=1))
