"""Charts of the online stage: of a comparison, and of the replays of a sequence."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.model.registry import ADAPTIVE
from adaptune.report.charts import (
    Axis,
    Band,
    Chart,
    Charts,
    Drawn,
    Line,
    Panel,
    Points,
    Spans,
    Words,
    shares,
)
from adaptune.runs.record import switched
from adaptune.space import IN_DOUBT
from online.modes import BASELINE, FIXED, WITHOUT_MODEL
from online.replayed import JudgedRun, ReplayedSequence
from online.statistics import ALL, ComparisonRow

_LINE, _BELOW = 0.12, 0.3
"""Height of a mode's line, and by which share of it the ratios on each sequence lie lower."""


def comparison_chart(rows: Sequence[ComparisonRow]) -> Chart | None:
    """Ratios to the yardstick's error, a line for each mode, the least at the top."""
    known = [row for row in rows if row.ratio is not None and row.mode != row.yardstick]
    if not known:
        return None
    # Those over all sequences, or on the only one.
    last = [row for row in known if row.sequence == known[-1].sequence]
    last.sort(key=lambda row: row.ratio or 0.0, reverse=True)
    modes, yardstick = [row.mode for row in last], last[0].yardstick

    def points(name: str, some: Sequence[ComparisonRow], below: float, **look: Any) -> Points:
        ratios = [row.ratio for row in some]
        places = [modes.index(row.mode) - below for row in some]
        texts = [f"{row.mode}, {row.sequence}" for row in some]
        return Points(ratios, places, name, texts=texts, **look)

    drawn: list[Drawn] = [Line([1.0, 1.0], [-0.6, len(modes) - 0.4], "", dashed=True, width=1.0)]
    ends = [(*row.ratio_interval, i) for i, row in enumerate(last) if row.ratio_interval]
    if ends:
        x = [value for low, high, _ in ends for value in (low, high, np.nan)]
        drawn.append(Line(x, [i for *_, i in ends for _ in range(3)], "95 % interval"))
    several = last[0].sequence == ALL
    where = "geometric mean over all sequences" if several else last[0].sequence
    drawn.append(points(where, last, 0.0))
    if several:
        of_each = [row for row in known if row.mode in modes and row.sequence != ALL]
        drawn.append(points("each sequence", of_each, _BELOW, faint=True, shape="circle"))
    x_axis = Axis(f"error over that of {yardstick} [-]", log=True)
    y_axis = Axis("", names=tuple(modes))
    return Chart(
        "comparison",
        f"Error of each mode over that of {yardstick}, on the test sequences",
        (Panel(x_axis, y_axis, tuple(drawn), height=0.3 + _LINE * len(modes)),),
        f"Left of the dashed line means less error than {yardstick}, right of it more; the least "
        f"error is at the top. Intervals are shown where the recordings are long enough, or many "
        f"enough." + (" Below each mean are the ratios on each sequence." if several else ""),
    )


TIME = Axis("time [s]")
_MOST_PLACES = 200
"""Points of a path; more would hide each other."""
_RESTARTED = "restarted by the health check"
_MARKS = {"lost": ("lost: left out, or restarts", "cross"), "late": ("late, or removed", "square")}
"""Names and shapes of the marks where a member of a bank does not work, by its state."""


def charts_of_replays(replayed: ReplayedSequence) -> Charts:
    """Charts of the replays of a sequence, in all modes that there are."""
    if replayed.modes:
        no_errors = f"No errors of the replays of {replayed.name}: it has no reference."
        yield error_chart(replayed) or no_errors
        yield choice_chart(replayed)
    else:
        yield f"No replays of {replayed.name}: run `adaptune online`."


