"""What clouds hold: one look at each while it is read, and what is wrong with all of them."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.compiled import compiled
from adaptune.errors import Finding, Key
from adaptune.geometry import nearest_rotation
from adaptune.recording.scan import Reading, Scan
from adaptune.recording.timing import SOONEST
from adaptune.trajectory import Trajectory

LEAST_POINTS = 20  # valid points that an odometry needs

# A look takes so many points, and sees whether there are any in so many directions.
_SAMPLE, _DIRECTIONS = 256, 24
_COVER = 1.0  # metres; nothing but a cover surrounds a sensor so closely


class Look(NamedTuple):
    """What a scan shows at a glance."""

    stamp: int
    reading: Reading
    n: int  # points
    near: float  # share of them within `_COVER`
    turn: float  # share of the directions around the sensor that hold points
    form: list[float]  # mean of x, y and z, and their standard deviations
    repeats: bool  # the points of the scan before
    soon: bool  # less than `SOONEST` after it


class Content:
    """Looks at the scans of a recording, in their order."""

    def __init__(self) -> None:
        self.looks: list[Look] = []
        self._last: Scan | None = None
        self._form: list[float] = []

    def see(self, scan: Scan) -> Look:
        """Look at a scan. One that repeats the last one, or comes too soon, is not the last one."""
        near, turn, *form = _kernel()(np.ascontiguousarray(scan.points, np.float32))
        repeats = soon = False
        if (last := self._last) is not None:
            soon = 0 < scan.stamp - last.stamp < SOONEST
            # All points are compared only where a glance shows the same.
            if len(scan) and form == self._form:
                repeats = np.array_equal(scan.points, last.points)
        if not repeats and not soon:
            self._last, self._form = scan, form
        look = Look(scan.stamp, scan.reading, len(scan), near, turn, form, repeats, soon)
        self.looks.append(look)
        return look

    def of_place(self, reference: Trajectory, known: bool, where: Key = ()) -> Iterator[Finding]:
        """Clouds that stay in place while the reference moves: they are in the frame of a map.

        Unless that is `known`, only a way that is longer than the view tells.
        """
        looks = [look for look in self.looks if look.n >= LEAST_POINTS]
        T = reference.at(np.array([look.stamp for look in looks], np.int64))
        there = np.isfinite(T[:, 0, 0])
        if np.count_nonzero(there) < 2 * _ROW:
            return
        poses, form = T[there, :3, 3], np.array([look.form for look in looks])[there]
        way, moved = form[:, :3] - form[:, :3].mean(axis=0), poses - poses.mean(axis=0)
        # Seen from the sensor, the middle of the points stays near it; in a map, it moves along.
        # The axes of the map and of the reference may differ.
        left = np.linalg.norm(way @ nearest_rotation(way, moved).T - moved)
        extent, view = np.linalg.norm(moved), np.linalg.norm(form[:, 3:])
        least = len(moved) ** 0.5 if known else 2.0 * view  # a metre from the middle
        if extent > least and left < _OTHER * extent:
            length = np.linalg.norm(np.diff(poses, axis=0), axis=1).sum()
            what = f"the clouds stay in place while the reference moves {length:.1f} m"
            mend = f"they are in the frame of a map: {_DRIVER}"
            yield Finding(where, what, mend, of="points", lacks="clouds in the sensor's frame")


def _glance(points: NDArray[np.float32]) -> tuple[float, ...]:
    n, number = len(points), min(len(points), _SAMPLE)
    near, seen, sums = 0, np.zeros(_DIRECTIONS, np.bool_), np.zeros(6)
    # Points lie by row or by column, and the golden ratio is in step with neither.
    row, step = 0, 1 if number == n else int(0.618 * n)
    for _ in range(number):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        row += step if row + step < n else step - n
        near += x * x + y * y + z * z < _COVER * _COVER
        # From 0 to 4 around the sensor, as an angle is, in less time.
        turn = y / max(abs(x) + abs(y), 1e-9)
        seen[int((1.0 + turn if x > 0.0 else 3.0 - turn) * 0.2499 * _DIRECTIONS)] = True
        for axis, value in enumerate((x, y, z)):
            sums[axis] += value
            sums[3 + axis] += value * value
    sums /= max(number, 1)
    rest = np.sqrt(np.maximum(sums[3:] - sums[:3] ** 2, 0.0))
    share = near / max(number, 1), np.count_nonzero(seen) / _DIRECTIONS
    return *share, sums[0], sums[1], sums[2], rest[0], rest[1], rest[2]


@cache
def _kernel() -> Callable[[NDArray[np.float32]], tuple[float, ...]]:
    return compiled(_glance)  # when a scan is read: it takes time


# Of what is usual, below which a cloud is a part of one, or has lost nearly all.
_PART, _LITTLE = 0.6, 0.15
# Clouds in a row before and after a change that lasts; seconds between neighbours that see the
# same; by which share their number and their form then differ.
_ROW, _SOON, _OTHER = 5, 0.25, 0.35
_LEFT_OUT = "adaptune leaves them out"
_CUT = "leave them out with `start` or `stop`"
_LOST = f"packets are lost, the view is blocked, or nothing is in reach; {_CUT}"
_DRIVER = "name the topic of the sensor's driver"


def of_looks(looks: Sequence[Look], where: Key = (), start: float = 0.0) -> Iterator[Finding]:
    """What is wrong with clouds in their order; the first is at `start` seconds of a recording."""
    if not looks:
        return
    stamps, readings, *rest = zip(*looks, strict=True)
    n, near, turn, _, repeats, soon = map(np.array, rest)
    role, seconds = "points", start + (np.array(stamps, np.int64) - stamps[0]) * 1e-9
    few, more, usual = n < LEAST_POINTS, np.diff(n), np.quantile(n, (0.75, 0.9))
    part = (n < _PART * usual[0]) & (turn < _PART * np.quantile(turn, 0.75))
    if (marks := float(np.median([reading.marks for reading in readings]))) > 0.01:
        what = f"{marks:.0%} of the points mark rays that did not come back, far away"
        yield Finding(where, what, _LEFT_OUT, of=role)
    if grow := sum(more > 0) > _ROW and np.mean(more >= 0) > 0.95 and n[-1] > 3 * n[0]:
        what = f"the clouds grow from {n[0]:,} to {n[-1]:,} points: they are a map"
        yield Finding(where, what, _DRIVER, of=role)
    kinds = (
        (few, 1, f"hold fewer than {LEAST_POINTS} valid points", f"odometries fail; {_CUT}"),
        (repeats, 1, "repeat the points of the one before", _LEFT_OUT),
        (soon, 1, "come less than 1 ms after the one before", _LEFT_OUT),
        (near > 0.9, 2, f"lie within {_COVER:g} m: something covers the sensor", _CUT),
        (part, 3, "see a part of the usual turn", _LOST),
        (n < _LITTLE * usual[1], 3, f"hold less than {_LITTLE:.0%} of the usual points", _LOST),
    )
    reported = np.zeros(len(n), np.bool_)
    for flags, fewest, what, mend in kinds[: 3 if grow else None]:
        index = np.flatnonzero(flags & ~reported)
        reported |= flags
        runs = np.split(index, np.flatnonzero(np.diff(index) > 2 * _ROW) + 1)
        for run in runs if len(runs) <= 3 else [index]:
            if len(run) >= fewest:
                many = f"all {len(n)}" if len(run) == len(n) else f"{len(run)} of {len(n)}"
                when = (float(seconds[run[0]]), float(seconds[run[-1]]))
                lacks = "clouds with points" if few.all() else ""
                yield Finding(where, f"{many} clouds {what}", mend, when, role, lacks)
    kept = np.flatnonzero(~reported)
    yield from _changes([looks[i] for i in kept.tolist()], seconds[kept], where)


def _changes(looks: Sequence[Look], seconds: NDArray[np.float64], where: Key) -> Iterator[Finding]:
    """Where clouds look other than before from one to the next, and stay so, or alternate."""
    if len(looks) < 2 * _ROW:
        return
    n, form = np.array([look.n for look in looks]), np.array([look.form for look in looks])
    mean, spread = form[:, :3], np.maximum(form[:, 3:], 1e-3)
    reach = np.linalg.norm(np.hypot(mean, spread), axis=1, keepdims=True)
    # The number, the extent, and the form, which turns with the axes.
    shown = np.hstack([np.log(np.column_stack([n, reach])), mean / spread, spread / reach])
    one, two = (np.median(np.abs(shown[k:] - shown[:-k]).max(axis=1)) for k in (1, 2))
    if one > _OTHER and two < 0.25 * one:
        mend = f"two sensors on one topic? {_DRIVER}"
        yield Finding(where, "two kinds of clouds alternate", mend, of="points")
        return
    rows = np.lib.stride_tricks.sliding_window_view(shown, _ROW, axis=0)
    middle = np.median(rows, axis=-1)
    shake = np.abs(rows - middle[..., None]).max(axis=(1, 2))
    change = np.abs(middle[_ROW:] - middle[:-_ROW])
    less, wider, other = change[:, 0], change[:, 1], np.linalg.norm(change[:, 2:], axis=1)
    lasts = change.max(axis=1) > 4.0 * np.maximum(shake[_ROW:], shake[:-_ROW])
    lasts &= (np.diff(seconds)[_ROW - 1 :][: len(lasts)] < _SOON) & (wider < 0.15)
    mend = "the sensor was set anew: use the part before or after, with `start` or `stop`"
    for i in np.flatnonzero(lasts & (np.maximum(less, other) > _OTHER))[:3] + _ROW:
        what = "the axes of the points change"
        if less[i - _ROW] > _OTHER:
            what = f"clouds of {n[i - 1]:,} points become ones of {n[i]:,}"
        yield Finding(where, f"at {seconds[i]:.1f} s, {what}", mend, of="points")
