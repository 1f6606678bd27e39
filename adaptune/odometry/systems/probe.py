"""Look at what a ROS system does, before it is tuned."""

import time
from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from itertools import islice
from typing import Any

import numpy as np

from adaptune.errors import OdometryError
from adaptune.geometry import Poses
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems.lockstep import OTHER_CLOCK, Lockstep, other_frame
from adaptune.odometry.systems.played_bag import MAX_SCATTER
from adaptune.odometry.systems.ros_system import QUIET
from adaptune.odometry.template import Template
from adaptune.recording.scan import Scan
from adaptune.ros.link import LinkError
from adaptune.space import ParameterSet, ParameterSpace, Selection

_SHORT = 50  # scans by which it is seen what a parameter changes while the system runs
_SCANS_BEFORE = 10  # scans of these before it is set
_LEAST_WAY = 0.5  # metres that it has to move from then on


class _Watched(Lockstep):
    """Notes when poses come, and with which stamps."""

    came: list[tuple[float, int]]

    def _take(self, kind: str, data: bytes) -> None:
        super()._take(kind, data)
        if self._poses:
            self.came.append((time.monotonic(), self._poses[-1][0]))


def look(
    settings: Any,
    parameters: ParameterSet,
    limits: Limits,
    scans: Iterable[Scan],
    others: ParameterSet | None = None,
) -> dict[str, str]:
    """Start a system on scans at the pace of the recording, and say what it does, by subject.

    Where it works on after its poses, it is driven without waiting, too. Where the settings name a
    node, it is also driven with each of the `others` set on the way, see `effects`.
    """
    plain = settings.model_copy(update={"play": "lockstep", "rate": 1.0, "node": None})
    system, scans = _Watched(parameters, plain, limits), list(scans)
    system.came = []
    report: dict[str, str] = {}
    shown: list[tuple[float, int]] = []
    path, works_on, why = [np.eye(4)], False, "see what went wrong"
    with closing(system):
        begin, steps = time.monotonic(), iter(scans)
        first = next(steps)
        system.start(first, np.eye(4))
        if system.faults:
            raise OdometryError(system.faults[0])
        took = system._shown[1] - begin
        shown.append((system._shown[1], first.stamp))
        for scan in steps:
            path.append(system.register(scan).T_odom_sensor)
            if system.ended:
                break
            shown.append((system._shown[1], scan.stamp))
        if (inside := system._system) is not None:
            report |= _topics(inside) | _declared(inside, system._template)
            if about := system._reader.about:
                said = filter(None, (about, other_frame(about, settings)))
                report["poses are of"] = "; ".join(said)
            works_on = system._works_on(inside)
            why = "set odometry.settings.play: bag"
            with suppress(LinkError):
                why = inside.link.why_unheard(system._topics[0]) or why
    seconds = max(1e-9 * (shown[-1][1] - shown[0][1]), 0.1)
    report["time of a start"] = f"{took:.1f} s"
    report |= about_poses(system.came, shown, why)
    report["CPU of a second"] = f"{system.usage.cpu / seconds:.2f} s"
    report["memory"] = f"{system.usage.memory or 0.0:.0f} MB"
    for fault in system.faults:
        report["went wrong"] = fault
    if works_on:
        hurried = _driven(plain.model_copy(update={"rate": 0.0}), parameters, limits, scans)
        report["works on after a pose"] = _apart(path, hurried)
    if settings.node is not None and others and not system.faults:
        live, vain = effects(settings, parameters, limits, scans, others)
        nothing = "nothing: leave out settings.node" if vain else "not known: it hardly moves here"
        report["takes effect while it runs"] = ", ".join(live) or nothing
        if vain:
            report["has no effect while it runs"] = (
                f"{', '.join(vain)}: do not switch live with these among the parameters"
            )
    return report


def _driven(
    settings: Any,
    parameters: ParameterSet,
    limits: Limits,
    scans: Sequence[Scan],
    change: ParameterSet | None = None,
) -> list[Poses]:
    """The path of a system, which gets a change of its parameters on the way."""
    with closing(Lockstep(parameters, settings, limits)) as system:
        system.start(scans[0], np.eye(4))
        path = [np.eye(4)]
        for n, scan in enumerate(scans[1:], 1):
            if n == _SCANS_BEFORE and change:
                system.apply(Selection(0, change))
            path.append(system.register(scan).T_odom_sensor)
    return path


def _furthest(path: Sequence[Poses], other: Sequence[Poses]) -> float:
    """The most metres between poses of two paths over the same scans."""
    n = min(len(path), len(other))
    off = np.array(path)[:n, :3, 3] - np.array(other)[:n, :3, 3]
    return float(np.nan_to_num(np.linalg.norm(off, axis=1), nan=np.inf).max())


