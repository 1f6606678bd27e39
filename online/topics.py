"""Scans and poses from topics, as they come."""

import json
import logging
import math
import threading
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import islice
from operator import itemgetter
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from adaptune.errors import AdaptuneError, warn_once
from adaptune.geometry import Poses, to_pose, to_quaternions
from adaptune.recording.clouds import CLOUDS, from_fields, header_of
from adaptune.recording.config import ImuConfig
from adaptune.recording.pose_messages import POSES, message_stamp
from adaptune.recording.scan import Imu, Scan
from adaptune.recording.timing import Timing
from adaptune.ros.link import LinkError, RosLink
from adaptune.selector import BACK
from adaptune.space import Selection
from adaptune.trajectory import Trajectory
from online.real_time import Arrival

SILENCE = 2.0
"""Seconds without a scan after which the log says so."""
IMU_WAIT = 0.1
"""Seconds that a scan waits for the IMU's measurements up to its end."""
_MAX_IMU = 20_000
"""Measurements that are kept."""
IMU_TYPE = "sensor_msgs/msg/Imu"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
SILENT = 10
"""Scans of which most have no pose; then the log says so."""
MAX_KEPT = 1000
"""Poses of a node, and scans of a drive, that are kept."""
_GAP = 1.0
"""Seconds between poses over which a pose is interpolated."""

_log = logging.getLogger(__name__)


class TopicScans:
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
    """

    def __init__(
        self,
        link: RosLink,
        points: str,
        timing: Timing,
        queue: int = 1,
        imu: ImuConfig | None = None,
    ):
        self.frame = "sensor"  # by the newest cloud
        self._link, self._points, self._timing, self._queue = link, points, timing, queue
        self._settings = imu
        # Load compiled code, for which the first scans should not wait.
        from_fields(dict.fromkeys("xyz", np.ones(1, np.float32)), 0, timing)
        self._news = threading.Condition()
        self._waiting: deque[tuple[Scan, float]] = deque()
        self._measured: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_MAX_IMU)
        self._dropped = 0
        self.stopped = False
        if imu is not None and imu.topic is not None:
            link.subscribe(imu.topic, IMU_TYPE, self._take_imu)
        self._kind = ""
        self._listen(link.topics())

    def _listen(self, topics: Mapping[str, str]) -> None:
        """Take the messages of the points' topic as what it is, by the `topics` that there are."""
        kind = topics.get(self._points, self._kind or next(iter(CLOUDS)))
        if kind not in CLOUDS:
            can = ", ".join(CLOUDS)
            raise LinkError(f"{self._points} is {kind}; name a topic of point clouds ({can})")
        if kind != self._kind:
            self._kind = kind
            take = partial(self._take, CLOUDS[kind])
            self._link.subscribe(self._points, kind, take, raw=True)

    def stop(self) -> None:
        """End all iterations."""
        with self._news:
            self.stopped = True
            self._news.notify()

    def arrivals(self) -> Iterator[Arrival]:
        """Scans as they come, until the clock goes back or `stop` is called.

        The scan at which the clock goes back begins the next iteration.
        """
        last: int | None = None
        while (found := self._next(last)) is not None:
            (scan, came), dropped = found
            if last is not None and scan.stamp <= last:
                with self._news:
                    self._dropped += dropped
                continue
            before, last = last, scan.stamp
            yield Arrival(self._with_imu(scan, before), came, dropped)

    def _next(self, last: int | None) -> tuple[tuple[Scan, float], int] | None:
        """The next scan, and how many were dropped before it; None at the end."""
        silent = 0.0
        while True:
            with self._news:
                if self._news.wait_for(lambda: bool(self._waiting or self.stopped), SILENCE):
                    break
            silent += SILENCE
            if not self._link.alive:
                raise LinkError("adaptune's node in ROS has ended; start again")
            # Again after twice as long.
            if np.log2(silent / SILENCE) % 1.0 == 0.0:
                self._tell_of_silence(silent)
        with self._news:
            if self.stopped:
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

    def _tell_of_silence(self, seconds: float) -> None:
        hint = ""
        try:
            topics = self._link.topics()
            if self._points not in topics:
                clouds = sorted(topic for topic, kind in topics.items() if kind in CLOUDS)
                among = f"point clouds come on {', '.join(clouds)}" if clouds else "no point clouds"
                hint = f"; nobody publishes it ({among})"
            self._listen(topics)
        except LinkError as error:
            hint = f"; {error}"
        _log.warning("%s: no scan for %.0f s%s", self._points, seconds, hint)

    def _take(self, decode: Callable[..., Scan], data: bytes) -> None:
        came = time.perf_counter()
        try:
            scan = decode(data, self._link.is2, self._timing)
        except AdaptuneError as error:
            _log.warning("%s: %s; the scan is left out", self._points, error)
            return
        with self._news:
            self.frame = header_of(data, self._link.is2)[1] or self.frame
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
                lambda: self.stopped or (self._measured and self._measured[-1][0] >= end),
                IMU_WAIT,
            )
            # The first scan gets those during it, or else the one before.
            taken: list[tuple[int, tuple[float, ...]]] = []
            while self._measured and (not taken or taken[-1][0] < end):
                taken.append(self._measured.popleft())
        if before is None:
            taken = [pair for pair in taken if pair[0] > scan.stamp] or taken[-1:]
        stamps = np.array([stamp for stamp, _ in taken], np.int64)
        values = np.array([values for _, values in taken], np.float64).reshape(-1, 6)
        imu = self._settings.in_si(Imu(stamps, values[:, :3], values[:, 3:]))
        return replace(scan, imu=imu)


