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
from adaptune.files import DAMAGED_NPZ, replacing
from adaptune.geometry import Poses
from adaptune.live.hops import Hops
from adaptune.metrics import FAILURE, cap
from adaptune.recording.cache import status_key
from adaptune.space import ParameterSet
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


_ARRAYS, _SINGLE = ("T_odom_sensor", "restarted", "registered"), ("errors", "seconds")
_PLAIN = ("parameters", "faults", "metrics", "usage", "repeats", "unhealthy", "failure", "source")
"""Parts of a trial that are stored as they are, in single precision, and as JSON."""
_SUMMARY = "summary"
"""Stored beside them, so that the others need not be read."""
_TRIAL = re.compile(r"\d{5,}\.npz")


class Archive:
    """The trials of a study, a file for each trial and sequence.

    Its folder holds ``<sequence>/frames.npz`` and ``<sequence>/<number>.npz``. All methods raise
    an ArchiveError where a file that they need is missing or damaged.

    Parameters
    ----------
    folder
        Need not exist.
    sources
        What trials depend on; recorded beside the first of a sequence that is written.
    """

    def __init__(self, folder: Path, sources: Sources | None = None):
        self.folder = folder
        self._sources = sources
        self._statuses: dict[str, dict[Path, str]] = {}
        self._finished: dict[str, dict[int, Summary]] | None = None

    def _note(self, sequence: str) -> None:
        """Record what the trials on a sequence depend on, before the first of them is written."""
        path = self.folder / sequence / manifest.FILE
        if self._sources is None or path.exists():
            return
        now = self._sources.statuses(sequence)
        if changed := dict(now.items() ^ self._statuses.get(sequence, now).items()):
            raise ConfigurationError(
                f"{next(iter(changed))}: has changed while {sequence} was read, and nothing on "
                f"{sequence} is stored; run the same command again"
            )
        manifest.record(path, self._sources.inputs(sequence))

    def inputs(self, sequence: str) -> dict[str, Any]:
        """All that trials on a sequence depend on now."""
        assert self._sources is not None
        return self._sources.inputs(sequence)

    def changes(self, sequence: str) -> list[str]:
        """In what this differs from what the stored trials depend on, in words."""
        assert self._sources is not None
        before = manifest.recorded(self.folder / sequence / manifest.FILE)
        return manifest.changes(before, self.inputs(sequence), self._sources.files(sequence))

    def renew(self, sequences: Sequence[str]) -> bool:
        """Set aside what was computed from other inputs than there are now, and say why.

        Earlier results of these inputs count again. Of trials on other sequences than these, only
        what all share is compared. Returns whether trials were moved.
        """
        assert self._sources is not None
        self._statuses = {name: self._sources.statuses(name) for name in sequences}
        moved: list[Path] = []
        why: dict[str, None] = {}
        for folder in sorted(self.folder.glob("*/")):
            name = folder.name
            files: Mapping[str, Sequence[Path]] = {}
            before = manifest.recorded(folder / manifest.FILE)
            now = {**(before or {}), **self._sources.shared}
            if name in sequences:
                now, files = self._sources.inputs(name), self._sources.files(name)
            if outdated := self._outdated(name, before, now):
                why |= dict.fromkeys(manifest.changes(before, now, files))
                moved += outdated
        if moved:
            n = sum(_TRIAL.fullmatch(file.name) is not None for file in moved)
            what = f"{n} trials are run" if n else f"{len(moved)} sequences are described"
            _log.warning("%s again: %s", what, "; ".join(why))
        self._finished = None
        back = [file for name in sequences for file in self._bring_back(name)]
        return any(_TRIAL.fullmatch(file.name) for file in [*moved, *back])

    def _outdated(
        self, name: str, before: manifest.Inputs | None, now: manifest.Inputs
    ) -> list[Path]:
        """Set aside the files of a sequence that depend on what has changed."""
        folder, study = self.folder / name, self.folder.parent
        differing = {key.partition(".")[0] for key, *_ in manifest.differences(before or {}, now)}
        if not differing:
            return []
        partly = before is not None and differing <= {"descriptors", "limits"}
        files = [] if partly else sorted(folder.glob("*.npz"))
        if partly and "descriptors" in differing:
            files += folder.glob("frames.npz")
        if partly and "limits" in differing:
            # A limit may have ended a drive of the whole recording alone.
            faulty = {n for n, run in self.finished(name).items() if run.faults}
            drives = [file for file in folder.glob("[0-9]*-*.npz") if _read_trial(file).faults]
            faulty |= {int(file.name.partition("-")[0]) for file in drives}
            files += (file for n in faulty for file in folder.glob(f"{n:05d}*.npz"))
        manifest.set_aside(study, folder, before, files)
        # The record changes last: until then, it is known what these depend on.
        if partly:
            manifest.record(folder / manifest.FILE, now)
        else:
            (folder / manifest.FILE).unlink(missing_ok=True)
        return [folder / file.name for file in files]

    def _bring_back(self, name: str) -> list[Path]:
        """Let earlier results of the same inputs count again, unless numbers now mean others."""
        assert self._sources is not None
        study, folder = self.folder.parent, self.folder / name
        if not (study / manifest.EARLIER).exists():
            return []
        now = self._sources.inputs(name)
        sets = Archive(manifest.earlier(study, folder, now).parent).finished(name)
        own = self.sets()
        if any(own.get(number, run.parameters) != run.parameters for number, run in sets.items()):
            return []
        files = manifest.bring_back(study, folder, now)
        if files:
            _log.info("%s: %d earlier results count again", name, len(files))
        self._finished = None
        return files

    def trial_path(
        self, sequence: str, number: int, whole: bool = False, bare: bool = False
    ) -> Path:
        """File of a trial, or of its drive along the whole recording, if that is another one.

        A `bare` drive is one of the whole without the health check.
        """
        whole = whole and not bare and not self.is_uncut(sequence)
        return self.folder / sequence / f"{number:05d}{'-whole' * whole}{'-bare' * bare}.npz"

    def tidy(self) -> None:
        """Remove unfinished files. No process may be writing."""
        for unfinished in self.folder.glob("*/.*.npz"):
            unfinished.unlink()

    def finished(self, sequence: str) -> Mapping[int, Summary]:
        """The finished trials on a sequence by number, without the drives of whole recordings.

        It grows as trials are written.
        """
        return self._all().setdefault(sequence, {})

    def _all(self) -> dict[str, dict[int, Summary]]:
        if self._finished is None:
            self._finished = {}
            paths = [path for path in self.folder.glob("*/*") if _TRIAL.fullmatch(path.name)]
            for path in sorted(paths, key=lambda path: (path.parent, int(path.stem))):
                of_sequence = self._finished.setdefault(path.parent.name, {})
                of_sequence[int(path.stem)] = _read_summary(path)
        return self._finished

    def known(self) -> dict[int, Summary]:
        """All finished trials, also on sequences that are no more used; of each, on one of them."""
        return {number: run for trials in self._all().values() for number, run in trials.items()}

    def sets(self) -> dict[int, ParameterSet]:
        """Their parameter sets."""
        return {number: run.parameters for number, run in self.known().items()}

    def has_frames(self, sequence: str, names: Sequence[str]) -> bool:
        """Whether the data that all trials on a sequence share exists, with these descriptors."""
        try:
            return list(self.read_frames(sequence).blocks) == list(names)
        except ArchiveError:
            return False

    def is_uncut(self, sequence: str) -> bool:
        """Whether trials drive the whole recording; False where it is not described yet."""
        path = self.folder / sequence / "frames.npz"
        if not path.exists():
            return False
        data = _read(path, ["stretches", "stamps"])
        (first, _, end), *more = data["stretches"].tolist()
        return not more and end - first == len(data["stamps"])

    def write_frames(self, sequence: str, frames: Frames) -> None:
        """Write the data that all trials on a sequence share."""
        self._note(sequence)
        path = self.folder / sequence / "frames.npz"
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
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
        path = self.folder / sequence / "frames.npz"
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
        data[_SUMMARY] = _packed(asdict(summary := summarise(trial)))
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **data)
        if path == self.trial_path(sequence, number) and self._finished is not None:
            self._finished.setdefault(sequence, {})[number] = summary

    def read(self, sequence: str, number: int, whole: bool = False, bare: bool = False) -> Trial:
        """Read a trial, or another drive, see `trial_path`."""
        return _read_trial(self.trial_path(sequence, number, whole, bare))

    def summary(
        self, sequence: str, number: int, whole: bool = False, bare: bool = False
    ) -> Summary:
        """Read the summary of a trial, or of another drive, see `trial_path`."""
        return _read_summary(self.trial_path(sequence, number, whole, bare))

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
                raise ArchiveError(f"{self.folder / sequence}: {what} and run again")
            read[:, i] = errors
        return np.empty((0, 0), np.float32) if read is None else read


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
    with suppress(ArchiveError):
        return Summary(**_unpacked(_read(path, [_SUMMARY])[_SUMMARY]))
    return summarise(_read_trial(path))  # it is of an earlier version, or damaged


def _read(path: Path, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    """The named arrays of a file, or all."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names or file}
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: there is no such file; run `adaptune offline`") from error
    except (KeyError, *DAMAGED_NPZ) as error:
        raise _damaged(path, error) from error
