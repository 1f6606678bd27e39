"""Trials on disk: parameters, poses, and the error at every frame."""

import json
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.files import DAMAGED_NPZ, replacing, write_text
from adaptune.geometry import Poses
from adaptune.live.hops import Hops
from adaptune.metrics import FAILURE, cap
from adaptune.recording.cache import status_key
from adaptune.space import ParameterSet, ParameterSets
from adaptune.strict import ConfigurationError

# In `Trial.usage`; the last one in seconds, where the first scan has no pose.
REGISTER_MS, PREPARE_MS, FIRST_POSE = "register_ms", "prepare_ms", "first_pose"
_log = logging.getLogger(__name__)


class ArchiveError(AdaptuneError):
    """A file of the archive that is missing or damaged."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Data that all trials on a sequence share."""

    stamps: NDArray[np.int64]  # (n,): nanoseconds
    T_ref_sensor: Poses  # (n, 4, 4): the reference, NaN where there is none
    descriptors: NDArray[np.float32]  # (n, n_features)
    blocks: dict[str, int]  # by name, in order, how many of the features are each descriptor's
    # (n,): degrees, of each scan's lowest points, see `adaptune.model.descriptor.lowest_elevation`.
    elevations: NDArray[np.float32]
    # Direct registrations, one a second at most, see `adaptune.live.hops`.
    hops: Hops = field(default_factory=lambda: Hops.of([]))
    evidence_ms: float = np.nan  # CPU time a scan that these took; NaN if not measured
    # (k, 3): of each stretch that is driven, the first scan, the first one that counts, and the one
    # after the last. The scans before the one that counts are warm-up.
    # By default, there is one: the whole recording.
    stretches: NDArray[np.intp] = field(default_factory=lambda: np.empty((0, 3), np.intp))

    def __post_init__(self) -> None:
        if not len(self.stretches):
            object.__setattr__(self, "stretches", np.array([[0, 0, len(self.stamps)]]))

    @property
    def uncut(self) -> "Frames":
        """The same with a single stretch, the whole recording."""
        return replace(self, stretches=self.stretches[:0])

    @property
    def n_driven(self) -> int:
        """Scans of all stretches, warm-up included."""
        return int((self.stretches[:, 2] - self.stretches[:, 0]).sum())

    @property
    def counted(self) -> Poses:
        """The reference where scans count, of shape (n, 4, 4); NaN elsewhere."""
        T_ref_sensor = np.full_like(self.T_ref_sensor, np.nan)
        for _, begin, end in self.stretches:
            T_ref_sensor[begin:end] = self.T_ref_sensor[begin:end]
        return T_ref_sensor


@dataclass(frozen=True, eq=False)
class Trial:
    """The drives of one parameter set on one sequence."""

    parameters: ParameterSet
    # (n, 4, 4): NaN where nothing is driven; of the first of several repeats
    T_odom_sensor: Poses
    # (n,): sub-trajectory RTE in percent; NaN without a sub-trajectory, infinite without poses. Of
    # several repeats, the mean of the capped errors.
    errors: NDArray[np.float64]
    # (n,): where the health check restarted it; of several repeats, how often in the mean
    restarted: NDArray[np.floating] | NDArray[np.bool_]
    # (n,): False where the scan had too few points, or the odometry gave no pose.
    registered: NDArray[np.bool_]
    # (n,): computing time of the odometry for each scan, without preparing it.
    # NaN where it begins, and where nothing is driven.
    seconds: NDArray[np.float64]
    # Reasons why the odometry's process ended or gave no pose, each with its last output.
    faults: tuple[str, ...] = ()
    # Of the whole trajectory by name, see `offline.objective`.
    metrics: dict[str, float] = field(default_factory=dict)
    # CPU time and memory, which differ from run to run: percent of a core, megabytes, and
    # milliseconds of CPU time a scan to register (`REGISTER_MS`) and prepare it (`PREPARE_MS`).
    usage: dict[str, float] = field(default_factory=dict)
    # RTE and metrics of every run, if the trial was run several times.
    repeats: tuple[dict[str, float], ...] = ()
    # Faults that the health check found, and how often, see
    # `adaptune.odometry.health.Guard.check`. Of several repeats, the first one with the most
    # scans without a pose.
    unhealthy: dict[str, int] = field(default_factory=dict)
    failure: str = ""  # why the set is never chosen; empty if it may be
    source: str = ""  # what proposed the set, see `offline.samplers.Proposal`

    @property
    def mean_error(self) -> float:
        """Mean capped error in percent over the frames with a sub-trajectory.

        It is the cap where no error is known, because the odometry gave no poses.
        """
        known = self.errors[~np.isnan(self.errors)]
        return float(cap(known).mean()) if len(known) else FAILURE


