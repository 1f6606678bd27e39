"""What the errors of an odometry, or of a bank's members, were over the last metres."""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, rectify
from adaptune.live.hops import (
    LENGTHS,
    NEW_GUESS,
    SECONDS,
    Hop,
    HopCloud,
    HopErrors,
    Hops,
    HopSquares,
    apart,
    hop_squares,
    register,
)
from adaptune.live.monitor import HOPS_TO_BE_LOST, Health, HealthMonitor
from adaptune.live.own_error import CONTRADICTED, OWN_SECONDS, SIMILAR, Link, OwnError, OwnErrors
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from adaptune.space import IN_DOUBT, Selection

SPACING = 1.0  # metres between scans that may be the start or the end of a hop
LOST = 10.0
"""Percent of a hop. An odometry that is more wrong has lost track."""
DOUBTFUL = 5.0
"""Percent of a hop. One that differs so much from the odometry must be confirmed by another."""
SELDOM = 50
"""Scans from one measurement to the next where nothing is in doubt: five seconds of most sensors.
The odometry costs as much a scan, whatever the sensor's rate."""
USUAL_SHARE = 0.4  # about the share of the seconds in which a bank measures
_GUESSES = 3
_TRY_AGAIN = 5  # after so many shorter hops, a long one is tried again
SHARED = 1.25
"""A hop may be this many times as long if it starts at a cloud that was prepared before."""
_MIN_DIRECTIONS = 1.5  # a hop must tell the motion in two directions at least


@dataclass(frozen=True, eq=False)
class _Anchor:
    """A scan at which a hop may start or end, and where everybody believed it to be."""

    stamp: int
    metres: float  # driven until there
    cloud: HopCloud
    T_odom_sensor: Poses  # (1 + n_members, 4, 4): of the odometry or bank, then of its members
    no_pose: NDArray[np.intp]  # (1 + n_members,): scans without a pose so far


class Measured(NamedTuple):
    """A hop, and where it starts and ends."""

    start: _Anchor
    end: _Anchor
    hop: Hop
    by_odometry: bool = True  # whether its own motion was the guess

    def errors(self) -> NDArray[np.float64]:
        """Of the odometry and the members, percent of the hop, of shape (1 + n_members, 3)."""
        moved = invert(self.start.T_odom_sensor) @ self.end.T_odom_sensor
        wrong = (moved[:, :3, 3] - self.hop.T_start_end[:3, 3]) @ self.hop.projection.T
        return np.asarray(100.0 / (self.end.metres - self.start.metres) * wrong)