def _apart(path: Sequence[Poses], hurried: Sequence[Poses]) -> str:
    metres = float(np.linalg.norm(np.diff(np.array(path)[:, :3, 3], axis=0), axis=1).sum())
    return (
        f"yes: at rate: 0 its path is up to {_furthest(path, hurried):.2f} m off that at rate: 1, "
        f"on {metres:.1f} m; keep odometry.settings.rate: 1 where that counts"
    )


def far_ends(space: ParameterSpace) -> ParameterSet:
    """For each parameter, the end of its range that is further from the baseline."""
    (others,) = space.from_unit((space.to_unit([space.baseline]) < 0.5).astype(float))
    return others


def check_live(odometry: OdometryFactory, scans: Iterable[Scan]) -> None:
    """Refuse to adapt a system live by parameters that have no effect while it runs."""
    space, settings = odometry.space, odometry.settings
    _, vain = effects(settings, space.baseline, odometry.limits, scans, far_ends(space))
    if vain:
        raise OdometryError(
            f"{settings.node}, set while it runs, changes nothing by {', '.join(vain)} (the first "
            f"{_SHORT} scans): it cannot adapt live by odometry.parameters.{vain[0].split()[0]}; "
            f"leave that out, or odometry.settings.node, and a bank adapts"
        )


def effects(
    settings: Any,
    parameters: ParameterSet,
    limits: Limits,
    scans: Iterable[Scan],
    others: ParameterSet,
) -> tuple[list[str], list[str]]:
    """Which of the `others` change the path if they are set while the system runs, which do not.

    It is driven on the first scans with each of them, and twice without. Nodes accept values that
    they never read again. Where it has not moved, or was lost, nothing is known: both are empty.
    """
    fast = settings.model_copy(update={"play": "lockstep", "rate": 0.0})
    some = list(islice(scans, _SHORT))
    path, again = (_driven(fast, parameters, limits, some) for _ in range(2))
    chance = 3.0 * _furthest(path, again) + 1e-6
    way = np.linalg.norm(np.diff(np.array(path)[_SCANS_BEFORE:, :3, 3], axis=0), axis=1).sum()
    if not (way > _LEAST_WAY and np.isfinite(chance)):
        return [], []
    live: list[str] = []
    vain: list[str] = []
    for name, value in others.items():
        try:
            changed = _driven(fast, parameters, limits, some, {name: value})
        except OdometryError as error:
            vain.append(f"{name} is refused ({error})")
            continue
        (live if _furthest(path, changed) > chance else vain).append(name)
    return live, vain


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


_OF_ROS = {"use_sim_time", "start_type_description_service"}  # parameters that every node has
_SHOWN = 40  # characters of a value


def _declared(system: Any, template: Template) -> dict[str, str]:
    """Parameters that nodes of ROS 2 declare, and that could be tuned if the template had them."""
    nodes: dict[str, dict[str, Any]] = {}
    with suppress(LinkError, OdometryError):
        nodes = system.link.ask("parameters") if system.link.is2 else {}
    known = {system.whole_name(template, name) for name in template.names} | _OF_ROS
    more = {k: v for held in nodes.values() for k, v in held.items() if k not in known}
    # Those ROS declares by itself.
    own = [
        f"{k} = {str(v)[:_SHOWN]}"
        for k, v in sorted(more.items())
        if not k.startswith("qos_overrides.")
    ]
    return {"declared, not in the template": ", ".join(own)} if own else {}


def about_poses(
    came: list[tuple[float, int]], shown: list[tuple[float, int]], why: str = "see what went wrong"
) -> dict[str, str]:
    """What is known of poses, which came at a time with a stamp, from scans that were shown.

    `why` says what to do where there are too few for lockstep.
    """
    n, came = len(came), [(t, stamp) for t, stamp in came if t >= shown[0][0]]
    early = {"poses before the first scan": str(n - len(came))} if len(came) < n else {}
    if not came:
        return early | {"poses": "none", "lockstep": f"no: {why}"}
    at, stamps = np.array([t for t, _ in shown]), np.array([stamp for _, stamp in shown])
    times = np.array([t for t, _ in came])
    of_scan = np.searchsorted(at, times, "right") - 1
    late = np.array([stamp for _, stamp in came]) - stamps[of_scan]
    steady = np.mean(np.abs(late - np.median(late)) < MAX_SCATTER) >= 0.9
    answered = len(set(of_scan.tolist()))
    since = len(shown) - int(of_scan[0])
    share = answered / since
    stamped = "its own clock"
    if steady and abs(np.median(late)) < OTHER_CLOCK:
        stamped = f"the scans, {1e-6 * np.median(late):.0f} ms after their begin"
    fits = share >= 0.75
    return early | {
        "first pose": f"after {of_scan[0] + 1} scans, {times[0] - at[0]:.1f} s",
        "poses of a scan": f"{len(came) / since:.2f} ({answered} of {since} scans have one)",
        "stamps": f"of {stamped}",
        "lag": f"{1e3 * float(np.median(times - at[of_scan])):.0f} ms",
        "lockstep": "yes" if fits else f"no: {why}",
    }
