"""Members of a bank that run beside this process, several of them in one other process.

A process receives each scan once, as soon as it is there, and prepares it once for all of its
members that prepare in the same way. Only odometries that are clean run like this: where one ends
its process, it ends the others there, too.
"""

import itertools
import time
from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import cache
from statistics import median_high
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system import processes
from adaptune._system.machine import other_core
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, invert, mean_motion
from adaptune.odometry import wire
from adaptune.odometry.base import InProcess, OdometryInstance, Usage
from adaptune.odometry.factory import Factory, OdometryFactory
from adaptune.odometry.prepared import PreparedScan
from adaptune.odometry.registry import make_here, odometry_class
from adaptune.odometry.remote import Isolated
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet

KEPT = 160
"""Scans that a process keeps for members that restart: those of a warm-up, at ten a second."""


SERVICE = __name__  # what a server does with an odometry of which there are several


class SentScan(NamedTuple):
    """A scan that a process was sent, or can be sent, under a number."""

    number: int
    stamp: int
    scan: Scan


class MemberProcess:
    """A process with members of an odometry, from the first start of one to the last close."""

    def __init__(self, name: str, bounds: processes.Bounds):
        self.generation = 0  # of how many processes this is the last
        self.ending = ""  # what is known of how the last one ended
        transport = processes.Forked(SERVICE, name, "members", bounds)
        self.conversation = processes.Conversation(transport)
        self.users = set[int]()  # numbers of the members that are not closed
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
        sent = SentScan(next(self._numbers), scan.stamp, scan)
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
                answer = self.conversation.next_message()
            except processes.HostError as error:
                self.ending, self._owed = str(error), 0
            else:
                self._owed -= 1
                self._answers.setdefault(answer.header["member"], deque()).append(answer)
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
        process.users.add(number)

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
        self._process.users.add(self._number)
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
        self._process.users.discard(self._number)
        if not self._process.users:
            self._process.close()


class Member(Isolated):
    """A member of a bank in another process, under a number there."""

    _checks_poses = False  # as a member in this process

    def __init__(
        self,
        process: MemberProcess,
        number: int,
        factory: OdometryFactory,
        parameters: ParameterSet,
    ):
        super().__init__(factory.name, parameters, factory.settings, factory.limits)
        self._process, self._number = process, number
        self.warm_up = factory.description.warm_up
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

    def _scan(self, prepared: SentScan) -> tuple[dict[str, Any], dict[str, Any]]:
        self._process.need(prepared)
        return {"stamp": prepared.stamp, "scan": prepared.number}, {}


def _keep(held: OrderedDict[int, Any], number: int, scan: Any) -> None:
    """Add a scan, and drop the oldest one; both sides do, so each knows what the other has."""
    held[number] = scan
    if len(held) > KEPT:
        held.popitem(last=False)


# What runs in the other process.

load = odometry_class


def members(_: str) -> processes.Answer:
    """Answer messages with members; scans come once, without an answer, and have numbers then."""
    made: dict[int, Any] = {}
    scans: OrderedDict[int, PreparedScan] = OrderedDict()
    first: dict[Hashable, Any] = {}
    spent, used = defaultdict[int, float](float), 0.0  # CPU seconds of each member, and of all

    def do(message: processes.Message) -> dict[str, Any]:
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
            scan = PreparedScan(wire.to_scan(message), first)
            _keep(scans, message.header["number"], scan)
            for member in made.values():
                scan.by(member)
            return None
        try:
            done = do(message)
        except AdaptuneError as error:
            done = {"type": "refused", "message": str(error)}
        number, now = message.header["member"], wire.used()
        spent[number] += now["cpu"] - used
        used = now["cpu"]
        return {**done, **now, "cpu": spent[number], "member": number}

    return answer


def spread(make: Factory, sets: Sequence[ParameterSet], cores: int) -> list[OdometryInstance]:
    """Make the members of a bank, on as many cores as they can use.

    Some run in this process, and the others in one more process for each further core, together
    where they prepare scans in the same way. Members that have processes of their own keep them.
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


# Which members of a bank agree, by how they moved over the last second.

WINDOW = 1.0
"""Seconds over which motions are compared. Jitter within them cancels, departure adds up."""
FLOOR = 0.1  # metres a second by which motions may always differ and agree
SHARE = 0.08  # share of the way by which they may always differ and agree
SPREAD = 6.0  # they may also differ by this many times what agreeing members usually differ by
MAX_TIMES_LEAST = 2.0
"""But not by more than this many times what they may always differ by: a departure that was not
noticed must not become usual."""
FAR = 2.0
"""Members restart where they differ from those that agree by this many times what they may."""
LEVER = 5.0
"""Metres. A turn that differs counts as much as the way that it makes at this distance."""
RESTART = 1.0  # seconds that pass between restarts of the same member
MEMORY = 30.0  # seconds in which members show by how much they usually differ
MARGIN = 0.006
"""Metres by which a scan that lies as well as the best may be farther from the scans before."""

_ENDLESS = 1e6
"""Metres that no motion has. What is not a number is not below them either."""
_METRES = np.repeat([LEVER / np.sqrt(2.0), 1.0], [9, 3])
"""What makes entries of a rotation and of a translation metres."""

Alignment = Callable[[Poses, tuple[int, ...]], NDArray[np.float64]]
"""Says how far the newest scan is from earlier ones, as the motions of members place it.