@dataclass(frozen=True)
class Summary:
    """The part of a finished trial that stays in memory."""

    parameters: ParameterSet
    mean_error: float  # see `Trial.mean_error`
    restarts: float  # how often the health check restarted the odometry
    faults: int  # how often its process ended or gave no pose
    ms: float  # milliseconds of the odometry for a scan
    others: dict[str, float] = field(default_factory=dict)  # other metrics by name
    repeats: Sequence[dict[str, float]] = ()  # see `Trial`
    unhealthy: dict[str, int] = field(default_factory=dict)  # see `Trial`
    failure: str = ""  # see `Trial`
    source: str = ""  # see `Trial`
    limits: str = ""  # digest of those of its processes

    @property
    def cost(self) -> float:
        """Milliseconds of CPU time a scan, with preparation; NaN if unknown."""
        return self.others.get(REGISTER_MS, np.nan) + self.others.get(PREPARE_MS, np.nan)

    @property
    def metrics(self) -> dict[str, float]:
        """All metrics of the trial, see `offline.objective`."""
        return {"rte": self.mean_error, "ms_per_scan": self.ms} | self.others


def summarise(trial: Trial) -> Summary:
    """Summarise a trial. The summary is the same before writing and after reading it."""
    errors = trial.errors.astype(np.float32).astype(np.float64)
    seconds = trial.seconds[~np.isnan(trial.seconds)].astype(np.float32)
    return Summary(
        trial.parameters,
        replace(trial, errors=errors).mean_error,
        float(trial.restarted.sum()),
        len(trial.faults),
        float(1e3 * seconds.mean(dtype=np.float64)) if len(seconds) else 0.0,
        trial.metrics | trial.usage,
        list(trial.repeats),
        trial.unhealthy,
        trial.failure,
        trial.source,
    )


class Sources(NamedTuple):
    """What the trials of a study depend on."""

    names: Sequence[str]  # of the sequences that are driven
    shared: manifest.Inputs  # on every sequence
    of_sequence: Callable[[str], manifest.Inputs]
    # The files that digests in these are of, see `manifest.changes`.
    files: Callable[[str], Mapping[str, Sequence[Path]]]

    def inputs(self, sequence: str) -> dict[str, Any]:
        """All that trials on a sequence depend on."""
        return dict(manifest.plain({**self.shared, **self.of_sequence(sequence)}))

    def statuses(self, sequence: str) -> dict[Path, str]:
        """By file of a sequence, what shows that it is the same as before."""
        return {file: status_key(file) for of in self.files(sequence).values() for file in of}


def _of_poses(inputs: manifest.Inputs) -> dict[str, Any]:
    """What poses depend on: descriptors are of scans, and limits end a drive as a fault."""
    return {key: value for key, value in inputs.items() if key not in ("descriptors", "limits")}


_ARRAYS, _SINGLE = ("T_odom_sensor", "restarted", "registered"), ("errors", "seconds")
_PLAIN = ("parameters", "faults", "metrics", "usage", "repeats", "unhealthy", "failure", "source")
"""Parts of a trial that are stored as they are, in single precision, and as JSON."""
_SUMMARY = "summary"
"""Stored beside them, so that the others need not be read."""
_TRIAL = re.compile(r"\d{5,}\.npz")


CURRENT = "current.json"
"""By sequence, the name of the folder that was used last."""


