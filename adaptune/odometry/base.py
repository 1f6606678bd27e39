"""What every odometry offers, and the base class of adapters."""

import time
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import AfterValidator, Field, model_serializer, model_validator

from adaptune._system.strict import StrictModel
from adaptune.errors import OdometryError, nearest
from adaptune.geometry import Poses, invert
from adaptune.odometry.template import Template
from adaptune.recording.config import resolve
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet, ParameterSpace, Selection

MIN_POINTS = 20  # an adapter does not register scans with fewer points in range
WARM_UP = 12.0
"""Seconds of scans on which an odometry with a map has to begin within a drive."""


class BaseSettings(StrictModel):
    """What a study sets once and does not tune."""


class RangeSettings(BaseSettings):
    """Settings of odometries that crop scans, in metres, and deskew those with points' times."""

    min_range: float = Field(1.0, ge=0, le=1e6)
    max_range: float = Field(100.0, gt=0, le=1e6)
    deskew: bool = True


class ToolSettings(RangeSettings):
    """Settings of odometries with a tool of their own.

    `config` is the user's parameter file for that tool. It gives the baseline, and every value that
    is not tuned; parameters that it does not hold are not tuned.
    """

    in_file: ClassVar[tuple[str, ...]] = ("min_range", "max_range", "deskew")
    """Settings that the file gives."""
    config: Annotated[str, AfterValidator(resolve)] | None = None

    @model_serializer(mode="wrap")
    def _dump(self, dump: Any) -> Any:
        given = () if self.config is None else self.in_file
        return {key: value for key, value in dump(self).items() if key not in given}

    @model_validator(mode="after")
    def _check(self) -> Self:
        # Studies of earlier versions name the defaults, too.
        plain = type(self).model_construct(config=self.config)
        twice = [key for key in self.in_file if getattr(self, key) != getattr(plain, key)]
        if self.config is not None and twice:
            raise ValueError(f"{twice[0]} is taken from {self.config}; change it there")
        return self

    @property
    def template(self) -> Template | None:
        """The user's file, if there is one."""
        return None if self.config is None else Template(Path(self.config))


class Registration(NamedTuple):
    """Where an odometry believes the sensor was at the scan's stamp."""

    T_odom_sensor: Poses  # of shape (4, 4)
    registered: bool = True  # False if the scan was too poor: the last motion then goes on


WITHOUT_POSE = Registration(np.full((4, 4), np.nan), registered=False)
"""What an odometry gives where there is no pose."""
WITHOUT_POSE.T_odom_sensor.setflags(write=False)


class Usage(NamedTuple):
    """What an odometry has used so far."""

    cpu: float  # seconds of CPU time
    memory: float | None  # peak megabytes of its own processes; None if it shares this process
    seconds: float | None = None  # a scan, if it runs apart from its calls; None if within them
    other_cpu: float = 0.0  # of `cpu`, seconds in other processes
    lacking: int = 0  # scans at which a program wrote no pose; those beside them may tell it

    @classmethod
    def total(cls, usages: Iterable["Usage"]) -> "Usage":
        """What all together have used."""
        every = list(usages)
        known = [usage.memory for usage in every if usage.memory is not None]
        cpu, other = sum(u.cpu for u in every), sum(u.other_cpu for u in every)
        return cls(cpu, sum(known) if known else None, other_cpu=other)


MemberState = Literal["works", "lost", "late", "rests"]
"""Of a member of a bank over a scan: its motion counts, it is left out or restarts, it is late or
was removed, or it rests."""


class Motions(NamedTuple):
    """How the sensor moved over the last scan, before any health check."""

    # (4, 4); NaN if there was no pose. After a start, what `start` received, or the identity.
    T_previous_current: Poses
    # the same for each member of a bank, by trial number; empty for single odometries
    members: Mapping[int, Poses]
    # how often it has begun anew so far: one more than before means that it failed
    starts: int = 0
    # what each member of a bank did, by trial number
    states: Mapping[int, MemberState] = {}


class Description(NamedTuple):
    """What a study must know of an odometry before it runs it; see also `Odometry`."""

    # the parameters that can be tuned; None if the study defines them
    space: ParameterSpace | None
    live: bool
    needs_imu: bool = False
    # whether it runs whole recordings only, with one parameter set from end to end
    whole: bool = False
    clean: bool = False  # whether instances in one process know nothing of each other
    module: str = ""  # in which a class is written
    warm_up: float = WARM_UP  # see `Odometry`


class OwnFile(NamedTuple):
    """A parameter set as the odometry's own tool reads it."""

    suffix: str  # of the file's name
    text: str
    use: str  # what to do with it: a command, where FILE stands for its path, or words
    name: str = ""  # whose it is, where that is not the odometry