class TopicPoses:
    """Poses of a LiDAR, of shape (4, 4), by an odometry on a `topic` (nav_msgs/Odometry).

    `T_base_sensor` is the LiDAR's pose in the frame whose poses it publishes, `points` the topic of
    the clouds that it hears. `late` ends what the log says of poses that "come later than".
    """

    def __init__(self, link: RosLink, topic: str, T_base_sensor: Poses, points: str, late: str):
        self._link, self._topic, self._points, self._late = link, topic, points, late
        self._T_base_sensor = T_base_sensor
        self._news = threading.Condition()
        self._poses: deque[tuple[int, Poses]] = deque(maxlen=MAX_KEPT)
        self._silent: deque[bool] = deque(maxlen=SILENT)
        self._missed: deque[int] = deque(maxlen=MAX_KEPT)  # stamps of scans without a pose in time
        self._asked = self._step = 0  # stamp of the newest scan, and nanoseconds since the last one
        self._warned = False
        link.subscribe(topic, ODOMETRY_TYPE, self._take)

    def at(self, stamp: int, seconds: float) -> Poses:
        """The pose at the stamp of a scan, which may come within so many seconds; else NaN."""
        self._step, self._asked = stamp - self._asked, stamp
        with self._news:
            self._news.wait_for(lambda: self._poses and self._poses[-1][0] >= stamp, seconds)
        T = self.near(stamp)
        known = bool(np.isfinite(T).all())
        self._silent.append(not known)
        if not known:
            self._missed.append(stamp)
        self._tell_of_silence()
        return T

    def near(self, stamp: int) -> Poses:
        """The pose at a stamp, straight between those that came; NaN if it is not known."""
        with self._news:
            after = bisect_left(self._poses, stamp, key=itemgetter(0))
            near = list(islice(self._poses, max(after - 1, 0), after + 1))
        if not near:
            return np.full((4, 4), np.nan)
        stamps, T = zip(*near, strict=True)
        known = Trajectory(np.array(stamps, np.int64), np.array(T))
        found: Poses = known.at(np.array([stamp], np.int64), _GAP)[0]
        return found

    def _take(self, message: Any) -> None:
        for stamp, _, position, orientation in POSES[ODOMETRY_TYPE](message):
            values = (position.x, position.y, position.z)
            quaternion = (orientation.x, orientation.y, orientation.z, orientation.w)
            try:
                T = to_pose((*values, *quaternion))
            except ValueError:
                continue  # no pose, which the health check sees
            with self._news:
                if self._poses and stamp < self._poses[-1][0] - BACK:
                    self._poses.clear()
                if not self._poses or stamp > self._poses[-1][0]:
                    self._poses.append((stamp, T @ self._T_base_sensor))
                self._news.notify()
                self._tell_of_missed(stamp)

    def _tell_of_silence(self) -> None:
        n = sum(self._silent)
        self._warned &= n > 0
        # A node that loses clouds answers now and then.
        if n < SILENT - 2 or len(self._silent) < SILENT or self._warned:
            return
        self._warned = True
        try:
            why = self._link.why_unheard(self._points)
        except LinkError as error:
            why = str(error)
        usual = "is it the topic, and does its node run?"
        _log.warning("%s: no pose for %d of %d scans; %s", self._topic, n, SILENT, why or usual)

    def _tell_of_missed(self, stamp: int) -> None:
        """Log, once, whether poses that were missed came late, by that of a stamp, or never."""
        steps = np.diff([at for at, _ in self._poses][-SILENT:])
        while self._missed and self._missed[0] <= stamp:
            late = stamp - self._missed.popleft() < 0.5 * self._step
            if not late and (len(steps) < 2 or steps[-1] <= 1.5 * np.median(steps)):
                continue  # its habit
            lost = "never come, and later ones do: is the node too slow, or does it lose clouds?"
            why = f"come later than {self._late}" if late else lost
            warn_once(f"{self._topic}: some poses {why}")


# What adaptune publishes while a robot drives.


UNKNOWN_ERROR = 5.0
"""Percent of the way that an odometry is believed to err by before anything is known of it."""


