"""A ROS system that hears a recording at its own pace, from its beginning to its end."""

import logging
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from adaptune.errors import AdaptuneError, OdometryError
from adaptune.odometry.program import ProgramInput, WholeRun, when_known
from adaptune.odometry.systems.engine import kept_log
from adaptune.odometry.systems.ros_system import QUIET, PoseReader, RosSystem, filled
from adaptune.recording.pose_messages import PATH, POSES, Pose, usable
from adaptune.trajectory import Trajectory

_BETWEEN_TOPIC_LOOKS = 0.1
_BETWEEN_STATES = 1.0
_QUIET_END = 2.0  # seconds without a pose, and without work, that are the end
_FIRST_POSE = 10.0  # the same where no pose has come yet
_BUSY_QUIET = 60.0  # seconds without a pose that are the end of a system that never rests
_IDLE = 0.1  # cores that a system may use while it rests: nodes wake up with the clock
_STEADY = 0.9  # least share of poses whose stamps are as far from the scans' as those of the others
MAX_SCATTER = 5_000_000  # nanoseconds by which these may differ: a clock differs by more

_log = logging.getLogger(__name__)


class PoseRecorder:
    """Records what a system publishes on the topic of its poses."""

    def __init__(self, reader: PoseReader):
        self.topic, self.reader = reader.topic, reader
        self.received: list[tuple[str, bytes]] = []
        self.last = time.monotonic()
        self.longest_pause = 0.0
        reader.hear(self._take)

    def _take(self, kind: str, data: bytes) -> None:
        now = time.monotonic()
        if self.received:
            self.longest_pause = max(self.longest_pause, now - self.last)
        self.last = now
        if kind == PATH:  # which repeats all poses
            self.received.clear()
        self.received.append((kind, data))

    def poses(self) -> list[Pose]:
        """Poses in the order in which they came; an `OdometryError` if the messages hold none."""
        messages = self.received
        if messages and (kind := messages[0][0]) not in POSES:
            raise OdometryError(
                f"{self.topic} is {kind}; odometry.settings.odometry must name poses"
            )
        return [pose for kind, data in messages for pose in self.reader.read(kind, data)]

    def newest(self) -> tuple[int, int]:
        """How many poses there are, and the stamp of the one that came last."""
        poses = self.reader.read(*self.received[-1]) if self.received else []
        return len(self.received) + max(len(poses) - 1, 0), poses[-1][0] if poses else 0


class Drain:
    """Tells when nothing comes any more of a system whose bag of n scans is over.

    Every scan has its pose, or none comes while the system rests, at any load of the machine.
    `last` is the last scan's stamp, `cpu` gives the seconds of CPU time that the system has used.
    """

    def __init__(self, recorder: PoseRecorder, n: int, last: int, cpu: Callable[[], float]):
        self._recorder, self._n, self._last, self._cpu = recorder, n, last, cpu
        self._over = self._since = time.monotonic()
        self._used = cpu()

    def over(self) -> bool:
        """Whether nothing comes any more."""
        recorder, now = self._recorder, time.monotonic()
        count, newest = recorder.newest()
        # Stamps of a clock of its own, or poses between scans, say nothing.
        if count == self._n and self._last <= newest < self._last + 10**9:
            return True
        heard = max(recorder.last, self._over)
        wait = max(_QUIET_END, 3.0 * recorder.longest_pause) if count else _FIRST_POSE
        if self._since < heard or now - self._since > wait:
            used, before, since = self._cpu(), self._used, self._since
            self._used, self._since = used, now
            if since >= heard:
                rests = used - before < _IDLE * (now - since)
                return rests or now - heard > max(_BUSY_QUIET, wait)
        return False