def error_chart(replayed: ReplayedSequence) -> Chart | None:
    """Error of every mode over time; and what modes have measured themselves."""
    panels = []
    if any(np.isfinite(track.errors).any() for track in replayed.modes.values()):
        panels.append(_errors(replayed))
    for mode, track in replayed.modes.items():
        if np.isfinite(track.run.estimated[:, 0]).any() or _in_doubt(track).any():
            panels.append(_estimates(mode, track, replayed))
    if not panels:
        return None
    measured = (
        " Below, what a mode measured of its own error while it drove, without the reference: it "
        "should follow the line of the true error, and the interval should hold it."
        if len(panels) > 1
        else ""
    )
    return Chart(
        f"{replayed.name}-errors",
        f"{replayed.name}: error over time",
        tuple(panels),
        f"Error of the sub-trajectory of {replayed.length:g} m that begins at each scan.{measured}",
        shared_x=True,
    )


def _errors(replayed: ReplayedSequence) -> Panel:
    drawn = _scenes(replayed)
    drawn += [Line(track.seconds, track.errors, mode) for mode, track in replayed.modes.items()]
    for mode, track in replayed.modes.items():
        if (restarted := track.run.restarted).any():
            x, y = track.seconds[restarted], track.errors[restarted]
            texts = [f"{mode}, {seconds:.1f} s" for seconds in x]
            drawn.append(Points(x, y, _RESTARTED, texts=texts, shape="triangle-down"))
    axis = Axis(f"RTE over the next {replayed.length:g} m [%]", log=True)
    return Panel(TIME, axis, tuple(drawn), height=1.6)


def _estimates(mode: str, track: JudgedRun, replayed: ReplayedSequence) -> Panel:
    seconds, states = track.span[:-1], track.states
    estimated, low, high = track.run.estimated.T
    drawn: list[Drawn] = []
    if (doubted := _in_doubt(track)).any():
        # From a selection at which that changes to the next; what is not shaded has no name.
        begins = np.flatnonzero(np.append(True, states[1:] != states[:-1]))
        names = tuple(str(states[i]) if doubted[i] else "" for i in begins)
        drawn.append(Spans([*seconds[begins], track.span[-1]], names, "state"))
    if np.isfinite(track.errors_behind).any():
        judge = "by the estimated reference" if replayed.estimated else "true"
        drawn.append(Line(track.seconds, track.errors_behind, judge))
    drawn += [
        Band(seconds, low, high, "95 % interval"),
        Line(seconds, estimated, "measured while driving"),
    ]
    y = Axis(f"RTE over {replayed.length:g} m,\nlast 30 s [%]", log=True)
    return Panel(TIME, y, tuple(drawn), f"{mode}: its error as measured while driving")


def _in_doubt(track: JudgedRun) -> NDArray[np.bool_]:
    return np.isin(track.states, list(IN_DOUBT))


def choice_chart(replayed: ReplayedSequence) -> Chart | None:
    """What every mode applied along the course: its parameters, or the weights of its bank."""
    panels = [*_parameters(replayed), *_weights(replayed), *_at_work(replayed)]
    if not panels:
        return None
    return Chart(
        f"{replayed.name}-choices",
        f"{replayed.name}: what was applied along the course",
        tuple(panels),
        "Parameters of each mode over time; of a bank, the shares of its members in the weighted "
        "mean. Names above are the scenes of the course, if it is a simulated one: what is applied "
        "should change with them. What no mode changes is not drawn."
        + "".join(f" {name.capitalize()}: {of}." for name, of in replayed.members.items()),
        shared_x=True,
    )


def _parameters(replayed: ReplayedSequence) -> Iterator[Panel]:
    single = {mode: track for mode, track in replayed.modes.items() if not track.weights}
    for name in dict.fromkeys(name for track in single.values() for name in track.run.values):
        chosen = {mode: t.run.values[name] for mode, t in single.items() if name in t.run.values}
        if all(len({*map(repr, values)}) < 2 for values in chosen.values()):
            continue
        every = [value for values in chosen.values() for value in values]
        is_named = any(isinstance(value, str) for value in every)
        names = tuple(sorted({_name(value) for value in every} - {""})) if is_named else None
        drawn = _scenes(replayed)
        for mode, values in chosen.items():
            y = [_place(value, names) for value in values]
            span, dashed = single[mode].span, not single[mode].adapts
            drawn.append(Line(span, [*y, y[-1]], mode, steps=True, dashed=dashed))
        log = name in replayed.space.logarithmic and names is None
        axis = Axis(replayed.space.labels[name], log=log, names=names)
        yield Panel(TIME, axis, tuple(drawn), name)


