"""The picture of the replays of a sequence: from above, and the errors and selections over time."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.report.paper import LINES, OTHERS, as_png_and_svg, log_scale, picture, plain
from adaptune.space import ParameterSpace

_HATCHES = ("", "///", "...", "\\\\\\", "xxx", "---")
_MARKS = 60
"""Most restarts that are marked."""
_MARGIN = 0.5
"""By how much of its extent the picture may reach beyond the reference."""
_ESTIMATE = OTHERS[4]


class Track(NamedTuple):
    """Errors and selections of one mode along a sequence."""

    seconds: NDArray[np.float64]  # since the first scan, of shape (n,)
    xy: NDArray[np.float64]  # metres, seen from the reference's first pose, of shape (n, 2)
    errors: NDArray[np.float64]  # sub-trajectory RTE in percent, of shape (n,)
    errors_behind: NDArray[np.float64]  # the mean of those that ended in the last 30 s
    restarted: NDArray[np.bool_]  # of shape (n,)
    choice_seconds: NDArray[np.float64]  # of shape (m,)
    choices: Mapping[str, Sequence[Any]]  # for every parameter its values, of shape (m,)
    weights: Mapping[str, Sequence[float]]  # in a bank by member instead, of shape (m,)
    # Of shape (m, 3): percent, the error that was estimated while driving, and the ends of its
    # interval; NaN where there is none.
    estimated: NDArray[np.float64]
    lost: NDArray[np.bool_]  # of shape (m,): whether the bank was lost

    @property
    def span(self) -> NDArray[np.float64]:
        """When each choice was made, and the end, until which the last one holds."""
        return np.append(self.choice_seconds, self.seconds[-1])

    @property
    def lost_spans(self) -> list[tuple[float, float]]:
        """When the bank was lost, from a selection to the first one at which it was not."""
        spans: list[tuple[float, float]] = []
        for begin, end in np.column_stack([self.span[:-1], self.span[1:]])[self.lost].tolist():
            goes_on = spans and spans[-1][1] == begin
            spans.append((spans.pop()[0] if goes_on else begin, end))
        return spans

    @property
    def restarts(self) -> list[int]:
        """Frames of the restarts to mark: of those in close succession the first."""
        marked: list[int] = []
        apart = self.seconds[-1] / _MARKS
        for i in np.flatnonzero(self.restarted).tolist():
            if not marked or self.seconds[i] - self.seconds[marked[-1]] > apart:
                marked.append(i)
        return marked


def draw_replays(
    path: Path,
    title: str,
    length: float,
    tracks: Mapping[str, Track],
    reference: NDArray[np.float64] | None,
    space: ParameterSpace,
    estimated: bool = False,
) -> None:
    """Draw the trajectories of all modes from above, and errors and selections over time.

    Parameters
    ----------
    path
        Of the PNG; the SVG lies beside it.
    title
        Of the picture.
    length
        Of a sub-trajectory in metres.
    tracks
        By mode.
    reference
        Its positions like those of a track; None if there is none.
    space
        The parameters.
    estimated
        Whether the reference was computed from the recording.
    """
    judge = "estimated reference" if estimated else "reference"
    true = f"by the {judge}" if estimated else "true"
    panels: list[tuple[float, Callable[[Any], None]]] = []
    if any(np.isfinite(track.errors).any() for track in tracks.values()):
        panels.append((2.4, partial(_draw_errors, tracks=tracks, length=length)))
    # Sets of several odometries have other parameters; a bank's weights are drawn instead.
    single = [track.choices for track in tracks.values() if not track.weights]
    shared = [name for name in single[0] if all(name in choices for choices in single)]
    drawn = partial(_draw_parameter, tracks=tracks, space=space)
    panels += [(1.0, partial(drawn, name=name)) for name in shared]
    for mode, track in tracks.items():
        if np.isfinite(track.estimated[:, 0]).any() or track.lost.any():
            known = partial(_draw_estimated, mode=mode, track=track, length=length, true=true)
            panels.append((1.6, known))
        if track.weights and mode != "even":
            panels.append((1.2, partial(_draw_weights, mode=mode, track=track)))
    heights = [height for height, _ in panels]
    with picture(as_png_and_svg(path), 14.0, max(5.0, 1.4 + 1.5 * sum(heights))) as figure:
        figure.suptitle(title, x=0.01, ha="left")
        left, right = figure.subfigures(1, 2, width_ratios=(2, 3))
        above = left.subplots()
        _draw_above(above, tracks, reference, judge)
        shape: Any = {"sharex": True, "squeeze": False, "height_ratios": heights}
        over_time: Any = right.subplots(len(panels), 1, **shape)[:, 0] if panels else ()
        for axes, (_, draw) in zip(over_time, panels, strict=True):
            draw(axes)
            axes.yaxis.set_tick_params(labelsize="small")
        if panels:
            over_time[-1].set_xlabel("time [s]")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=7)


def _draw_above(
    axes: Any, tracks: Mapping[str, Track], reference: NDArray[np.float64] | None, judge: str
) -> None:
    """Trajectories, and where odometries were restarted; the legend is that of the picture."""
    for mode, track in tracks.items():
        known = track.errors[np.isfinite(track.errors)]
        mean = f", mean RTE {known.mean():.3g} %" if len(known) else ""
        axes.plot(*track.xy.T, label=f"{mode}{mean}", **LINES[mode])
    if reference is not None:
        some = reference[np.linspace(0, len(reference) - 1, 40).astype(int)]
        ring: Any = {"color": "#009e73", "mfc": "white", "ms": 4, "ls": ""}
        axes.plot(*some.T, "o", label=judge, **ring)
    axes.plot(0.0, 0.0, "P", color="black", mec="white", ms=9, label="start")
    label = "restarted by the health check"
    for mode, track in tracks.items():
        if at := track.restarts:
            axes.plot(*track.xy[at].T, label=label, **_restart(mode))
            label = "_"  # not twice in the legend
    (left, right), (low, high) = _extent(tracks, reference)
    axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="from above")


def _restart(mode: str) -> dict[str, Any]:
    return {"marker": "v", "ls": "", "mfc": LINES[mode]["color"], "mec": "black", "ms": 7}


def _extent(
    tracks: Mapping[str, Track], reference: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Limits of x and y, of shape (2, 2): neither a sliver, nor far from the reference."""
    drawn = np.concatenate([track.xy for track in tracks.values()])
    if reference is not None:
        side = _MARGIN * max(float(np.ptp(reference, axis=0).max()), 1.0)
        drawn = drawn.clip(reference.min(axis=0) - side, reference.max(axis=0) + side)
        drawn = np.concatenate([drawn, reference])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    sides = np.maximum(high - low, 0.5 * float((high - low).max()) + 0.1)
    middle = 0.5 * (low + high)
    return np.column_stack([middle - 0.55 * sides, middle + 0.55 * sides])


