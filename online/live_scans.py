"""Scans from a topic, as they come."""

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.ros.ros_link import LinkError, RosLink
from adaptune.sequence.imu import Imu
from adaptune.sequence.pointcloud2 import PointCloud2, from_fields, read_points
from adaptune.sequence.pose_messages import message_stamp
from adaptune.sequence.recorded import ImuSettings
from adaptune.sequence.scan import Scan
from adaptune.sequence.timing import Timing
from adaptune.timed_selector import BACK
from online.real_time import Arrival

SILENCE = 2.0
"""Seconds without a scan after which the log says so."""
IMU_WAIT = 0.1
"""Seconds that a scan waits for the IMU's measurements up to its end."""
_MOST_IMU = 20_000
"""Measurements that are kept."""
CLOUD, IMU = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"

_log = logging.getLogger(__name__)


class LiveScans:
    """Scans of a topic, with what the IMU measured.

    A scan that is not newer than the one before is ignored. Of the scans that come while nobody
    asks, the newest ones wait.

    Parameters
    ----------
    link
        To the robot.
    points
        Topic of the point clouds.
    timing
        Meaning of their stamps.
    queue
        Scans that may wait; with 0 all do.
    imu
        How to read the IMU, its topic included; None without.

    Attributes
    ----------
    ignored : int
        Scans that came twice, or after a newer one.
    damaged : int
        Messages that held no scan.
    frame : str
        Name of the sensor's frame, by the newest cloud.
    """

    def __init__(
        self,
        link: RosLink,
        points: str,
        timing: Timing,
        queue: int = 1,
        imu: ImuSettings | None = None,
    ):
        self.ignored = self.damaged = 0
        self.frame = "sensor"
        self._link, self._points, self._timing, self._queue = link, points, timing, queue
        self._settings = imu
        _warm_up(timing)
        self._news = threading.Condition()
        self._waiting: deque[tuple[Scan, float]] = deque()
        self._measured: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_MOST_IMU)
        self._dropped = 0
        self._stopped = False
        if imu is not None and imu.topic is not None:
            link.subscribe(imu.topic, IMU, self._take_imu)
        link.subscribe(points, CLOUD, self._take)

    def stop(self) -> None:
        """End all iterations."""
        with self._news:
            self._stopped = True
            self._news.notify()

    def arrivals(self) -> Iterator[Arrival]:
        """Scans as they come, until the clock goes back or `stop` is called.

        The scan at which the clock goes back begins the next iteration.
        """
        last: int | None = None
        while (found := self._next(last)) is not None:
            (scan, came), dropped = found
            if last is not None and scan.stamp <= last:
                self.ignored += 1
                continue
            before, last = last, scan.stamp
            yield Arrival(self._with_imu(scan, before), came, dropped)

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stopped

    def _next(self, last: int | None) -> tuple[tuple[Scan, float], int] | None:
        """The next scan, and how many were dropped before it; None at the end."""
        silent = 0.0
        while not self._is_there():
            silent += SILENCE
            if not self._link.alive:
                raise LinkError("adaptune's node in ROS has ended; start again")
            # Again after twice as long.
            if np.log2(silent / SILENCE) % 1.0 == 0.0:
                self._tell_of_silence(silent)
        with self._news:
            if self._stopped:
                return None
            stamp = self._waiting[0][0].stamp
            if last is not None and stamp < last - BACK:
                _log.warning("the clock went back by %.1f s: a new drive", (last - stamp) * 1e-9)
                self._measured.clear()
                return None
            if silent:
                _log.warning("%s: scans come again, after %.0f s", self._points, silent)
            dropped, self._dropped = self._dropped, 0
            return self._waiting.popleft(), dropped

    def _is_there(self) -> bool:
        """Whether there is a scan, or the end, before the silence is too long."""
        with self._news:
            return self._news.wait_for(lambda: bool(self._waiting or self._stopped), SILENCE)

    def _tell_of_silence(self, seconds: float) -> None:
        hint = ""
        try:
            topics = self._link.topics()
            if self._points not in topics:
                clouds = sorted(topic for topic, kind in topics.items() if kind == CLOUD)
                among = f"point clouds come on {', '.join(clouds)}" if clouds else "no point clouds"
                hint = f"; nobody publishes it ({among})"
        except LinkError as error:
            hint = f"; {error}"
        _log.warning("%s: no scan for %.0f s%s", self._points, seconds, hint)

    def _take(self, message: Any) -> None:
        came = time.perf_counter()
        try:
            scan = to_scan(message, self._timing)
        except AdaptuneError as error:
            self.damaged += 1
            _log.warning("%s: %s; the scan is left out", self._points, error)
            return
        with self._news:
            self.frame = message.header.frame_id or self.frame
            self._waiting.append((scan, came))
            if self._queue and len(self._waiting) > self._queue:
                self._waiting.popleft()
                self._dropped += 1
            self._news.notify()

    def _take_imu(self, message: Any) -> None:
        w, a = message.angular_velocity, message.linear_acceleration
        values = (w.x, w.y, w.z, a.x, a.y, a.z)
        stamp = message_stamp(message)
        with self._news:
            if np.isfinite(values).all() and (not self._measured or stamp > self._measured[-1][0]):
                self._measured.append((stamp, values))
                self._news.notify()

    def _with_imu(self, scan: Scan, before: int | None) -> Scan:
        """The scan with what was measured since the scan before."""
        if self._settings is None:
            return scan
        end = scan.stamp + scan.span
        with self._news:
            self._news.wait_for(
                lambda: self._stopped or (self._measured and self._measured[-1][0] >= end),
                IMU_WAIT,
            )
            # The first scan gets those during it, and the one before.
            taken: list[tuple[int, tuple[float, ...]]] = []
            while self._measured and (not taken or taken[-1][0] < end):
                taken.append(self._measured.popleft())
        if before is None:
            taken = [one for one in taken if one[0] > scan.stamp] or taken[-1:]
        stamps = np.array([stamp for stamp, _ in taken], np.int64)
        values = np.array([values for _, values in taken], np.float64).reshape(-1, 6)
        T = np.eye(4) if self._settings.T_sensor_imu is None else self._settings.T_sensor_imu
        acceleration = values[:, 3:] * self._settings.scale
        imu = Imu(stamps, values[:, :3], acceleration, T, self._settings.noise)
        return replace(scan, imu=imu)


def _warm_up(timing: Timing) -> None:
    """Load compiled code, for which the first scans should not wait."""
    numbers = np.ones(1, np.float32)
    from_fields(dict.fromkeys("xyz", numbers), 0, timing)


def to_scan(message: Any, timing: Timing) -> Scan:
    """The scan of a sensor_msgs/PointCloud2.

    Raises
    ------
    AdaptuneError
        If it holds no points with x, y and z.
    """
    fields = tuple((one.name, one.offset, one.datatype, one.count) for one in message.fields)
    cloud = PointCloud2(
        message_stamp(message),
        message.height,
        message.width,
        fields,
        bool(message.is_bigendian),
        message.point_step,
        message.row_step,
        memoryview(message.data),
    )
    return from_fields(read_points(cloud), cloud.stamp, timing)
