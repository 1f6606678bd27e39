"""Watch an odometry of somebody else's: how wrong it is, and whether to believe its pose."""

import csv
import math
import time
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert
from adaptune.live.evidence import LiveEvidence
from adaptune.odometry.base import Motions
from adaptune.odometry.health import Guard, HealthCheck
from adaptune.recording.scan import Scan
from adaptune.recording.timing import Timing
from adaptune.ros.link import RosLink
from adaptune.selector import Periods
from adaptune.space import State
from online.topics import RosMessages, TopicPoses, TopicScans

WINDOW = 15.0
"""Seconds over which the error is told, or 30 m: a drift is to be seen soon."""
PATIENCE = 1.0
"""Seconds from a scan to its pose. Who steers nothing may wait, and slow odometries are in time."""
WAITING = 20
"""Scans that wait for their poses at most: those of a second of fast sensors."""
DIAGNOSTICS = "/diagnostics"
LEVELS: dict[State, int] = {"good": 0, "unknown": 1, "doubtful": 1, "lost": 2}
"""As diagnostic_msgs/DiagnosticStatus counts them: OK, WARN, ERROR."""


class Told(NamedTuple):
    """What is known of an odometry at a scan."""

    stamp: int  # nanoseconds
    seconds: float  # since the first scan
    state: State
    why: str  # what speaks against it
    error: float  # percent of the way over the last metres; NaN if nothing was measured
    low: float  # ends of the 95 % interval
    high: float
    restarts: int  # how often its motion was none of a platform's


class Watch:
    """Watches an odometry by its poses and the scans, and steers nothing.

    Show it every scan with its pose. Once a second, `see` tells what is known; it takes some tens
    of milliseconds then. An error is that over `length` metres.
    """

    def __init__(self, length: float = 25.0):
        self._evidence = LiveEvidence((), length, WINDOW)
        self._guard = Guard(HealthCheck())
        self._periods, self._starts = Periods(1e9), 0
        self._T = np.eye(4)  # the motion to the scan before
        self._last: tuple[int, Poses] | None = None
        self._first: int | None = None

    def see(self, scan: Scan, T_odom_sensor: Poses) -> Told | None:
        """See a scan and its pose, of shape (4, 4), NaN if there is none; tell once a second."""
        self._evidence.observe(scan.stamp, scan, Motions(self._T, {}, self._starts))
        self._first = scan.stamp if self._first is None else self._first
        known = bool(np.isfinite(T_odom_sensor).all())
        if not known:
            self._T = np.full((4, 4), np.nan)
        elif self._last is None:
            self._T = np.eye(4)
        else:
            # Over the scans without a pose, too.
            before, T_before = self._last
            elapsed, self._T = (scan.stamp - before) * 1e-9, invert(T_before) @ T_odom_sensor
            if self._guard.check(self._T, elapsed) is not None:
                self._starts += 1
                T_healthy, T_step = self._guard.go_on(elapsed)
                self._T = T_healthy @ T_step
        if known:
            self._last = scan.stamp, np.array(T_odom_sensor)
        if not self._periods.due(scan.stamp):
            return None
        self._evidence.check()
        self._evidence.measure()
        (state, why), error = self._evidence.health, self._evidence.own_error()
        mean, low, high = (math.nan,) * 3 if error is None else error
        seconds = (scan.stamp - self._first) * 1e-9
        return Told(scan.stamp, seconds, state, why, mean, low, high, self._starts)


def watch_topics(
    link: RosLink, points: str, odometry: str, T_base_sensor: Poses, length: float
) -> Iterator[Told]:
    """Watch a node on a robot; where the clock goes back, all begins anew.

    `odometry` is the topic of its poses, `T_base_sensor` the LiDAR's in the frame that they are of.
    What is told is published as diagnostics, too.
    """
    publish = link.advertise(DIAGNOSTICS, "diagnostic_msgs/msg/DiagnosticArray")
    messages = RosMessages(link.store, "odom")
    late = f"{PATIENCE:g} s after their scans, and are not used: let less run on this machine"
    poses = TopicPoses(link, odometry, T_base_sensor, points, late)
    scans = TopicScans(link, points, Timing(), WAITING)
    while not scans.stopped:
        watch = Watch(length)
        for scan, came, _ in scans.arrivals():
            T = poses.at(scan.stamp, max(0.0, came + PATIENCE - time.perf_counter()))
            if (told := watch.see(scan, T)) is not None:
                publish(messages.diagnostics(told.stamp, odometry, *_shown(told)))
                yield told


def _shown(told: Told) -> tuple[int, str, dict[str, str]]:
    values = {"state": told.state, "restarts": str(told.restarts)}
    for name in ("error", "low", "high"):
        if math.isfinite(value := getattr(told, name)):
            values[f"{name} [% of the way]"] = f"{value:.3f}"
    return LEVELS[told.state], told.why or told.state, values


def write_told(path: Path, told: Iterable[Told]) -> None:
    """Write what was told as CSV."""
    from adaptune._system.files import replacing

    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = ((f"{x:.3f}" if isinstance(x, float) else x for x in one) for one in told)
        csv.writer(file).writerows([Told._fields, *rows])


def in_words(told: list[Told]) -> list[str]:
    """Whether to believe the odometry, in at most three sentences."""
    if len(told) < 2:
        return ["Too short to tell: give two seconds of scans at least."]
    spans = [(one, after.seconds - one.seconds) for one, after in pairwise(told)]
    total = told[-1].seconds - told[0].seconds
    begins: dict[State, str] = {"lost": "Do not rely on it", "doubtful": "Look at it"}
    said = []
    for state, first in begins.items():
        if within := [(one, seconds) for one, seconds in spans if one.state == state]:
            what = f"{first}: it is {state} for {sum(s for _, s in within):.0f} s of {total:.0f}"
            said.append(f"{what}, first at {within[0][0].seconds:.1f} s: {within[0][0].why}.")
    if not said:
        unknown = sum(seconds for one, seconds in spans if one.state == "unknown")
        said = [f"Nothing speaks against it in {total:.0f} s, {unknown:.0f} of them unknown."]
    errors = [one.error for one in told if math.isfinite(one.error)]
    if errors:
        said.append(f"Its error is {np.mean(errors):.2f} % of the way in the mean, as measured.")
    return said
