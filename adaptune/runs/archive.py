"""Trials on disk: parameters, poses, and the error at every frame."""

import json
import logging
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from adaptune._system import manifest
from adaptune._system.files import DAMAGED_NPZ, replacing, write_text
from adaptune._system.strict import ConfigurationError
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.live.hops import Hops
from adaptune.metrics import FAILURE, cap
from adaptune.model.descriptor import compact
from adaptune.recording.cache import status_key
from adaptune.space import ParameterSet, ParameterSets

# In `TrialSummary.others`; the last one in seconds, where the first scan has no pose.
REGISTER_MS, PREPARE_MS, FIRST_POSE = "register_ms", "prepare_ms", "first_pose"
T = TypeVar("T")
Kind = Literal["", "whole", "bare"]
"""Of a drive: a trial's, which may be of segments; of the whole recording; of the whole without
the health check."""
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
    evidence_ms: float = np.nan  # CPU time a scan that live evidence takes; NaN if not measured
    # (k, 3): of each segment that is driven, the first scan, the first one that counts, and the one
    # after the last. The scans before the one that counts are warm-up.
    # By default, there is one: the whole recording.
    segments: NDArray[np.intp] = field(default_factory=lambda: np.empty((0, 3), np.intp))

    def __post_init__(self) -> None:
        if not len(self.segments):
            object.__setattr__(self, "segments", np.array([[0, 0, len(self.stamps)]]))

    @property
    def uncut(self) -> "Frames":
        """The same with a single segment, the whole recording."""
        return replace(self, segments=self.segments[:0])

    @property
    def n_driven(self) -> int:
        """Scans of all segments, warm-up included."""
        return int((self.segments[:, 2] - self.segments[:, 0]).sum())

    @property
    def counted(self) -> Poses:
        """The reference where scans count, of shape (n, 4, 4); NaN elsewhere."""
        T_ref_sensor = np.full_like(self.T_ref_sensor, np.nan)
        for _, begin, end in self.segments:
            T_ref_sensor[begin:end] = self.T_ref_sensor[begin:end]
        return T_ref_sensor


@dataclass(frozen=True)
class TrialSummary:
    """The part of a finished trial that stays in memory."""

    parameters: ParameterSet
    # Mean clipped error in percent over the frames with a sub-trajectory. It is the cap where no
    # error is known, because the odometry gave no poses.
    mean_error: float
    restarts: float  # how often the health check restarted the odometry
    faults: int  # how often its process ended or gave no pose
    ms: float  # milliseconds of the odometry for a scan
    # Metrics of the whole trajectory by name, see `offline.objective`; CPU time and memory, which
    # differ from run to run: percent of a core, megabytes, and milliseconds of CPU time a scan to
    # register (`REGISTER_MS`) and prepare it (`PREPARE_MS`); seconds (`FIRST_POSE`).
    others: dict[str, float] = field(default_factory=dict)
    # RTE and metrics of every run, if the trial was run several times.
    repeats: Sequence[dict[str, float]] = ()
    failure: str = ""  # why the set is never chosen; empty if it may be
    source: str = ""  # what proposed the set, see `offline.samplers.Proposal`
    limits: str = ""  # digest of those of its processes

    @property
    def cost(self) -> float:
        """Milliseconds of CPU time a scan, with preparation; NaN if unknown."""
        return self.others.get(REGISTER_MS, np.nan) + self.others.get(PREPARE_MS, np.nan)

    @property
    def metrics(self) -> dict[str, float]:
        """All metrics of the trial, see `offline.objective`."""
        return {"rte": self.mean_error, "ms_per_scan": self.ms} | self.others


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial(TrialSummary):
    """The runs of one parameter set on one sequence."""

    # (n, 4, 4): NaN where nothing is driven; of the first of several repeats
    T_odom_sensor: Poses
    # (n,): sub-trajectory RTE in percent; NaN without a sub-trajectory, infinite without poses. Of
    # several repeats, the mean of the clipped errors.
    errors: NDArray[np.float64]
    # (n,): where the health check restarted it; of several repeats, how often in the mean
    restarted: NDArray[np.floating] | NDArray[np.bool_]
    # Why the odometry's process ended or gave no pose, each with its last output.
    reasons: tuple[str, ...] = ()

    __eq__, __hash__ = object.__eq__, object.__hash__  # trials have arrays

    @classmethod
    def of(
        cls,
        parameters: ParameterSet,
        T_odom_sensor: Poses,
        errors: NDArray[np.float64],
        restarted: NDArray[np.floating] | NDArray[np.bool_],
        ms: float,
        reasons: Sequence[str] = (),
        **others: Any,
    ) -> Self:
        """Sum up a trial. `others` are further parts of its summary."""
        # As they are read back, so that the summary is the same then.
        known = errors[~np.isnan(errors)].astype(np.float32)
        return cls(
            parameters=parameters,
            mean_error=float(cap(known).mean()) if len(known) else FAILURE,
            restarts=float(restarted.sum()),
            faults=len(reasons),
            ms=ms,
            T_odom_sensor=T_odom_sensor,
            errors=errors,
            restarted=restarted,
            reasons=tuple(reasons),
            **others,
        )

    @property
    def summary(self) -> TrialSummary:
        """What stays in memory."""
        return TrialSummary(**{one.name: getattr(self, one.name) for one in fields(TrialSummary)})


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