class PlayedBag(WholeRun):
    """A ROS system that hears a bag, from its beginning to its end."""

    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        self._end = time.monotonic() + self._limits.seconds * len(given.stamps)
        template, text = filled(self.settings, self.parameters)
        memory, fault = self._limits.memory, ""
        system = self.settings.system(self.settings, memory, text, folder, given)
        with closing(system):
            try:
                recorder = PoseRecorder(system.reader())
                points = self._renamed(given).get(given.points, given.points)
                system.wait(points)
                system.check(template, self.parameters)
                self._play(system, recorder, given)
                system.warn_of_unread()
                why = system.link.why_unheard(points)
                self._check_published(system, recorder, why)
                return self._checked(recorder, given, why)
            except AdaptuneError as error:
                fault = str(error)
                raise
            finally:
                self._finish(system, given, fault)

    def _renamed(self, given: ProgramInput) -> dict[str, str]:
        """Topics of the recording that the system expects by another name."""
        pairs = ((given.points, self.settings.points), (given.imu, self.settings.imu))
        renamed = {old: new for old, new in pairs if old and new and old != new}
        # Poses that were recorded with the bag are not the system's.
        if (odometry := self.settings.odometry) not in (given.points, given.imu):
            renamed[odometry] = f"/recorded{odometry}"
        return renamed

    def _play(self, system: RosSystem, recorder: PoseRecorder, given: ProgramInput) -> None:
        """Play the bag and wait until nothing comes any more."""
        n, looked = len(given.stamps), time.monotonic()
        system.play(self.settings.rate, self._renamed(given))
        while not system.played():
            time.sleep(_BETWEEN_TOPIC_LOOKS)
            if time.monotonic() - looked > _BETWEEN_STATES:
                looked = time.monotonic()
                self._see(system, n)
            self._check(recorder)
        # Nodes that sleep by the clock must wake up to finish.
        with AnyReader([given.path]) as reader:
            end = int(reader.end_time)
        system.run_clock(end, self.settings.rate)
        drain = Drain(recorder, n, int(given.stamps[-1]), lambda: self._see(system, n))
        while not drain.over():
            time.sleep(_BETWEEN_TOPIC_LOOKS)
            self._check(recorder)
        self._see(system, n)

    def _see(self, system: RosSystem, n: int) -> float:
        """See whether the system runs, and its CPU seconds, which count as its time."""
        system.state()
        cpu = system.usage.cpu
        self._usage = system.usage._replace(seconds=cpu / n, other_cpu=cpu)
        return cpu

    def _check(self, recorder: PoseRecorder) -> None:
        if recorder.reader.fault:
            raise OdometryError(recorder.reader.fault)
        if time.monotonic() > self._end:
            raise self.too_long

    def _check_published(self, system: RosSystem, recorder: PoseRecorder, why: str = "") -> None:
        if recorder.received:
            return
        if why:
            raise OdometryError(f"nothing was published on {recorder.topic}: {why}")
        topics = ", ".join(sorted(system.link.topics().keys() - QUIET))
        raise OdometryError(
            f"nothing was published on {self.settings.odometry} until the system had rested for "
            f"{_FIRST_POSE:g} s after the bag; nodes announce {topics or 'no topics'}. If it is "
            f"there, does the system need another sensor, or some seconds at rest at the start? If "
            f"not, name the topic as odometry.settings.odometry"
        )

    def _finish(self, system: RosSystem, given: ProgramInput, fault: str) -> None:
        """End the system, and keep what is left of the run."""
        self._words = system.words()
        system.stop()
        limits = {"input": str(given.path), "rate": self.settings.rate, "cpus": self.settings.cpus}
        with kept_log(self, given.logs, fault, **limits) as kept:
            if kept is not None:
                system.keep(kept)

    def _checked(self, recorder: PoseRecorder, given: ProgramInput, why: str = "") -> Trajectory:
        """The trajectory, if its stamps are those of the data, or each scan has one pose."""
        poses = recorder.poses()
        if not poses:
            what = recorder.reader.lacking or "its messages hold none"
            raise OdometryError(f"no pose on {recorder.topic}: {what}")
        stamps = np.array([stamp for stamp, *_ in poses], np.int64)
        try:
            check_stamps(stamps, given.stamps)
        except OdometryError as error:
            if len(stamps) != len(given.stamps):
                raise OdometryError(
                    f"{error}, and {len(stamps)} poses for {len(given.stamps)} scans cannot be "
                    f"matched by number; set odometry.settings.play: lockstep"
                ) from error
            _log.warning("%s: %s; poses are matched to scans by number", self.name, error)
            stamps = given.stamps
            poses = [(s, *pose) for s, (_, *pose) in zip(stamps.tolist(), poses, strict=True)]
        trajectory, left_out = usable(poses)
        if trajectory is None or left_out:
            raise OdometryError(left_out[0])
        n, half = len(given.stamps), 0.5 * float(np.median(np.diff(given.stamps)))
        near = np.searchsorted(stamps, given.stamps - half) < np.searchsorted(
            stamps, given.stamps + 2.0 * half
        )
        if (~near).sum() > 0.01 * n:
            more = "set play: lockstep, a lower rate, or more cpus (odometry.settings)"
            self._unanswered, self._help = ~near, f"; {why or f'if it drops scans, {more}'}"
            _log.warning(
                "%s: %d of %d scans have no pose at rate %g; %s%s",
                *(self.name, (~near).sum(), n, self.settings.rate),
                *(when_known(near, given.stamps), self._help),
            )
        return trajectory


