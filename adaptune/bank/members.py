"""Members of a bank that run beside this process, several of them in one other process.

A process receives each scan once, as soon as it is there, and prepares it once for all of its
members that prepare in the same way. Only odometries that are clean run like this: where one ends
its process, it ends the others there, too.
"""

import contextlib
import itertools
import resource
import time
from collections import OrderedDict, deque
from collections.abc import Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from adaptune import processes
from adaptune.errors import AdaptuneError, OdometryError
from adaptune.geometry import Poses
from adaptune.odometry import wire
from adaptune.odometry.base import (
    InProcess,
    OdometryInstance,
    Preparations,
    PreparedScan,
    Registration,
    Usage,
)
from adaptune.odometry.factory import Factory, OdometryFactory
from adaptune.odometry.registry import make_here
from adaptune.odometry.remote import SERVICE, Faulting
from adaptune.processes import other_core
from adaptune.recording.scan import Scan
from adaptune.selection import Selection
from adaptune.space import ParameterSet

KEPT = 160
"""Scans that a process keeps for members that restart: those of a warm-up, at ten a second."""


class SentScan(NamedTuple):
    """A scan that a process was sent, or can be sent, under a number."""

    number: int
    scan: Scan


class MemberProcess:
    """A process with members, which the first start of one begins.

    Parameters
    ----------
    name
        An odometry that is imported before the process is forked.
    bounds
        Its limits.
    """

    def __init__(self, name: str, bounds: processes.Bounds):
        self.generation = 0  # of how many processes this is the last
        self.ending = ""  # what is known of how the last one ended
        self._name = name
        self._bounds = bounds
        self._stream: processes.SocketStream | None = None
        self._numbers = itertools.count()
        self._held: OrderedDict[int, None] = OrderedDict()
        self._answers: dict[int, deque[processes.Message]] = {}
        self._owed = 0  # answers that are not here yet

    @property
    def busy(self) -> bool:
        """Whether it works: a scan that it is sent would wait."""
        return self._owed > 0

    @property
    def alive(self) -> bool:
        """Whether it was there when it was last used."""
        return self._stream is not None

    def connect(self) -> None:
        """Begin a new process if there is none.

        Raises
        ------
        OdometryError
            If the odometry cannot be imported.
        """
        if self._stream is None:
            try:
                self._stream = processes.connect(SERVICE, self._name, "members", self._bounds)
            except processes.HostError as error:
                raise OdometryError(str(error)) from error
            self.generation += 1
            self._held.clear()
            self._answers, self._owed = {}, 0

    def sent(self, scan: Scan) -> SentScan:
        """Give a scan a number, and send it where there is a process that takes it now."""
        sent = SentScan(next(self._numbers), scan)
        if not self.busy:
            self.need(sent)
        return sent

    def need(self, sent: SentScan) -> None:
        """Send a scan that the process does not have."""
        if self._stream is not None and sent.number not in self._held:
            _keep(self._held, sent.number, None)
            header = {"type": "scan", "number": sent.number, "stamp": sent.scan.stamp}
            self._send(header, **wire.scan_arrays(sent.scan))

    def ask(self, header: dict[str, Any], **arrays: Any) -> None:
        """Send a member what it has to answer."""
        self._owed += 1
        self._send(header, **arrays)

    def _send(self, header: dict[str, Any], **arrays: Any) -> None:
        if self._stream is not None:
            # A process that does not listen any more has said why, or has ended.
            with contextlib.suppress(OSError):
                processes.send(self._stream, header, **arrays)

    def ready(self, member: int, seconds: float) -> bool:
        """Whether `receive` would not wait longer than so many seconds."""
        end = time.perf_counter() + seconds
        while not self._answers.get(member) and self._stream is not None:
            if not self._stream.ready(end - time.perf_counter()):
                return False
            self._take_answer(self._stream)
        return True

    def receive(self, member: int) -> processes.Message | None:
        """Wait for a member's answer; None if the process ends before."""
        while not self._answers.get(member) and self._stream is not None:
            self._take_answer(self._stream)
        mine = self._answers.get(member)
        return mine.popleft() if mine else None

    def _take_answer(self, stream: processes.SocketStream) -> None:
        answer = None
        with contextlib.suppress(OSError, processes.WireError):
            answer = processes.receive(stream)
        if answer is None or answer.header["type"] == "fault":
            self.ending = "its process ended" if answer is None else answer.header["message"]
            self.close()
        else:
            self._owed -= 1
            self._answers.setdefault(answer.header["member"], deque()).append(answer)

    def close(self) -> None:
        """End the process."""
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream, self._owed = None, 0