def _draw_errors(axes: Any, tracks: Mapping[str, Track], length: float) -> None:
    for i, (mode, track) in enumerate(tracks.items()):
        axes.plot(track.seconds, track.errors, **LINES[mode])
        if at := track.restarts:
            high = np.full(len(at), 1.02 + 0.03 * i)
            top = {"clip_on": False, "transform": axes.get_xaxis_transform()}
            axes.plot(track.seconds[at], high, **_restart(mode), **top)
    if any((np.isfinite(t.errors) & (t.errors > 0.0)).any() for t in tracks.values()):
        log_scale(axes)
    axes.set_ylabel(f"RTE over the next {length:g} m [%]")


def _draw_parameter(
    axes: Any, tracks: Mapping[str, Track], space: ParameterSpace, name: str
) -> None:
    """What was applied of a parameter; a bank applies that of each of its members."""
    single = {mode: track for mode, track in tracks.items() if not track.weights}
    named = any(isinstance(v, str) for track in single.values() for v in track.choices[name])
    for mode, track in single.items():
        values = [_name(v) if named else v for v in track.choices[name]]
        axes.step(track.span, [*values, values[-1]], where="post", **LINES[mode])
    # A line at a bound does not lie on the frame.
    axes.margins(y=0.15)
    if name in space.logarithmic:
        log_scale(axes)
    unit = space.labels[name].removeprefix(name)
    axes.set_ylabel(name.replace("_", "\n") + unit, fontsize="small")


def _name(value: Any) -> str:
    """A value among names; the set of another odometry may have none."""
    if isinstance(value, str):
        return value or "-"
    return "-" if np.isnan(value) else plain(value)


def _draw_estimated(axes: Any, mode: str, track: Track, length: float, true: str) -> None:
    """What a bank has estimated of its own error, what `true` names, and when it was lost."""
    estimated, low, high = track.estimated.T
    if np.isfinite(track.errors_behind).any():
        wide = LINES[mode] | {"lw": 3.6, "ls": "-"}  # seen where the estimate lies on it
        axes.plot(track.seconds, track.errors_behind, **wide, label=true)
    # A logarithmic axis has no zero.
    low = np.where(low > 0.0, low, 0.1 * high)
    seconds = track.choice_seconds
    axes.fill_between(seconds, low, high, color=_ESTIMATE, alpha=0.25, lw=0, label="95 % interval")
    axes.plot(seconds, estimated, color=_ESTIMATE, lw=1.4, label="estimated")
    if (np.isfinite(estimated) & (estimated > 0.0)).any():
        log_scale(axes)
    label = "lost"
    for begin, end in track.lost_spans:
        axes.axvspan(begin, end, color="#999999", alpha=0.35, lw=0, label=label)
        label = "_"  # not twice in the legend
    axes.set(
        ylabel=f"RTE over {length:g} m,\nlast 30 s [%]",
        title=f"{mode}: its error as estimated while driving",
    )
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _draw_weights(axes: Any, mode: str, track: Track) -> None:
    """The weights of a bank's members, stacked."""
    weights = 100.0 * np.array(list(track.weights.values()))
    drawn = axes.stackplot(
        track.span,
        np.column_stack([weights, weights[:, -1]]),
        labels=list(track.weights),
        colors=[OTHERS[i % len(OTHERS)] for i in range(len(weights))],
        step="post",
        edgecolor="black",
        lw=0.5,
    )
    for band, hatch in zip(drawn, cycle(_HATCHES)):
        band.set_hatch(hatch)
    axes.set(
        ylim=(0.0, 100.0),
        ylabel="weight [%]",
        title=f"{mode} applies a bank: weights of its members",
    )
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), reverse=True)