class LiveEvidence:
    """Measures errors by hops, see `adaptune.live.hops`.

    Show it every scan with `observe`; once a second, `measure` registers a scan, which takes some
    tens of milliseconds. Memory is bounded. `members` are trial numbers of a bank's members, as in
    `Motions`; empty for a single odometry. `length` is that of the sub-trajectories whose mean
    error `own_error` estimates, in metres.
    """

    def __init__(
        self, members: tuple[int, ...] = (), length: float = 25.0, seconds: float = OWN_SECONDS
    ):
        self.members = members
        self._length, self._seconds = length, seconds
        self.reset()

    def reset(self) -> None:
        """Forget everything, as before a new recording."""
        self._last: tuple[int, Scan] | None = None
        self._T_odom_sensor = np.tile(np.eye(4), (1 + len(self.members), 1, 1))
        self._no_pose = np.zeros(1 + len(self.members), np.intp)
        self._without = np.full(1 + len(self.members), -np.inf)
        self._metres = 0.0
        self._newest: _Anchor | None = None
        self._short = self._since = self._n_starts = 0
        self._restarted = 0  # stamp of the scan of the last restart
        self._monitor = HealthMonitor()
        self._begin()

    def forget(self) -> None:
        """Forget the hops, for the odometry has another set; the next begins at the newest scan."""
        self._begin()

    def _begin(self) -> None:
        self._rejected = 0  # hops in a row, which a restart does not excuse
        self._blind = 0  # hops in a row that do not tell the way, as in a tunnel
        self._forget_errors()
        self._own = OwnErrors(self._length, seconds=self._seconds)
        self._anchors: deque[_Anchor] = deque()
        self._measured = -np.inf

    def _forget_errors(self) -> None:
        n = 1 + len(self.members)
        self._hops = HopErrors(np.empty((0, n, 3)), np.empty(0), np.empty(0), np.empty(0))
        self._wrong = np.zeros(n, np.intp)  # hops in a row by which each was wrong

    @property
    def health(self) -> Health:
        """Whether to believe the odometry, or the bank."""
        return self._monitor.health(int(self._wrong[0]), self._rejected)

    def due(self, in_doubt: bool) -> bool:
        """Whether to measure now, if the caller is `in_doubt` or not.

        It is where there is no hop yet, where the last one was rejected or disagreed, where hops
        have yet to reach over a sub-trajectory, and after `SELDOM` scans.
        """
        unknown = not len(self._hops.errors) or self._rejected or self._wrong.any()
        in_doubt = in_doubt or self.health.state in IN_DOUBT
        if in_doubt or unknown or self._since >= SELDOM:
            return True
        behind = 0.0 if self._newest is None else self._newest.metres - self._measured
        return not self._own.complete and behind >= LENGTHS[0]

    def spread(self) -> float:
        """How far the members came apart over the last metres, see `spread_of`; 0 if unknown."""
        start, end = self._anchors[0] if self._anchors else None, self._newest
        if start is None or end is None or end.metres - start.metres < LENGTHS[-1]:
            return 0.0
        moved = (invert(start.T_odom_sensor) @ end.T_odom_sensor)[1:, :3, 3]
        with_poses = moved[(end.no_pose == start.no_pose)[1:]]
        return float(spread_of(100.0 / (end.metres - start.metres) * with_poses))

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See a scan, before it is registered; see `adaptune.selector.Selector.observe`."""
        if self._last is not None:
            self._move(*self._last, motions)
        self._last = stamp, scan
        self._since += 1
        self._monitor.see(stamp * 1e-9, scan)

    def _move(self, before: int, scan: Scan, motions: Motions) -> None:
        """Take note of the motion that ended at the scan before."""
        T = np.stack(
            [motions.T_previous_current, *(motions.members[trial] for trial in self.members)]
        )
        finite = np.asarray(np.isfinite(T).all(axis=(1, 2)))
        self._no_pose = self._no_pose + ~finite
        self._without[~finite] = before * 1e-9
        # Without a pose, the health check lets the odometry go on; so does this.
        T[~finite] = T[0] if finite[0] else np.eye(4)
        restarted = self._newest is not None and motions.starts > self._n_starts
        self._n_starts = motions.starts
        if restarted:
            # What a member did before says nothing of it now, but the drive has the jump.
            self._forget_errors()
            self._restarted = before
        self._monitor.move(before * 1e-9, motions.T_previous_current, restarted)
        # The first scan is where the odometry starts, whatever motion it was given.
        if self._newest is None:
            T[:] = np.eye(4)
        self._T_odom_sensor = rectify(self._T_odom_sensor @ T)
        # The straight way since the last anchor: a robot that stands does not drive by jitter.
        if self._anchors:
            last = self._anchors[-1]
            way = invert(last.T_odom_sensor[0]) @ self._T_odom_sensor[0]
            self._metres = last.metres + float(np.linalg.norm(way[:3, 3]))
        seconds = 0.0 if self._newest is None else (before - self._newest.stamp) * 1e-9
        if self._newest is not None and finite[0] and not restarted:
            # This, not the motion before it, is how the sensor moved while it took the last scan.
            self._newest.cloud.moved(T[0], seconds)
        cloud = HopCloud(scan, T[0], 0.0 if restarted else seconds)
        self._newest = _Anchor(before, self._metres, cloud, self._T_odom_sensor, self._no_pose)
        if not self._anchors or self._metres - self._anchors[-1].metres >= SPACING:
            self._anchors.append(self._newest)
            # Before the start of the longest hop, one more is kept, to confirm it.
            while len(self._anchors) > 2 and self._metres - self._anchors[2].metres >= LENGTHS[0]:
                self._anchors.popleft()

    @property
    def checking(self) -> bool:
        """Whether the last `check` began a second that is to be compared."""
        return self._monitor.begun

    def check(self) -> None:
        """Compare the motion since the last check with a registration of the scans at its ends."""
        if self._newest is not None:
            self._monitor.measure(self._newest.stamp * 1e-9, self._newest.cloud)

    def measure(self) -> Measured | None:
        """Register the newest scan whose motion is known to one some metres before.

        None before the first hop is complete, where the sensor has moved less than a metre, or
        where no registration was accepted. A hop that contradicts the odometry counts only if a
        registration to another scan says the same: where a scene repeats itself, one can be wrong
        by metres.
        """
        end = self._newest
        if end is None or end.metres - self._measured < SPACING:
            return None
        starts = self._starts(end)
        if not starts:
            return None
        self._measured, self._since = end.metres, 0
        if end is not self._anchors[-1]:
            self._anchors.append(end)
        measured = self._register(starts, end)
        if measured is not None:
            shows = measured.hop.shows(measured.hop.T_start_end[:3, 3])
            self._blind = 0 if shows else self._blind + 1
            # On an open plain only height can be told; that is no loss of track.
            if np.trace(measured.hop.projection) < _MIN_DIRECTIONS:
                return None
        if measured is None or not self._is_confirmed(measured):
            self._rejected += starts[-1].stamp >= self._restarted
            return None
        self._take(measured)
        return measured

    def _starts(self, end: _Anchor) -> list[_Anchor]:
        """Where a hop may start, in the order in which that is tried."""
        long, short = (self._start(end, length) for length in LENGTHS)
        first, second = long, short
        if long is not None and 0 < self._short < _TRY_AGAIN:
            self._short += 1
            first, second = short, long
        return [a for a in (first, second) if a is not None and a.stamp < end.stamp]

    def _start(self, end: _Anchor, length: float) -> _Anchor | None:
        """The last anchor before so many metres, or one a little before it that is prepared."""
        before = [a for a in reversed(self._anchors) if end.metres - a.metres >= length]
        most = SHARED * length
        near = (a for a in before if a.cloud.is_prepared and end.metres - a.metres <= most)
        return next(near, before[0] if before else None)

    def _register(self, starts: Sequence[_Anchor], end: _Anchor) -> Measured | None:
        """The first registration that is accepted; if the last was rejected, members guess, too."""
        guesses = [self._guesses(start, end) for start in starts]
        for first, stop in ((0, 1), (1, _GUESSES))[: 2 if self._rejected else 1]:
            for start, of_start in zip(starts, guesses, strict=True):
                hop = register(start.cloud, end.cloud, of_start[first:stop])
                if end.metres - start.metres >= LENGTHS[0]:
                    self._short = int(hop is None)
                if hop is not None:
                    return Measured(start, end, hop, first == 0)
        return None

    def _guesses(self, start: _Anchor, end: _Anchor) -> list[Poses]:
        """The odometry's motion, and those of members that disagree with it."""
        tried: list[Poses] = []
        for T in invert(start.T_odom_sensor) @ end.T_odom_sensor:
            if all(apart(T, other) > NEW_GUESS for other in tried) and len(tried) < _GUESSES:
                tried.append(T)
        return tried

    def _is_confirmed(self, measured: Measured) -> bool:
        """Whether a hop agrees with the odometry, or a hop from another scan agrees with it."""
        wrong, end = measured.errors()[0], measured.end
        if np.linalg.norm(wrong) <= DOUBTFUL:
            return True
        at = self._anchors.index(measured.start)
        # The scan before, so that it spans the same way; at the begin of a drive the scan after.
        other = self._anchors[at - 1 if at else 1]
        if other.stamp >= end.stamp:
            return False
        guess = invert(other.T_odom_sensor[0]) @ end.T_odom_sensor[0]
        if not measured.by_odometry:
            between = invert(other.T_odom_sensor[0]) @ measured.start.T_odom_sensor[0]
            guess = between @ measured.hop.T_start_end
        hop = register(other.cloud, end.cloud, [guess])
        if hop is None:
            return False
        confirming = Measured(other, end, hop).errors()[0]
        # About the same direction and length.
        lengths = np.linalg.norm(wrong), np.linalg.norm(confirming)
        return bool(np.linalg.norm(wrong - confirming) < min(lengths))

    def _take(self, measured: Measured) -> None:
        """Compare with what was measured; over a restart there are no errors of members."""
        start, end, hop, _ = measured
        errors = measured.errors()
        errors[end.no_pose > start.no_pose] = np.nan
        ends = start.metres, end.metres, end.stamp * 1e-9
        known = np.asarray(np.isfinite(errors).all(axis=1))
        if start.stamp >= self._restarted:
            # Those that are back count as measured, not as lost.
            self._hops = self._hops.filled(known & np.isfinite(self._without))
            self._hops = self._hops.with_hop(errors, *ends)
            self._without[known] = -np.inf
            # A scan without a pose says nothing of the rest of the hop.
            with np.errstate(invalid="ignore"):
                wrong = np.linalg.norm(errors, axis=1) > LOST
            self._wrong = np.where(wrong, self._wrong + 1, 0)
        if known[0] and not self._blind:
            self._own.add(Link(*ends, start.T_odom_sensor[0], end.T_odom_sensor[0], hop))
        self._rejected = 0

    def _told_to_restart(self) -> frozenset[int]:
        """Trial numbers of members that two hops in a row show to be lost; each is told once."""
        lost = self._wrong >= HOPS_TO_BE_LOST
        lost[0] = False
        self._wrong = np.where(lost, 0, self._wrong)
        self._no_pose = self._no_pose + lost
        return frozenset(np.array(self.members, np.intp)[lost[1:]].tolist())

    def present(self) -> NDArray[np.bool_]:
        """Which members may have weight, of shape (n_members,).

        One that gave no pose for a scan gets weight again once a hop that begins after that scan
        has measured it, or after `SECONDS` with poses. All may have some if none is present.
        """
        now = 0.0 if self._newest is None else self._newest.stamp * 1e-9
        present = np.asarray(now - self._without[1:] > SECONDS)
        return present if present.any() else ~present

    def squares(self, members: Collection[int] | None = None) -> HopSquares | None:
        """What the last hops say of some members, by trial, or of all, or of a single odometry."""
        chosen = self.members if members is None else members
        columns = [i for i, trial in enumerate(self.members, 1) if trial in chosen] or [0]
        return hop_squares(self._hops._replace(errors=self._hops.errors[:, columns]))

    def own_error(self) -> OwnError | None:
        """The odometry's, or the bank's, own error over the last metres; None if nothing tells."""
        # Where hops are rejected, or blind, the last chains are of before.
        if max(self._rejected, self._blind) >= HOPS_TO_BE_LOST:
            return None
        return self._own.estimate()

    def _own_error_with(self, predicted: float, similarity: float) -> OwnError | None:
        """The same, with what training predicts where it knows the place."""
        # Unknown where the training has one segment.
        share = 1.0 if np.isnan(similarity) else min(1.0, similarity / SIMILAR)
        alone = self.own_error()
        # A bank's prediction has live evidence in it already.
        if self.members or alone is None or not share or not alone.low <= CONTRADICTED * predicted:
            return alone
        # Nor does training know of a failure.
        last = 0 if self._newest is None else self._newest.stamp
        if self._restarted and last - self._restarted < OWN_SECONDS * 1e9:
            return alone
        return self._own.estimate_with(predicted, share)

    def estimated(self, selection: Selection) -> Selection:
        """A selection with what is measured."""
        state, why = self.health
        restart = self._told_to_restart()
        selection = selection._replace(state=state, why=why, restart=restart)
        error = self._own_error_with(selection.predicted_error, selection.similarity)
        if error is None:
            return selection
        return selection._replace(
            estimated_error=error.mean, estimated_low=error.low, estimated_high=error.high
        )


