"""Charts of the replays of a sequence: errors, parameters and places."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.charts.chart import (
    Axis,
    Band,
    Chart,
    Charts,
    Drawn,
    Line,
    Panel,
    Points,
    Shares,
    Spans,
    charts_of,
)
from adaptune.drawing import plain
from adaptune.study.study import Study
from online.replay_picture import Track
from online.replayed_sequence import ModeReplay, ReplayedSequence, read_replays
from online.selection_charts import familiarity_chart, latency_chart

TIME = Axis("time [s]")
_MOST_PLACES = 200
"""Points of a map; more would hide each other."""
_MOST_MAPS = 12
_SLENDER, _LOW = 0.2, 0.35
"""A course whose height from above is a smaller share of its width has low panels."""
_RESTARTED = "restarted by the health check"


def charts_of_replays(study: Study, sequence: str) -> Charts:
    """Charts of the replays of a sequence, in all modes that there are, and what is missing.

    Raises
    ------
    AdaptuneError
        If a file of a replay is damaged, or all are of something else than the study.
    """
    replayed = read_replays(study, sequence)
    if not replayed.modes:
        none = [f"No replays of {sequence}: run `adaptune online`."]
        return Charts([], [*replayed.refused] or none)
    whose = "mode whose replay can be read" if replayed.refused else "mode"
    return charts_of(
        (
            *replayed.refused,
            error_chart(replayed)
            or f"No errors of the replays of {sequence}: it has no reference.",
            choice_chart(replayed),
            map_chart(replayed)
            or f"No map of what was selected on {sequence}: no {whose} has changed anything.",
            familiarity_chart(replayed),
            latency_chart(replayed),
        )
    )


def error_chart(replayed: ReplayedSequence) -> Chart | None:
    """Error of every mode over time, with its switches; and what modes have measured themselves."""
    panels = []
    if any(np.isfinite(of.track.errors).any() for of in replayed.modes.values()):
        panels.append(_errors(replayed))
    for mode, of in replayed.modes.items():
        if np.isfinite(of.track.estimated[:, 0]).any() or of.track.lost.any():
            panels.append(_estimates(mode, of.track, replayed))
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
        f"Error of the sub-trajectory of {replayed.length:g} m that begins at each scan. Markers "
        f"on a line are switches of its parameters.{measured}",
        shared_x=True,
    )


def _errors(replayed: ReplayedSequence) -> Panel:
    drawn: list[Drawn] = _scenes(replayed)
    for mode, (track, *_) in replayed.modes.items():
        drawn.append(Line(track.seconds, track.errors, mode))
        at = np.searchsorted(track.seconds, switches(track))
        at = at[at < len(track.seconds)]
        if len(at):
            drawn.append(Points(track.seconds[at], track.errors[at], mode))
    for mode, (track, *_) in replayed.modes.items():
        if restarts := track.restarts:
            x, y = track.seconds[restarts], track.errors[restarts]
            texts = [f"{mode}, {seconds:.1f} s" for seconds in x]
            drawn.append(Points(x, y, _RESTARTED, texts=texts, marker="v"))
    axis = Axis(f"RTE over the next {replayed.length:g} m [%]", log=True)
    return Panel(TIME, axis, tuple(drawn), height=1.6)


def switches(track: Track) -> NDArray[np.float64]:
    """Seconds of the selections that changed a parameter; none of a bank, which changes weights."""
    if track.weights or len(track.choice_seconds) < 2:
        return np.empty(0)
    rows = list(zip(*track.choices.values(), strict=True))
    # As texts, because NaN does not equal itself.
    changed = [i for i in range(1, len(rows)) if repr(rows[i]) != repr(rows[i - 1])]
    return track.choice_seconds[changed]


def _estimates(mode: str, track: Track, replayed: ReplayedSequence) -> Panel:
    seconds, (estimated, low, high) = track.choice_seconds, track.estimated.T
    drawn: list[Drawn] = []
    if spans := track.lost_spans:
        # Between two stretches in which it was lost lies one without a name.
        edges = [edge for span in spans for edge in span]
        names = [name for _ in spans for name in ("lost", "")][:-1]
        drawn.append(Spans(edges, tuple(names), "lost"))
    if np.isfinite(track.errors_behind).any():
        judge = "by the estimated reference" if replayed.estimated else "true"
        drawn.append(Line(track.seconds, track.errors_behind, judge))
    drawn += [
        Band(seconds, low, high, "95 % interval"),
        Line(seconds, estimated, "measured while driving"),
    ]
    y = Axis(f"RTE over {replayed.length:g} m, last 30 s [%]", log=True)
    return Panel(TIME, y, tuple(drawn), f"{mode}: its error as measured while driving")


def choice_chart(replayed: ReplayedSequence) -> Chart | None:
    """What every mode applied along the course: its parameters, or the weights of its bank."""
    panels = [*_parameters(replayed), *_weights(replayed)]
    if not panels:
        return None
    return Chart(
        f"{replayed.name}-choices",
        f"{replayed.name}: what was applied along the course",
        tuple(panels),
        "Parameters of each mode over time; of a bank, the shares of its members in the weighted "
        "mean, the fixed set's first (without a model, the baseline's). Names above are the scenes "
        "of the course, if it is a simulated one: what is applied should change with them.",
        shared_x=True,
    )


def _parameters(replayed: ReplayedSequence) -> Iterator[Panel]:
    single = {mode: of.track for mode, of in replayed.modes.items() if not of.track.weights}
    for name in dict.fromkeys(name for track in single.values() for name in track.choices):
        chosen = {mode: t.choices[name] for mode, t in single.items() if name in t.choices}
        names = _names(v for values in chosen.values() for v in values)
        drawn = _scenes(replayed)
        for mode, values in chosen.items():
            y = [_place(value, names) for value in values]
            drawn.append(Line(single[mode].span, [*y, y[-1]], mode, steps=True))
        log = name in replayed.space.logarithmic and names is None
        axis = Axis(replayed.space.labels[name], log=log, names=names)
        yield Panel(TIME, axis, tuple(drawn), name)


def _names(values: Iterator[Any]) -> tuple[str, ...] | None:
    """The names on an axis of these values; None if all are numbers."""
    every = list(values)
    if not any(isinstance(value, str) for value in every):
        return None
    return tuple(sorted({_name(value) for value in every} - {""}))


def _name(value: Any) -> str:
    """A value among names; the set of another odometry has none."""
    return value if isinstance(value, str) else "" if np.isnan(value) else plain(value)


def _place(value: Any, names: tuple[str, ...] | None) -> float:
    if names is None:
        return float(value)
    return float(names.index(name)) if (name := _name(value)) else np.nan


def _weights(replayed: ReplayedSequence) -> Iterator[Panel]:
    for mode, (track, *_) in replayed.modes.items():
        shares = 100.0 * np.array(list(track.weights.values()))
        if not _changes(shares):
            continue
        shares = np.column_stack([shares, shares[:, -1]])
        drawn = (*_scenes(replayed), Shares(track.span, shares, tuple(track.weights)))
        y = Axis("weight [%]", limits=(0.0, 100.0))
        yield Panel(TIME, y, drawn, f"{mode} applies a bank: weights of its members")


def _changes(weights: NDArray[np.float64]) -> bool:
    """Whether weights, of shape (n_members, m), change along the course."""
    return bool(len(weights) > 1 and np.ptp(weights, axis=1).max() > 0.0)


def _scenes(replayed: ReplayedSequence) -> list[Drawn]:
    return [] if replayed.scenes is None else [replayed.scenes]


def map_chart(replayed: ReplayedSequence) -> Chart | None:
    """The course from above, coloured by what each mode applied there."""
    panels = [
        panel
        for mode, of in replayed.modes.items()
        if of.adapts and np.isfinite(of.places).all(axis=1).any()
        for panel in _maps(mode, of, replayed)
    ]
    if not panels:
        return None
    return Chart(
        f"{replayed.name}-map",
        f"{replayed.name}: what was applied where, from above",
        tuple(panels[:_MOST_MAPS]),
        "Each point is a scan where the sensor was, seen from its first pose; its colour is what "
        "was applied there. Of a bank, it is the share of the heaviest member other than its first "
        "one, which is the fixed set, or without a model the baseline. Places that look alike "
        "should have the same colour.",
        # A course that leads straight ahead needs the whole width, and no height.
        columns=1 if panels[0].height < 1.0 else min(2, len(panels)),
    )


def _maps(mode: str, of: ModeReplay, replayed: ReplayedSequence) -> Iterator[Panel]:
    if of.track.weights:
        weights = 100.0 * np.array(list(of.track.weights.values()))
        if _changes(weights):
            title = f"{mode}: heaviest other member"
            yield _map(of, weights[1:].max(axis=0), "weight [%]", title)
        return
    for name, values in of.track.choices.items():
        if any(isinstance(v, str) for v in values) or len(set(map(repr, values))) < 2:
            continue
        chosen = np.array(values, float)
        label, log = replayed.space.labels[name], name in replayed.space.logarithmic
        yield _map(of, chosen, label, f"{mode}: {name}", log)


def _map(
    of: ModeReplay, chosen: NDArray[np.float64], label: str, title: str, log: bool = False
) -> Panel:
    """A panel with what was chosen at each selection, of shape (m,), at some of the scans."""
    known = np.flatnonzero(np.isfinite(of.places).all(axis=1))
    some = known[np.unique(np.linspace(0, len(known) - 1, _MOST_PLACES).astype(int))]
    x, y = of.places[some].T
    texts = [f"{seconds:.1f} s" for seconds in of.track.seconds[some]]
    drawn = (
        Points(x, y, "", chosen[of.selection_at()][some], label, log, texts),
        Points(x[:1], y[:1], "start", marker="P"),
    )
    wide, high = (float(np.ptp(of.places[known][:, axis])) + 1.0 for axis in (0, 1))
    height = _LOW if high < _SLENDER * wide else 1.0
    return Panel(Axis("x [m]"), Axis("y [m]"), drawn, title, equal=True, height=height)
