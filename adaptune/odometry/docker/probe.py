"""Look at what a ROS system does, before it is tuned."""

import time
from collections.abc import Iterable
from contextlib import closing
from typing import Any

import numpy as np

from adaptune.errors import OdometryError
from adaptune.odometry.docker.lockstep import Lockstep
from adaptune.odometry.docker.played_bag import MAX_SCATTER
from adaptune.odometry.docker.ros_system import QUIET
from adaptune.odometry.remote import Limits
from adaptune.recording.scan import Scan
from adaptune.ros.link import LinkError
from adaptune.space import ParameterSet


class _Watched(Lockstep):
    """Notes when poses come, and with which stamps."""

    came: list[tuple[float, int]]

    def _take(self, kind: str, data: bytes) -> None:
        super()._take(kind, data)
        if self._poses:
            self.came.append((time.monotonic(), self._poses[-1][0]))


def look(
    settings: Any, parameters: ParameterSet, limits: Limits, scans: Iterable[Scan]
) -> dict[str, str]:
    """Start a system on scans at the pace of the recording, and say what it does, by subject."""
    plain = settings.model_copy(update={"play": "lockstep", "rate": 1.0, "node": None})
    system = _Watched(parameters, plain, limits)
    system.came = []
    found: dict[str, str] = {}
    shown: list[tuple[float, int]] = []
    with closing(system):
        begin, steps = time.monotonic(), iter(scans)
        first = next(steps)
        system.start(first, np.eye(4))
        if system.faults:
            raise OdometryError(system.faults[0])
        took = system._shown[1] - begin
        shown.append((system._shown[1], first.stamp))
        for scan in steps:
            system.register(scan)
            if system.ended:
                break
            shown.append((system._shown[1], scan.stamp))
        if not system.ended:
            found |= _topics(system._system)
    seconds = max(1e-9 * (shown[-1][1] - shown[0][1]), 0.1)
    found["time of a start"] = f"{took:.1f} s"
    found |= _poses(system.came, shown)
    found["CPU of a second"] = f"{system.usage.cpu / seconds:.2f} s"
    found["memory"] = f"{system.usage.memory or 0.0:.0f} MB"
    for fault in system.faults:
        found["went wrong"] = fault
    return found


def _topics(system: Any) -> dict[str, str]:
    try:
        state = system.state()
        published = system.link.topics().keys()
    except (OdometryError, LinkError):
        return {}
    heard = state["subscribed"].keys()
    return {
        "subscribed topics": ", ".join(sorted(heard - QUIET)),
        "published topics": ", ".join(sorted(published - QUIET)),
    }


def _poses(came: list[tuple[float, int]], shown: list[tuple[float, int]]) -> dict[str, str]:
    """What is known of poses, which came at a time with a stamp, from scans that were shown."""
    if not came:
        return {"poses": "none", "lockstep": "no: see what went wrong"}
    at, stamps = np.array([t for t, _ in shown]), np.array([stamp for _, stamp in shown])
    times = np.array([t for t, _ in came])
    of_scan = np.searchsorted(at, times, "right") - 1
    late = np.array([stamp for _, stamp in came]) - stamps[of_scan]
    steady = np.mean(np.abs(late - np.median(late)) < MAX_SCATTER) >= 0.9
    answered = len(set(of_scan.tolist()))
    since = len(shown) - int(of_scan[0])
    share = answered / since
    stamped = "its own clock"
    if steady:
        stamped = f"the scans, {1e-6 * np.median(late):.0f} ms after their begin"
    fits = share >= 0.75
    return {
        "first pose": f"after {of_scan[0] + 1} scans, {times[0] - at[0]:.1f} s",
        "poses of a scan": f"{len(came) / since:.2f} ({answered} of {since} scans have one)",
        "stamps": f"of {stamped}",
        "lag": f"{1e3 * float(np.median(times - at[of_scan])):.0f} ms",
        "lockstep": "yes" if fits else "no: set odometry.settings.play: bag",
    }
