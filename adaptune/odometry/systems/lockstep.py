"""A ROS system that receives scan after scan, and can change its parameters."""

import contextlib
import logging
import shutil
import threading
import time
import weakref
from functools import partial
from typing import Any

import numpy as np

from adaptune._system import processes
from adaptune._system.files import make_temporary
from adaptune.errors import AdaptuneError, OdometryError, UnavailableError, nearest, warn_once
from adaptune.geometry import Poses, invert, rectify, to_pose
from adaptune.odometry.base import WITHOUT_POSE, Registration, Usage
from adaptune.odometry.faults import Faulting, pose_fault
from adaptune.odometry.own_frame import END, AtStamp, duration_of
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems.played_bag import MAX_SCATTER, OWN_CLOCK
from adaptune.odometry.systems.ros_system import QUIET, RosSystem, filled, matrix
from adaptune.recording.clouds import LIVOX_TYPES
from adaptune.recording.export import IMU, POINTS, Messages, measurements, structured
from adaptune.recording.scan import Scan
from adaptune.ros.link import LinkError
from adaptune.space import ParameterSet, Selection

_IMU_TYPE = "sensor_msgs/msg/Imu"

_log = logging.getLogger(__name__)
_MOST_SILENT = 30  # scans in a row without a pose that are a fault
_LEAST_ANSWERED = 0.75  # least share of scans with a pose, of so many or more since the first one
_USAGE_POLL = 1.0  # seconds between looks at what the system has used
_MOST_PATIENT = 3
"""Scans in a row for which it waits in full before the first pose; then it waits `_IMPATIENCE`."""
_IMPATIENCE = 0.5  # seconds
_BACKGROUND, _BUSY = 0.5, 0.2  # seconds after the last pose, and cores, at which a system works on
OTHER_CLOCK = 2 * 10**9
"""Nanoseconds between the stamps of a scan and of its pose that no system adds to a scan's."""
_EARLY = 1_000_000  # nanoseconds by which a pose's stamp may be before the scan's


_SEEN: set[str] = set()
"""Systems of which it is known whether they work on after their last pose."""