OWN_CLOCK = "the system stamps poses by its own clock, not by the scans"


def check_stamps(stamps: NDArray[np.int64], scans: NDArray[np.int64]) -> None:
    """Refuse stamps of poses that are not those of the scans, in nanoseconds, shapes (m,) and (n,).

    A system that publishes one pose for a scan stamps it with the scan's start, its end, or
    anything fixed between. One that publishes more is judged by begin and end only. There is an
    `OdometryError` if they go back, are further off than a scan and a quarter, or scatter.
    """
    if len(stamps) < 2:
        return
    if backwards := int((np.diff(stamps) < 0).sum()):
        what = f"{backwards} of {len(stamps)} poses have stamps that go back"
        raise OdometryError(f"{what}: {OWN_CLOCK}")
    period = float(np.median(np.diff(scans)))
    if stamps[-1] - scans[-1] > 1e9 + period or scans[0] - stamps[0] > 1e9 + period:
        begin, end = (1e-9 * stamps[[0, -1]]).tolist()
        raise OdometryError(
            f"its poses are of {begin:.3f} s to {end:.3f} s, the scans of "
            f"{1e-9 * scans[0]:.3f} s to {1e-9 * scans[-1]:.3f} s: {OWN_CLOCK}"
        )
    if len(stamps) > 1.5 * len(scans):
        return
    # Pose j is of scan j, or of a later one if poses are missing before it.
    missing = max(0, len(scans) - len(stamps))
    n = min(len(stamps), len(scans))
    late = 1e-9 * float(np.percentile(stamps[:n] - scans[missing : missing + n], 95))
    early = 1e-9 * float(np.percentile(scans[:n] - stamps[:n], 95))
    if max(late, early) > 1.25e-9 * period:
        how = f"{late:.3f} s late" if late > early else f"{early:.3f} s early"
        raise OdometryError(f"its stamps are up to {how}: {OWN_CLOCK}")
    i = np.searchsorted(scans, stamps).clip(1, len(scans) - 1)
    off = np.minimum(np.abs(stamps - scans[i]), np.abs(stamps - scans[i - 1])).astype(float)
    scatter = np.abs(off - np.median(off))
    if np.mean(scatter < MAX_SCATTER) < _STEADY:
        by = 1e-9 * float(np.percentile(scatter, 95))
        raise OdometryError(f"its stamps scatter by up to {by:.3f} s: {OWN_CLOCK}")
