"""A ROS 1 system in a container, on a bag that is played."""

import logging
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys.store import Typestore

from adaptune.errors import AdaptuneError
from adaptune.odometry.base import OdometryError
from adaptune.odometry.docker.engine import Mount
from adaptune.odometry.docker.ros_container import RosSystem
from adaptune.odometry.docker.ros_parameters import filled, server_keys, warn_of_unread
from adaptune.odometry.docker.trial_log import costs, kept_log
from adaptune.odometry.program_input import ProgramInput
from adaptune.odometry.whole_run import WholeRun
from adaptune.ros.ros1 import Ros1
from adaptune.sequence.pose_messages import PATH, POSES, Pose, usable
from adaptune.trajectory import Trajectory

_BETWEEN_LOOKS = 0.1
_BETWEEN_STATES = 1.0
_LONGEST_PAUSE = 10.0
"""Seconds."""
_STEADY = 0.9
"""Least share of poses whose stamps are as far from the scans' as those of the others."""

_log = logging.getLogger(__name__)


class PoseRecorder:
    """Records what a system publishes on the topic of its poses."""

    def __init__(self, link: Ros1, topic: str):
        self.topic, self.store = topic, link.store
        self.received: list[tuple[str, bytes]] = []
        self.last = time.monotonic()
        self.longest_pause = 0.0
        link.record(topic, self._take)

    def _take(self, kind: str, data: bytes) -> None:
        now = time.monotonic()
        if self.received:
            self.longest_pause = max(self.longest_pause, now - self.last)
        self.last = now
        if kind == PATH:  # which repeats all poses
            self.received.clear()
        self.received.append((kind, data))

    def poses(self) -> list[Pose]:
        """Poses in the order in which they came, see `adaptune.sequence.pose_messages`.

        Raises
        ------
        OdometryError
            If the messages hold no poses.
        """
        messages = self.received
        if messages and (kind := messages[0][0]) not in POSES:
            raise OdometryError(
                f"{self.topic} is {kind}; odometry.settings.odometry must name poses"
            )
        return [pose for kind, data in messages for pose in self._poses(kind, data)]

    def newest(self) -> int:
        """Stamp of the pose that came last; 0 if there is none."""
        if not self.received or self.received[-1][0] not in POSES:
            return 0
        return max((stamp for stamp, *_ in self._poses(*self.received[-1])[-1:]), default=0)

    def _poses(self, kind: str, data: bytes) -> list[Pose]:
        return POSES[kind](self.store.deserialize_ros1(data, kind))

    def write(self, path: Path) -> None:
        """Write a ROS 1 bag."""
        write_poses(path, self.topic, self.received, self.store)


def write_poses(
    path: Path, topic: str, messages: list[tuple[str, bytes]], store: Typestore
) -> None:
    """Write messages of one type to a ROS 1 bag, at their poses' stamps."""
    with Writer(path) as bag:
        connection = None
        for kind, data in messages:
            if connection is None:
                connection = bag.add_connection(topic, kind, typestore=store)
            stamps = [stamp for stamp, *_ in POSES[kind](store.deserialize_ros1(data, kind))]
            bag.write(connection, max(stamps, default=0), data)