class Member(Faulting):
    """A member of a bank in another process.

    Parameters
    ----------
    process
        Where it lives.
    number
        Its number there.
    factory
        Of its odometry.
    parameters
        All of them.
    """

    apart = True

    def __init__(
        self,
        process: MemberProcess,
        number: int,
        factory: OdometryFactory,
        parameters: ParameterSet,
    ):
        super().__init__(factory.name, parameters)
        self._process = process
        self._number = number
        self._hello = {
            "odometry": factory.name,
            "settings": factory.settings.model_dump(mode="json"),
        }
        self._generation: int | None = None
        self._cpu = self._memory = 0.0

    @property
    def ended(self) -> bool:
        return not self._process.alive or self._generation != self._process.generation

    @property
    def usage(self) -> Usage:
        # The first one reports the memory of all.
        memory = None if self._number else self._memory
        return Usage(self._cpu, memory, elsewhere=self._cpu)

    @property
    def preparation(self) -> MemberProcess:
        return self._process

    @property
    def busy(self) -> bool:
        return self._process.busy

    def ready(self, seconds: float) -> bool:
        return self.ended or self._process.ready(self._number, seconds)

    def prepare(self, scan: Scan) -> SentScan:
        return self._process.sent(scan)

    def start(
        self, prepared: SentScan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._last_motion.start(T_odom_sensor, T_previous_current)
        if self.given_up:
            return
        self._process.connect()
        if self.ended:
            self._generation = self._process.generation
            self._ask({"type": "hello", **self._hello, "parameters": self.parameters})
        self._process.need(prepared)
        motion = T_previous_current
        header = {"type": "start", "scan": prepared.number}
        self._ask(header, pose=T_odom_sensor, motion=motion)

    def submit(self, prepared: SentScan) -> None:
        if not self.ended:
            self._process.need(prepared)
            header = {"type": "register", "scan": prepared.number, "member": self._number}
            self._process.ask(header)

    def collect(self) -> Registration:
        registration = Registration(np.full((4, 4), np.nan), registered=False)
        if (answer := self._receive()) is not None:
            T_odom_sensor = answer.arrays["pose"].copy()
            registration = Registration(T_odom_sensor, bool(answer.header["registered"]))
        self._last_motion.move(registration.T_odom_sensor)
        return registration

    def apply(self, selection: Selection) -> None:
        self.parameters |= selection.parameters
        self._ask({"type": "configure", "parameters": selection.parameters})

    def close(self) -> None:
        self._generation = None
        if self._number == 0:
            self._process.close()

    def _ask(self, header: dict[str, Any], **arrays: Any) -> None:
        if not self.ended:
            self._process.ask({**header, "member": self._number}, **arrays)
            self._receive()

    def _receive(self) -> processes.Message | None:
        """Wait for the answer; None, and a fault, if the process has ended."""
        if self._generation is None:
            return None
        answer = self._process.receive(self._number)
        if answer is None:
            self.note_fault(self._process.ending)
            return None
        if answer.header["type"] == "refused":
            raise OdometryError(f"{self.name}: {answer.header['message']}")
        self._cpu += answer.header["cpu"]
        self._memory = max(self._memory, answer.header["memory"])
        return answer


def _keep(held: OrderedDict[int, Any], number: int, what: Any) -> None:
    """Add a scan, and drop the oldest one; both sides do, so each knows what the other has."""
    held[number] = what
    if len(held) > KEPT:
        held.popitem(last=False)


def serve(reader: processes.Readable, writer: BinaryIO) -> None:
    """Be the other process: answer messages with members until the stream ends."""
    members: dict[int, InProcess] = {}
    scans: OrderedDict[int, PreparedScan] = OrderedDict()
    preparations = Preparations()
    used = 0.0
    while (message := processes.receive(reader)) is not None:
        header = message.header
        if header["type"] == "scan":
            scan = preparations.of(wire.to_scan(message))
            _keep(scans, header["number"], scan)
            for member in members.values():
                scan.by(member)
            continue
        arrays, answer = {}, {"type": "done", "member": header["member"]}
        try:
            found = _answer(members, scans, message)
        except AdaptuneError as error:
            answer |= {"type": "refused", "message": str(error)}
        else:
            if found is not None:
                answer["registered"] = found.registered
                arrays["pose"] = np.asarray(found.T_odom_sensor, np.float64)
        now = resource.getrusage(resource.RUSAGE_SELF)
        cpu = now.ru_utime + now.ru_stime
        processes.send(
            writer, answer | {"cpu": cpu - used, "memory": now.ru_maxrss * 1024e-6}, **arrays
        )
        used = cpu


def _answer(
    members: dict[int, InProcess], scans: OrderedDict[int, PreparedScan], message: processes.Message
) -> Registration | None:
    header, arrays = message
    number, kind = header["member"], header["type"]
    if kind == "hello":
        made: Any = make_here(header["odometry"], header["parameters"], header["settings"])
        members[number] = InProcess(made[0])
        return None
    member = members[number]
    if kind == "configure":
        member.odometry.configure(header["parameters"])
        return None
    prepared = scans[header["scan"]].by(member)
    if kind == "register":
        return member.register(prepared)
    # Arrays from the stream are read-only; an odometry may change its poses.
    motion = arrays["motion"].copy() if "motion" in arrays else None
    member.start(prepared, arrays["pose"].copy(), motion)
    return None


def spread(make: Factory, sets: Sequence[ParameterSet], cores: int) -> list[OdometryInstance]:
    """Make the members of a bank, on as many cores as they can use.

    Some members run in this process, and the others in one more process for each further core.
    Those that prepare scans in the same way run together. Members that have processes of their own
    keep them.

    Parameters
    ----------
    make
        Makes members in this process.
    sets
        Of the members.
    cores
        That all of them may use.
    """
    made = [make(parameters) for parameters in sets]
    alike: dict[Any, list[int]] = {}
    for i, member in enumerate(made):
        if isinstance(member, InProcess):
            alike.setdefault(member.preparation, []).append(i)
    movable = [i for together in alike.values() for i in together]
    n = min(cores, len(movable))
    # This process, which does more than its members, has the smallest share.
    for i_process, share in enumerate(np.array_split(movable[::-1], n)[: n - 1] if n > 1 else ()):
        factories = [make.alone(sets[i]) for i in share]
        bounds = factories[0][0].limits.bounds
        whole = bounds._replace(memory=bounds.memory * len(share), core=other_core(i_process))
        process = MemberProcess(factories[0][0].name, whole)
        for number, (i, (factory, own)) in enumerate(zip(share, factories, strict=True)):
            made[i] = Member(process, number, factory, own)
        process.connect()
    return made
