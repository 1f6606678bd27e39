"""A class of the user in this process: where it goes wrong, this is a fault and nothing else."""

import signal
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

from pydantic import BaseModel

from adaptune._system import processes
from adaptune.errors import AdaptuneError, in_a_line
from adaptune.geometry import Poses
from adaptune.odometry import wire
from adaptune.odometry.base import WITHOUT_POSE, Odometry, Registration, Usage
from adaptune.odometry.faults import Faulting, pose_fault
from adaptune.odometry.registry import odometry_class
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet, Selection


class _LateError(BaseException):
    """A call has taken too long; not an exception that user code would handle."""


class Guarded(Faulting):
    """A clean class of the user in this process, with the faults that `Isolated` would have.

    The limit of seconds for a scan holds for Python code in the main thread.
    """

    def __init__(self, name: str, parameters: ParameterSet, settings: BaseModel, seconds: float):
        super().__init__(name, parameters)
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
            preparation: Hashable = self._guarded(lambda odometry: odometry.preparation)
            hash(preparation)
        except (processes.HostError, TypeError):
            return self  # it shares with nobody
        return preparation

    def prepare(self, scan: Scan) -> Any:
        try:
            return self._guarded(lambda odometry: odometry.prepare(scan))
        except processes.HostError as fault:
            return fault  # of whoever is given this in place of a scan

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._last_motion.start(T_odom_sensor, T_previous_current)
        motion = None if T_previous_current is None else T_previous_current.copy()
        given = prepared, T_odom_sensor.copy(), motion
        self._running = not self.given_up
        if self._running:
            self._noted(lambda odometry: odometry.start(*given), prepared)

    def _collect(self) -> Registration:
        def register(odometry: Odometry) -> Registration:
            found = wire.unpacked(odometry.register, odometry.register(self._submitted))
            if wrong := pose_fault(found.T_odom_sensor):
                raise processes.HostError(f"it gave a pose {wrong}")
            return found

        if not self._running:
            return WITHOUT_POSE
        begin = time.process_time()
        registration: Registration = self._noted(register, self._submitted)
        self._cpu += time.process_time() - begin
        return registration

    def apply(self, selection: Selection) -> None:
        self.parameters |= selection.parameters
        self._noted(lambda odometry: odometry.configure(selection.parameters))

    def close(self) -> None:
        self._odometry, self._running = None, False

    def _noted(self, call: Callable[[Odometry], Any], prepared: Any = None) -> Any:
        """What a call of user code returns; after a fault, which is noted, it is `WITHOUT_POSE`."""
        try:
            return self._guarded(call, prepared)
        except processes.HostError as fault:
            return self.note_fault(str(fault))

    def _guarded(self, call: Callable[[Odometry], Any], prepared: Any = None) -> Any:
        """What a call of user code returns; a `HostError` with the place where it raised."""
        if isinstance(prepared, processes.HostError):
            raise prepared
        try:
            with _limited(self._seconds):
                if self._odometry is None:
                    cls = odometry_class(self.name)
                    settings = cls.settings_type.model_validate(self._settings)
                    self._odometry = cls(self.parameters, settings)
                return call(self._odometry)
        except AdaptuneError:
            raise
        except _LateError as error:
            what = f"a scan took longer than isolation.seconds = {self._seconds:g}"
            raise processes.HostError(what) from error
        except BaseException as error:
            raise processes.HostError(in_a_line(error)) from error


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