def _name(value: Any) -> str:
    """A value among names; the set of another odometry has none."""
    if isinstance(value, str):
        return value
    number = np.format_float_positional(value, 6, fractional=False, trim="-")
    return "" if np.isnan(value) else number


def _place(value: Any, names: tuple[str, ...] | None) -> float:
    if names is None:
        return float(value)
    return float(names.index(name)) if (name := _name(value)) else np.nan


def _weights(replayed: ReplayedSequence) -> Iterator[Panel]:
    for mode, track in replayed.modes.items():
        parts = 100.0 * np.array(list(track.weights.values()))
        if len(parts) < 2 or not np.ptp(parts, axis=1).any():
            continue  # they never change
        parts = np.column_stack([parts, parts[:, -1]])
        # Shares hide what is shaded.
        ends = [] if replayed.scenes is None else replayed.scenes.edges[1:-1]
        edges = (Line([edge] * 2, [0.0, 100.0], "", dashed=True, width=1.0) for edge in ends)
        drawn = (*_scenes(replayed), *shares(track.span, parts, track.weights), *edges)
        y = Axis("weight [%]", limits=(0.0, 100.0))
        yield Panel(TIME, y, drawn, f"{mode} applies a bank: weights of its members")


def _at_work(replayed: ReplayedSequence) -> Iterator[Panel]:
    """When the members of a bank work, where one does not always."""
    for mode, track in replayed.modes.items():
        states = np.array(list(track.members.values()))
        if not states.size or np.isin(states, ["works", ""]).all():
            continue
        rows, seconds = np.indices(states.shape)[0], np.broadcast_to(track.seconds, states.shape)
        # Until the next scan, so that a single one is seen.
        works = states == "works"
        works[:, 1:] |= works[:, :-1]
        each = zip(track.members, np.where(works, rows, np.nan), strict=True)
        drawn: list[Drawn] = [Line(track.seconds, y, name, width=7.0) for name, y in each]
        for state, (name, shape) in _MARKS.items():
            if (at := states == state).any():
                drawn.append(Points(seconds[at], rows[at], name, shape=shape))
        title = f"{mode}: which members of its bank work; where there is nothing, one rests"
        yield Panel(TIME, Axis("", names=tuple(track.members)), tuple(drawn), title, height=0.3)


def _scenes(replayed: ReplayedSequence) -> list[Drawn]:
    return [] if replayed.scenes is None else [replayed.scenes]


def charts_of_comparison(
    rows: Sequence[ComparisonRow], read: Callable[[str], ReplayedSequence]
) -> Charts:
    """The picture of a comparison, and the ratios of all modes; `read` is `read_replays`."""
    yield overview_chart(rows, read)
    yield comparison_chart(rows) or "No ratios of errors: no sequence has a reference."


def overview_chart(
    rows: Sequence[ComparisonRow], read: Callable[[str], ReplayedSequence]
) -> Chart | None:
    """The sequence on which the main modes differ most: where, how far off, and what was chosen."""
    main = WITHOUT_MODEL if rows[0].yardstick == BASELINE else (BASELINE, FIXED, ADAPTIVE)
    errors: dict[str, dict[str, float]] = {}
    for row in rows:
        if row.sequence != ALL and row.mode in main and row.rte is not None:
            errors.setdefault(row.sequence, {})[row.mode] = max(row.rte, 1e-12)
    ratios = {
        sequence: max(e.values()) / min(e.values()) for sequence, e in errors.items() if len(e) > 1
    }
    if not ratios:
        return None
    name = max(ratios, key=lambda name: ratios[name])
    replayed = read(name)
    if errors[name].keys() - replayed.modes.keys():
        return None  # in a copy of a folder, replays of another model may hide these
    replayed = replace(replayed, modes={mode: replayed.modes[mode] for mode in errors[name]})
    places = _turned([*replayed.modes.values()][-1].places)
    panels = _path(replayed, places), _errors_around(replayed), *_chosen(replayed)
    *means, least = (f"{mode} ({rte:.2g} %)" for mode, rte in errors[name].items())
    last = [*replayed.modes][-1]
    chose = f"The last panel shows what {last} chose" if len(panels) > 2 else f"{last} kept its set"
    return Chart(
        "overview",
        f"{name}: error of {', '.join(means)} and {least}",
        panels,
        f"The error at each moment is the mean of the sub-trajectories of {replayed.length:g} m "
        f"through it. {chose}.",
        shared_x=True,
    )


