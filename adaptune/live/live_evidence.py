"""What the errors of an odometry, or of a bank's members, were over the last metres."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, rectify, rotation_angle
from adaptune.live.hop import LENGTHS, Hop, HopCloud, register
from adaptune.live.squares import HopErrors, LiveSquares, live_squares
from adaptune.odometry.base import Motions
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan

SPACING = 1.0
"""Metres between scans that may be the start or the end of a hop."""
LOST = 10.0
"""Percent of a hop. An odometry that is more wrong has lost track."""
TWICE = 2
"""Hops in a row that must be rejected, or disagree, before an odometry counts as lost."""
GROWTH = -0.15
"""The error over `length` metres, as a share of them, grows with this power of the length."""
_APART = 0.3
"""Metres between guesses that are worth a registration each."""
_GUESSES = 3
_TRY_AGAIN = 5
"""After so many shorter hops, a long one is tried again."""
_FEWEST_DIRECTIONS = 1.5
"""A hop must tell the motion in two directions at least."""
_FULL_TURN = 10.0
"""Metres at which a difference in rotation counts as one in translation, in radians."""


class OwnError(NamedTuple):
    """An odometry's own error, estimated without ground truth, in percent of the distance."""

    mean: float
    low: float  # 95 % interval
    high: float


class Measured(NamedTuple):
    """A hop, and the stamps of its scans in nanoseconds."""

    start: int
    end: int
    hop: Hop


@dataclass(frozen=True, eq=False)
class _Anchor:
    """A scan at which a hop may start or end, and where everybody believed it to be."""

    stamp: int
    metres: float  # driven until there
    cloud: HopCloud
    T_odom_sensor: Poses  # (1 + n_members, 4, 4): of the odometry or bank, then of its members
    no_pose: NDArray[np.intp]  # (1 + n_members,): scans without a pose so far


