"""Drive on a robot: scans from a topic, poses and selections on others."""

import csv
import io
import itertools
import logging
import subprocess
import threading
from collections import deque
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from adaptune.errors import AdaptuneError, OdometryError, nearest
from adaptune.geometry import Poses, invert, to_pose
from adaptune.odometry.base import OdometryInstance, Registration
from adaptune.odometry.tracker import RegisteredScan
from adaptune.recording.clouds import POSES
from adaptune.recording.config import ImuConfig, SequenceConfig
from adaptune.recording.scan import Scan
from adaptune.recording.timing import Timing
from adaptune.ros.link import LinkError, RosLink, Steering
from adaptune.selector import BACK, Selector
from adaptune.space import Selection
from adaptune.strict import in_one_line
from adaptune.study.config import RealTimeConfig, RosConfig, SteerConfig, StudyConfig
from adaptune.study.study import ModeError, Study, StudySequences
from adaptune.trajectory import Trajectory, tum_lines
from online.live import LiveScans, RosMessages, Uncertainty, placed
from online.modes import UNTRAINED, WITHOUT_MODEL, Mode, ReplaySetup, needed
from online.real_time import RealTimeDrive, SelectorProcess
from online.record import FRAME_COLUMNS, SELECTION_COLUMNS, frame_row, selection_row
from online.replay import Choice, ReplayRecord, Watch

# What a drive leaves on disk, written while it lasts.


class DriveLog:
    """Writes ``trajectory.tum``, ``frames.csv`` and ``selections.csv``, line by line.

    Where the disk is full, the log ends and the drive goes on.

    `names` are those of the parameters, columns of ``selections.csv``. With `goes_on`, the drive
    goes on where nothing can be recorded from the start.

    Attributes
    ----------
    lost : str
        Why the log ended; empty while it lasts.

    Raises
    ------
    OSError
        If the files cannot be made, unless the drive goes on.
    """

    def __init__(self, folder: Path, names: list[str], *, goes_on: bool = False):
        self.folder, self.lost = folder, ""
        self._names = names
        self._files: dict[str, IO[str]] = {}
        try:
            folder.mkdir(parents=True)
            for name in ("trajectory.tum", "frames.csv", "selections.csv"):
                # A line is on disk when it is written: the robot may be switched off.
                file = (folder / name).open("w", buffering=1, newline="", encoding="utf-8")
                self._files[name] = file
        except OSError as error:
            if not goes_on:
                raise
            self._end(error)
        self._write("frames.csv", _csv(FRAME_COLUMNS))
        self._write("selections.csv", _csv((*SELECTION_COLUMNS, *names)))

    def scan(self, step: RegisteredScan, late: float) -> None:
        """Note a scan: its pose, and how late that was in seconds."""
        stamps = np.array([step.stamp], np.int64)
        (line,) = tum_lines(stamps, step.T_odom_sensor[None])
        self._write("trajectory.tum", line)
        self._write("frames.csv", _csv(frame_row(step, late)))

    def choice(self, choice: Choice) -> None:
        """Note a selection."""
        self._write("selections.csv", _csv(selection_row(choice, self._names)))

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            try:
                file.close()
            except OSError as error:
                self._end(error)

    def _write(self, name: str, line: str) -> None:
        if not self.lost:
            try:
                self._files[name].write(line)
            except OSError as error:
                self._end(error)

    def _end(self, error: OSError) -> None:
        if not self.lost:
            self.lost = in_one_line(error)
            _log.warning("%s: nothing more is recorded (%s); the drive goes on", self.folder, error)


def _csv(row: Iterable[Any]) -> str:
    text = io.StringIO()
    csv.writer(text).writerow(row)
    return text.getvalue()


# Somebody else's odometry node, of which only parameters are set.