class Archive:
    """The trials of a study, a file for each trial and sequence.

    It holds ``<sequence>-<digest>/frames.npz`` and ``<sequence>-<digest>/<number>.npz``. The digest
    is of all that poses depend on: what differs is in another folder, and what is there counts
    again. All methods raise an ArchiveError where a file that they need is missing or damaged.

    Parameters
    ----------
    folder
        Need not exist.
    sources
        What trials depend on; recorded beside the first of a sequence that is written. Without, it
        is what was used last.
    """

    def __init__(self, folder: Path, sources: Sources | None = None):
        self.folder = folder
        self._sources = sources
        self._last: dict[str, str] = {}
        with suppress(OSError, ValueError):
            self._last = dict(json.loads((folder / CURRENT).read_text()))
        self._folders: dict[str, Path] = {}
        self._statuses: dict[str, dict[Path, str]] = {}
        self._finished: dict[str, dict[int, Summary]] = {}
        self._known: dict[int, Summary] | None = None
        shared = {} if sources is None else manifest.plain(sources.shared)
        self._limits, self._described = (
            manifest.digest(shared.get(key)) if sources else "" for key in ("limits", "descriptors")
        )

    def of(self, sequence: str) -> Path:
        """The folder of a sequence."""
        if sequence not in self._folders:
            name = self._last.get(sequence, sequence)
            if self._sources is not None:
                self._statuses[sequence] = self._sources.statuses(sequence)
                digest = manifest.digest(_of_poses(self.inputs(sequence)))
                name = f"{sequence}-{digest[: manifest.SHORT]}"
            self._folders[sequence] = self.folder / name
        return self._folders[sequence]

    def _note(self, sequence: str) -> Path:
        """Record what the trials on a sequence depend on, before the first of them is written."""
        folder = self.of(sequence)
        if self._sources is None or (folder / manifest.FILE).exists():
            return folder
        now = self._sources.statuses(sequence)
        if changed := dict(now.items() ^ self._statuses[sequence].items()):
            raise ConfigurationError(
                f"{next(iter(changed))}: has changed while {sequence} was read, and nothing on "
                f"{sequence} is stored; run the same command again"
            )
        self._use(sequence)
        return folder

    def _use(self, sequence: str) -> None:
        """Record what trials on a sequence depend on, and that these are those of now."""
        folder = self.of(sequence)
        self._last[sequence] = folder.name
        write_text(self.folder / CURRENT, json.dumps(self._last, indent=1) + "\n")
        manifest.record(folder / manifest.FILE, self.inputs(sequence))

    def inputs(self, sequence: str) -> dict[str, Any]:
        """All that trials on a sequence depend on now."""
        assert self._sources is not None
        return self._sources.inputs(sequence)

    def begin(self) -> None:
        """Say what has changed since the last run, and use what there is of what is now."""
        assert self._sources is not None
        why: dict[str, None] = {}
        n = 0
        for name in self._sources.names:
            last = self.folder / self._last.get(name, name)
            if (before := manifest.recorded(last / manifest.FILE)) is not None:
                files = self._sources.files(name)
                why |= dict.fromkeys(manifest.changes(before, self.inputs(name), files))
                n += max(0, len(_trials(last)) - len(self.finished(name)))
            if (self.of(name) / manifest.FILE).exists():
                self._use(name)
        if why:
            again = f"{n} trials are run again" if n else "since the last run"
            _log.warning("%s: %s", again, "; ".join(why))

    def trial_path(
        self, sequence: str, number: int, whole: bool = False, bare: bool = False
    ) -> Path:
        """File of a trial, or of its drive along the whole recording, if that is another one.

        A `bare` drive is one of the whole without the health check.
        """
        whole = whole and not bare and not self.is_uncut(sequence)
        return self.of(sequence) / f"{number:05d}{'-whole' * whole}{'-bare' * bare}.npz"

    def tidy(self) -> None:
        """Remove unfinished files. No process may be writing."""
        for unfinished in self.folder.glob("*/.*.npz"):
            unfinished.unlink()

    def finished(self, sequence: str) -> Mapping[int, Summary]:
        """The finished trials on a sequence by number, without the drives of whole recordings.

        It grows as trials are written.
        """
        if sequence not in self._finished:
            sets, runs = self.sets(), self._runs(self.of(sequence))
            same = {
                n: run for n, run in runs.items() if sets.get(n, run.parameters) == run.parameters
            }
            self._finished[sequence] = same
        return self._finished[sequence]

    def known(self) -> dict[int, Summary]:
        """All finished trials, also on sequences that are no more used; of each, on one of them.

        So a number means one set everywhere.
        """
        if self._known is None:
            self._known = {}
            for folder in self._used():
                for number, run in self._runs(folder).items():
                    self._known.setdefault(number, run)
        return self._known

    def sets(self) -> dict[int, ParameterSet]:
        """Their parameter sets."""
        return {number: run.parameters for number, run in self.known().items()}

    def _used(self) -> list[Path]:
        """The folders whose trials count; of sequences that are not driven, what all share does."""
        if self._sources is None:
            return [self.folder / name for name in self._last.values()] or [*self.folder.glob("*/")]
        driven, others = [], []
        for folder in sorted(self.folder.glob("*/")):
            if (name := folder.name.rpartition("-")[0]) in self._sources.names:
                driven += [folder] * (folder == self.of(name))
                continue
            before = manifest.recorded(folder / manifest.FILE) or {}
            now = manifest.plain({**before, **self._sources.shared})
            others += [folder] * (_of_poses(before) == _of_poses(now))
        return driven + others

    def _runs(self, folder: Path) -> dict[int, Summary]:
        runs = {int(path.stem): _read_summary(path) for path in _trials(folder)}
        return {number: run for number, run in runs.items() if self._counts(run)}

    def _counts(self, run: Summary) -> bool:
        """Whether a run does not depend on other limits than now."""
        return not (run.faults and self._limits) or run.limits == self._limits

    def has_frames(self, sequence: str, names: Sequence[str]) -> bool:
        """Whether the data that all trials on a sequence share exists, with these descriptors."""
        try:
            made = _unpacked(_read(self.of(sequence) / "frames.npz", ["made"])["made"])
            return made == self._described and [*self.read_frames(sequence).blocks] == [*names]
        except ArchiveError:
            return False

    def is_uncut(self, sequence: str) -> bool:
        """Whether trials drive the whole recording; False where it is not described yet."""
        path = self.of(sequence) / "frames.npz"
        if not path.exists():
            return False
        data = _read(path, ["stretches", "stamps"])
        (first, _, end), *more = data["stretches"].tolist()
        return not more and end - first == len(data["stamps"])

    def write_frames(self, sequence: str, frames: Frames) -> None:
        """Write the data that all trials on a sequence share."""
        path = self._note(sequence) / "frames.npz"
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
                made=_packed(self._described),
                stamps=frames.stamps,
                T_ref_sensor=frames.T_ref_sensor,
                descriptors=compact(frames.descriptors),
                blocks=_packed(frames.blocks),
                elevations=frames.elevations.astype(np.float32),
                evidence_ms=frames.evidence_ms,
                stretches=frames.stretches,
                **{f"hops_{name}": array for name, array in frames.hops._asdict().items()},
            )

    def read_frames(self, sequence: str) -> Frames:
        """Read the data that all trials on a sequence share."""
        path = self.of(sequence) / "frames.npz"
        data = _read(path)
        try:
            return Frames(
                data["stamps"],
                data["T_ref_sensor"],
                data["descriptors"].astype(np.float32),
                dict(_unpacked(data["blocks"])),
                data["elevations"],
                Hops(*(data[f"hops_{name}"] for name in Hops._fields)),
                float(data["evidence_ms"]),
                data["stretches"].astype(np.intp),
            )
        except (KeyError, ValueError, TypeError) as error:
            raise _damaged(path, error) from error

    def write(
        self, sequence: str, number: int, trial: Trial, whole: bool = False, bare: bool = False
    ) -> None:
        """Write a trial, or another drive, see `trial_path`."""
        self._note(sequence)
        path = self.trial_path(sequence, number, whole, bare)
        data = {name: getattr(trial, name) for name in _ARRAYS}
        data |= {name: getattr(trial, name).astype(np.float32) for name in _SINGLE}
        data |= {name: _packed(getattr(trial, name)) for name in _PLAIN}
        summary = replace(summarise(trial), limits=self._limits)
        data[_SUMMARY] = _packed(asdict(summary))
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **data)
        if path == self.trial_path(sequence, number):
            self.known().setdefault(number, summary)
            self.finished(sequence)
            self._finished[sequence][number] = summary

    def read(self, sequence: str, number: int, whole: bool = False, bare: bool = False) -> Trial:
        """Read a trial, or another drive, see `trial_path`."""
        return _read_trial(self.trial_path(sequence, number, whole, bare))

    def summary(
        self, sequence: str, number: int, whole: bool = False, bare: bool = False
    ) -> Summary:
        """Read the summary of a trial, or of another drive, see `trial_path`."""
        path = self.trial_path(sequence, number, whole, bare)
        if not self._counts(found := _read_summary(path)):
            raise ArchiveError(f"{path}: had a fault with other limits; run `adaptune offline`")
        return found

    def read_errors(self, sequence: str, numbers: Sequence[int]) -> NDArray[np.float32]:
        """Errors of several trials on a sequence, of shape (n_frames, n_trials).

        Errors of a trial that was not run on it are NaN.
        """
        read: NDArray[np.float32] | None = None
        for i, number in enumerate(numbers):
            if number not in self.finished(sequence):
                continue
            path = self.trial_path(sequence, number)
            # Arrays are loaded one by one. Poses, most of the file, are not needed.
            errors = _read(path, ["errors"])["errors"]
            if read is None:
                read = np.full((len(errors), len(numbers)), np.nan, np.float32)
            if len(errors) != len(read):
                what = "trials are of recordings of different lengths; remove the folder"
                raise ArchiveError(f"{self.of(sequence)}: {what} and run again")
            read[:, i] = errors
        return np.empty((0, 0), np.float32) if read is None else read

    def errors_of(self, sequence: str, sets: ParameterSets) -> dict[int, NDArray[np.float32]]:
        """By number, the errors (n_frames,) of those of some sets that were run on a sequence."""
        runs = self.finished(sequence)
        known = [n for n in sets if n in runs and runs[n].parameters == sets[n]]
        return dict(zip(known, self.read_errors(sequence, known).T, strict=True))


