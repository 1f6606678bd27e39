"""What every odometry offers, and the base class of adapters."""

import functools
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict

from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, invert
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet, ParameterSpace, nearest


class OdometryError(AdaptuneError):
    """An odometry that cannot do what is asked of it."""


class BaseSettings(BaseModel):
    """What a study sets once and does not tune."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class WarmUp(NamedTuple):
    """Which of the last scans a new instance sees before it takes over.

    Attributes
    ----------
    seconds : float
        How far back they go.
    full_rate : float
        Of the most recent scans, those of so many seconds are all seen.
    stride : int
        Of the scans before, every so many is seen.
    """

    seconds: float = 12.0
    full_rate: float = 4.0
    stride: int = 1


class Registration(NamedTuple):
    """Where an odometry believes the sensor was.

    Attributes
    ----------
    T_odom_sensor : ndarray of shape (4, 4)
        Pose at the scan's stamp.
    registered : bool
        False if the scan was too poor to register: the last motion then goes on.
    """

    T_odom_sensor: Poses
    registered: bool = True


class Usage(NamedTuple):
    """What an odometry has used so far.

    Attributes
    ----------
    cpu : float
        Seconds of CPU time.
    memory : float or None
        Peak megabytes of the odometry's own processes; None if it shares this process.
    """

    cpu: float
    memory: float | None


class Motions(NamedTuple):
    """How the sensor moved over the last scan, before any health check.

    Attributes
    ----------
    T_previous_current : ndarray of shape (4, 4)
        Motion of the odometry or of the whole bank. NaN if there was no pose. After a start it is
        the motion that `start` received, or the identity.
    members : dict of ndarray
        The same for each member of a bank, by trial number; empty for single odometries.
    """

    T_previous_current: Poses
    members: Mapping[int, Poses]


class Description(NamedTuple):
    """What a study must know of an odometry before it runs it.

    Attributes
    ----------
    space : ParameterSpace or None
        The parameters that can be tuned; None if the study defines them.
    live : bool
        See `Odometry`.
    needs_imu : bool
        See `Odometry`.
    warm_up : WarmUp
        See `Odometry`.
    whole : bool
        Whether it runs whole recordings only, with one parameter set from end to end.
    """

    space: ParameterSpace | None
    live: bool
    needs_imu: bool = False
    warm_up: WarmUp = WarmUp()
    whole: bool = False


class OdometryInstance(Protocol):
    """An odometry that runs along a sequence: in this process, in another one, or a bank of them.

    `submit` and `collect` let several instances in other processes work at the same time. After
    `close`, `prepare` still works and `start` begins again.
    """

    @property
    def faults(self) -> Sequence[str]:
        """What went wrong so far. The poses of scans with a fault are NaN."""

    @property
    def usage(self) -> Usage:
        """CPU time and memory so far."""

    @property
    def motions(self) -> Motions:
        """Motions over the last scan."""

    def prepare(self, scan: Scan) -> Any:
        """See `Odometry.prepare`."""

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`."""

    def submit(self, prepared: Any) -> None:
        """Begin to register the next scan."""

    def collect(self) -> Registration:
        """Wait for the pose of the submitted scan."""

    def register(self, prepared: Any) -> Registration:
        """Find the pose of the next scan: submit it, then collect."""

    def apply(self, selection: Selection) -> None:
        """Change to what was selected, before the next scan.

        A single odometry takes the parameters. A bank takes the weights; if there are none, the
        member with the selected trial gets all the weight.

        Raises
        ------
        OdometryError
            If the odometry cannot change its parameters, or a bank does not hold the set.
        """

    def close(self) -> None:
        """End all processes of this odometry."""


class _Record:
    """The last two poses of an instance, and the CPU time of its registrations."""

    def __init__(self) -> None:
        self.active = False
        self.cpu = 0.0
        self._started_with: Poses | None = np.eye(4)
        self._T_before = self._T_now = np.eye(4)

    def call(self, method: Callable[..., Any], *arguments: Any) -> tuple[Any, bool]:
        """Call a method. False if it is part of another call, which is recorded instead."""
        if self.active:
            return method(*arguments), False
        self.active = True
        try:
            return method(*arguments), True
        finally:
            self.active = False

    def start(self, T_odom_sensor: Poses, T_previous_current: Poses | None) -> None:
        self._started_with = np.eye(4) if T_previous_current is None else T_previous_current
        self._T_now = np.array(T_odom_sensor)

    def register(self, T_odom_sensor: Poses) -> None:
        # A copy, in case the odometry changes its pose in place.
        self._T_before, self._T_now = self._T_now, np.array(T_odom_sensor)
        self._started_with = None

    @property
    def motion(self) -> Poses:
        if self._started_with is not None:
            return self._started_with
        return invert(self._T_before) @ self._T_now


def _recorded_start(start: Callable[..., None]) -> Callable[..., None]:
    @functools.wraps(start)
    def recorded(
        self: "Recorded",
        prepared: Any,
        T_odom_sensor: Poses,
        T_previous_current: Poses | None = None,
    ) -> None:
        record = self._odometry_record
        if record.call(start, self, prepared, T_odom_sensor, T_previous_current)[1]:
            record.start(T_odom_sensor, T_previous_current)

    return recorded


def _recorded_registration(register: Callable[..., Registration]) -> Callable[..., Registration]:
    @functools.wraps(register)
    def recorded(self: "Recorded", *prepared: Any) -> Registration:
        record, begin = self._odometry_record, time.process_time()
        registration: Registration
        registration, outermost = record.call(register, self, *prepared)
        if outermost:
            record.cpu += time.process_time() - begin
            record.register(registration.T_odom_sensor)
        return registration

    return recorded