def spread_of(vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Root mean square distance from their mean of vectors of shape (..., n, 3); 0 of none."""
    if not vectors.shape[-2]:
        return np.zeros(vectors.shape[:-2])
    deviations = vectors - vectors.mean(axis=-2, keepdims=True)
    return np.asarray(np.sqrt((deviations**2).sum(axis=-1).mean(axis=-1)))


# Hops along a recording whose poses are known, at least in part.

PERIOD = 1_000_000_000  # nanoseconds from one registration to the next


def hops_along(
    scans: Iterable[tuple[Scan, Poses]],
    advance: Callable[[int], None] = lambda _: None,
    *,
    checks: bool = False,
) -> Hops:
    """Register scans directly to those some metres before, once a second.

    Known poses, of shape (4, 4), give each registration its first guess; where they are NaN,
    nothing is measured. `advance` is called after every scan with how many are done. With `checks`,
    the pose is checked each second, too, as selectors do: it then takes as long as theirs.
    """
    live = LiveEvidence()
    hops: list[tuple[int, int, Hop]] = []
    frame_of: dict[int, int] = {}
    due, last, step = 0, np.full((4, 4), np.nan), np.eye(4)
    for i, (scan, T) in enumerate(scans):
        before, step = step, invert(last) @ T if i else np.eye(4)
        if not np.isfinite(step).all():
            live.reset()
        # The motion over the scan before, as an odometry knows it.
        known = before if np.isfinite(before).all() else np.eye(4)
        live.observe(scan.stamp, scan, Motions(known, {}))
        frame_of[scan.stamp] = i
        due = due if i else scan.stamp
        if scan.stamp >= due:
            due += (int(scan.stamp - due) // PERIOD + 1) * PERIOD
            if checks:
                live.check()
            if (measured := live.measure()) is not None:
                ends = frame_of[measured.start.stamp], frame_of[measured.end.stamp]
                hops.append((*ends, measured.hop))
        last = T
        advance(i + 1)
    return Hops.of(hops)
