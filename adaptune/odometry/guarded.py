"""A class of the user in this process: where it goes wrong, this is a fault and nothing else."""

import signal
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel

from adaptune.errors import AdaptuneError, in_a_line
from adaptune.geometry import Poses
from adaptune.odometry.base import Odometry, Registration, Usage
from adaptune.odometry.isolation import Faulting, pose_fault
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.wire import unpacked
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet

T = TypeVar("T")


class _Unprepared:
    """What stands for a scan that could not be prepared."""

    nbytes = 0

    def __init__(self, fault: str):
        self.fault = fault


class _LateError(BaseException):
    """A call has taken too long; not an exception that user code would handle."""


class _FaultError(Exception):
    """What a class of the user has raised."""


class Guarded(Faulting):
    """A clean class of the user in this process, with the faults that `Isolated` would have.

    Parameters
    ----------
    name, parameters
        The odometry.
    settings
        Its checked settings.
    seconds
        Time for one scan. It holds for Python code in the main thread; other code is trusted.
    """

    def __init__(self, name: str, parameters: ParameterSet, settings: BaseModel, seconds: float):
        super().__init__(name, parameters)
        self._class: Any = odometry_class(name)
        self._seconds = seconds
        self._settings = settings.model_dump(mode="json")
        self._odometry: Odometry | None = None
        self._cpu = 0.0
        self._running = False

    @property
    def ended(self) -> bool:
        return not self._running

    @property
    def usage(self) -> Usage:
        return Usage(self._cpu, None)

    @property
    def preparation(self) -> Hashable:
        try:
            preparation = self._guarded(lambda: self._made().preparation)
            hash(preparation)
        except (_FaultError, TypeError):
            return self  # it shares with nobody
        return preparation

    def prepare(self, scan: Scan) -> Any:
        try:
            return self._guarded(lambda: self._made().prepare(scan))
        except _FaultError as fault:
            return _Unprepared(str(fault))

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._last_motion.start(T_odom_sensor, T_previous_current)
        self._running = False
        if self.given_up:
            return
        try:
            motion = None if T_previous_current is None else T_previous_current.copy()
            started = _checked(prepared)
            self._guarded(lambda: self._made().start(started, T_odom_sensor.copy(), motion))
            self._running = True
        except _FaultError as fault:
            self.note_fault(str(fault))

    def submit(self, prepared: Any) -> None:
        self._submitted = prepared

    def collect(self) -> Registration:
        registration = Registration(np.full((4, 4), np.nan), registered=False)
        if self._running:
            begin = time.process_time()
            try:
                registration = self._registered(_checked(self._submitted))
            except _FaultError as fault:
                registration = self.note_fault(str(fault))
            self._cpu += time.process_time() - begin
        self._last_motion.move(registration.T_odom_sensor)
        return registration

    def _registered(self, prepared: Any) -> Registration:
        found = self._guarded(lambda: unpacked(self._made().register(prepared)))
        T_odom_sensor = self._guarded(lambda: np.array(found.T_odom_sensor, np.float64))
        if wrong := pose_fault(T_odom_sensor):
            raise _FaultError(f"it gave a pose {wrong}")
        return Registration(T_odom_sensor, bool(found.registered))

    def apply(self, selection: Selection) -> None:
        self.parameters |= selection.parameters
        try:
            self._guarded(lambda: self._made().configure(selection.parameters))
        except _FaultError as fault:
            self.note_fault(str(fault))

    def close(self) -> None:
        self._odometry, self._running = None, False

    def _made(self) -> Odometry:
        if self._odometry is None:
            settings = self._class.settings_type.model_validate(self._settings)
            self._odometry = self._class(self.parameters, settings)
        assert self._odometry is not None
        return self._odometry

    def _guarded(self, call: Callable[[], T]) -> T:
        """What a call of user code returns; a `_FaultError` with the place where it raised."""
        try:
            with _limited(self._seconds):
                return call()
        except AdaptuneError:
            raise
        except _LateError as error:
            what = f"a scan took longer than isolation.seconds = {self._seconds:g}"
            raise _FaultError(what) from error
        except BaseException as error:
            raise _FaultError(in_a_line(error)) from error


def _checked(prepared: Any) -> Any:
    if isinstance(prepared, _Unprepared):
        raise _FaultError(prepared.fault)
    return prepared


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise a `_LateError` in the block after so long, where there is a way."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(_: int, __: object) -> None:
        raise _LateError

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