class Lockstep(Faulting):
    """A ROS system that hears a scan, and then waits for the next one until its pose is there.

    It begins anew with each start. Where a scan gets no pose, the last motion goes on. With a
    `rate`, a scan waits until as much time has passed since the one before as in the recording.
    """

    isolated = True

    def __init__(self, parameters: ParameterSet, settings: Any, limits: Limits):
        super().__init__(settings.image or settings.command[0], parameters)
        self._settings, self._limits = settings, limits
        self._system: RosSystem | None = None
        self._used = self._used_before = Usage(0.0, 0.0)
        extrinsic = settings.extrinsic
        self._T_base_sensor = np.eye(4) if extrinsic is None else to_pose(extrinsic)
        self._news = threading.Condition()
        self._poses: list[tuple[int, Poses]] = []
        self._waiting = self._has_run = False
        self._shown = (0, -np.inf)  # stamp of the last scan, and when it was published
        self._looked = -np.inf
        self._patience = min(settings.patience, limits.seconds)
        # Scans since the first pose after each start, and those that got a pose.
        self._n_shown = self._n_answered = 0
        self._missed: list[int] = []  # stamps of scans that got none in time
        self._n_too_late = 0  # poses of these that came after all

    @property
    def ended(self) -> bool:
        return self._system is None

    @property
    def begun(self) -> bool:
        return self._has_run or bool(self.faults)

    @property
    def usage(self) -> Usage:
        if self._system is not None and time.monotonic() - self._looked > _USAGE_POLL:
            self._look(self._system)
        cpu = self._used_before.cpu + self._used.cpu
        memory = max(self._used_before.memory or 0.0, self._used.memory or 0.0)
        return Usage(cpu, memory, other_cpu=cpu)

    def start(
        self, prepared: Scan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._last_motion.start(T_odom_sensor, T_previous_current)
        self.close()
        if self.given_up:
            return
        self._T_odom_sensor = np.array(T_odom_sensor)
        self._T_step = np.eye(4) if T_previous_current is None else np.array(T_previous_current)
        self._T_odom_own: Poses | None = None
        self._at_stamp, self._T_known = AtStamp(END), T_previous_current
        self._silent, self._poses, self._missed, self._n_too_late = 0, [], [], 0
        self._shown = (prepared.stamp, -np.inf)
        self._late: int | None = None
        self._steady = True  # whether all poses are as late as the first one
        try:
            self._begin(prepared)
            self._show(prepared)
            self._correct()
        except (OdometryError, LinkError) as error:
            fault = self._quoting(error)
            # One that has run can be gone for good.
            if not self._has_run:
                self.close()
                raise OdometryError(f"{self.name}: {fault}") from error
            self.note_fault(fault)

    def submit(self, prepared: Scan) -> None:
        self._waiting = True
        if self._system is not None:
            try:
                self._show(prepared)
            except (OdometryError, LinkError) as error:
                self.note_fault(self._quoting(error))

    def _collect(self) -> Registration:
        self._waiting = False
        if self._system is None:
            return WITHOUT_POSE
        T_before = self._T_odom_sensor
        self._T_odom_sensor = T_before @ self._T_step
        try:
            registered = self._correct()
        except (OdometryError, LinkError) as error:
            return self.note_fault(self._quoting(error))
        if registered:
            self._T_step = rectify(invert(T_before) @ self._T_odom_sensor)
        return Registration(self._T_odom_sensor.copy(), registered)

    def ready(self, seconds: float) -> bool:
        return self._system is None or self._pose(seconds) is not None

    @property
    def busy(self) -> bool:
        return self._waiting

    def apply(self, selection: Selection) -> None:
        """Set the node's parameters, see `adaptune.ros.steering.Steering.apply`."""
        if unknown := selection.parameters.keys() - self.parameters.keys():
            raise OdometryError(f"{self.name} has no parameter {min(unknown)!r}")
        self.parameters |= selection.parameters
        if self._system is not None and self._steering is not None:
            name = partial(self._system.whole_name, self._template)
            try:
                self._steering.apply({name(k): v for k, v in selection.parameters.items()})
            except LinkError as error:
                raise OdometryError(str(error)) from error

    def close(self) -> None:
        if self._system is not None:
            self._look(self._system)
            self._warn_of_background(self._system)
            if too_late := self._of_patience():
                _log.warning("%s: %s; these scans count as without a pose", self.name, too_late)
            if self._has_run:
                with contextlib.suppress(OdometryError, LinkError):
                    self._system.warn_of_unread()
            self._system.close()
            shutil.rmtree(self._folder, ignore_errors=True)
            self._system = None
            self._used_before = Usage(self.usage.cpu, self.usage.memory)
            self._used = Usage(0.0, 0.0)

    def _of_patience(self) -> str:
        """What to do where poses come too late; empty where they do not."""
        if self._n_too_late <= len(self._missed):  # most did not come at all
            return ""
        return (
            f"{self._n_too_late} poses came later than odometry.settings.patience "
            f"({self._patience:g} s): raise it, or let fewer programs run (offline.workers: 1)"
        )

    def _warn_of_background(self, system: RosSystem) -> None:
        """Log, once, where the system works on after its last pose, though nothing waits for it."""
        if self._settings.rate or not self._n_answered or self.name in _SEEN:
            return
        _SEEN.add(self.name)
        if self._works_on(system):
            warn_once(
                f"{self.name}: it works on after its last pose, as systems that map in the "
                f"background do; at rate: 0, it has less time for that than on a robot, so its "
                f"poses may be worse: set odometry.settings.rate: 1, or let `adaptune inspect` of "
                f"the study say by how much they differ"
            )

    def _works_on(self, system: RosSystem) -> bool:
        """Whether it uses CPU time now, after its last pose."""
        self._look(system, fresh=True)
        before = self._used.cpu
        time.sleep(_BACKGROUND)
        self._look(system, fresh=True)
        return self._used.cpu - before > _BUSY * _BACKGROUND

    def __del__(self) -> None:
        self.close()

    def _look(self, system: RosSystem, fresh: bool = False) -> None:
        """See what the system has used; log, once, which node died where poses come still."""
        self._looked = time.monotonic()
        with contextlib.suppress(OdometryError, LinkError):
            system.state(fresh)
        self._used = system.usage
        if system.died and self._n_answered and not self._silent:
            warn_once(
                f"{self.name}: {system.died}, and poses come still; if it is not needed, let the "
                f"launch file leave it out, as by visualize:=false"
            )

    def _begin(self, scan: Scan) -> None:
        """Start the system, and wait until it listens."""
        self._template, text = filled(self._settings, self.parameters)
        self._folder = make_temporary()
        try:
            system = self._settings.system(self._settings, self._limits.memory, text, self._folder)
        except AdaptuneError:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        self._system = system
        link, topics = system.link, (self._settings.points or POINTS, self._settings.imu or IMU)
        self._messages = Messages(link.version)
        take = weakref.WeakMethod(self._take)  # the link must not keep this alive
        self._reader = system.reader()
        self._reader.hear(lambda *given: (do := take()) and do(*given))
        self._clock = system.run_clock(scan.stamp, self._settings.rate or 1.0)
        self._kind = system.cloud_type(topics[0])
        self._send_cloud = link.advertise_bytes(topics[0], self._kind)
        self._send_imu = link.advertise(topics[1], _IMU_TYPE) if self._settings.imu else None
        self._topics = topics
        system.wait(topics[0], topics if self._settings.imu else topics[:1])
        system.check(self._template, self.parameters)
        self._steering = system.steering()

    def _show(self, scan: Scan) -> None:
        """Publish what the system hears until the end of a scan."""
        self._stamp = scan.stamp
        self._span = duration_of(scan) if self._settings.pose_time == "end" else 0
        stamp, at = self._shown
        self._gap = scan.stamp - stamp
        if rate := self._settings.rate:
            time.sleep(max(0.0, at + 1e-9 * (scan.stamp - stamp) / rate - time.monotonic()))
        self._shown = scan.stamp, time.monotonic()
        with self._news:
            self._poses = []
        assert self._system is not None
        messages, (points, imu_topic) = self._messages, self._topics
        if scan.imu is not None and self._send_imu is not None:
            for _, stamp, measured in measurements(messages, scan.imu, imu_topic):
                self._clock.reach(stamp)
                self._send_imu(measured)
        self._clock.reach(scan.stamp + max(scan.span, 0))
        header = messages.header(points, scan.stamp, self._settings.frame)
        if self._kind in LIVOX_TYPES:
            self._send_cloud(messages.livox(header, scan))
        else:
            cloud = messages.cloud(header, structured(scan))
            self._send_cloud(self._system.link.encode(cloud, self._kind))

    def _correct(self) -> bool:
        """Correct the predicted pose; False if the system gave none."""
        waits = bool(self._n_answered) or self._silent < _MOST_PATIENT
        pose = self._pose(self._patience if waits else min(self._patience, _IMPATIENCE))
        if pose is not None and self._late is None and self._silent:
            # It may be of an earlier scan; then others follow, though nothing more was sent.
            time.sleep(self._patience)
            pose = self._pose(0.0)
        assert self._system is not None
        if self._late is not None or pose is not None:
            self._n_shown += 1
        if pose is None:
            self._silent += 1
            self._check_silent(self._system)
            return False
        stamp, T_own = pose
        self._silent, self._has_run = 0, True
        self._n_answered += 1
        if wrong := pose_fault(T_own):
            raise OdometryError(f"it gave a pose {wrong}")
        if self._late is None:
            self._late = stamp - self._stamp
            if other := other_frame(about := self._reader.about, self._settings):
                warn_once(f"{self.name}: its poses are of {about}; {other}")
        scatter = abs(stamp - self._stamp - self._late)
        if scatter >= MAX_SCATTER or abs(self._late) >= OTHER_CLOCK:
            self._steady = False
            warn_once(f"{self.name}: {OWN_CLOCK}; poses are matched to scans by their order")
            if silent := self._n_shown - self._n_answered:
                raise OdometryError(
                    f"{OWN_CLOCK}, and {silent} scans had no pose after {self._patience:g} s, so "
                    f"a late pose cannot be told from the next one; raise "
                    f"odometry.settings.patience and isolation.seconds"
                )
        T_own = T_own @ self._T_base_sensor
        # It is of a later moment if its stamp says so, or the user; stamps of a clock say nothing.
        late, is_first = stamp - self._stamp, self._T_odom_own is None
        is_later = self._steady and late > 0 and (is_first or late <= 1.5 * self._gap)
        taken = self._stamp, late if is_later else self._span
        if self._T_odom_own is None:
            T_odom_then = self._at_stamp.begin(*taken, self._T_odom_sensor, self._T_known)
            self._T_odom_own = T_odom_then @ invert(T_own)
        else:
            self._T_odom_sensor = self._at_stamp(*taken, self._T_odom_own @ T_own)
        return True

    def _check_silent(self, system: RosSystem) -> None:
        """Raise an `OdometryError` where a scan without a pose is one too many."""
        with self._news:
            self._missed.append(self._stamp)
        try:
            system.state()
        except OdometryError as error:
            what = str(error)
            if self._n_answered or not ("died" in what or "ended" in what):
                raise
            # One that ends with a code has said why.
            help_ = "; if it knows no points but the bag's own, set odometry.settings.play: bag"
            help_ *= "with code" not in what
            raise OdometryError(f"{what} before its first pose{help_}") from error
        n, answered, is_silent = self._n_shown, self._n_answered, self._silent >= _MOST_SILENT
        if not is_silent and (n < _MOST_SILENT or answered >= _LEAST_ANSWERED * n):
            return
        why = self._of_patience() or system.link.why_unheard(self._topics[0])
        if is_silent:
            published = system.link.topics().keys() - {*QUIET, *self._topics}
            topic = self._settings.odometry
            near = "" if topic in published else nearest(topic, published)
            needs = "" if self._settings.imu else "an IMU (odometry.settings.imu), or "
            why = (
                self._reader.lacking
                or why
                or near * near.startswith("did you mean")
                or (f"does it need {needs}all that the bag holds (play: bag)?")
            )
            raise OdometryError(
                f"no pose {'' if answered else 'yet '}on {topic} for {_MOST_SILENT} scans in a "
                f"row; topics that are published: {', '.join(sorted(published)) or 'none'}; {why}"
            )
        raise OdometryError(
            f"it gave poses for {answered} of {n} scans, and lockstep needs one for each; "
            f"{why or 'set odometry.settings.play: bag'}"
        )

    def _pose(self, seconds: float) -> tuple[int, Poses] | None:
        """The system's pose of the scan that was published last; None if it does not come.

        Its stamp is as late as that of the first pose was: a system gives it at the scan's begin,
        or at its end, where the next scan begins.
        """
        earliest = self._stamp - _EARLY + (0 if self._late is None else self._late // 2)

        def there() -> bool:
            came = bool(self._poses) and self._poses[-1][0] >= earliest
            return came or bool(self._reader.fault)

        with self._news:
            came = self._news.wait_for(there, seconds)
            if self._reader.fault:
                raise OdometryError(self._reader.fault)
            return self._poses[-1] if came else None

    def _take(self, kind: str, data: bytes) -> None:
        if self._system is None:
            return
        poses = [] if self._reader.fault else self._reader.read(kind, data)[-1:]
        with self._news:
            if poses:
                of_scan = poses[-1][0] - (self._late or 0)
                missed = [stamp for stamp in self._missed if abs(of_scan - stamp) >= MAX_SCATTER]
                self._n_too_late += len(self._missed) - len(missed)
                self._missed = missed
            self._poses = [(stamp, matrix(p, q)) for stamp, _, p, q in poses] or self._poses
            self._news.notify_all()

    def _quoting(self, error: Exception) -> str:
        """An error, and the last lines that the system wrote; no engine is no fault of a trial."""
        if isinstance(error, UnavailableError):
            raise error
        words = "" if self._system is None else self._system.words()
        return processes.quoting(str(error), words)


def other_frame(about: str, settings: Any) -> str:
    """What to set where poses are of another frame than scans are: `about` begins with theirs."""
    if (
        not about
        or settings.extrinsic is not None
        or about.split(maxsplit=1)[0].lstrip("/") == settings.frame.lstrip("/")
    ):
        return ""
    return f"scans are of {settings.frame}: set odometry.settings.extrinsic if it is not there"
