"""A ROS 1 system in a container that receives scan after scan, and can change its parameters."""

import contextlib
import shutil
import tempfile
import threading
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.files import temporary_prefix
from adaptune.geometry import Poses, invert, rectify
from adaptune.odometry.base import OdometryError, Registration, UnavailableError, Usage
from adaptune.odometry.docker.ros_container import RosSystem
from adaptune.odometry.docker.ros_parameters import filled, server_keys, warn_of_unread, whole_name
from adaptune.odometry.isolation import Faulting, Limits, pose_fault
from adaptune.ros.ros_link import LinkError
from adaptune.ros.steering import Steering
from adaptune.selection import Selection
from adaptune.sequence.config import to_pose
from adaptune.sequence.export import IMU, POINTS, Messages, structured
from adaptune.sequence.pose_messages import POSES
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet
from adaptune.trajectory import Trajectory

_CLOUD, _IMU = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"
_MOST_SILENT = 30
"""Scans in a row without a pose that are a fault."""
_BETWEEN_LOOKS = 1.0
"""Seconds between looks at what the system has used."""
_EARLY = 1_000_000
"""Nanoseconds by which a pose's stamp may be before the scan's."""


class Lockstep(Faulting):
    """A ROS 1 system that hears a scan, and then waits for the next one until its pose is there.

    It begins in a new container. Where a scan gets no pose, the last motion goes on.

    Parameters
    ----------
    parameters, limits
        See `Isolated`.
    settings
        A `RustleSettings`.
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
        self._looked = -np.inf

    @property
    def ended(self) -> bool:
        return self._system is None

    @property
    def usage(self) -> Usage:
        if self._system is not None and time.monotonic() - self._looked > _BETWEEN_LOOKS:
            self._look(self._system)
        cpu = self._used_before.cpu + self._used.cpu
        memory = max(self._used_before.memory or 0.0, self._used.memory or 0.0)
        return Usage(cpu, memory, elsewhere=cpu)

    def prepare(self, scan: Scan) -> Scan:
        return scan  # the system prepares

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
        self._late: int | None = None
        self._before: tuple[int, Poses] | None = None
        try:
            self._begin(prepared)
            self._show(prepared)
            self._correct()
        except UnavailableError:
            raise
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
            except UnavailableError:
                raise
            except (OdometryError, LinkError) as error:
                self.note_fault(self._told(error))

    def collect(self) -> Registration:
        self._waiting = False
        lost = Registration(np.full((4, 4), np.nan), registered=False)
        if self._system is None:
            return lost
        T_before = self._T_odom_sensor
        self._T_odom_sensor = T_before @ self._T_step
        try:
            registered = self._correct()
        except UnavailableError:
            raise
        except (OdometryError, LinkError) as error:
            return self.note_fault(self._told(error))
        if registered:
            self._T_step = rectify(invert(T_before) @ self._T_odom_sensor)
        self._last_motion.move(self._T_odom_sensor)
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
            try:
                self._steering.apply(
                    {
                        whole_name(self._template, name): value
                        for name, value in selection.parameters.items()
                    }
                )
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
        self._clock = system.run_clock(scan.stamp)
        self._send_cloud = link.advertise(topics[0], _CLOUD)
        self._send_imu = link.advertise(topics[1], _IMU) if self._settings.imu else None
        self._topics = topics
        system.wait(topics[0], topics if self._settings.imu else topics[:1])
        self._keys = keys = server_keys(self._template, self.parameters, link.ask("parameters"))
        self._steering = None
        if (node := self._settings.node) is not None:

            def set_parameters(values: ParameterSet) -> Mapping[str, Any]:
                return link.set_parameters(node, values, keys)

            command = self._settings.set_parameter
            self._steering = Steering(node, set_parameters, command, system.run)

    def _show(self, scan: Scan) -> None:
        """Publish what the system hears until the end of a scan."""
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
        seconds = min(self._settings.patience, self._limits.seconds)
        found = self._pose(seconds)
        assert self._system is not None
        if found is None:
            self._silent += 1
            self._system.state()
            if self._silent >= _MOST_SILENT:
                published = self._system.link.topics().keys() - {"/clock", "/rosout", *self._topics}
                raise OdometryError(
                    f"no pose on {self._settings.odometry} for {_MOST_SILENT} scans in a row; "
                    f"topics that are published: {', '.join(sorted(published)) or 'none'}"
                )
            return False
        stamp, T_own = found
        self._silent, self._has_run = 0, True
        if wrong := pose_fault(T_own):
            raise OdometryError(f"it gave a pose {wrong}")
        T_own = T_own @ self._T_base_sensor
        if self._late is None:
            self._late = stamp - self._stamp
        T_own = self._at_scan(stamp, T_own)
        if self._T_odom_own is None:
            self._T_odom_own = self._T_odom_sensor @ invert(T_own)
        self._T_odom_sensor = self._T_odom_own @ T_own
        return True

    def _at_scan(self, stamp: int, T_own_sensor: Poses) -> Poses:
        """The pose at the scan's stamp, if the system gives that at the scan's end."""
        before, self._before = self._before, (stamp, T_own_sensor)
        if before is None or not before[0] <= self._stamp < stamp:
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
        if self._system is None or kind not in POSES:
            return
        found = POSES[kind](self._system.link.store.deserialize_ros1(data, kind))[-1:]
        for stamp, _, p, q in found:
            try:
                T = to_pose((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            except ValueError:
                T = np.full((4, 4), np.nan)
            with self._news:
                self._poses = [(stamp, T)]
                self._news.notify_all()

    def _told(self, error: Exception) -> str:
        """An error, and the last lines that the system wrote."""
        words = "" if self._system is None else self._system.words()
        return f"{error}: {words}" if words else str(error)