class LiveEvidence:
    """Measures errors by hops, see `adaptune.live.hop`.

    Show it every scan with `observe`; once a second, `measure` registers a scan, which takes some
    tens of milliseconds. Points that have times are motion-compensated, by the odometry's last
    motion. Memory is bounded: it keeps the scans of the last metres, one a metre, and the errors of
    the last hops.

    Parameters
    ----------
    members
        Trial numbers of a bank's members, as in `Motions`; empty for a single odometry.

    Attributes
    ----------
    lost : bool
        Whether the odometry or bank has lost track, as far as the last hops tell.
    """

    def __init__(self, members: tuple[int, ...] = ()):
        self.members = members
        self.reset()

    def reset(self) -> None:
        """Forget everything, as before a new recording."""
        self.lost = False
        self._last: tuple[int, Scan] | None = None
        self._T_odom_sensor = np.tile(np.eye(4), (1 + len(self.members), 1, 1))
        self._no_pose = np.zeros(1 + len(self.members), np.intp)
        self._metres = 0.0
        self._newest: _Anchor | None = None
        self._anchors: deque[_Anchor] = deque()
        self._measured = -np.inf
        self._short = 0
        self._rejected = self._disagreeing = 0
        n = 1 + len(self.members)
        self._hops = HopErrors(np.empty((0, n, 3)), np.empty(0), np.empty(0), np.empty(0))
        self._wrong = np.zeros(n, np.intp)

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See a scan, before it is registered; see `adaptune.selector.Selector.observe`."""
        if self._last is not None:
            self._move(*self._last, motions)
        self._last = stamp, scan

    def _move(self, before: int, scan: Scan, motions: Motions) -> None:
        """Take note of the motion that ended at the scan before."""
        T = np.stack(
            [motions.T_previous_current, *(motions.members[trial] for trial in self.members)]
        )
        finite = np.asarray(np.isfinite(T).all(axis=(1, 2)))
        self._no_pose = self._no_pose + ~finite
        # Without a pose, the health check lets the odometry go on; so does this.
        T[~finite] = T[0] if finite[0] else np.eye(4)
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
        self._newest = _Anchor(
            before,
            self._metres,
            HopCloud(scan, T[0], seconds),
            self._T_odom_sensor,
            self._no_pose,
        )
        if not self._anchors or self._metres - self._anchors[-1].metres >= SPACING:
            self._anchors.append(self._newest)
            while len(self._anchors) > 1 and self._metres - self._anchors[1].metres >= LENGTHS[0]:
                self._anchors.popleft()

    def measure(self) -> Measured | None:
        """Register the newest scan whose motion is known to one some metres before.

        Nothing is measured before the first hop is complete, nor where the sensor has moved less
        than a metre since the last one.

        Returns
        -------
        Measured or None
            None if no registration was accepted.
        """
        end = self._newest
        if end is None or end.metres - self._measured < SPACING:
            return None
        tried = False
        for length in LENGTHS:
            start = self._start_of(length, end)
            if start is None:
                continue
            long = length == LENGTHS[0]
            if long and 0 < self._short < _TRY_AGAIN:
                self._short += 1
                continue
            tried = True
            hop = register(start.cloud, end.cloud, self._guesses(start, end))
            if hop is not None and np.trace(hop.projection) < _FEWEST_DIRECTIONS:
                # On an open plain only height can be told; that is no loss of track.
                self._measured = end.metres
                return None
            if hop is not None:
                self._short = 0 if long else self._short
                self._take(start, end, hop)
                return Measured(start.stamp, end.stamp, hop)
            if long:
                self._short = 1
        if tried:
            self._measured = end.metres
            self._rejected += 1
            self._update_lost()
        return None

    def _start_of(self, length: float, end: _Anchor) -> _Anchor | None:
        far = [anchor for anchor in self._anchors if end.metres - anchor.metres >= length]
        return far[-1] if far and far[-1].stamp < end.stamp else None

    def _guesses(self, start: _Anchor, end: _Anchor) -> Iterator[Poses]:
        """The odometry's motion, and those of members that disagree with it."""
        moved = invert(start.T_odom_sensor) @ end.T_odom_sensor
        tried: list[Poses] = []
        for T in moved:
            if all(_apart(T, other) > _APART for other in tried) and len(tried) < _GUESSES:
                tried.append(T)
                yield T

    def _take(self, start: _Anchor, end: _Anchor, hop: Hop) -> None:
        """Compare with what was measured."""
        length = end.metres - start.metres
        moved = invert(start.T_odom_sensor) @ end.T_odom_sensor
        errors = 100.0 / length * (moved[:, :3, 3] - hop.T_start_end[:3, 3]) @ hop.projection.T
        errors[end.no_pose > start.no_pose] = np.nan
        self._hops = self._hops.with_hop(errors, start.metres, end.metres, end.stamp * 1e-9)
        self._measured = end.metres
        self._rejected = 0
        # A scan without a pose says nothing of the rest of the hop.
        with np.errstate(invalid="ignore"):
            wrong = np.linalg.norm(errors, axis=1) > LOST
        self._wrong = np.where(wrong, self._wrong + 1, 0)
        self._disagreeing = int(self._wrong[0])
        self._update_lost()

    def _update_lost(self) -> None:
        self.lost = max(self._rejected, self._disagreeing) >= TWICE

    def _told_to_restart(self) -> frozenset[int]:
        """Trial numbers of the members that two hops in a row have shown to be lost.

        Each is told once. Then only hops that begin after that count against it.
        """
        told = self._wrong >= TWICE
        told[0] = False
        self._wrong = np.where(told, 0, self._wrong)
        self._no_pose = self._no_pose + told
        return frozenset(np.array(self.members, np.intp)[told[1:]].tolist())

    def squares(self) -> LiveSquares | None:
        """What the last hops say of the members, or of a single odometry; None without any."""
        return live_squares(self._hops._replace(errors=self._hops.errors[:, bool(self.members) :]))

    def forget(self) -> None:
        """Forget the hops so far, for the odometry has got another set.

        The next one begins at the newest scan.
        """
        self._hops = HopErrors(*(array[:0] for array in self._hops))
        self._anchors.clear()
        self._measured = -np.inf
        self._wrong[:] = 0
        self._rejected = self._disagreeing = 0
        self.lost = False

    def own_error(self, length: float) -> OwnError | None:
        """The odometry's, or the bank's, own error over the last hops; None without any.

        The interval is that of a mean square over as many independent windows as the hops cover,
        with errors normally distributed.

        Parameters
        ----------
        length
            Metres of the sub-trajectories whose mean error it stands for.
        """
        hops = self._hops._replace(errors=self._hops.errors[:, :1])
        if (found := live_squares(hops)) is None:
            return None
        from scipy.stats import chi2

        square, noise = float(found.products[0, 0]), found.noise
        freedom = 3.0 * found.windows
        low, high = (square * freedom / chi2.ppf(p, freedom) for p in (0.975, 0.025))
        scale = (length / float((hops.end - hops.start).mean())) ** GROWTH
        ends = (scale * float(np.sqrt(max(end - noise, 0.0))) for end in (square, low, high))
        return OwnError(*ends)

    def estimated(self, selection: Selection, length: float) -> Selection:
        """A selection with what is measured; `length` is that of `own_error`."""
        error = self.own_error(length)
        if error is None:
            return selection._replace(lost=self.lost)
        return selection._replace(
            estimated_error=error.mean,
            estimated_low=error.low,
            estimated_high=error.high,
            lost=self.lost,
            restart=self._told_to_restart(),
        )


def _apart(T: Poses, other: Poses) -> float:
    """How far two motions are apart, in metres; a radian counts as much as ten metres."""
    moved = invert(other) @ T
    return float(np.linalg.norm(moved[:3, 3]) + _FULL_TURN * rotation_angle(moved))