ODOMETRY = "nav_msgs/msg/Odometry"
PATIENCE = 0.3
"""Seconds after a scan in which the node's pose must be there."""
SILENT = 10
"""Scans of which most have no pose; then the log says so."""
_COMMAND = 5.0
"""Seconds for a command that sets a parameter."""
_KEPT = 1000
"""Poses of a node, and scans of a drive, that are kept."""
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
        self._poses: deque[tuple[int, Poses]] = deque(maxlen=_KEPT)
        self._begun: tuple[int, Poses] | None = None
        self._T_odom_node: Poses | None = None
        self._steering = Steering(
            settings.node,
            lambda parameters: link.set_parameters(settings.node, parameters),
            settings.command,
            _run,
        )
        self._silent: deque[bool] = deque(maxlen=SILENT)
        self._told = False
        link.subscribe(settings.odometry, ODOMETRY, self._take)

    def start(
        self, prepared: Scan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        # The node goes on; its motions continue from here.
        self._begun, self._T_odom_node = (prepared.stamp, np.array(T_odom_sensor)), None
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared: Scan) -> None:
        self._submitted = prepared.stamp

    def collect(self) -> Registration:
        T_node = self._pose(self._submitted, PATIENCE)
        T_odom_sensor = np.full((4, 4), np.nan)
        known = bool(np.isfinite(T_node).all())
        self._silent.append(not known)
        self._tell_of_silence()
        if known:
            if self._T_odom_node is None:
                assert self._begun is not None
                stamp, T = self._begun
                T_begin = self._pose(stamp, 0.0)
                T_first = T_begin if np.isfinite(T_begin).all() else T_node
                self._T_odom_node = T @ invert(T_first)
            T_odom_sensor = self._T_odom_node @ T_node
        self._last_motion.move(T_odom_sensor)
        return Registration(T_odom_sensor, known)

    def _tell_of_silence(self) -> None:
        n = sum(self._silent)
        self._told &= n > 0
        # A node that loses clouds answers now and then.
        if n < SILENT - 2 or len(self._silent) < SILENT or self._told:
            return
        self._told, settings = True, self._settings
        try:
            why = self._link.why_unheard(self._points)
        except LinkError as error:
            why = str(error)
        what = "%s: no pose of %s for %d of %d scans; %s"
        usual = "is it the topic, and does the node run?"
        _log.warning(what, settings.odometry, settings.node, n, SILENT, why or usual)

    def apply(self, selection: Selection) -> None:
        """Set the parameters, see `adaptune.ros.link.Steering.apply`."""
        self._steering.apply(selection.parameters)

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


SELECTION_TOPIC = "adaptune/selection"

_log = logging.getLogger(__name__)


class DriveRecord(NamedTuple):
    """What became of a drive."""

    folder: Path  # of its trajectory, selections and scans
    scans: int
    record: ReplayRecord  # of its last part, where the clock went back


class RobotDrive:
    """A study's odometry, or somebody else's node, on a robot.

    Parameters
    ----------
    study
        The study; ``drives/<time>`` in its folder receives the drive.
    mode
        One of `ReplaySetup.modes`, or `untrained`.
    model_path
        The error model; None for `untrained` and `baseline`.

    Raises
    ------
    AdaptuneError
        If the mode, the model and the study do not go together.
    """

    def __init__(self, study: Study, mode: str, model_path: Path | None):
        config = study.config
        real_time = (config.online.real_time or RealTimeConfig()).model_copy(update={"rate": 1.0})
        online = config.online.model_copy(update={"real_time": real_time})
        config = config.model_copy(update={"online": online})
        # What is only compared with is for replays.
        setup = replace(ReplaySetup.of(study), config=config, also=())
        self._study, self._setup, self._settings = study, setup, real_time
        self._ros = config.online.ros
        self._like = _like(config, study.sequences)
        self._points = _named(self._ros.points or self._like.points, "online.ros.points")
        self._scans: LiveScans | None = None
        self._stopped = False
        model = None if model_path is None else study.model(model_path)
        modes = WITHOUT_MODEL
        if model is not None and model_path is not None:
            setup.check(model, model_path)
            rules = () if self._ros.steer is None else config.online.rules
            modes = (*dict.fromkeys((*setup.modes(model), *rules)), UNTRAINED)
        if mode not in modes:
            raise ModeError(f"--mode: there is no mode {mode!r}; {nearest(mode, modes)}")
        if self._ros.steer is not None:
            if mode not in config.online.rules:
                raise ModeError(f"online.ros.steer: in the mode {mode} nothing is selected")
            model = needed(mode, model)
            fixed = {model.fixed: model.sets[model.fixed]}
            # A node that is steered has one set at a time.
            make = partial(Selector, model, mode, (), config.descriptor)
            self._mode = Mode(mode, fixed, selector=make)
        elif study.odometry.description.whole:
            raise ModeError(
                f"{study.odometry.name} runs whole recordings: name the node that runs it on the "
                f"robot (online.ros.steer)"
            )
        else:
            self._mode = setup.mode(mode, model)

    def run(self, link: RosLink, watch: Watch = lambda _: None) -> DriveRecord:
        """Drive until Ctrl-C, or until `stop` is called.

        Where the clock goes back, all begins anew.

        `watch` is called after every scan.
        """
        done = 0
        with ExitStack() as stack:
            steered = None
            if self._ros.steer is not None:
                steered = SteeredNode(link, self._ros.steer, self._points)
            selector = None
            if self._mode.selector is not None:
                period = self._study.config.online.period
                selector = SelectorProcess(self._mode.selector, period)
                stack.enter_context(closing(selector))
            self._scans = scans = self._topics(link)
            publisher = _Publisher(link, self._ros, self._study.config.sub_trajectory, scans)
            driven = None
            while driven is None or not (scans.stopped or self._stopped):
                odometry = steered or self._setup.instance(self._mode)
                with closing(odometry):
                    driven = self._part(odometry, selector, publisher, watch, done)
                done = driven.scans
        return driven

    def stop(self) -> None:
        """End the drive; any thread may call it."""
        self._stopped = True
        if self._scans is not None:
            self._scans.stop()

    def _topics(self, link: RosLink) -> LiveScans:
        """Subscribe to scans, and to an IMU if the odometry needs one."""
        like, imu = self._like, None
        timing = Timing(like.stamp, like.time_unit, like.period)
        if self._study.odometry.description.needs_imu and self._ros.steer is None:
            imu = like.imu or ImuConfig()
            imu = imu.model_copy(update={"topic": _named(imu.topic, "imu.topic")})
        return LiveScans(link, self._points, timing, self._settings.queue, imu)

    def _part(
        self,
        odometry: OdometryInstance,
        selector: SelectorProcess | None,
        publisher: "_Publisher",
        watch: Watch,
        done: int,
    ) -> DriveRecord:
        """Drive until the clock goes back; so many scans were there before."""
        assert self._scans is not None
        folder, names = _new_folder(self._study.folder / "drives"), self._study.odometry.space.names
        # A robot that drives goes on, whatever happens to its disk.
        with closing(DriveLog(folder, list(names), goes_on=done > 0)) as log:
            publisher.begin(log)
            try:
                if selector is not None:
                    odometry.apply(selector.fixed)
            except AdaptuneError as error:
                if not done:
                    raise
                _log.warning("the fixed set cannot be applied: %s", error)
            record = ReplayRecord(1.0, publisher.choice)
            for name in ("steps", "choices", "rejected", "late", "waited"):
                setattr(record, name, deque(maxlen=_KEPT))
            health = self._study.config.health
            drive = RealTimeDrive(odometry, health, self._settings, selector, record, "drive")
            if self._stopped:
                self._scans.stop()
            try:
                for arrival in self._scans.arrivals():
                    publisher.step(drive.step(arrival), record.late[-1])
                    watch(record)
            except KeyboardInterrupt:
                self._scans.stop()
            drive.finish()
            return DriveRecord(folder, done + record.done, record)


