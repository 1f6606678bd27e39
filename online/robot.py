"""Drive on a robot: scans from a topic, poses and selections on others."""

import itertools
import logging
from collections import deque
from contextlib import ExitStack, closing
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from adaptune.errors import AdaptuneError, nearest
from adaptune.geometry import invert
from adaptune.model.registry import ADAPTIVE, STANDBY
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.tracker import RegisteredScan
from adaptune.recording.config import ImuConfig, SequenceConfig
from adaptune.recording.timing import Timing
from adaptune.ros.link import RosLink
from adaptune.runs.files import DriveLog
from adaptune.runs.loop import AfterScan
from adaptune.runs.record import Choice, Run
from adaptune.selector import Selector
from adaptune.study.config import RealTimeConfig, RosConfig, StudyConfig
from adaptune.study.driven import ModeError
from adaptune.study.sequences import StudySequences
from adaptune.study.study import Study
from online.modes import UNTRAINED, WITHOUT_MODEL, Mode, ReplaySetup, needed
from online.real_time import RealTimeDrive
from online.selector_process import SelectorProcess
from online.steered import SteeredNode
from online.topics import MAX_KEPT, ODOMETRY_TYPE, RosMessages, TopicScans, Uncertainty, placed

SELECTION_TOPIC = "adaptune/selection"
_BEGIN = 6.0  # seconds in which a node that is not there is known to be missing

_log = logging.getLogger(__name__)


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

    folder: Path  # of its trajectory, selections and scans; of the last part

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
        self.done = 0  # scans of all parts before
        self._scans: TopicScans | None = None
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

    def run(self, link: RosLink, watch: AfterScan = lambda _: None) -> Run:
        """Drive until Ctrl-C or `stop`; where the clock goes back, all begins anew."""
        with ExitStack() as stack:
            steer, make = self._ros.steer, self._mode.selector
            steered = None if steer is None else SteeredNode(link, steer, self._points)
            selector = make and SelectorProcess(make, self._study.config.online.period)
            if selector is not None:
                stack.enter_context(closing(selector))
            self._scans = scans = self._topics(link)
            publisher = _Publisher(link, self._ros, self._study.config.sub_trajectory, scans)
            run = None
            while run is None or not (scans.stopped or self._stopped):
                odometry = steered or self._setup.instance(self._mode)
                with closing(odometry):
                    run = self._part(odometry, selector, publisher, watch)
                self.done += run.done
        return run

    def stop(self) -> None:
        """End the drive; any thread may call it."""
        self._stopped = True
        if self._scans is not None:
            self._scans.stop()

    def _topics(self, link: RosLink) -> TopicScans:
        """Subscribe to scans, and to an IMU if the odometry needs one."""
        like, imu = self._like, None
        timing = Timing(like.stamp, like.time_unit, like.period)
        if self._study.odometry.description.needs_imu and self._ros.steer is None:
            imu = like.imu or ImuConfig()
            imu = imu.model_copy(update={"topic": _named(imu.topic, "imu.topic")})
        return TopicScans(link, self._points, timing, self._settings.queue, imu)

    def _part(
        self,
        odometry: OdometryInstance,
        selector: SelectorProcess | None,
        publisher: "_Publisher",
        watch: AfterScan,
    ) -> Run:
        """Drive until the clock goes back."""
        assert self._scans is not None
        names, goes_on = list(self._study.odometry.space.names), self.done > 0
        self.folder = _new_folder(self._study.folder / "drives")
        # A robot that drives goes on, whatever happens to its disk.
        with closing(DriveLog(self.folder, names, goes_on=goes_on)) as log:
            publisher.begin(log)
            try:
                if selector is not None:
                    odometry.apply(selector.fallback)
                    # One that is there, but busy, takes it when it can.
                    odometry.confirmed(0.0 if goes_on else _BEGIN)
            except AdaptuneError as error:
                if not goes_on:
                    raise
                _log.warning("the fixed set cannot be applied: %s", error)
            run = Run(1.0, publisher.choice)
            for name in ("steps", "choices", "rejected", "late", "waited"):
                setattr(run, name, deque(maxlen=MAX_KEPT))
            health = self._study.config.health
            drive = RealTimeDrive(odometry, health, self._settings, selector, run, "drive")
            if self._stopped:
                self._scans.stop()
            try:
                for arrival in self._scans.arrivals():
                    publisher.step(drive.step(arrival), run.late[-1])
                    watch(run)
            except KeyboardInterrupt:
                self._scans.stop()
            drive.finish()
            return run


class _Publisher:
    """Publishes and records what a drive finds."""

    def __init__(self, link: RosLink, ros: RosConfig, length: float, scans: TopicScans):
        self._scans = scans
        self._messages = RosMessages(link.store, ros.frame)
        self._length = length
        self._selection = link.advertise(SELECTION_TOPIC, "std_msgs/msg/String")
        # A node that is steered publishes its own poses.
        own = ros.steer is None
        self._odometry = link.advertise(ros.odometry, ODOMETRY_TYPE) if own else None
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
