"""Somebody else's odometry node, of which only parameters are set."""

import logging
import subprocess
import time
from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np

from adaptune.errors import AdaptuneError, OdometryError
from adaptune.geometry import Poses, invert, to_pose
from adaptune.odometry.base import OdometryInstance, Registration
from adaptune.recording.scan import Scan
from adaptune.ros.link import BusyError, RosLink
from adaptune.ros.steering import Steering
from adaptune.space import ParameterSet, Selection
from adaptune.study.config import SteerConfig
from online.topics import TopicPoses

_log = logging.getLogger(__name__)

_COMMAND = 5.0
"""Seconds for a command that sets a parameter."""
_BUSY = 2
"""Sets without an answer; with one more, the log says so."""


class SteeredNode(OdometryInstance):
    """An odometry that runs elsewhere and publishes its poses."""

    faults = ()
    rewinds = False

    def __init__(self, link: RosLink, settings: SteerConfig, points: str):
        self._settings = settings
        T_base_sensor = np.eye(4) if settings.extrinsic is None else to_pose(settings.extrinsic)
        late = f"online.ros.steer.patience ({settings.patience:g} s) allows: raise it, or let less"
        late += " run on this machine"
        self._poses = TopicPoses(link, settings.odometry, T_base_sensor, points, late)
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
        # Only a thread of its own waits for a node that is busy.
        self._asking, self._verdict = ThreadPoolExecutor(1), Future[None]()
        self._newest = self._asked = 0
        self._unread = 0  # answers to what is no longer asked for, which may come
        self._told, self._held = False, "it has confirmed none so far"

    def start(
        self, prepared: Scan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        # The node goes on; its motions continue from here.
        self._begun, self._T_odom_node = (prepared.stamp, np.array(T_odom_sensor)), None
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared: Scan) -> None:
        self._submitted = prepared.stamp

    def _collect(self) -> Registration:
        T_node = self._poses.at(self._submitted, self._settings.patience)
        T_odom_sensor = np.full((4, 4), np.nan)
        known = bool(np.isfinite(T_node).all())
        if known:
            if self._T_odom_node is None:
                assert self._begun is not None
                stamp, T = self._begun
                T_begin = self._poses.near(stamp)
                T_first = T_begin if np.isfinite(T_begin).all() else T_node
                self._T_odom_node = T @ invert(T_first)
            T_odom_sensor = self._T_odom_node @ T_node
        return Registration(T_odom_sensor, known)

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


def _run(command: list[str]) -> tuple[int, str]:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_COMMAND, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise OdometryError(f"{command[0]}: {error}") from error
    return done.returncode, done.stderr or done.stdout
