"""A Dask cluster whose workers run trials.

A worker reads recordings that it has under the same path. Other recordings are decoded and sent to
it once; it keeps them in its cache of decoded sequences under a digest of their contents. Results
always return to the driver.
"""

import base64
import contextlib
import dataclasses
import hashlib
import io
import logging
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, Self
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from adaptune import __version__
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.processes import pin
from adaptune.recording import Scan, SequenceConfig, cache
from adaptune.recording.cache import fingerprints
from adaptune.recording.recording import sequence_files
from adaptune.recording.scan import Imu, ImuNoise
from adaptune.recording.views import WithImu
from adaptune.study.sequences import StudySequences
from offline.trial import TrialSetup
from offline.workers import Death, Outcome, Sequences, Task, attempt

CHUNK = 1 << 26
"""Bytes of scans in one message."""

_TIMEOUT = 10.0
_PERIOD = 1.0

_log = logging.getLogger(__name__)


class ClusterError(AdaptuneError):
    """A cluster that cannot be used."""


class LackingError(AdaptuneError):
    """A worker does not have the sequence."""


class _Place(NamedTuple):
    """The place of a worker: its host, and its number on that host."""

    host: str
    rank: int


class Cluster:
    """The workers of a Dask cluster, as a `Pool`.

    Its workers share `memory` bytes for prepared scans. Use it as a context: leaving it cancels the
    tasks that are not done.

    Raises
    ------
    ClusterError
        If it cannot be reached, has no workers, or workers of another version.
    """

    def __init__(self, setup: TrialSetup, names: Iterable[str], memory: float, address: str):
        try:
            import distributed
        except ImportError as error:
            raise ClusterError("--cluster needs Dask: pip install 'adaptune[dask]'") from error
        self._killed = distributed.KilledWorker
        self._sequences = setup.sequences
        self._memory = memory
        self._address = address
        self._digests = {name: recording_digest(setup.sequences.config(name)) for name in names}
        self._away = _away(setup, self._digests)
        # Distinguishes this campaign from others on the same workers.
        self._token = uuid4().hex
        self._places: dict[str, _Place] = {}
        self._tasks: dict[str, Task] = {}
        self._futures: dict[str, Any] = {}
        self._done = threading.Event()
        self._waits = False
        try:
            self._client = distributed.Client(address, timeout=_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"--cluster {address}: cannot be reached ({error}); start a scheduler there "
                f"(`dask scheduler`), or leave --cluster out"
            ) from error
        try:
            found = self.workers()
        except ClusterError:
            self._client.close()
            raise
        if not found:
            self._client.close()
            raise ClusterError(
                f"--cluster {address}: has no workers; start some with `dask worker {address}`"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):
            self._client.cancel(list(self._futures.values()), force=True)
        self._client.close()

    def workers(self) -> Collection[str]:
        """See `Pool`."""
        hosts = self._hosts()
        for gone in self._places.keys() - hosts.keys():
            del self._places[gone]
        if new := [worker for worker in hosts if worker not in self._places]:
            self._check(new)
            for worker in new:
                taken = {p.rank for p in self._places.values() if p.host == hosts[worker]}
                rank = next(r for r in range(len(taken) + 1) if r not in taken)
                self._places[worker] = _Place(hosts[worker], rank)
        if not hosts and not self._waits:
            _log.warning("%s: no worker is left; waiting for others", self._address)
        self._waits = not hosts
        return list(self._places)

    def start(self, worker: str, task: Task) -> None:
        """See `Pool`."""
        memory = self._memory / max(len(self._places), 1)
        self._tasks[worker] = task
        future = self._client.submit(
            perform,
            self._token,
            self._away,
            task,
            self._places[worker].rank,
            memory,
            workers=[worker],
            allow_other_workers=False,
            pure=False,
        )
        future.add_done_callback(lambda _: self._done.set())
        self._futures[worker] = future

    def wait(self) -> list[tuple[str, Outcome]]:
        """See `Pool`."""
        # Dask does not report the death of a worker: look now and then.
        self._done.wait(_PERIOD)
        self._done.clear()
        hosts = self._hosts()
        outcomes = []
        for worker, future in list(self._futures.items()):
            if not future.done() and worker in hosts:
                continue
            task = self._tasks.pop(worker)
            del self._futures[worker]
            outcome = self._outcome(worker, future)
            if isinstance(outcome, LackingError):
                self._send(worker, task.sequence)
                self.start(worker, task)
            else:
                outcomes.append((worker, outcome))
        return outcomes

    def _outcome(self, worker: str, future: Any) -> Outcome:
        if future.status == "finished":
            outcome: Outcome = future.result()
            return outcome
        if future.status == "error":
            error = future.exception()
            if not isinstance(error, self._killed):
                return ClusterError(f"worker {worker}: {type(error).__name__}: {error}")
        self._client.cancel([future], force=True)
        return Death(f"worker {worker} has gone")

    def _hosts(self) -> dict[str, str]:
        """The host of every worker that the scheduler knows."""
        if self._client.status == "running":
            with contextlib.suppress(OSError):
                known = self._client.scheduler_info(n_workers=-1)["workers"]
                return {worker: about["host"] for worker, about in known.items()}
        raise ClusterError(
            f"--cluster {self._address}: the scheduler has gone; run the same command again to "
            f"resume"
        )

    def _check(self, workers: list[str]) -> None:
        """Refuse workers of another version."""

        def version() -> str:
            # Dask sends an inner function as code, so it runs without adaptune.
            from importlib.metadata import version

            return version("adaptune")

        versions = self._client.run(version, workers=workers, on_error="return")
        for worker, found in versions.items():
            if isinstance(found, OSError):
                continue  # it has gone again
            if found != __version__:
                what = "no adaptune" if isinstance(found, Exception) else f"adaptune {found}"
                raise ClusterError(
                    f"--cluster {self._address}: worker {worker} has {what}, and this is "
                    f"{__version__}; install the same version there"
                )

    def _send(self, worker: str, name: str) -> None:
        """Send a sequence to a worker, unless a worker on the same host has received it."""
        digest = self._digests[name]
        try:
            if self._client.run(_has, digest, workers=[worker])[worker]:
                return
            sequence = self._sequences.open(name)
            _log.info("%s: sending it to %s", name, worker)
            self._client.run(_begin, digest, sequence.name, workers=[worker])
            stamps = []
            for scans in _chunks(sequence):
                stamps += [scan.stamp for scan in scans]
                self._client.run(_append, digest, scans, workers=[worker])
            motion = _pack(sequence, np.array(stamps, np.int64), imu=self._sequences.with_imu)
            if self._client.run(_end, digest, motion, workers=[worker])[worker]:
                return
            problem = "see its log"
        except OSError as error:
            problem = str(error)
        # `wait` notices a worker that has gone.
        if worker in self._hosts():
            raise ClusterError(
                f"worker {worker} cannot keep the sequence {name} in its cache ({problem})"
            )