class PlayedBag(WholeRun):
    """A ROS 1 system that hears a bag, from its beginning to its end."""

    @property
    def called(self) -> str:
        return str(self.settings.image)

    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        self._seconds: dict[str, float] = {}
        self._end = time.monotonic() + self._limits.seconds * len(given.stamps)
        template, text = filled(self.settings, self.parameters)
        source = given.path.resolve()
        # As RUSTLE mounts the folder of a data set.
        bag = Mount(source, f"/rustle/dataset/{source.name}")
        with self._timed("container"):
            system = RosSystem(self.settings, self._limits.memory, text, folder, [bag])
        recorder, fault = PoseRecorder(system.link, self.settings.odometry), ""
        with closing(system):
            try:
                renamed = self._renamed(given)
                with self._timed("ready"):
                    system.wait(renamed.get(given.points, given.points))
                    keys = server_keys(template, self.parameters, system.link.ask("parameters"))
                self._play(system, recorder, given, bag.target)
                warn_of_unread(system.link, self.called, keys)
                self._check_published(system, recorder)
                return self._checked(recorder, given)
            except AdaptuneError as error:
                fault = str(error)
                raise
            finally:
                self._finish(system, recorder, given, fault)

    @contextmanager
    def _timed(self, what: str) -> Iterator[None]:
        begin = time.monotonic()
        yield
        self._seconds[what] = time.monotonic() - begin

    def _renamed(self, given: ProgramInput) -> dict[str, str]:
        """Topics of the recording that the system expects by another name."""
        pairs = ((given.points, self.settings.points), (given.imu, self.settings.imu))
        renamed = {old: new for old, new in pairs if old and new and old != new}
        # Poses that were recorded with the bag are not the system's.
        if (odometry := self.settings.odometry) not in (given.points, given.imu):
            renamed[odometry] = f"/recorded{odometry}"
        return renamed

    def _play(
        self, system: RosSystem, recorder: PoseRecorder, given: ProgramInput, bag: str
    ) -> None:
        """Play the bag and wait until nothing comes any more."""
        n = len(given.stamps)
        with self._timed("bag"):
            looked = time.monotonic()
            system.play(bag, self.settings.rate, self._renamed(given))
            while not system.played():
                time.sleep(_BETWEEN_LOOKS)
                if time.monotonic() - looked > _BETWEEN_STATES:
                    looked = time.monotonic()
                    self._see(system, n)
                self._check_time()
        with self._timed("drained"):
            over = time.monotonic()
            # Nodes that sleep by the clock must wake up to finish.
            system.run_clock(_end_of(given.path), self.settings.rate)
            while not self._drained(recorder, over, int(given.stamps[-1])):
                time.sleep(_BETWEEN_LOOKS)
                self._check_time()
            self._see(system, n)

    def _see(self, system: RosSystem, n: int) -> None:
        """See whether the system runs, and what it has used.

        The bag sets the pace, so CPU time counts as the system's time.
        """
        system.state()
        self._usage = system.usage._replace(seconds=system.usage.cpu / n)

    def _drained(self, recorder: PoseRecorder, over: float, last: int) -> bool:
        """Whether the pose of the last scan is there, or nothing came for a while."""
        # Stamps of a clock of its own say nothing.
        if last <= recorder.newest() < last + 10**9:
            return True
        pause = min(max(self.settings.drain, 3.0 * recorder.longest_pause), _LONGEST_PAUSE)
        return bool(time.monotonic() - max(recorder.last, over) > pause)

    def _check_time(self) -> None:
        if time.monotonic() > self._end:
            limit = f"isolation.seconds = {self._limits.seconds:g}"
            raise OdometryError(f"it took longer than {limit} for each scan")

    def _check_published(self, system: RosSystem, recorder: PoseRecorder) -> None:
        if recorder.received:
            return
        topic, drain = self.settings.odometry, self.settings.drain
        topics = set(system.link.topics()) - {"/clock", "/rosout"}
        others = ", ".join(sorted(topics - {topic})) or "nothing"
        if topic in topics:
            raise OdometryError(
                f"nothing was published on {topic} until {drain:g} s after the bag, though a node "
                f"announces it (others publish {others}); a system that is slow to begin needs a "
                f"longer odometry.settings.drain"
            )
        raise OdometryError(
            f"nothing was published on {topic}, but on {others}; name its topic as "
            f"odometry.settings.odometry"
        )

    def _finish(
        self, system: RosSystem, recorder: PoseRecorder, given: ProgramInput, fault: str
    ) -> None:
        """End the system, and keep what is left of the run."""
        self._words, written = system.words(), system.log()
        with self._timed("removed"):
            system.stop()
        steps = ", ".join(f"{name} {value:.1f} s" for name, value in self._seconds.items())
        _log.info("%s: %s; %.1f s of CPU time", self.called, steps, self._usage.cpu)
        limits = {"input": str(given.path), "rate": self.settings.rate, "cpus": self.settings.cpus}
        about = limits | costs(self._usage, self._seconds) | ({"fault": fault} if fault else {})
        with kept_log(given.logs, self.settings, self.parameters, about) as kept:
            if kept is None:
                return
            (kept / "roscore.log").write_bytes(written)
            system.keep(kept)
            if recorder.received and recorder.received[0][0] in POSES:
                recorder.write(kept / "odometry.bag")

    def _checked(self, recorder: PoseRecorder, given: ProgramInput) -> Trajectory:
        """The trajectory, if its stamps are those of the data."""
        poses = recorder.poses()
        stamps = np.array([stamp for stamp, *_ in poses], np.int64)
        if scatter := check_stamps(stamps, given.stamps):
            _log.warning(
                "%s: stamps of poses scatter by up to %.3f s around those of the scans: %s, and "
                "errors contain it",
                *(self.called, scatter, _OWN_CLOCK),
            )
        trajectory, unusable = usable(poses)
        if trajectory is None or unusable:
            raise OdometryError(
                f"{unusable} of {len(poses)} poses are no poses (NaN, or no rotation)"
            )
        n, half = len(given.stamps), 0.5 * float(np.median(np.diff(given.stamps)))
        near = np.searchsorted(stamps, given.stamps - half) < np.searchsorted(
            stamps, given.stamps + 2.0 * half
        )
        # Systems need a few scans to begin.
        missing = int((~near[np.argmax(near) :]).sum())
        if missing > 0.01 * n:
            _log.warning(
                "%s: %d of %d scans have no pose at rate %g: it drops scans, so a lower "
                "odometry.settings.rate gives other results",
                *(self.called, missing, n, self.settings.rate),
            )
        return trajectory