_ARRAYS = "T_odom_sensor", "restarted", "errors"
"""Parts of a trial that are stored as they are; errors are stored in single precision."""
_SUMMARY, _REASONS = "summary", "faults"
"""Stored beside them as JSON, the first one so that the others need not be read."""
_TRIAL = re.compile(r"\d{5,}\.npz")


CURRENT = "current.json"
"""By sequence, the name of the folder that was used last."""
NAMED_BY_DIGEST = f"-{'[0-9a-f]' * manifest.SHORT}"
"""How the names of the folders of sequences end."""


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
        self._finished: dict[str, dict[int, TrialSummary]] = {}
        self._known: dict[int, TrialSummary] | None = None
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

    def _record_inputs(self, sequence: str) -> Path:
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
            if (before := self._recorded(last, name)) is not None:
                files = self._sources.files(name)
                why |= dict.fromkeys(manifest.changes(before, self.inputs(name), files))
                n += max(0, len(_trials(last)) - len(self.finished(name)))
            if self.of(name).exists():
                self._use(name)
        if why:
            again = f"{n} trials are run again" if n else "since the last run"
            _log.warning("%s: %s", again, "; ".join(why))

    def _recorded(self, folder: Path, sequence: str) -> dict[str, Any] | None:
        """What trials depend on; None where that is damaged, and its folder is named by what is."""
        try:
            return manifest.recorded(folder / manifest.FILE)
        except ConfigurationError:
            if folder != self.of(sequence):
                raise
            return None

    def changes(self) -> list[str]:
        """In what the study differs from that of the last trials, in words, recordings apart."""
        assert self._sources is not None
        for name in filter(self._last.get, self._sources.names):
            if before := self._recorded(self.folder / self._last[name], name):
                before = _of_poses(before)
                return manifest.changes(before, before | _of_poses(self._sources.shared))
        return []

    def trial_path(self, sequence: str, number: int, kind: Kind = "") -> Path:
        """File of a trial, or of another drive of its set, if that is another one."""
        same = not kind or (kind == "whole" and self.is_uncut(sequence))
        return self.of(sequence) / f"{number:05d}{'' if same else f'-{kind}'}.npz"

    def tidy(self) -> None:
        """Remove unfinished files. No process may be writing."""
        for unfinished in self.folder.glob("*/.*.npz"):
            unfinished.unlink()

    def finished(self, sequence: str) -> Mapping[int, TrialSummary]:
        """The finished trials on a sequence by number, without the drives of whole recordings.

        It grows as trials are written.
        """
        if sequence not in self._finished:
            sets, trials = self.sets(), self._summaries(self.of(sequence))
            same = {
                n: one for n, one in trials.items() if sets.get(n, one.parameters) == one.parameters
            }
            self._finished[sequence] = same
        return self._finished[sequence]

    def known(self) -> dict[int, TrialSummary]:
        """All finished trials, also on sequences that are no more used; of each, on one of them.

        So a number means one set everywhere.
        """
        if self._known is None:
            self._known = {}
            for folder in self._used():
                for number, trial in self._summaries(folder).items():
                    self._known.setdefault(number, trial)
        return self._known

    def sets(self) -> dict[int, ParameterSet]:
        """Their parameter sets."""
        return {number: trial.parameters for number, trial in self.known().items()}

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

    def _summaries(self, folder: Path) -> dict[int, TrialSummary]:
        trials = {int(path.stem): _summary_of(path) for path in _trials(folder)}
        return {number: trial for number, trial in trials.items() if self._counts(trial)}

    def _counts(self, trial: TrialSummary) -> bool:
        """Whether a trial does not depend on other limits than now."""
        return not (trial.faults and self._limits) or trial.limits == self._limits

    def has_frames(self, sequence: str, names: Sequence[str]) -> bool:
        """Whether the data that all trials on a sequence share exists, with these descriptors."""
        try:
            made = _read(self.of(sequence) / "frames.npz", dict, "made")["made"]
            return made == self._described and [*self.read_frames(sequence).blocks] == [*names]
        except ArchiveError:
            return False

    def is_uncut(self, sequence: str) -> bool:
        """Whether trials drive the whole recording; False where it is not described yet."""
        path = self.of(sequence) / "frames.npz"
        if not path.exists():
            return False
        data = _read(path, dict, "segments", "stamps")
        (first, _, end), *more = data["segments"].tolist()
        return not more and end - first == len(data["stamps"])

    def write_frames(self, sequence: str, frames: Frames) -> None:
        """Write the data that all trials on a sequence share."""
        path = self._record_inputs(sequence) / "frames.npz"
        hops = {f"hops_{name}": array for name, array in frames.hops._asdict().items()}
        parts = vars(frames) | hops | {"made": self._described}
        parts |= {"descriptors": compact(frames.descriptors)}
        parts |= {"elevations": frames.elevations.astype(np.float32)}
        del parts["hops"]
        _write(path, parts, np.savez_compressed)

    def read_frames(self, sequence: str) -> Frames:
        """Read the data that all trials on a sequence share."""
        return _read(self.of(sequence) / "frames.npz", _frames_of)

    def write(self, sequence: str, number: int, trial: Trial, kind: Kind = "") -> None:
        """Write a trial, or another drive."""
        self._record_inputs(sequence)
        path = self.trial_path(sequence, number, kind)
        summary = replace(trial.summary, limits=self._limits)
        arrays = {name: getattr(trial, name) for name in _ARRAYS}
        arrays["errors"] = trial.errors.astype(np.float32)
        _write(path, arrays | {_SUMMARY: asdict(summary), _REASONS: trial.reasons}, np.savez)
        if path == self.trial_path(sequence, number):
            self.known().setdefault(number, summary)
            self.finished(sequence)
            self._finished[sequence][number] = summary

    def read(self, sequence: str, number: int, kind: Kind = "") -> Trial:
        """Read a trial, or another drive."""
        return _read(self.trial_path(sequence, number, kind), _trial_of)

    def summaries(
        self, names: Iterable[str], numbers: Collection[int], kind: Kind = "whole"
    ) -> dict[str, dict[int, TrialSummary]]:
        """By sequence, the drives that there are of some trials, by number."""
        found: dict[str, dict[int, TrialSummary]] = {name: {} for name in names}
        for name, of in found.items():
            for number in numbers:
                with suppress(ArchiveError):
                    of[number] = self.summary(name, number, kind)
        return found

    def summary(self, sequence: str, number: int, kind: Kind = "") -> TrialSummary:
        """Read the summary of a trial, or of another drive."""
        path = self.trial_path(sequence, number, kind)
        if not self._counts(found := _summary_of(path)):
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
            errors = _read(path, dict, "errors")["errors"]
            if read is None:
                read = np.full((len(errors), len(numbers)), np.nan, np.float32)
            if len(errors) != len(read):
                what = "trials are of recordings of different lengths; remove the folder"
                raise ArchiveError(f"{self.of(sequence)}: {what} and run again")
            read[:, i] = errors
        return np.empty((0, 0), np.float32) if read is None else read

    def errors_of(self, sequence: str, sets: ParameterSets) -> dict[int, NDArray[np.float32]]:
        """By number, the errors (n_frames,) of those of some sets that were run on a sequence."""
        trials = self.finished(sequence)
        known = [n for n in sets if n in trials and trials[n].parameters == sets[n]]
        return dict(zip(known, self.read_errors(sequence, known).T, strict=True))