class LastMotion:
    """The motion over the last scan, from one pose to the next."""

    def __init__(self) -> None:
        self._starts = -1
        self.start(np.eye(4))

    def start(self, T_odom_sensor: Poses, T_previous_current: Poses | None = None) -> None:
        """Begin at a pose, with the motion that led there; None if the sensor stood still."""
        self._starts += 1
        self._started_with = np.eye(4) if T_previous_current is None else T_previous_current
        self._T_before: Poses | None = None
        self._T_now = np.array(T_odom_sensor, order="C")

    def move(self, T_odom_sensor: Poses) -> None:
        """Move to the pose of the next scan."""
        # A copy, in case the odometry changes its pose in place. Products of matrices round by
        # their layout in memory, which must not depend on where the odometry runs.
        self._T_before, self._T_now = self._T_now, np.array(T_odom_sensor, order="C")

    @property
    def motions(self) -> Motions:
        """The motion, without members."""
        if self._T_before is None:
            return Motions(self._started_with, {}, self._starts)
        return Motions(invert(self._T_before) @ self._T_now, {}, self._starts)


class OdometryInstance(ABC):
    """An odometry that runs along a sequence: in this process, in another one, or a bank of them.

    `submit` and `collect` let several instances in other processes work at the same time. After
    `close`, `prepare` still works and `start` begins again.
    """

    # Whether it works in another process, from `submit` on.
    isolated: ClassVar[bool] = False
    # Whether it can be shown scans of the past again.
    rewinds: bool = True
    warm_up: float = WARM_UP  # see `Odometry`

    @property
    def faults(self) -> Sequence[str]:
        """What went wrong so far. The poses of scans with a fault are NaN."""
        return ()

    @property
    def usage(self) -> Usage:
        """CPU time and memory so far."""
        return Usage(0.0, None)

    @cached_property
    def _last_motion(self) -> LastMotion:
        return LastMotion()

    @property
    def motions(self) -> Motions:
        """Motions over the last scan."""
        return self._last_motion.motions

    @property
    def preparation(self) -> Hashable:
        """What `prepare` depends on besides the scan; where it is equal, instances share scans."""
        return type(self).prepare

    @property
    def ended(self) -> bool:
        """Whether a fault has ended it: it gives no pose until the next start."""
        return False

    @property
    def begun(self) -> bool:
        """Whether it has given a pose; the poses of scans before its first one are unknown."""
        return True

    @property
    def given_up(self) -> bool:
        """Whether it had so many faults that it does not start again."""
        return False

    @property
    def busy(self) -> bool:
        """Whether what runs it works on a scan that was not collected, and takes no other."""
        return False

    def ready(self, seconds: float) -> bool:  # noqa: ARG002
        """Whether `collect` has something to give in so many seconds."""
        return True

    def prepare(self, scan: Scan) -> Any:
        """Do to a scan all that does not depend on the pose or on earlier scans.

        All instances with the same `preparation` share the result, and none may change it. By
        default that is the scan itself, where another process prepares.
        """
        return scan

    @abstractmethod
    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """Forget all scans and begin with this one, at a pose of shape (4, 4).

        Odometries predict by the last motion, of shape (4, 4); None if the sensor stood still.
        """

    def submit(self, prepared: Any) -> None:
        """Begin to register the next scan."""
        self._submitted = prepared

    def collect(self) -> Registration:
        """Wait for the pose of the submitted scan."""
        registration = self._collect()
        self._last_motion.move(registration.T_odom_sensor)
        return registration

    def _collect(self) -> Registration:
        raise NotImplementedError

    def register(self, prepared: Any) -> Registration:
        """Find the pose of the next scan: submit it, then collect."""
        self.submit(prepared)
        return self.collect()

    def apply(self, selection: Selection) -> None:
        """Change to what was selected, before the next scan.

        A single odometry takes the parameters. A bank takes the weights; if there are none, the
        member with the selected trial gets all the weight. There is an `OdometryError` if the
        odometry cannot change its parameters, or a bank does not hold the set.
        """
        raise NotImplementedError

    def confirmed(self, seconds: float = 0.0) -> bool:  # noqa: ARG002
        """Whether it is known to hold what was applied last; an error, as of `apply`, if not."""
        return True

    def close(self) -> None:  # noqa: B027 - most have none
        """End all processes of this odometry."""