class Recorded(ABC):
    """Records motion and CPU time, whatever a subclass does to find poses.

    For that it wraps `start`, `register` and `collect` of each subclass.
    """

    def __init_subclass__(cls, **keywords: Any):
        super().__init_subclass__(**keywords)
        for name in ("start", "register", "collect"):
            if method := vars(cls).get(name):
                wrap: Any = _recorded_start if name == "start" else _recorded_registration
                setattr(cls, name, wrap(method))

    @functools.cached_property
    def _odometry_record(self) -> _Record:
        return _Record()

    @property
    def usage(self) -> Usage:
        """CPU time of the registrations; the memory is that of this process."""
        return Usage(self._odometry_record.cpu, None)

    @property
    def motions(self) -> Motions:
        """See `OdometryInstance.motions`."""
        return Motions(self._odometry_record.motion, {})

    @abstractmethod
    def submit(self, prepared: Any) -> None:
        """See `OdometryInstance.submit`."""

    @abstractmethod
    def collect(self) -> Registration:
        """See `OdometryInstance.collect`."""

    def register(self, prepared: Any) -> Registration:
        """See `OdometryInstance.register`."""
        self.submit(prepared)
        return self.collect()

    def close(self) -> None:  # noqa: B027 - most have nothing to close
        """See `OdometryInstance.close`."""


class Odometry(Recorded):
    """A LiDAR odometry in this process; base class of adapters.

    A new instance knows nothing; `start` places it, `register` moves it on scan by scan. All of
    it runs on one thread, so that the same scans give the same poses. An adapter implements
    `prepare`, `start` and `register`, and `configure` if it is `live`.

    Attributes
    ----------
    space : ParameterSpace
        The parameters that can be tuned, with sensible ranges; class attribute.
    settings_type : type
        Pydantic model of what is set once; class attribute.
    live : bool
        Whether `configure` may be called between scans; class attribute.
    clean : bool
        Whether a second instance in the same process knows nothing of the first, and no scan ends
        the process; class attribute. Others run in a process of their own.
    needs_imu : bool
        Whether scans must bring along what an IMU measured; class attribute.
    warm_up : WarmUp
        The warm-up of a new instance that takes over, unless a study sets another; class attribute.
    parameters : dict
        The present value of every parameter in `space`.

    Parameters
    ----------
    parameters
        Values of any of the parameters in `space`; the others keep their baseline. The caller
        checks ranges.
    settings
        An instance of `settings_type`.

    Raises
    ------
    OdometryError
        If there is no such parameter.
    """

    space: ClassVar[ParameterSpace]
    settings_type: ClassVar[type[BaseSettings]] = BaseSettings
    live: ClassVar[bool]
    clean: ClassVar[bool] = False
    needs_imu: ClassVar[bool] = False
    warm_up: ClassVar[WarmUp] = WarmUp()
    faults: Sequence[str] = ()

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        self.settings: Any = self.settings_type() if settings is None else settings
        self.parameters = self.space.baseline | self._known(parameters or {})

    @classmethod
    def describe(cls, settings: Any) -> Description:  # noqa: ARG003
        """What a study must know of the odometry with these settings."""
        return Description(cls.space, cls.live, cls.needs_imu, cls.warm_up)

    @abstractmethod
    def prepare(self, scan: Scan) -> Any:
        """Do to a scan all that does not depend on parameters, pose or earlier scans.

        All instances with the same settings share the result, and none may change it.
        """

    @abstractmethod
    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """Forget all scans and begin with this one.

        Parameters
        ----------
        prepared
            A prepared scan.
        T_odom_sensor
            Pose of the sensor, of shape (4, 4).
        T_previous_current
            The last motion, of shape (4, 4), for odometries that predict by it; None if the sensor
            stood still.
        """

    @abstractmethod
    def register(self, prepared: Any) -> Registration:
        """Find the pose of the next scan."""

    def submit(self, prepared: Any) -> None:
        """See `OdometryInstance.submit`; `collect` does the work."""
        self.__submitted = prepared

    def collect(self) -> Registration:
        """See `OdometryInstance.collect`."""
        return self.register(self.__submitted)

    def apply(self, selection: Selection) -> None:
        """See `OdometryInstance.apply`."""
        self.configure(selection.parameters)

    def configure(self, parameters: ParameterSet) -> None:
        """Change parameters between scans; the others stay.

        Raises
        ------
        OdometryError
            If the odometry is not `live`, or has no such parameter.
        """
        if not self.live:
            raise OdometryError(f"{type(self).__name__} cannot change its parameters between scans")
        self.parameters |= self._known(parameters)

    def _known(self, parameters: ParameterSet) -> ParameterSet:
        for name in parameters:
            if name not in self.space.names:
                raise OdometryError(
                    f"{type(self).__name__} has no parameter {name!r}: "
                    f"{nearest(name, self.space.names)}"
                )
        return parameters


def prepared_bytes(prepared: Any) -> int:
    """Memory that a prepared scan takes, roughly, in bytes."""
    if isinstance(prepared, Scan):
        columns = (prepared.times, prepared.rings, prepared.intensities)
        prepared = (prepared.points, *columns, prepared.imu)
    if isinstance(prepared, tuple):
        return sum(map(prepared_bytes, prepared))
    if prepared is None:
        return 0
    size = getattr(prepared, "nbytes", None)
    return int(size) if size is not None else 1_000_000