def _frames_of(parts: dict[str, Any]) -> Frames:
    hops = Hops(*(parts.pop(f"hops_{name}") for name in Hops._fields))
    descriptors, segments = parts["descriptors"].astype(np.float32), parts["segments"]
    about = {"descriptors": descriptors, "segments": segments.astype(np.intp), "hops": hops}
    del parts["made"]
    return Frames(**parts | about | {"evidence_ms": float(parts["evidence_ms"])})


def _trial_of(parts: dict[str, Any]) -> Trial:
    arrays = {name: parts[name] for name in _ARRAYS}
    arrays["errors"] = parts["errors"].astype(np.float64)
    return Trial(**_figures(parts), **arrays, reasons=tuple(parts[_REASONS]))


def _summary_of(path: Path) -> TrialSummary:
    return _read(path, lambda parts: TrialSummary(**_figures(parts)), _SUMMARY)


def _figures(parts: Mapping[str, Any]) -> dict[str, Any]:
    """The stored summary, without what an older adaptune kept and nothing reads."""
    stored = {**parts[_SUMMARY]}
    stored.pop("unhealthy", None)
    return stored


def _trials(folder: Path) -> list[Path]:
    """The files of trials, in the order of their numbers."""
    paths = [path for path in folder.glob("*.npz") if _TRIAL.fullmatch(path.name)]
    return sorted(paths, key=lambda path: int(path.stem))


def _write(path: Path, parts: Mapping[str, Any], save: Callable[..., None]) -> None:
    """Write arrays and numbers as they are, and all else as the bytes of its JSON."""
    arrays = {
        name: part
        if isinstance(part, np.ndarray | float)
        else np.frombuffer(json.dumps(part).encode(), np.uint8)
        for name, part in parts.items()
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        save(file, **arrays)


def _read(path: Path, make: Callable[[dict[str, Any]], T], *names: str) -> T:
    """What is made of the named parts of a file, or of all."""
    try:
        with np.load(path, allow_pickle=False) as file:
            parts = {name: file[name] for name in names or file}
        packed = [name for name, part in parts.items() if part.dtype == np.uint8]
        return make(parts | {name: json.loads(parts[name].tobytes()) for name in packed})
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: there is no such file; run `adaptune offline`") from error
    except (KeyError, *DAMAGED_NPZ) as error:
        # NumPy says how to load such a file unsafely.
        why = "it does not hold NumPy's numbers" if "pickle" in str(error) else error
        raise ArchiveError(f"{path}: is damaged ({why}); remove it and run again") from error