def _path(replayed: ReplayedSequence, places: NDArray[np.float64]) -> Panel:
    """The path, coloured by kind of place, or where none is known by the error of the last mode."""
    mode, track = list(replayed.modes.items())[-1]
    x, y = places.T
    drawn: list[Drawn] = []
    named = [(int(np.isfinite(x).argmax()), "start")]
    if (scenes := replayed.scenes) is None:
        some = np.linspace(0, len(x) - 1, _MOST_PLACES).astype(int)
        some = some[np.isfinite(track.errors_around[some])]
        drawn.append(Line(x, y, "", faint=True))
        drawn.append(Points(x[some], y[some], "", track.errors_around[some], "error [%]"))
    else:
        ends = np.searchsorted(track.seconds, scenes.edges)
        for begin, end, name in zip(ends[:-1], ends[1:], scenes.names, strict=True):
            drawn.append(Line(x[begin : end + 1], y[begin : end + 1], name, width=7.0))
        named += [*zip((ends[:-1] + ends[1:]) // 2, scenes.names, strict=True)]
    at = [i for i, _ in named]
    drawn.append(Words(x[at], y[at], [name for _, name in named]))
    title = f"the path from above, by {'kind of place' if scenes else f'error of {mode}'}"
    return Panel(Axis("[m]"), Axis("[m]"), tuple(drawn), title, equal=True)


def _turned(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places, of shape (n, 2), turned so that they lie along x, and lead to the right."""
    known = places[np.isfinite(places).all(axis=1)]
    angles = np.radians(np.arange(0.0, 180.0, 2.0))
    heights = np.ptp(known @ (-np.sin(angles), np.cos(angles)), axis=0)
    angle = angles[heights.argmin()]
    along = np.array([np.cos(angle), np.sin(angle)])
    along *= np.sign((known[-1] - known[0]) @ along) or 1.0
    return np.asarray((places - known[0]) @ np.column_stack([along, (-along[1], along[0])]))


def _errors_around(replayed: ReplayedSequence) -> Panel:
    fixed, lines = replayed.modes.get(FIXED), []
    for mode, track in replayed.modes.items():
        same = fixed is not None and np.array_equal(track.errors, fixed.errors, equal_nan=True)
        # It would hide the line of the fixed set, which it has kept.
        lines.append(Line(track.seconds, track.errors_around, mode, dashed=mode != FIXED and same))
    title = f"error (RTE over {replayed.length:g} m) around each moment"
    return Panel(TIME, Axis("error [%]", log=True), (*_scenes(replayed), *lines), title, height=1.6)


def _chosen(replayed: ReplayedSequence) -> Iterator[Panel]:
    """What the last mode chose: weights, or the parameter that it changed most often."""
    mode, track = list(replayed.modes.items())[-1]
    if track.weights:
        yield from _weights(replace(replayed, modes={mode: track}))
    elif track.adapts:
        chosen = track.run.values
        changes = {name: switched({name: values}).sum() for name, values in chosen.items()}
        most = max(changes, key=lambda name: changes[name])
        if changes[most]:
            (panel,) = (panel for panel in _parameters(replayed) if panel.title == most)
            yield replace(panel, title=f"what {mode} chose: {most}")
