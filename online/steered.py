"""Somebody else's odometry node, of which only parameters are set."""

import logging
import subprocess
import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np

from adaptune.errors import AdaptuneError, OdometryError, warn_once
from adaptune.geometry import Poses, invert, to_pose
from adaptune.odometry.base import OdometryInstance, Registration
from adaptune.recording.pose_messages import POSES
from adaptune.recording.scan import Scan
from adaptune.ros.link import BusyError, LinkError, RosLink
from adaptune.ros.steering import Steering
from adaptune.selector import BACK
from adaptune.space import ParameterSet, Selection
from adaptune.study.config import SteerConfig
from adaptune.trajectory import Trajectory

_log = logging.getLogger(__name__)

ODOMETRY = "nav_msgs/msg/Odometry"
SILENT = 10
"""Scans of which most have no pose; then the log says so."""
_COMMAND = 5.0
"""Seconds for a command that sets a parameter."""
KEPT = 1000
"""Poses of a node, and scans of a drive, that are kept."""
_BUSY = 2
"""Sets without an answer; with one more, the log says so."""
_GAP = 1.0
"""Seconds between poses over which a pose is interpolated."""


class SteeredNode(OdometryInstance):
    """An odometry that runs elsewhere and publishes its poses."""

    faults = ()
    rewinds = False

    def __init__(self, link: RosLink, settings: SteerConfig, points: str):
        self._settings, self._link, self._points = settings, link, points
        extrinsic = settings.extrinsic
        self._T_base_sensor = np.eye(4) if extrinsic is None else to_pose(extrinsic)
        self._news = threading.Condition()
        self._poses: deque[tuple[int, Poses]] = deque(maxlen=KEPT)
        self._begun: tuple[int, Poses] | None = None
        self._T_odom_node: Poses | None = None
        self._steering = Steering(
            settings.node,
            lambda parameters: link.set_parameters(
                settings.node, parameters, lambda: self._asked != self._newest
            ),
            settings.command,
            _run,
        )
        self._silent: deque[bool] = deque(maxlen=SILENT)
        self._missed: deque[int] = deque(maxlen=KEPT)  # stamps of scans without a pose in time
        self._warned = False
        # Only a thread of its own waits for a node that is busy.
        self._asking, self._verdict = ThreadPoolExecutor(1), Future[None]()
        self._newest = self._asked = 0
        self._unread = 0  # answers to what is no longer asked for, which may come
        self._told, self._held = False, "it has confirmed none so far"
        link.subscribe(settings.odometry, ODOMETRY, self._take)

    def start(
        self, prepared: Scan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        # The node goes on; its motions continue from here.
        self._begun, self._T_odom_node = (prepared.stamp, np.array(T_odom_sensor)), None
        self._submitted = prepared.stamp
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared: Scan) -> None:
        self._step, self._submitted = prepared.stamp - self._submitted, prepared.stamp

    def _collect(self) -> Registration:
        T_node = self._pose(self._submitted, self._settings.patience)
        T_odom_sensor = np.full((4, 4), np.nan)
        known = bool(np.isfinite(T_node).all())
        self._silent.append(not known)
        if not known:
            self._missed.append(self._submitted)
        self._tell_of_silence()
        if known:
            if self._T_odom_node is None:
                assert self._begun is not None
                stamp, T = self._begun
                T_begin = self._pose(stamp, 0.0)
                T_first = T_begin if np.isfinite(T_begin).all() else T_node
                self._T_odom_node = T @ invert(T_first)
            T_odom_sensor = self._T_odom_node @ T_node
        return Registration(T_odom_sensor, known)

    def _tell_of_silence(self) -> None:
        n = sum(self._silent)
        self._warned &= n > 0
        # A node that loses clouds answers now and then.
        if n < SILENT - 2 or len(self._silent) < SILENT or self._warned:
            return
        self._warned, settings = True, self._settings
        try:
            why = self._link.why_unheard(self._points)
        except LinkError as error:
            why = str(error)
        what = "%s: no pose of %s for %d of %d scans; %s"
        usual = "is it the topic, and does the node run?"
        _log.warning(what, settings.odometry, settings.node, n, SILENT, why or usual)

    def apply(self, selection: Selection) -> None:
        """Ask the node to take the parameters, and no longer for others; see `confirmed`."""
        self._newest += 1
        self._verdict = self._asking.submit(self._ask, self._newest, selection.parameters)

    def confirmed(self, seconds: float = 0.0) -> bool:
        wait((self._verdict,), seconds)
        return self._verdict.done() and self._verdict.result() is None

    def close(self) -> None:
        self._newest += 1

    def _ask(self, number: int, parameters: ParameterSet) -> None:
        """Ask until the node confirms, see `adaptune.ros.steering.Steering.apply`, or refuses."""
        self._asked, node = number, self._settings.node
        while number == self._newest:
            try:
                self._steering.apply(parameters)
            except AdaptuneError as error:
                outdated = number != self._newest
                no_answer = outdated or isinstance(error, BusyError)
                # An answer may be to what was asked before.
                if not (no_answer or self._unread):
                    raise
                self._unread += 1 if no_answer else -1
                if not self._told and (not outdated or self._unread > _BUSY):
                    self._told = True
                    _log.warning("%s; the newest set stays asked for; %s", error, self._held)
            else:
                values = ", ".join(f"{name} = {value}" for name, value in parameters.items())
                self._held = f"it has confirmed {values} at {time.strftime('%H:%M:%S')}"
                if self._told:
                    _log.warning("%s answers again: %s", node, self._held)
                self._told, self._unread = False, 0
                return
        raise BusyError(f"{node} has not confirmed it")

    def _take(self, message: Any) -> None:
        for stamp, _, position, orientation in POSES[ODOMETRY](message):
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

    def _tell_of_missed(self, stamp: int) -> None:
        """Log, once, whether poses that were missed came late, by that of a stamp, or never."""
        settings, steps = self._settings, np.diff([at for at, _ in self._poses][-SILENT:])
        while self._missed and self._missed[0] <= stamp:
            late = stamp - self._missed.popleft() < 0.5 * self._step
            if not late and (len(steps) < 2 or steps[-1] <= 1.5 * np.median(steps)):
                continue  # its habit
            why = f"come later than online.ros.steer.patience ({settings.patience:g} s) allows"
            why += ": raise it, or let less run on this machine"
            lost = "never come, and later ones do: is the node too slow, or does it lose clouds?"
            warn_once(f"{settings.odometry}: some poses of {settings.node} {why if late else lost}")

    def _pose(self, stamp: int, seconds: float) -> Poses:
        """The node's pose at a stamp, of shape (4, 4); NaN if it does not come in time."""
        with self._news:
            self._news.wait_for(lambda: self._poses and self._poses[-1][0] >= stamp, seconds)
            poses = list(self._poses)
        if not poses:
            return np.full((4, 4), np.nan)
        stamps, T = zip(*poses, strict=True)
        known = Trajectory(np.array(stamps, np.int64), np.array(T))
        found: Poses = known.at(np.array([stamp], np.int64), _GAP)[0]
        return found


def _run(command: list[str]) -> tuple[int, str]:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_COMMAND, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise OdometryError(f"{command[0]}: {error}") from error
    return done.returncode, done.stderr or done.stdout