def compact(descriptors: NDArray[np.float32]) -> NDArray[Any]:
    """Descriptors for a file. Counts become whole numbers, which take less room."""
    with np.errstate(invalid="ignore"):
        counts = descriptors.astype(np.uint16)
    return counts if (counts == descriptors).all() else descriptors


def _packed(value: Any) -> NDArray[np.uint8]:
    """Plain data for a file, as the bytes of its JSON."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


def _unpacked(array: NDArray[np.uint8]) -> Any:
    return json.loads(array.tobytes())


def _damaged(path: Path, error: Exception) -> ArchiveError:
    # NumPy says how to load such a file unsafely.
    why = "it does not hold NumPy's numbers" if "pickle" in str(error) else error
    return ArchiveError(f"{path}: is damaged ({why}); remove it and run again")


def _read_trial(path: Path) -> Trial:
    data = _read(path)
    try:
        parts: dict[str, Any] = {name: data[name] for name in _ARRAYS}
        parts |= {name: data[name].astype(np.float64) for name in _SINGLE}
        parts |= {name: _unpacked(data[name]) for name in _PLAIN}
        parts |= {name: tuple(parts[name]) for name in ("faults", "repeats")}
        return Trial(**parts)
    except (KeyError, ValueError) as error:
        raise _damaged(path, error) from error


def _read_summary(path: Path) -> Summary:
    try:
        return Summary(**_unpacked(_read(path, [_SUMMARY])[_SUMMARY]))
    except (TypeError, ValueError) as error:
        raise _damaged(path, error) from error


def _trials(folder: Path) -> list[Path]:
    """The files of trials, in the order of their numbers."""
    paths = [path for path in folder.glob("*.npz") if _TRIAL.fullmatch(path.name)]
    return sorted(paths, key=lambda path: int(path.stem))


def _read(path: Path, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    """The named arrays of a file, or all."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names or file}
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: there is no such file; run `adaptune offline`") from error
    except (KeyError, *DAMAGED_NPZ) as error:
        raise _damaged(path, error) from error
