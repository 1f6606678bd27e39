"""Members of a bank that run beside this process, several of them in one other process.

A process receives each scan once, as soon as it is there, and prepares it once for all of its
members that prepare in the same way. Only odometries that are clean run like this: where one ends
its process, it ends the others there, too.
"""

import itertools
import time
from collections import OrderedDict, defaultdict, deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from adaptune import processes
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.odometry import wire
from adaptune.odometry.base import InProcess, OdometryInstance, Preparations, PreparedScan, Usage
from adaptune.odometry.factory import Factory, OdometryFactory
from adaptune.odometry.registry import make_here, odometry_class
from adaptune.odometry.remote import Isolated
from adaptune.processes import other_core
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet

KEPT = 160
"""Scans that a process keeps for members that restart: those of a warm-up, at ten a second."""


SERVICE = processes.Service(__name__, tuple(processes.ONE_THREAD.items()))
"""What a server does with an odometry of which there are several."""


class SentScan(NamedTuple):
    """A scan that a process was sent, or can be sent, under a number."""

    number: int
    scan: Scan

    @property
    def stamp(self) -> int:
        """Nanoseconds."""
        return self.scan.stamp


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
        self.conversation = processes.Conversation(
            processes.Forked(SERVICE, name, "members", bounds)
        )
        self._numbers = itertools.count()
        self._held: OrderedDict[int, None] = OrderedDict()
        self._answers: dict[int, deque[processes.Message]] = {}
        self._owed = 0  # answers that are not here yet

    @property
    def busy(self) -> bool:
        """Whether it works: a scan that it is sent would wait."""
        return self._owed > 0

    def open(self) -> None:
        """Begin a new process if there is none; a `HostError` if the odometry is not imported."""
        if not self.conversation.alive:
            self.conversation.open()
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
        if self.conversation.alive and sent.number not in self._held:
            _keep(self._held, sent.number, None)
            header = {"type": "scan", "number": sent.number, "stamp": sent.stamp}
            self.conversation.send(header, **wire.scan_arrays(sent.scan))

    def ask(self, header: dict[str, Any], **arrays: Any) -> None:
        """Send a member what it has to answer."""
        self._owed += 1
        self.conversation.send(header, **arrays)

    def answer(self, member: int, seconds: float | None = None) -> processes.Message | None:
        """Wait for a member's answer, which stays, at most so long; None if there is none."""
        end = None if seconds is None else time.perf_counter() + seconds
        while not (mine := self._answers.get(member)) and self.conversation.alive:
            if end is not None and not self.conversation.ready(end - time.perf_counter()):
                break
            try:
                found = self.conversation.next_message()
            except processes.HostError as error:
                self.ending, self._owed = str(error), 0
            else:
                self._owed -= 1
                self._answers.setdefault(found.header["member"], deque()).append(found)
        return mine[0] if mine else None

    def receive(self, member: int) -> processes.Message:
        """Take a member's answer; a `HostError` if the process ends before."""
        if self.answer(member) is None:
            raise processes.HostError(self.ending)
        return self._answers[member].popleft()

    def close(self) -> None:
        """End the process."""
        self.conversation.close()
        self._owed = 0


class _Channel(processes.Conversation):
    """The part of a process's conversation that is one member's."""

    def __init__(self, process: MemberProcess, number: int):
        self._process, self._number = process, number
        self._generation: int | None = None

    @property
    def alive(self) -> bool:
        return self._generation is not None

    @property
    def lost(self) -> bool:
        """Whether the process that the member was in has ended."""
        process = self._process
        return not process.conversation.alive or self._generation != process.generation

    def open(self) -> None:
        self._process.open()
        self._generation = self._process.generation

    def send(self, header: Mapping[str, Any], **arrays: Any) -> None:
        if not self.lost:
            self._process.ask({**header, "member": self._number}, **arrays)

    def ready(self, seconds: float) -> bool:
        return self.lost or self._process.answer(self._number, seconds) is not None

    def receive(self) -> processes.Message:
        if self._generation != self._process.generation:
            raise processes.HostError(self._process.ending)
        return processes.accepted(self._process.receive(self._number))

    def close(self) -> None:
        self._generation = None
        if self._number == 0:
            self._process.close()

    def __del__(self) -> None:
        pass  # the process ends with its last member


class Member(Isolated):
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

    def __init__(
        self,
        process: MemberProcess,
        number: int,
        factory: OdometryFactory,
        parameters: ParameterSet,
    ):
        super().__init__(factory.name, parameters, factory.settings, factory.limits)
        self._process, self._number = process, number
        self._conversation: _Channel = _Channel(process, number)
        self._fresh = False

    @property
    def ended(self) -> bool:
        return self._conversation.lost

    @property
    def usage(self) -> Usage:
        # The first one reports the memory of all.
        memory = None if self._number else self._memory
        return super().usage._replace(memory=memory)

    @property
    def preparation(self) -> MemberProcess:
        return self._process

    @property
    def busy(self) -> bool:
        return self._process.busy

    def prepare(self, scan: Scan) -> Any:
        return self._process.sent(scan)

    def _pose_fault(self, T_odom_sensor: Poses) -> None:
        pass  # it is none of a member in this process either

    def _scan(self, prepared: SentScan) -> tuple[dict[str, Any], dict[str, Any]]:
        self._process.need(prepared)
        return {"stamp": prepared.stamp, "scan": prepared.number}, {}


def _keep(held: OrderedDict[int, Any], number: int, what: Any) -> None:
    """Add a scan, and drop the oldest one; both sides do, so each knows what the other has."""
    held[number] = what
    if len(held) > KEPT:
        held.popitem(last=False)


# What runs in the other process.


def load(name: str) -> None:
    """Import the odometry."""
    odometry_class(name)


def members(_: str) -> processes.Answer:
    """Answer messages with members, as `adaptune.odometry.wire` does with one odometry.

    Scans come once, in messages without an answer; others name a scan by its number.
    """
    made: dict[int, Any] = {}
    scans: OrderedDict[int, PreparedScan] = OrderedDict()
    preparations = Preparations()
    spent, used = defaultdict[int, float](float), 0.0  # CPU seconds of each member, and of all

    def done(message: processes.Message) -> dict[str, Any]:
        header = message.header
        if header["type"] == "hello":
            given = header["odometry"], header["parameters"], header["settings"]
            made[header["member"]], _ = make_here(*given)
            return {}
        member = made[header["member"]]
        prepared = scans[header["scan"]].by(member) if "scan" in header else None
        return wire.answered(member, message, prepared)

    def answer(message: processes.Message) -> dict[str, Any] | None:
        nonlocal used
        if message.header["type"] == "scan":
            scan = preparations.of(wire.to_scan(message))
            _keep(scans, message.header["number"], scan)
            for member in made.values():
                scan.by(member)
            return None
        try:
            found = done(message)
        except AdaptuneError as error:
            found = {"type": "refused", "message": str(error)}
        number, now = message.header["member"], wire.used()
        spent[number] += now["cpu"] - used
        used = now["cpu"]
        return {**found, **now, "cpu": spent[number], "member": number}

    return answer


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
        process.open()
    return made