class Odometry(ABC):
    """A LiDAR odometry; base class of adapters. `InProcess` runs one as an instance.

    A new instance knows nothing; `start` places it, `register` moves it on scan by scan. All of
    it runs on one thread, so that the same scans give the same poses. An adapter implements
    `prepare`, `start` and `register`, and `configure` if it is `live`. All attributes but the last
    are of the class.

    Attributes
    ----------
    space : ParameterSpace
        The parameters that can be tuned, with sensible ranges.
    settings_type : type
        Pydantic model of what is set once.
    live : bool
        Whether `configure` may be called between scans.
    clean : bool
        Whether a second instance in the same process knows nothing of the first, and no scan ends
        the process. Others run in a process of their own.
    needs_imu : bool
        Whether scans must bring along what an IMU measured.
    warm_up : float
        Seconds of past scans that one that begins within a drive has to see.
    parameters : dict
        The present value of every parameter in `space`.

    Parameters
    ----------
    parameters
        Values of any of the parameters in `space`; the others keep their baseline. The caller
        checks ranges. There is an `OdometryError` if there is no such parameter.
    settings
        An instance of `settings_type`.
    values
        Parameters by their names, as in ``MyIcp(voxel=0.5)``.
    """

    space: ClassVar[ParameterSpace]
    settings_type: ClassVar[type[BaseSettings]] = BaseSettings
    live: ClassVar[bool] = False
    clean: ClassVar[bool] = False
    needs_imu: ClassVar[bool] = False
    warm_up: ClassVar[float] = WARM_UP

    def __init__(
        self,
        parameters: ParameterSet | None = None,
        settings: BaseSettings | None = None,
        **values: Any,
    ):
        self.settings: Any = self.settings_type() if settings is None else settings
        given = (parameters or {}) | values
        self.parameters = self.tuned(settings).baseline | self._known(given)

    @classmethod
    def tuned(cls, settings: Any) -> ParameterSpace:
        """The parameters that can be tuned, with baselines from the user's file if there is one."""
        template = settings.template if isinstance(settings, ToolSettings) else None
        return cls.space if template is None else template.based(cls.space, cls._under(template))

    @classmethod
    def _under(cls, template: Template) -> str:  # noqa: ARG003
        """The path in the user's file under which its values stand."""
        return ""

    @classmethod
    def describe(cls, settings: Any) -> Description:
        """What a study must know of the odometry with these settings."""
        if isinstance(settings, ToolSettings):
            cls(settings=settings)  # raises where a value does not fit
        known = cls.tuned(settings), cls.live, cls.needs_imu
        if not 0.0 <= cls.warm_up < np.inf:
            raise OdometryError(
                f"{cls.__name__}: warm_up is {cls.warm_up}; give seconds, 0 or more"
            )
        described = Description(*known, clean=cls.clean, module=cls.__module__)
        return described._replace(warm_up=cls.warm_up)

    @classmethod
    def own_file(cls, parameters: ParameterSet, settings: Any) -> OwnFile | None:
        """A set in the user's file, or as the odometry's own tool reads it; None if it has none."""
        template = settings.template if isinstance(settings, ToolSettings) else None
        if template is None:
            return None
        under, path = cls._under(template), template.path
        text = template.fill({under + name: value for name, value in parameters.items()})
        return OwnFile(path.suffix, text, f"in the place of {path.name}")

    @property
    def preparation(self) -> Hashable:
        """What `prepare` depends on besides the scan, which may be parameters, too; see there."""
        # Classes that share `prepare` may differ in what that calls.
        return type(self), self.settings.model_dump_json()

    @abstractmethod
    def prepare(self, scan: Scan) -> Any:
        """Prepare a scan for all with the same `preparation`; see `OdometryInstance`."""

    @abstractmethod
    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """Forget all scans and begin with this one; see `OdometryInstance`."""

    @abstractmethod
    def register(self, prepared: Any) -> Registration:
        """Find the pose of the next scan."""

    def configure(self, parameters: ParameterSet) -> None:
        """Change parameters between scans; the others stay.

        There is an `OdometryError` if the odometry is not `live`, or has no such parameter.
        """
        if not self.live:
            raise OdometryError(
                f"{type(self).__name__} cannot change its parameters between scans: "
                f"set online.switching.mechanism to bank"
            )
        self.parameters |= self._known(parameters)

    def _known(self, parameters: ParameterSet) -> ParameterSet:
        if unknown := [name for name in parameters if name not in self.space.names]:
            help_ = nearest(unknown[0], self.space.names)
            raise OdometryError(f"{type(self).__name__} has no parameter {unknown[0]!r}: {help_}")
        return parameters


class InProcess(OdometryInstance):
    """Runs an adapter, which nothing else may use, in this process, and notes what it takes."""

    faults: Sequence[str] = ()

    def __init__(self, odometry: Odometry):
        self.odometry, self.warm_up = odometry, odometry.warm_up
        self._cpu = 0.0

    @property
    def usage(self) -> Usage:
        """CPU time of the registrations; the memory is that of this process."""
        return Usage(self._cpu, None)

    @property
    def preparation(self) -> Hashable:
        return self.odometry.preparation

    def prepare(self, scan: Scan) -> Any:
        return self.odometry.prepare(scan)

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self.odometry.start(prepared, T_odom_sensor, T_previous_current)
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def _collect(self) -> Registration:
        begin = time.process_time()
        registration = Registration(*self.odometry.register(self._submitted))
        self._cpu += time.process_time() - begin
        return registration

    def apply(self, selection: Selection) -> None:
        self.odometry.configure(selection.parameters)
