"""Drive on a robot: scans from a topic, poses and selections on others."""

import itertools
import logging
from collections import deque
from contextlib import ExitStack, closing
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

from adaptune.errors import AdaptuneError, nearest
from adaptune.geometry import invert
from adaptune.model.registry import ADAPTIVE, STANDBY
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.tracker import RegisteredScan
from adaptune.recording.config import ImuConfig, SequenceConfig
from adaptune.recording.timing import Timing
from adaptune.ros.link import RosLink
from adaptune.selector import Selector
from adaptune.study.config import RealTimeConfig, RosConfig, StudyConfig
from adaptune.study.driven import ModeError
from adaptune.study.sequences import StudySequences
from adaptune.study.study import Study
from online.live import KEPT, ODOMETRY, LiveScans, RosMessages, Uncertainty, placed
from online.modes import UNTRAINED, WITHOUT_MODEL, Mode, ReplaySetup, needed
from online.real_time import RealTimeDrive
from online.record import DriveLog
from online.replay import Choice, ReplayRecord, Watch
from online.selector_process import SelectorProcess
from online.steered import SteeredNode

SELECTION_TOPIC = "adaptune/selection"
_BEGIN = 6.0  # seconds in which a node that is not there is known to be missing

_log = logging.getLogger(__name__)


class DriveRecord(NamedTuple):
    """What became of a drive."""

    folder: Path  # of its trajectory, selections and scans
    scans: int
    record: ReplayRecord  # of its last part, where the clock went back


class RobotDrive:
    """A study's odometry, or somebody else's node, on a robot.

    ``drives/<time>`` in the study's folder receives each drive. The `mode` is one of
    `ReplaySetup.modes`, or `untrained`; this one and `baseline` need no model. By default it is
    what is recommended; of a single set, `standby` where that is possible.

    Raises
    ------
    AdaptuneError
        If the mode, the model and the study do not go together.
    """

    def __init__(self, study: Study, mode: str | None, model_path: Path | None):
        config = study.config
        real_time = (config.online.real_time or RealTimeConfig()).model_copy(update={"rate": 1.0})
        online = config.online.model_copy(update={"real_time": real_time})
        config = config.model_copy(update={"online": online})
        # What is only compared with is for replays.
        model, modes = None if model_path is None else study.model(model_path), WITHOUT_MODEL
        setup = replace(ReplaySetup.of(study, model), config=config, also=())
        self._study, self._setup, self._settings = study, setup, real_time
        self._ros = config.online.ros
        self._like = _like(config, study.sequences)
        self._points = _named(self._ros.points or self._like.points, "online.ros.points")
        self._scans: LiveScans | None = None
        self._stopped = False
        if model_path is not None:
            setup.check(model_path)
            mode = mode or setup.default(steered=self._ros.steer is not None)
            modes = (*dict.fromkeys((*setup.modes, ADAPTIVE, STANDBY)), UNTRAINED)
        if mode is None or mode not in modes:
            raise ModeError(f"--mode: there is no mode {mode!r}; {nearest(str(mode), modes)}")
        if self._ros.steer is not None:
            if mode == ADAPTIVE:
                raise ModeError(
                    "online.ros.steer: a node drives one set at a time, and `adaptive` is a bank; "
                    "leave out --mode, or give --mode standby"
                )
            if mode not in (STANDBY, *config.online.rules):
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
            self._mode = setup.mode(mode)

    @property
    def mode(self) -> str:
        """What it drives."""
        return self._mode.name

    def run(self, link: RosLink, watch: Watch = lambda _: None) -> DriveRecord:
        """Drive until Ctrl-C or `stop`; where the clock goes back, all begins anew."""
        done = 0
        with ExitStack() as stack:
            steer, make = self._ros.steer, self._mode.selector
            steered = None if steer is None else SteeredNode(link, steer, self._points)
            selector = make and SelectorProcess(make, self._study.config.online.period)
            if selector is not None:
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
                    # One that is there, but busy, takes it when it can.
                    odometry.confirmed(0.0 if done else _BEGIN)
            except AdaptuneError as error:
                if not done:
                    raise
                _log.warning("the fixed set cannot be applied: %s", error)
            record = ReplayRecord(1.0, publisher.choice)
            for name in ("steps", "choices", "rejected", "late", "waited"):
                setattr(record, name, deque(maxlen=KEPT))
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
    name = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S")
    numbers = itertools.count(2)
    folder = parent / name
    while folder.exists():
        folder = parent / f"{name}_{next(numbers)}"
    return folder
