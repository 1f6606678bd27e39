"""ROS 1 systems in Docker images that have RUSTLE's layout (Tavares, University of Coimbra, 2026).

Such an image has a package with ``rustle.launch``, which loads ``/rustle/config/params.yaml``; a
login shell finds it.
"""

import contextlib
import logging
import re
import shutil
import struct
import tempfile
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator
from rosbags.highlevel import AnyReader
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from adaptune import processes
from adaptune.errors import AdaptuneError, OdometryError, UnavailableError
from adaptune.files import temporary_prefix
from adaptune.geometry import Poses, invert, rectify, to_pose
from adaptune.odometry.base import (
    LOST,
    Description,
    Faulting,
    OdometryInstance,
    OwnFile,
    Registration,
    Usage,
    pose_fault,
)
from adaptune.odometry.docker.engine import ContainerSettings, Mount, image_digest, kept_log
from adaptune.odometry.docker.ros_container import (
    RosSystem,
    filled,
    server_keys,
    warn_of_unread,
    whole_name,
)
from adaptune.odometry.program import (
    ProgramInput,
    Template,
    WholeRun,
    WholeSettings,
    check_names,
    when_known,
)
from adaptune.odometry.remote import Limits
from adaptune.recording.clouds import PATH, POSES, Pose, usable
from adaptune.recording.config import resolve
from adaptune.recording.export import IMU, POINTS, Messages, structured
from adaptune.recording.scan import Scan
from adaptune.ros.link import LinkError, SetCommand, Steering
from adaptune.ros.ros1 import Ros1
from adaptune.space import ParameterSet, Selection
from adaptune.trajectory import Trajectory


def _topic(name: str) -> str:
    if not re.fullmatch(r"/[A-Za-z][\w/]*", name):
        raise ValueError(f"{name!r} is no name in ROS; it begins with a slash, as /Odometry")
    return name


Topic = Annotated[str, AfterValidator(_topic)]


class RustleSettings(ContainerSettings, WholeSettings):
    """An image in RUSTLE's layout.

    ``docs/docker.md`` describes the settings and their defaults.
    """

    template: Annotated[str, AfterValidator(resolve)]
    odometry: Topic
    points: Topic | None = None
    imu: Topic | None = None
    package: str | None = Field(None, pattern=r"^[\w-]+$")
    arguments: tuple[Annotated[str, Field(pattern=r"^[\w:=./-]+$")], ...] = ()
    play: Literal["bag", "lockstep"] = "bag"
    rate: float = Field(1.0, ge=0, le=100)
    use_sim_time: bool | None = None
    ready: float = Field(60.0, gt=0, le=3600)
    patience: float = Field(2.0, gt=0, le=3600)
    node: Topic | None = None
    set_parameter: SetCommand | None = None

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages in which the launch file may be."""
        return ("rustle-ros", "rustle") if self.package is None else (self.package,)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.play == "bag" and not self.rate:
            raise ValueError("rate: 0 is for play: lockstep; a bag plays at 1, or at another rate")
        if self.set_parameter is not None and self.node is None:
            raise ValueError("set_parameter: name the node, too (node)")
        if self.node is not None and self.play == "bag":
            raise ValueError("node: parameters change only with play: lockstep")
        return self


class Rustle:
    """A ROS 1 system, run on a bag that is played, or scan by scan."""

    settings_type = RustleSettings

    @staticmethod
    def describe(settings: RustleSettings) -> Description:
        """The study defines the parameters."""
        whole = settings.play == "bag"
        needs_imu = not whole and settings.imu is not None
        return Description(None, settings.node is not None, needs_imu, whole=whole)

    @staticmethod
    def check(settings: RustleSettings, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the image is not here, or a parameter is not in its file."""
        template = Template(Path(settings.template))
        if template.path.suffix not in (".yaml", ".yml"):
            raise OdometryError(f"template: {template.path} is not YAML, as ROS 1 reads it")
        check_names(parameters, template, ())
        image_digest(settings.image)

    @staticmethod
    def own_file(parameters: ParameterSet, settings: RustleSettings) -> OwnFile:
        """The parameter file that the system reads."""
        template, text = filled(settings, parameters)
        return OwnFile(template.path.suffix, text, f"in the place of {template.path.name}")

    @staticmethod
    def instance(
        parameters: ParameterSet,
        settings: RustleSettings,
        limits: Limits,
        read: Callable[[], ProgramInput] | None,
    ) -> OdometryInstance:
        """Make an instance, as all programs of the user are made."""
        if settings.play == "bag":
            return PlayedBag(parameters, settings, limits, read)
        return Lockstep(parameters, settings, limits)