def _away(setup: TrialSetup, digests: Mapping[str, str]) -> TrialSetup:
    """The setup for workers, which may not have the recordings."""
    given = {f.name: getattr(setup.sequences, f.name) for f in dataclasses.fields(StudySequences)}
    given["folder"] = setup.sequences.folder.absolute()
    sequences = AwaySequences(**given, digests=digests)
    odometry = setup.odometry.reading(sequences.program_input)
    return TrialSetup(setup.settings, odometry, sequences)


def _chunks(scans: Iterable[Scan]) -> Iterator[list[Scan]]:
    chunk: list[Scan] = []
    size = 0
    for scan in scans:
        chunk.append(scan)
        size += scan.points.nbytes
        if size > CHUNK:
            yield chunk
            chunk, size = [], 0
    if chunk:
        yield chunk


def _pack(sequence: Any, stamps: NDArray[np.int64], *, imu: bool) -> str:
    """Reference poses, and the IMU's measurements, as text."""
    arrays = {}
    if (reference := sequence.reference()) is not None:
        arrays["T_ref_sensor"] = reference.at(stamps)
    if imu and (measured := sequence.imu()) is not None:
        arrays |= {f.name: np.asarray(getattr(measured, f.name)) for f in dataclasses.fields(Imu)}
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    return base64.b64encode(packed.getvalue()).decode()


