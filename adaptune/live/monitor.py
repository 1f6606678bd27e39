"""Whether to believe an odometry's pose: one state, from all that is known while it drives.

The motion over each second is compared with a direct registration of the scans at its ends, which
also sees an odometry that stands still; the size of scans, restarts and missing poses, and what
hops say (`adaptune.live.evidence`), count beside it.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert, rotation_angle, scale, squared_ranges
from adaptune.live.hops import NEW_GUESS, Hop, HopCloud, apart, register
from adaptune.recording.scan import Scan
from adaptune.space import State

HELD = 3.0
"""Seconds for which what was found counts; twice the interval of slower scans."""
OFF, OFF_SHARE = 0.25, 0.05
"""Metres, and share of the way, by which a motion over a second may differ from a registration:
several times what registrations are wrong by, and half of a jump that matters."""
OFF_ANGLE = 0.07
"""Radians by which it may differ."""
BETTER = 0.05
"""By how much more of the points have to lie near each other for another motion to be believed."""
FEWER, NEARER = 0.7, 0.5
"""Shares of the usual number of points, and of their median range, below which a scan is odd: the
sensor is covered, or data are lost."""
USUAL_SCANS, ODD_SECONDS = 15, 10.0
"""Scans whose median is usual; what stays odd for longer is usual, too."""
KEPT_STEPS = 30
"""Registrations that are remembered."""
USUALLY, LEAST_STEPS = 0.8, 5
"""Share of so many registrations that were accepted from which one that is not means something."""
STARTS, STARTS_SECONDS = 3, 10.0
"""Restarts within so many seconds by which an odometry is lost."""
LONGEST = 2.0
"""Seconds between scans that are compared, or twice their interval."""
HOPS_TO_BE_LOST = 2
"""Hops in a row that must disagree before it counts as lost, or be rejected to be unknown."""
NO_POSE = 1.0
"""Seconds without a pose after which it is lost."""


class Health(NamedTuple):
    """Whether to believe a pose, and why not."""

    state: State = "unknown"
    why: str = ""


class _Step(NamedTuple):
    """What a registration over a second said."""

    seconds: float
    accepted: bool
    off: str = ""  # how it contradicts the odometry; empty if it does not
    known: bool = False  # whether it tells the motion's direction


class HealthMonitor:
    """Knows whether to believe an odometry, or a bank, by its scans and motions."""

    def __init__(self) -> None:
        self._sizes: deque[tuple[int, float]] = deque(maxlen=USUAL_SCANS)
        self._odd: tuple[float, str] | None = None  # since when, and what
        self._odd_until = -np.inf
        self._steps: deque[_Step] = deque(maxlen=KEPT_STEPS)
        self._starts: deque[float] = deque(maxlen=STARTS)
        self._begin: tuple[float, HopCloud] | None = None
        self.begun = False  # whether the next call of `measure` ends what this one began
        self._T_begin_now = np.eye(4)
        self._measured: tuple[Poses, float] | None = None  # the last second's motion
        self._now = self._posed = -np.inf
        self._period = 0.0  # seconds between the last scans

    def see(self, seconds: float, scan: Scan) -> None:
        """See the newest scan."""
        if np.isinf(self._now):
            self._now = self._posed = seconds
        self._period, self._now = max(0.0, seconds - self._now), seconds
        points = scan.points[::10]
        reach = float(np.sqrt(np.median(squared_ranges(points)))) if len(points) else 0.0
        usual = np.median(self._sizes, axis=0) if len(self._sizes) == USUAL_SCANS else (0, 0.0)
        odd = ""
        if len(scan) < FEWER * usual[0]:
            odd = f"a scan has {len(scan):,} points, {usual[0]:,.0f} were usual"
        elif reach < NEARER * usual[1]:
            odd = f"half of the points are within {reach:.1f} m, {usual[1]:.1f} m was usual"
        if odd:
            since = seconds if self._odd is None else self._odd[0]
            self._odd, self._odd_until = (since, odd), seconds
        elif seconds - self._odd_until > HELD:
            self._odd = None
        if not odd or seconds - (self._odd[0] if self._odd else seconds) > ODD_SECONDS:
            self._sizes.append((len(scan), reach))

    def move(self, seconds: float, T_previous_current: Poses, restarted: bool) -> None:
        """Learn the motion to the scan of a time, NaN without a pose, and a restart there."""
        if np.isfinite(T_previous_current).all():
            self._posed = seconds
            self._T_begin_now = self._T_begin_now @ T_previous_current
        if restarted:
            self._starts.append(seconds)

    def measure(self, seconds: float, cloud: HopCloud) -> None:
        """Compare the motion since the last call with a registration of the scans at its ends."""
        begin, T = self._begin, self._T_begin_now
        self._begin, self._T_begin_now = (seconds, cloud), np.eye(4)
        took = 0.0 if begin is None else seconds - begin[0]
        # Over a longer time, scans have too little in common.
        self.begun = not 0.0 < took <= max(LONGEST, 2.0 * self._period)
        if begin is None or self.begun:
            return
        guesses = [T]
        if self._measured is not None:
            goes_on = scale(self._measured[0], took / self._measured[1])
            if apart(T, goes_on) > NEW_GUESS:
                guesses.append(goes_on)
        found = [hop for guess in guesses if (hop := register(begin[1], cloud, [guess]))]
        if not found:
            self._measured = None
            self._steps.append(_Step(seconds, False))
            return
        best = max(found, key=lambda hop: hop.inliers)
        # Where a place repeats itself, another motion looks as well; one that is known counts more.
        tells = np.trace(best.projection) > np.trace(found[0].projection) + 0.5
        best = best if tells or best.inliers >= found[0].inliers + BETTER else found[0]
        self._measured = best.T_start_end, took
        off = _contradicts(T, best, took)
        # Along a place that shows nothing, scans look as if the sensor stood still.
        if off and np.linalg.norm(best.T_start_end[:3, 3]) < np.linalg.norm(T[:3, 3]):
            there = register(begin[1], cloud, [T], iterations=1)
            if there is not None:
                best = best._replace(projection=there.projection @ best.projection)
                off = _contradicts(T, best, took)
        self._steps.append(_Step(seconds, True, off, _is_known(T, best)))

    def health(self, wrong: int = 0, rejected: int = 0) -> Health:
        """The state now; so many hops in a row were `wrong` by much, or `rejected`."""
        now, held = self._now, max(HELD, 2.0 * self._period)
        # Where nothing is in doubt, seconds are compared seldom.
        until = self._steps[-1].seconds if self._steps else now
        steps = [step for step in self._steps if until - step.seconds <= 2.0 * held]
        last = [step for step in steps if until - step.seconds <= held]
        off = [step.off for step in steps if step.accepted][-2:]
        doubts = [step.off for step in reversed(last) if step.off]
        known, silent = any(step.known for step in last), now - self._posed
        unconfirmed = rejected >= HOPS_TO_BE_LOST
        hops = "registrations over 10 m do not confirm its motion"
        often = f"{STARTS} impossible motions or more within {STARTS_SECONDS:g} s"
        restarts = [now - at for at in self._starts]
        accepted = [step.accepted for step in self._steps]
        usual = len(accepted) > LEAST_STEPS and float(np.mean(accepted)) >= USUALLY
        # The worst first.
        found: list[tuple[bool, State, str]] = [
            (silent > max(NO_POSE, 2.0 * self._period), "lost", f"no pose for {silent:.1f} s"),
            (sum(ago <= STARTS_SECONDS for ago in restarts) >= STARTS, "lost", often),
            (len(off) == 2 and all(off), "lost", "".join(off[-1:])),
            (wrong >= HOPS_TO_BE_LOST, "lost", "registrations over 10 m contradict its motion"),
            (any(ago <= held for ago in restarts), "doubtful", "its motion was impossible"),
            (bool(doubts), "doubtful", "".join(doubts[:1])),
            (self._odd is not None, "doubtful", self._odd[1] if self._odd else ""),
            (wrong > 0 or (unconfirmed and not known), "doubtful", hops),
            (usual and not accepted[-1], "doubtful", "scans of a second cannot be registered"),
            (not known, "unknown", "the scans do not tell its motion" if self._steps else ""),
            # From a cave into the open, scans of each second agree, and those 10 m apart do not.
            (unconfirmed, "unknown", hops),
            (True, "good", ""),
        ]
        return next(Health(state, why) for so, state, why in found if so)


def _contradicts(T_odom: Poses, hop: Hop, took: float) -> str:
    """How a registration contradicts a motion, in words; empty if it does not."""
    wrong = hop.projection @ (T_odom[:3, 3] - hop.T_start_end[:3, 3])
    off, way = float(np.linalg.norm(wrong)), float(np.linalg.norm(hop.T_start_end[:3, 3]))
    if off > OFF + OFF_SHARE * way:
        moved = float(np.linalg.norm(T_odom[:3, 3]))
        return f"it moved {moved:.1f} m in {took:.1f} s, its scans say {way:.1f} m"
    turned = float(rotation_angle(invert(T_odom) @ hop.T_start_end))
    if turned > OFF_ANGLE:
        return f"its turn is off by {np.degrees(turned):.0f} degrees in {took:.1f} s"
    return ""


def _is_known(T_odom: Poses, hop: Hop) -> bool:
    """Whether a registration tells how far the sensor moved: in a corridor it may not."""
    step = T_odom[:3, 3]
    if float(np.linalg.norm(step)) < OFF:
        return float(np.trace(hop.projection)) > 2.5
    return hop.shows(step)