def read_poses(store: Typestore, kind: str, data: bytes) -> list[Pose]:
    """The poses in a message; none if it is of another type."""
    try:
        return POSES[kind](store.deserialize_ros1(data, kind)) if kind in POSES else []
    except (SerdeError, struct.error, ValueError, IndexError) as error:
        raise OdometryError(f"it publishes a {kind} that cannot be read ({error})") from error


# A ROS 1 system in a container that receives scan after scan, and can change its parameters.


_CLOUD, _IMU = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"
_MOST_SILENT = 30
"""Scans in a row without a pose that are a fault."""
_LEAST_ANSWERED = 0.75
"""Least share of scans with a pose, of so many or more since the first one."""
_BETWEEN_LOOKS = 1.0
"""Seconds between looks at what the system has used."""
_EARLY = 1_000_000
"""Nanoseconds by which a pose's stamp may be before the scan's."""


class Lockstep(Faulting):
    """A ROS 1 system that hears a scan, and then waits for the next one until its pose is there.

    It begins in a new container. Where a scan gets no pose, the last motion goes on. With a `rate`,
    a scan waits until as much time has passed since the one before as in the recording.
    """

    apart = True

    def __init__(self, parameters: ParameterSet, settings: Any, limits: Limits):
        super().__init__(settings.image, parameters)
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

    @property
    def ended(self) -> bool:
        return self._system is None

    @property
    def begun(self) -> bool:
        return self._has_run or bool(self.faults)

    @property
    def usage(self) -> Usage:
        if self._system is not None and time.monotonic() - self._looked > _BETWEEN_LOOKS:
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
        self._silent, self._stamp, self._poses = 0, prepared.stamp, []
        self._n_shown = self._n_answered = 0  # since its first pose
        self._shown = (prepared.stamp, -np.inf)
        self._late: int | None = None
        self._steady = True  # whether all poses are as late as the first one
        self._before: tuple[int, Poses] | None = None
        try:
            self._begin(prepared)
            self._show(prepared)
            self._correct()
        except (OdometryError, LinkError) as error:
            told = self._told(error)
            # One that has run can be gone for good.
            if not self._has_run:
                self.close()
                raise OdometryError(f"{self.name}: {told}") from error
            self.note_fault(told)

    def submit(self, prepared: Scan) -> None:
        self._stamp, self._waiting = prepared.stamp, True
        if self._system is not None:
            try:
                self._show(prepared)
            except (OdometryError, LinkError) as error:
                self.note_fault(self._told(error))

    def collect(self) -> Registration:
        self._waiting = False
        registration = LOST
        if self._system is not None:
            try:
                registration = self._registration()
            except (OdometryError, LinkError) as error:
                registration = self.note_fault(self._told(error))
        self._last_motion.move(registration.T_odom_sensor)
        return registration

    def _registration(self) -> Registration:
        T_before = self._T_odom_sensor
        self._T_odom_sensor = T_before @ self._T_step
        registered = self._correct()
        if registered:
            self._T_step = rectify(invert(T_before) @ self._T_odom_sensor)
        return Registration(self._T_odom_sensor.copy(), registered)

    def ready(self, seconds: float) -> bool:
        return self._system is None or self._pose(seconds) is not None

    @property
    def busy(self) -> bool:
        return self._waiting

    def apply(self, selection: Selection) -> None:
        """Set the node's parameters, see `adaptune.ros.link.Steering.apply`."""
        if unknown := selection.parameters.keys() - self.parameters.keys():
            raise OdometryError(f"{self.name} has no parameter {min(unknown)!r}")
        self.parameters |= selection.parameters
        if self._system is not None and self._steering is not None:
            named = {whole_name(self._template, n): v for n, v in selection.parameters.items()}
            try:
                self._steering.apply(named)
            except LinkError as error:
                raise OdometryError(str(error)) from error

    def close(self) -> None:
        if self._system is not None:
            self._look(self._system)
            if self._has_run:
                with contextlib.suppress(OdometryError, LinkError):
                    warn_of_unread(self._system.link, self.name, self._keys)
            self._system.close()
            shutil.rmtree(self._folder, ignore_errors=True)
            self._system = None
            self._used_before = Usage(self.usage.cpu, self.usage.memory)
            self._used = Usage(0.0, 0.0)

    def __del__(self) -> None:
        self.close()

    def _look(self, system: RosSystem) -> None:
        """See what the system has used."""
        self._looked = time.monotonic()
        with contextlib.suppress(OdometryError, LinkError):
            system.state()
        self._used = system.usage

    def _begin(self, scan: Scan) -> None:
        """Start the system, and wait until it listens."""
        self._template, text = filled(self._settings, self.parameters)
        self._folder = Path(tempfile.mkdtemp(prefix=temporary_prefix()))
        try:
            system = RosSystem(self._settings, self._limits.memory, text, self._folder)
        except AdaptuneError:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        self._system = system
        link, topics = system.link, (self._settings.points or POINTS, self._settings.imu or IMU)
        self._messages = Messages(1)
        take = weakref.WeakMethod(self._take)  # the link must not keep this alive
        link.record(self._settings.odometry, lambda *given: (do := take()) and do(*given))
        self._clock = system.run_clock(scan.stamp, self._settings.rate or 1.0)
        self._send_cloud = link.advertise(topics[0], _CLOUD)
        self._send_imu = link.advertise(topics[1], _IMU) if self._settings.imu else None
        self._topics = topics
        system.wait(topics[0], topics if self._settings.imu else topics[:1])
        self._keys = keys = server_keys(self._template, self.parameters, link.ask("parameters"))
        self._steering = None
        if (node := self._settings.node) is not None:
            command = self._settings.set_parameter
            set_parameters = partial(link.set_parameters, node, keys=keys)
            self._steering = Steering(node, set_parameters, command, system.run)

    def _show(self, scan: Scan) -> None:
        """Publish what the system hears until the end of a scan."""
        stamp, at = self._shown
        if rate := self._settings.rate:
            time.sleep(max(0.0, at + 1e-9 * (scan.stamp - stamp) / rate - time.monotonic()))
        self._shown = scan.stamp, time.monotonic()
        with self._news:
            self._poses = []
        messages, (points, imu_topic) = self._messages, self._topics
        if scan.imu is not None and self._send_imu is not None:
            imu = scan.imu
            measured = zip(imu.stamps.tolist(), imu.angular_velocity, imu.acceleration, strict=True)
            for stamp, gyro, acceleration in measured:
                self._clock.reach(stamp)
                header = messages.header(imu_topic, stamp, "imu")
                self._send_imu(messages.imu(header, gyro, acceleration))
        self._clock.reach(scan.stamp + max(scan.span, 0))
        header = messages.header(points, scan.stamp, "lidar")
        self._send_cloud(messages.cloud(header, structured(scan)))

    def _correct(self) -> bool:
        """Correct the predicted pose; False if the system gave none."""
        found = self._pose(self._patience)
        if found is not None and self._late is None and self._silent:
            # It may be of an earlier scan; then others follow, though nothing more was sent.
            time.sleep(self._patience)
            found = self._pose(0.0)
        assert self._system is not None
        if self._n_answered or found is not None:
            self._n_shown += 1
        if found is None:
            self._silent += 1
            self._check_silent(self._system)
            return False
        stamp, T_own = found
        self._silent, self._has_run = 0, True
        self._n_answered += 1
        if wrong := pose_fault(T_own):
            raise OdometryError(f"it gave a pose {wrong}")
        if self._late is None:
            self._late = stamp - self._stamp
        if abs(stamp - self._stamp - self._late) >= _MAX_SCATTER:
            self._steady = False
            if silent := self._n_shown - self._n_answered:
                raise OdometryError(
                    f"{_OWN_CLOCK}, and {silent} scans had no pose after {self._patience:g} s, so "
                    f"a late pose cannot be told from the next one; raise "
                    f"odometry.settings.patience and isolation.seconds"
                )
        T_own = self._at_scan(stamp, T_own @ self._T_base_sensor)
        if self._T_odom_own is None:
            self._T_odom_own = self._T_odom_sensor @ invert(T_own)
        self._T_odom_sensor = self._T_odom_own @ T_own
        return True

    def _check_silent(self, system: RosSystem) -> None:
        """Raise an `OdometryError` where a scan without a pose is one too many."""
        try:
            system.state()
        except OdometryError as error:
            if self._n_answered:
                raise
            help_ = "if it knows no points but the bag's own, set odometry.settings.play: bag"
            raise OdometryError(f"{error} before its first pose; {help_}") from error
        if self._silent >= _MOST_SILENT:
            published = system.link.topics().keys() - {"/clock", "/rosout", *self._topics}
            raise OdometryError(
                f"no pose on {self._settings.odometry} for {_MOST_SILENT} scans in a row; "
                f"topics that are published: {', '.join(sorted(published)) or 'none'}; does it "
                f"need an IMU (odometry.settings.imu), or all that the bag holds (play: bag)?"
            )
        n, answered = self._n_shown, self._n_answered
        if n >= _MOST_SILENT and answered < _LEAST_ANSWERED * n:
            raise OdometryError(
                f"it gave poses for {answered} of {n} scans, and lockstep needs one for each; set "
                f"odometry.settings.play: bag"
            )

    def _at_scan(self, stamp: int, T_own_sensor: Poses) -> Poses:
        """The pose at the scan's stamp, if the system gives that at the scan's end."""
        before, self._before = self._before, (stamp, T_own_sensor)
        # Stamps of a clock say nothing.
        if before is None or not before[0] <= self._stamp < stamp or not self._steady:
            return T_own_sensor
        both = Trajectory(np.array([before[0], stamp]), np.stack([before[1], T_own_sensor]))
        T: Poses = both.at(np.array([self._stamp], np.int64), 1e9)[0]
        return T

    def _pose(self, seconds: float) -> tuple[int, Poses] | None:
        """The system's pose of the scan that was published last; None if it does not come.

        It comes after the scan was published. Its stamp is as late as that of the first pose was:
        a system gives it at the scan's begin, or at its end, where the next scan begins.
        """
        earliest = self._stamp - _EARLY + (0 if self._late is None else self._late // 2)

        def there() -> bool:
            return bool(self._poses) and self._poses[-1][0] >= earliest

        with self._news:
            return self._poses[-1] if self._news.wait_for(there, seconds) else None

    def _take(self, kind: str, data: bytes) -> None:
        if self._system is None:
            return
        for stamp, _, p, q in read_poses(self._system.link.store, kind, data)[-1:]:
            try:
                T = to_pose((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            except ValueError:
                T = np.full((4, 4), np.nan)
            with self._news:
                self._poses = [(stamp, T)]
                self._news.notify_all()

    def _told(self, error: Exception) -> str:
        """An error, and the last lines that the system wrote; no engine is no fault of a trial."""
        if isinstance(error, UnavailableError):
            raise error
        words = "" if self._system is None else self._system.words()
        return processes.quoting(str(error), words)


# A ROS 1 system in a container, on a bag that is played.

_BETWEEN_TOPIC_LOOKS = 0.1
_BETWEEN_STATES = 1.0
_QUIET = 2.0
"""Seconds without a pose, and without work, that are the end."""
_FIRST = 10.0
"""The same where no pose has come yet."""
_BUSY_QUIET = 60.0
"""Seconds without a pose that are the end of a system that never rests."""
_IDLE = 0.1
"""Cores that a system may use while it rests: nodes wake up with the clock."""
_STEADY = 0.9
"""Least share of poses whose stamps are as far from the scans' as those of the others."""
_MAX_SCATTER = 5_000_000
"""Nanoseconds by which these may differ: a clock differs by more."""

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
        """Poses in the order in which they came; an `OdometryError` if the messages hold none."""
        messages = self.received
        if messages and (kind := messages[0][0]) not in POSES:
            raise OdometryError(
                f"{self.topic} is {kind}; odometry.settings.odometry must name poses"
            )
        return [pose for kind, data in messages for pose in self._poses(kind, data)]

    def newest(self) -> tuple[int, int]:
        """How many poses there are, and the stamp of the one that came last."""
        poses = self._poses(*self.received[-1]) if self.received else []
        return len(self.received) + max(len(poses) - 1, 0), poses[-1][0] if poses else 0

    def _poses(self, kind: str, data: bytes) -> list[Pose]:
        return read_poses(self.store, kind, data)


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
        wait = max(_QUIET, 3.0 * recorder.longest_pause) if count else _FIRST
        if self._since < heard or now - self._since > wait:
            used, before, since = self._cpu(), self._used, self._since
            self._used, self._since = used, now
            if since >= heard:
                rests = used - before < _IDLE * (now - since)
                return rests or now - heard > max(_BUSY_QUIET, wait)
        return False


class PlayedBag(WholeRun):
    """A ROS 1 system that hears a bag, from its beginning to its end."""

    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        self._end = time.monotonic() + self._limits.seconds * len(given.stamps)
        template, text = filled(self.settings, self.parameters)
        source = given.path.resolve()
        # As RUSTLE mounts the folder of a data set.
        bag = Mount(source, f"/rustle/dataset/{source.name}")
        system = RosSystem(self.settings, self._limits.memory, text, folder, [bag])
        recorder, fault = PoseRecorder(system.link, self.settings.odometry), ""
        with closing(system):
            try:
                renamed = self._renamed(given)
                system.wait(renamed.get(given.points, given.points))
                keys = server_keys(template, self.parameters, system.link.ask("parameters"))
                self._play(system, recorder, given, bag.target)
                warn_of_unread(system.link, self.name, keys)
                self._check_published(system, recorder)
                return self._checked(recorder, given)
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

    def _play(
        self, system: RosSystem, recorder: PoseRecorder, given: ProgramInput, bag: str
    ) -> None:
        """Play the bag and wait until nothing comes any more."""
        n, looked = len(given.stamps), time.monotonic()
        system.play(bag, self.settings.rate, self._renamed(given))
        while not system.played():
            time.sleep(_BETWEEN_TOPIC_LOOKS)
            if time.monotonic() - looked > _BETWEEN_STATES:
                looked = time.monotonic()
                self._see(system, n)
            self._check_time()
        # Nodes that sleep by the clock must wake up to finish.
        with AnyReader([given.path]) as reader:
            end = int(reader.end_time)
        system.run_clock(end, self.settings.rate)
        drain = Drain(recorder, n, int(given.stamps[-1]), lambda: self._see(system, n))
        while not drain.over():
            time.sleep(_BETWEEN_TOPIC_LOOKS)
            self._check_time()
        self._see(system, n)

    def _see(self, system: RosSystem, n: int) -> float:
        """See whether the system runs, and how many seconds of CPU time it has used.

        The bag sets the pace, so CPU time counts as the system's time.
        """
        system.state()
        cpu = system.usage.cpu
        self._usage = system.usage._replace(seconds=cpu / n, other_cpu=cpu)
        return cpu

    def _check_time(self) -> None:
        if time.monotonic() > self._end:
            raise self.too_long

    def _check_published(self, system: RosSystem, recorder: PoseRecorder) -> None:
        if recorder.received:
            return
        topics = ", ".join(sorted(system.link.topics().keys() - {"/clock", "/rosout"}))
        raise OdometryError(
            f"nothing was published on {self.settings.odometry} until the system had rested for "
            f"{_FIRST:g} s after the bag; nodes announce {topics or 'no topics'}. If it is there, "
            f"does the system need another sensor, or some seconds at rest at the start? If not, "
            f"name the topic as odometry.settings.odometry"
        )

    def _finish(self, system: RosSystem, given: ProgramInput, fault: str) -> None:
        """End the system, and keep what is left of the run."""
        self._words, written = system.words(), system.log()
        system.stop()
        limits = {"input": str(given.path), "rate": self.settings.rate, "cpus": self.settings.cpus}
        with kept_log(self, given.logs, fault, **limits) as kept:
            if kept is not None:
                (kept / "roscore.log").write_bytes(written)
                system.keep(kept)

    def _checked(self, recorder: PoseRecorder, given: ProgramInput) -> Trajectory:
        """The trajectory, if its stamps are those of the data, or each scan has one pose."""
        poses = recorder.poses()
        stamps = np.array([stamp for stamp, *_ in poses], np.int64)
        try:
            check_stamps(stamps, given.stamps)
        except OdometryError as error:
            if len(stamps) != len(given.stamps):
                counts = f"{len(stamps)} poses for {len(given.stamps)} scans"
                help_ = (
                    f"{counts} cannot be matched by number; set odometry.settings.play: lockstep"
                )
                raise OdometryError(f"{error}, and {help_}") from error
            _log.warning("%s: %s; poses are matched to scans by number", self.name, error)
            stamps = given.stamps
            poses = [(s, *of) for s, (_, *of) in zip(stamps.tolist(), poses, strict=True)]
        trajectory, left_out = usable(poses)
        if trajectory is None or left_out:
            raise OdometryError(left_out[0])
        n, half = len(given.stamps), 0.5 * float(np.median(np.diff(given.stamps)))
        near = np.searchsorted(stamps, given.stamps - half) < np.searchsorted(
            stamps, given.stamps + 2.0 * half
        )
        if (~near).sum() > 0.01 * n:
            _log.warning(
                "%s: %d of %d scans have no pose at rate %g; %s",
                *(self.name, (~near).sum(), n, self.settings.rate, when_known(near, given.stamps)),
            )
        return trajectory


_OWN_CLOCK = "the system stamps poses by its own clock, not by the scans"


def check_stamps(stamps: NDArray[np.int64], scans: NDArray[np.int64]) -> None:
    """Refuse stamps of poses that are not those of the scans, in nanoseconds, shapes (m,) and (n,).

    A system that publishes one pose for a scan stamps it with the scan's start, its end, or
    anything fixed between. One that publishes more is judged by begin and end only.

    Raises
    ------
    OdometryError
        If they go back, are further off than a scan and a quarter, or scatter. It says how far.
    """
    if len(stamps) < 2:
        return
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
        return
    # Pose j is of scan j, or of a later one if poses are missing before it.
    missing = max(0, len(scans) - len(stamps))
    n = min(len(stamps), len(scans))
    late = 1e-9 * float(np.percentile(stamps[:n] - scans[missing : missing + n], 95))
    early = 1e-9 * float(np.percentile(scans[:n] - stamps[:n], 95))
    if max(late, early) > 1.25e-9 * period:
        how = f"{late:.3f} s late" if late > early else f"{early:.3f} s early"
        raise OdometryError(f"its stamps are up to {how}: {_OWN_CLOCK}")
    i = np.searchsorted(scans, stamps).clip(1, len(scans) - 1)
    off = np.minimum(np.abs(stamps - scans[i]), np.abs(stamps - scans[i - 1])).astype(float)
    scatter = np.abs(off - np.median(off))
    if np.mean(scatter < _MAX_SCATTER) < _STEADY:
        by = 1e-9 * float(np.percentile(scatter, 95))
        raise OdometryError(f"its stamps scatter by up to {by:.3f} s: {_OWN_CLOCK}")