def recording_digest(config: SequenceConfig) -> str:
    """Digest of a recording's content and its settings; paths and times of change do not count.

    Raises
    ------
    AdaptuneError
        If a file is missing or cannot be read.
    """
    settings = config.model_dump_json(exclude={"bag", "kitti", "folder", "reference", "cache"})
    files = sequence_files(config)
    topic = None if files.reference else config.reference
    found = [*fingerprints(files.recording), *fingerprints(files.reference)]
    about = f"{__version__} {settings} {topic} {' '.join(found)}"
    return hashlib.blake2b(about.encode(), digest_size=16).hexdigest()


# What follows runs on the workers.


@dataclasses.dataclass(frozen=True, kw_only=True)
class AwaySequences(StudySequences):
    """The sequences of a study on a worker, which may not have the recordings."""

    digests: Mapping[str, str]  # `recording_digest` of every sequence at the driver

    def open(self, name: str) -> Any:
        """See `StudySequences.open`.

        Raises
        ------
        LackingError
            If the sequence is not here and was not sent.
        """
        digest = self.digests[name]
        with contextlib.suppress(AdaptuneError, OSError):
            if recording_digest(self.config(name)) == digest:
                return super().open(name)
        entry = cache.find(digest)
        if entry is None:
            raise LackingError(name)
        sent: Any = _Sent(entry)
        return WithImu(sent) if self.with_imu else sent


class _Sent:
    """A sequence that was sent."""

    def __init__(self, entry: cache.CachedScans):
        self._entry = entry
        self._motion = np.load(io.BytesIO(base64.b64decode(entry.about["motion"])))
        self.name: str = entry.about["name"]
        self.n_messages = len(entry)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self._entry)

    def reference(self) -> "_Known | None":
        """Poses at the scans' stamps."""
        if "T_ref_sensor" not in self._motion:
            return None
        return _Known(self._entry.stamps, self._motion["T_ref_sensor"])

    def imu(self) -> Imu | None:
        """Measurements of the IMU, if the odometry needs them."""
        if "stamps" not in self._motion:
            return None
        of_imu = {f.name: self._motion[f.name] for f in dataclasses.fields(Imu)}
        return Imu(**of_imu | {"noise": ImuNoise(*of_imu["noise"].tolist())})

    def played_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """See `Sequence`."""
        return stamps


class _Known(NamedTuple):
    """A trajectory that is known at some stamps."""

    stamps: NDArray[np.int64]
    T_world_sensor: Poses

    def at(self, stamps: NDArray[np.int64]) -> Poses:
        """Poses at known stamps, of shape (n, 4, 4)."""
        return self.T_world_sensor[np.searchsorted(self.stamps, stamps)]


_lock = threading.Lock()
_held: tuple[str, Sequences] | None = None
_writers: dict[str, cache.Writer] = {}


def perform(token: str, setup: TrialSetup, task: Task, core: int, memory: float) -> Outcome:
    """Do a task, with the sequences that earlier tasks of the same campaign have prepared."""
    global _held  # noqa: PLW0603 (a Dask worker keeps nothing else from task to task)
    with _lock:
        pin(core)
        if _held is None or _held[0] != token:
            _held = token, Sequences(setup, memory)
        return attempt(_held[1], task)


def _has(digest: str) -> bool:
    return cache.find(digest) is not None


def _begin(digest: str, name: str) -> None:
    _writers[digest] = cache.Writer(digest, {"name": name, "left_out": {}})


def _append(digest: str, scans: list[Scan]) -> None:
    for scan in scans:
        _writers[digest].append(scan)


def _end(digest: str, motion: str) -> bool:
    with _writers.pop(digest) as writer:
        writer.done(motion=motion)
    return _has(digest)