class Uncertainty:
    """How uncertain a pose is, by the errors that were measured on the way.

    Errors of sub-trajectories are taken to be independent: over each metre, the variance grows by
    the squared error times the length of a sub-trajectory. The heading is taken to err by as much,
    in radians, over a sub-trajectory.

    `length` is a sub-trajectory's, in metres.
    """

    def __init__(self, length: float):
        self._length = length
        self._share = 1e-2 * UNKNOWN_ERROR
        self.position = self.rotation = 0.0  # variances: square metres, square radians

    def learn(self, selection: Selection) -> None:
        """Go on with the error of a selection: the measured one, or else the predicted."""
        for error in (selection.estimated_error, selection.predicted_error):
            if math.isfinite(error):
                self._share = 1e-2 * error
                return

    def move(self, T_previous_current: Poses) -> None:
        """Move on, by a motion of shape (4, 4)."""
        metres = float(np.linalg.norm(T_previous_current[:3, 3]))
        if math.isfinite(metres):
            self.position += self._share**2 * self._length * metres
            self.rotation += self._share**2 * metres / self._length


Placed = tuple[list[float], list[float]]
"""Position and quaternion of a pose."""


def placed(T: Poses) -> list[Placed]:
    """Positions and quaternions of poses of shape (n, 4, 4)."""
    return list(zip(T[:, :3, 3].tolist(), to_quaternions(T).tolist(), strict=True))


class RosMessages:
    """Makes messages of one ROS, in the odometry's `frame`."""

    def __init__(self, store: Typestore, frame: str):
        self._types, self._frame = store.types, frame

    def header(self, stamp: int, frame: str | None = None) -> Any:
        """A header in a frame, by default the odometry's."""
        time = self._types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        kind: Any = self._types["std_msgs/msg/Header"]
        # ROS 1 counts messages.
        numbered = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}
        return kind(stamp=time, frame_id=frame or self._frame, **numbered)

    def _vector(self, kind: str, values: Iterable[float]) -> Any:
        return self._types[f"geometry_msgs/msg/{kind}"](*values)

    def pose(self, at: Placed) -> Any:
        """geometry_msgs/Pose."""
        position, orientation = self._vector("Point", at[0]), self._vector("Quaternion", at[1])
        return self._types["geometry_msgs/msg/Pose"](position=position, orientation=orientation)

    def odometry(
        self, stamp: int, at: Placed, child: str, variances: tuple[float, float] = (0.0, 0.0)
    ) -> Any:
        """nav_msgs/Odometry with variances of position and rotation; the twist is not known."""
        zero = self._vector("Vector3", (0.0, 0.0, 0.0))
        twist = self._types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
        # By convention -1 says that a value is not known.
        unknown = np.zeros(36)
        unknown[0] = -1.0
        certain = np.diag(np.repeat(variances, 3)).ravel()
        with_covariance = "geometry_msgs/msg/{}WithCovariance".format
        return self._types["nav_msgs/msg/Odometry"](
            header=self.header(stamp),
            child_frame_id=child,
            pose=self._types[with_covariance("Pose")](pose=self.pose(at), covariance=certain),
            twist=self._types[with_covariance("Twist")](twist=twist, covariance=unknown),
        )

    def transform(self, stamp: int, at: Placed, child: str) -> Any:
        """tf2_msgs/TFMessage."""
        translation, rotation = self._vector("Vector3", at[0]), self._vector("Quaternion", at[1])
        transform = self._types["geometry_msgs/msg/Transform"](translation, rotation)
        stamped = self._types["geometry_msgs/msg/TransformStamped"]
        return self._types["tf2_msgs/msg/TFMessage"](
            transforms=[stamped(self.header(stamp), child, transform)]
        )

    def diagnostics(
        self, stamp: int, name: str, level: int, message: str, values: Mapping[str, str]
    ) -> Any:
        """diagnostic_msgs/DiagnosticArray of one status."""
        pair = self._types["diagnostic_msgs/msg/KeyValue"]
        status = self._types["diagnostic_msgs/msg/DiagnosticStatus"](
            level=level,
            name=f"adaptune: {name}",
            message=message,
            hardware_id="",
            values=[pair(key=key, value=value) for key, value in values.items()],
        )
        array = self._types["diagnostic_msgs/msg/DiagnosticArray"]
        return array(header=self.header(stamp), status=[status])

    def selection(self, stamp: int, selection: Selection, why_not: str) -> Any:
        """std_msgs/String with JSON: what was selected."""
        found = {
            "stamp": stamp,
            "trial": selection.trial,
            "parameters": dict(selection.parameters),
            "weights": {str(k): v for k, v in (selection.weights or {}).items()} or None,
            "predicted_error": _number(selection.predicted_error),
            "predicted_fixed": _number(selection.predicted_fixed),
            "estimated_error": _number(selection.estimated_error),
            "estimated_low": _number(selection.estimated_low),
            "estimated_high": _number(selection.estimated_high),
            "unit": "percent of the way",
            "state": selection.state,
            "why": selection.why or None,
            "lost": selection.lost,
            "why_not": why_not or None,
        }
        return self._types["std_msgs/msg/String"](data=json.dumps(found))


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None