_OWN_CLOCK = "the system stamps poses by its own clock, not by the scans"


def check_stamps(stamps: NDArray[np.int64], scans: NDArray[np.int64]) -> float:
    """Refuse stamps of poses that are not those of the scans.

    A system that publishes one pose for a scan stamps it with the scan's start, its end, or
    anything fixed between. One that publishes more is judged by begin and end only.

    Parameters
    ----------
    stamps, scans
        Nanoseconds, of shapes (m,) and (n,).

    Returns
    -------
    float
        Seconds by which stamps scatter around those of the scans; 0 if they do not.

    Raises
    ------
    OdometryError
        If they go back, or are further off than two scans. It says how far.
    """
    if len(stamps) < 2:
        return 0.0
    if backwards := int((np.diff(stamps) < 0).sum()):
        what = f"{backwards} of {len(stamps)} poses have stamps that go back"
        raise OdometryError(f"{what}: {_OWN_CLOCK}")
    period = float(np.median(np.diff(scans)))
    if stamps[-1] - scans[-1] > 1e9 + period or scans[0] - stamps[0] > 1e9 + period:
        begin, end = (1e-9 * stamps[[0, -1]]).tolist()
        raise OdometryError(
            f"its poses are of {begin:.3f} s to {end:.3f} s, the scans of "
            f"{1e-9 * scans[0]:.3f} s to {1e-9 * scans[-1]:.3f} s: {_OWN_CLOCK}"
        )
    if len(stamps) > 1.5 * len(scans):
        return 0.0
    # Pose j is of scan j, or of a later one if poses are missing before it.
    missing = max(0, len(scans) - len(stamps))
    n = min(len(stamps), len(scans))
    late = 1e-9 * float(np.percentile(stamps[:n] - scans[missing : missing + n], 95))
    early = 1e-9 * float(np.percentile(scans[:n] - stamps[:n], 95))
    if max(late, early) > 2e-9 * period:
        how = f"{late:.3f} s late" if late > early else f"{early:.3f} s early"
        raise OdometryError(f"its stamps are up to {how}: {_OWN_CLOCK}")
    i = np.searchsorted(scans, stamps).clip(1, len(scans) - 1)
    off = np.minimum(np.abs(stamps - scans[i]), np.abs(stamps - scans[i - 1])).astype(float)
    steady = np.abs(off - np.median(off)) < max(5e6, 0.1 * period)
    return 0.0 if steady.mean() > _STEADY else 1e-9 * float(np.percentile(off, 95))


def _end_of(bag: Path) -> int:
    with AnyReader([bag]) as reader:
        return int(reader.end_time)
