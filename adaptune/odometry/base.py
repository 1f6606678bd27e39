"""What every odometry must do to be tuned."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict

from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, invert, rectify
from adaptune.sequence import Scan
from adaptune.space import ParameterSet, ParameterSpace, nearest


class OdometryError(AdaptuneError):
    """An odometry that cannot do what is asked of it."""


class BaseSettings(BaseModel):
    """What is set once for a study and not tuned."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class WarmUp(NamedTuple):
    """Which of the last scans a new instance sees before it takes over.

    Attributes
    ----------
    seconds : float
        How far back they go.
    full_rate : float
        Seconds of the most recent ones, of which it sees all.
    stride : int
        Every how many of those before it sees.
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
        False if the scan was too poor to register: the pose then goes on with the last motion.
    """

    T_odom_sensor: Poses
    registered: bool = True


class Description(NamedTuple):
    """What a study must know of an odometry before it runs it.

    Attributes
    ----------
    space : ParameterSpace or None
        What can be tuned; None where that is the study's to define.
    live : bool
        See `Odometry`.
    needs_imu : bool
        See `Odometry`.
    warm_up : WarmUp
        See `Odometry`.
    whole : bool
        Whether it runs whole recordings only, and so with one parameter set from end to end.
    """

    space: ParameterSpace | None
    live: bool
    needs_imu: bool = False
    warm_up: WarmUp = WarmUp()
    whole: bool = False


class Box(Protocol):
    """What can be driven through a recording, see `Odometry` for what each method does."""

    def prepare(self, scan: Scan) -> Any:
        """See `Odometry.prepare`."""

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`."""

    def register(self, prepared: Any) -> Registration:
        """See `Odometry.register`."""

    def configure(self, parameters: ParameterSet) -> None:
        """See `Odometry.configure`."""


class Odometry(ABC):
    """A LiDAR odometry, seen from outside.

    A new instance knows nothing; `start` places it, `register` moves it on scan by scan. All of
    it runs on one thread, so that the same scans give the same poses.

    Attributes
    ----------
    space : ParameterSpace
        What can be tuned, with sensible ranges; class attribute.
    settings_type : type
        What is set once, as a pydantic model; class attribute.
    live : bool
        Whether `configure` may be called between scans; class attribute.
    clean : bool
        Whether a second instance in the same process knows nothing of the first, and no scan ends
        the process; class attribute. One that is not known to be clean runs in a process of its
        own.
    needs_imu : bool
        Whether scans must bring along what an IMU measured; class attribute.
    warm_up : WarmUp
        What serves where a new instance takes over, unless a study says otherwise; class attribute.
    parameters : dict
        The present value of every parameter in `space`.

    Parameters
    ----------
    parameters
        Values of any of the parameters in `space`; the others keep their baseline. Values
        outside the range in `space` are the caller's to judge.
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

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        self.settings: Any = self.settings_type() if settings is None else settings
        self.parameters = self.space.baseline | self._known(parameters or {})

    @classmethod
    def describe(cls, settings: Any) -> Description:  # noqa: ARG003
        """What a study must know of it, with these settings."""
        return Description(cls.space, cls.live, cls.needs_imu, cls.warm_up)

    @abstractmethod
    def prepare(self, scan: Scan) -> Any:
        """Do to a scan all that does not depend on parameters, pose or earlier scans.

        What it returns serves every instance with the same settings, and must not be changed by
        any.
        """

    @abstractmethod
    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """Forget all scans and begin with this one.

        Parameters
        ----------
        prepared
            A scan, prepared.
        T_odom_sensor
            Where the sensor is, of shape (4, 4).
        T_previous_current
            The last motion, of shape (4, 4), for odometries that predict by it; none means that
            the sensor stood still.
        """

    @abstractmethod
    def register(self, prepared: Any) -> Registration:
        """Find the pose of the next scan."""

    def configure(self, parameters: ParameterSet) -> None:
        """Change parameters between scans; those not named stay.

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


class Anchored(Odometry):
    """An odometry that can only begin at rest, in a frame of its own, and with a usable scan.

    Its own frame is placed by the first pose that comes back. Where none comes back, the last
    motion goes on.
    """

    @abstractmethod
    def _usable(self, prepared: Any) -> bool:
        """Whether it can begin with a scan."""

    @abstractmethod
    def _begin(self, prepared: Any) -> None:
        """Make a new one for a usable scan, which it is handed next."""

    @abstractmethod
    def _hand_over(self, prepared: Any) -> Poses | None:
        """Hand a scan over, usable or not, and return ``T_own_sensor`` if a pose comes back."""

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`."""
        self._T_odom_sensor = T_odom_sensor
        self._T_previous_current = np.eye(4) if T_previous_current is None else T_previous_current
        self._T_odom_own: Poses | None = None
        self._begun = False
        self._go_on(prepared)

    def register(self, prepared: Any) -> Registration:
        """See `Odometry.register`."""
        T_odom_previous = self._T_odom_sensor
        self._T_odom_sensor = T_odom_previous @ self._T_previous_current
        registered = self._go_on(prepared)
        if registered:
            self._T_previous_current = rectify(invert(T_odom_previous) @ self._T_odom_sensor)
        return Registration(self._T_odom_sensor, registered)

    def _go_on(self, prepared: Any) -> bool:
        """Correct the predicted pose, and tell whether there was something to correct it by."""
        if not self._begun:
            if not self._usable(prepared):
                return False
            self._begin(prepared)
            self._begun = True
        T_own_sensor = self._hand_over(prepared)
        if T_own_sensor is None:
            return False
        if self._T_odom_own is None:
            self._T_odom_own = self._T_odom_sensor @ invert(T_own_sensor)
        self._T_odom_sensor = self._T_odom_own @ T_own_sensor
        return True


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