Receives ``T_then_now`` of shape (n_scans, n_members, 4, 4), and how many scans ago each `then` was.
Returns mean distances of shape (n_members,) in metres; infinite where there is nothing to compare.
"""


class Agreement:
    """Tells which members of a bank agree, scan after scan; see docs/research/bank.md.

    Each pose of a member in the last second is a vector: the way, and the turn as the way it makes
    at `LEVER` metres. A straight line through these vectors says how far the member came. Two
    members are near each other if they differ, in a second, by no more than ::

        least = max(FLOOR, SHARE * way)
        min(max(least, SPREAD * usual difference), MAX_TIMES_LEAST * least, lost_track)

    and, over the newest scan alone, by no more than `lost_track` metres a second. Before the first
    half second, the newest scan alone counts. The heaviest group of members that are all near each
    other agrees.

    Attributes
    ----------
    T_previous_current : ndarray of shape (4, 4)
        How the bank moved over the last scan: the weighted mean of the members that agree; NaN if
        no member had a motion.
    due : ndarray of shape (n_members,)
        Which members should restart at the bank's pose: those left out at the last scan that differ
        by more than `FAR` times what they may, and have not restarted in the last second.
    judged : bool
        Whether the short registrations decided at the last scan.
    """

    def __init__(self, n_members: int, lost_track: float):
        self._n_members, self._lost_track = n_members, lost_track
        self._usual: deque[tuple[float, float]] = deque()  # times, and what was usual
        self._times = deque([0.0])
        self.start()

    def start(self) -> None:
        """Forget how the members and the bank have moved; what is usual stays."""
        # Each track begins where it likes; the bank's is the last.
        self._tracks = deque([np.tile(np.eye(4), (self._n_members + 1, 1, 1))])
        self._times = deque([self._times[-1]])
        self._restarted = np.full(self._n_members, -np.inf)
        self.T_previous_current = np.eye(4)
        self.judged = False
        self.due = np.zeros(self._n_members, np.bool_)

    def judge(
        self,
        T_previous_current: Poses,
        seconds: float,
        weights: NDArray[np.float64],
        alignment: Alignment | None = None,
        lost: bool = False,
    ) -> NDArray[np.bool_]:
        """Which members agree at the next scan, of shape (n_members,); none if none has a motion.

        Motions over the scan are of shape (n_members, 4, 4), NaN where there is none; weights of
        shape (n_members,). Short registrations (`alignment`) are asked where the heaviest group
        does not hold more than half of the votes and of the members, or where the bank is known to
        be `lost` and members disagree; then only members within `MARGIN` of the best are believed.
        """
        known = np.asarray((np.abs(T_previous_current) < _ENDLESS).all(axis=(1, 2)))
        moved = np.where(known[:, None, None], T_previous_current, np.eye(4))
        self._advance(moved, seconds)
        near, far, departures = self._near(known, moved, seconds)
        agreeing = self._heaviest(near, weights, moved, alignment, lost)
        self._move(T_previous_current, weights, agreeing)
        self.due = np.zeros_like(agreeing)
        if agreeing.any():
            self._remember(departures, agreeing)
        if agreeing.any() and not agreeing.all():
            self._begin_anew(~known)
            # A single member may be the only one that is not lost.
            sure = agreeing.sum() > 1 or self.judged
            # Stamps are not quite even.
            long_ago = self._times[-1] - self._restarted > 0.95 * RESTART
            self.due = far[:, agreeing].all(axis=1) & (sure | ~known) & long_ago
        return agreeing

    def restarted(self, members: NDArray[np.bool_]) -> None:
        """Members, as a mask of shape (n_members,), begin anew: as the bank has moved so far."""
        self._begin_anew(members)
        self._restarted[members] = self._times[-1]

    def _begin_anew(self, members: NDArray[np.bool_]) -> None:
        if members.any():
            for tracks in self._tracks:
                tracks[:-1][members] = tracks[-1]

    def _advance(self, moved: Poses, seconds: float) -> None:
        tracks = self._tracks[-1].copy()
        tracks[:-1] = tracks[:-1] @ moved
        self._tracks.append(tracks)
        self._times.append(self._times[-1] + seconds)
        # Stamps are not quite even.
        while len(self._times) > 2 and self._times[-1] - self._times[0] > 1.05 * WINDOW:
            self._tracks.popleft()
            self._times.popleft()

    def _near(
        self, known: NDArray[np.bool_], moved: Poses, seconds: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
        """Which members are near each other, which are far, and by how many metres a second."""
        tracks = np.array(self._tracks)[:, :-1]
        times = np.array(self._times)
        times -= times.mean()
        way = _vectors(invert(tracks[0]) @ tracks).reshape(len(times), -1)
        span = times[-1] - times[0]
        came = (times * (span / (times @ times)) @ way).reshape(-1, 12)
        departures = _distances(came)
        scale = max(span, WINDOW)
        near = (_distances(_vectors(moved)) <= self._lost_track * seconds) & known & known[:, None]
        if span < 0.5 * WINDOW:
            return near, ~near, departures / scale
        ways = np.linalg.norm(came[known, 9:], axis=1).tolist()
        least = max(FLOOR * scale, SHARE * (median_high(ways) if ways else 0.0))
        # As long as nothing is usual, they may differ by the most.
        differed = [difference for _, difference in self._usual]
        usual = SPREAD * median_high(differed) * scale if differed else np.inf
        bound = min(max(least, usual), MAX_TIMES_LEAST * least)
        most = self._lost_track * span
        far = ~near | (departures > min(FAR * bound, most))
        return near & (departures <= min(bound, most)), far, departures / scale

    def _heaviest(
        self,
        near: NDArray[np.bool_],
        weights: NDArray[np.float64],
        moved: Poses,
        alignment: Alignment | None,
        lost: bool,
    ) -> NDArray[np.bool_]:
        """The heaviest group of members that are near each other, among those believed."""
        self.judged = False
        known = near.diagonal()
        if near[known][:, known].all():
            return known.copy()
        # Among members without weight, two that agree outvote one.
        votes = weights + 1e-9
        group = self._group(near, votes, moved)
        most = votes[group].sum() > 0.5 * votes.sum() and group.sum() > 0.5 * self._n_members
        if alignment is None or (most and not lost):
            return group
        distances = np.where(known, alignment(*self._to_now()), np.inf)
        self.judged = bool(np.isfinite(distances).any())
        believed = distances <= distances[known].min() + MARGIN
        return self._group(near & believed & believed[:, None], votes, moved)

    def _group(
        self, near: NDArray[np.bool_], votes: NDArray[np.float64], moved: Poses
    ) -> NDArray[np.bool_]:
        """The heaviest group; of those as heavy the one that goes on most like the bank before."""
        inside = _groups(self._n_members)
        # No two that are not near each other, and nobody who is not near itself.
        possible = inside[~(inside @ ~near & inside).any(axis=1)]
        heard = possible @ votes
        best = possible[heard > heard.max() - 1e-12]
        if len(best) == 1:
            return np.asarray(best[0])
        as_before = np.linalg.norm(moved[:, :3, 3] - self.T_previous_current[:3, 3], axis=1)
        return np.asarray(best[((best @ as_before) / best.sum(axis=1)).argmin()])

    def _to_now(self) -> tuple[Poses, tuple[int, ...]]:
        """Motions since the scan before and since the oldest of the window; see `Alignment`."""
        ago = (1, len(self._tracks) - 1)[: len(self._tracks) - 1]
        now = self._tracks[-1][:-1]
        return np.array([invert(self._tracks[-1 - n][:-1]) @ now for n in ago]), ago

    def _move(
        self, T_previous_current: Poses, weights: NDArray[np.float64], agreeing: NDArray[np.bool_]
    ) -> None:
        """Move the bank by the mean of the members that agree."""
        if not agreeing.any():
            self.T_previous_current = np.full((4, 4), np.nan)
            return
        shares = share(weights, agreeing)[agreeing]
        self.T_previous_current = mean_motion(T_previous_current[agreeing], shares)
        self._tracks[-1][-1] = self._tracks[-1][-1] @ self.T_previous_current

    def _remember(self, departures: NDArray[np.float64], agreeing: NDArray[np.bool_]) -> None:
        """Remember by how much agreeing members differ, once there is a second to tell it from."""
        if agreeing.sum() > 1 and self._times[-1] - self._times[0] > 0.5 * WINDOW:
            # Each pair twice, and each member from itself.
            differences = sorted(departures[agreeing][:, agreeing].ravel().tolist())
            n = int(agreeing.sum())
            self._usual.append((self._times[-1], differences[(n * n + n) // 2 - 1]))
            while self._times[-1] - self._usual[0][0] > MEMORY:
                self._usual.popleft()


def share(weights: NDArray[np.float64], agreeing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Weights of the members that agree; equal if they have none. Of shape (..., n_members)."""
    shares = np.where(agreeing, weights, 0.0)
    return np.where(shares.any(axis=-1, keepdims=True), shares, agreeing.astype(np.float64))


@cache
def _groups(n_members: int) -> NDArray[np.bool_]:
    """All groups of members but the empty one, of shape (2 ** n_members - 1, n_members)."""
    numbers = np.arange(1, 2**n_members)
    return np.asarray(numbers[:, None] >> np.arange(n_members) & 1, np.bool_)


def _vectors(T: Poses) -> NDArray[np.float64]:
    """Motions of shape (..., 4, 4) as vectors of shape (..., 12) that differ by metres."""
    vectors = T[..., :3, :].swapaxes(-1, -2).reshape(*T.shape[:-2], 12)
    # The distance of rotation matrices is the square root of two times the chord of the turn.
    return np.asarray(vectors * _METRES)


def _distances(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances of shape (n, n) between vectors of shape (n, n_dimensions)."""
    differences = vectors[:, None] - vectors
    return np.asarray(np.sqrt(np.einsum("ijk,ijk->ij", differences, differences)))