class _Publisher:
    """Publishes and records what a drive finds."""

    def __init__(self, link: RosLink, ros: RosConfig, length: float, scans: LiveScans):
        self._scans = scans
        self._messages = RosMessages(link.store, ros.frame)
        self._length = length
        self._selection = link.advertise(SELECTION_TOPIC, "std_msgs/msg/String")
        # A node that is steered publishes its own poses.
        own = ros.steer is None
        self._odometry = link.advertise(ros.odometry, ODOMETRY) if own else None
        tf = own and ros.tf
        self._tf = link.advertise("/tf", "tf2_msgs/msg/TFMessage") if tf else None

    def begin(self, log: DriveLog) -> None:
        """Begin a drive, which has a log of its own."""
        self._log = log
        self._uncertainty = Uncertainty(self._length)
        self._last: RegisteredScan | None = None

    def choice(self, choice: Choice) -> None:
        """Tell of a selection."""
        self._log.choice(choice)
        if not choice.why_not:
            self._uncertainty.learn(choice.selection)
        self._selection(self._messages.selection(choice.stamp, choice.selection, choice.why_not))

    def step(self, step: RegisteredScan, late: float) -> None:
        """Tell of a pose, which was so many seconds late."""
        self._log.scan(step, late)
        last, self._last = self._last, step
        if last is not None:
            self._uncertainty.move(invert(last.T_odom_sensor) @ step.T_odom_sensor)
        if step.unhealthy is not None and (last is None or last.unhealthy is None):
            _log.warning("the odometry restarts: the health check found %s", step.unhealthy)
        (at,) = placed(step.T_odom_sensor[None])
        where = step.stamp, at, self._scans.frame
        if self._odometry is not None:
            variances = self._uncertainty.position, self._uncertainty.rotation
            self._odometry(self._messages.odometry(*where, variances))
        if self._tf is not None:
            self._tf(self._messages.transform(*where))


def _like(config: StudyConfig, sequences: StudySequences) -> SequenceConfig:
    """The sequence of a study that was recorded with the robot's sensor."""
    name, names = config.online.ros.like or config.training[0], [*config.sequences, *config.courses]
    if name not in names:
        raise AdaptuneError(f"online.ros.like: no sequence {name!r}; {nearest(name, names)}")
    return sequences.config(name)


def _named(topic: str | None, key: str) -> str:
    if topic is None:
        raise AdaptuneError(f"{key}: name the topic on the robot")
    return topic


def _new_folder(parent: Path) -> Path:
    """A folder named by the time, which is not there yet."""
    name = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S")
    numbers = itertools.count(2)
    folder = parent / name
    while folder.exists():
        folder = parent / f"{name}_{next(numbers)}"
    return folder
