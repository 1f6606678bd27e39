"""A study: a checked configuration, and what is made of it."""

import contextlib
import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any, Generic, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypeVar

from adaptune import manifest, yaml12
from adaptune.archive import Archive, Sources
from adaptune.errors import AdaptuneError, OdometryError
from adaptune.files import locked, write_text
from adaptune.machine import available
from adaptune.manifest import merged
from adaptune.model import ErrorModel
from adaptune.model.descriptor import descriptor_content
from adaptune.model.registry import ADAPTIVE
from adaptune.odometry.base import Description, OwnFile
from adaptune.odometry.program import ProgramInput, program_input
from adaptune.odometry.registry import Factory, OdometryFactory, OdometryPool, declare
from adaptune.recording.cache import fingerprints
from adaptune.recording.changed import with_imu
from adaptune.recording.config import REFERENCE_FILES, SOURCES, SequenceConfig
from adaptune.recording.export import Layout
from adaptune.recording.parts import part_name
from adaptune.recording.recording import (
    SequenceFiles,
    open_sequence,
    sequence_files,
    wants_estimate,
)
from adaptune.recording.scan import Recording
from adaptune.reference.stored import BREAK, EstimateError, StoredEstimate
from adaptune.simulation.course import Course
from adaptune.space import ODOMETRY, ParameterSet, ParameterSpace
from adaptune.strict import ConfigurationError
from adaptune.study.config import (
    OdometryConfig,
    OnlineConfig,
    StudyConfig,
    SwitchingConfig,
)

_READER = 2
"""Changes where the same files give other scans or poses than before."""

# The sequences of a study by name: recordings and simulated courses.


_OF_POSES = ("reference", "child_frame", "extrinsic", "clock_offset", "max_gap")
"""Keys of a sequence that change its reference only."""
_AS_ESTIMATED = {
    **{key: SequenceConfig.model_fields[key].default for key in _OF_POSES},
    # A gap as long says where the estimate is not to be trusted.
    "max_gap": BREAK,
}
"""Values of these keys where the poses are the LiDAR's own, estimated at its scans."""

_inputs: dict[tuple[str, str], ProgramInput] = {}
"""What programs read, by folder and everything that it depends on."""


@dataclass(frozen=True)
class StudySequences:
    """Opens the sequences of a study by name, in any process."""

    recordings: Mapping[str, SequenceConfig]
    courses: Mapping[str, Course]
    # The study's folder: it keeps recorded courses, estimated references and what programs read.
    folder: Path
    with_imu: bool = False  # whether scans bring along the IMU's measurements
    layout: Layout = "bag"  # the format that a program reads

    def recording(self, course: str) -> Path:
        """The bag of a simulated course; the parts of a course share it."""
        return self.folder / "recordings" / f"{self.courses[course].of or course}.bag"

    def config(self, name: str) -> SequenceConfig:
        """Configuration of a sequence or a course."""
        config = self.unseen(name)
        if self._is_made(name):
            reference = str(self.estimate_path(name).absolute())
            config = config.model_copy(update=_AS_ESTIMATED | {"reference": reference})
        return config

    def unseen(self, name: str) -> SequenceConfig:
        """Configuration of a sequence, or a course, without an estimate that was made of it."""
        if name in self.recordings:
            return self.recordings[name]
        from adaptune.simulation.course import as_sequence

        return as_sequence(self.courses[name], self.recording(name))

    def estimate_path(self, name: str) -> Path:
        """The TUM file of an estimated reference."""
        return self.folder / "references" / f"{name}.tum"

    def _is_made(self, name: str) -> bool:
        """Whether an estimated reference of a sequence is in the study's folder."""
        given, path = self.recordings.get(name), self.estimate_path(name)
        # The file beside it is written last.
        there = given is not None and path.exists() and path.with_suffix(".json").exists()
        return there and wants_estimate(self.recordings[name])

    def estimate(self, name: str) -> StoredEstimate | None:
        """What is known about an estimated reference, also a file's; None if it is not one."""
        if self._is_made(name):
            return StoredEstimate.read(self.estimate_path(name))
        given = self.recordings.get(name)
        if given is None or not (given.reference or "").endswith(REFERENCE_FILES):
            return None
        # The user's own file of poses may have any file beside it.
        with contextlib.suppress(EstimateError):
            return StoredEstimate.read(Path(given.reference or ""))
        return None

    def key(self, name: str) -> str:
        """The key under which the user finds a sequence: a part has none of its own."""
        part = self.config(name).part
        whole = name if part is None else name.removesuffix(part_name("", part))
        if part is None or whole == name:
            return f"sequences.{name}"
        return f"[{whole}: {100.0 * part[0]:.10g}-{100.0 * part[1]:.10g}%]"

    def recorded_in(self, name: str) -> str:
        """What a sequence was recorded in: parts of a recording share it."""
        config = self.config(name)
        return str(next(path for key in SOURCES if (path := getattr(config, key)) is not None))

    def open(self, name: str) -> Recording:
        """Open a sequence, or a recorded course.

        A SequenceError says that it cannot be opened, a ConfigurationError that the course has not
        been recorded.
        """
        self._check_recorded(name)
        sequence = open_sequence(self.config(name))
        return with_imu(sequence) if self.with_imu else sequence

    def _check_recorded(self, name: str) -> None:
        if name in self.courses and not self.recording(name).exists():
            raise ConfigurationError(
                f"{self.recording(name)}: the course {name} is not recorded yet; run "
                f"`adaptune simulate` with this study first"
            )

    def files(self, name: str) -> SequenceFiles:
        """The files that a sequence is read from; errors as of `open`."""
        self._check_recorded(name)
        return sequence_files(self.config(name))

    def inputs(self, name: str) -> dict[str, Any]:
        """Everything that the scans and the reference of a sequence depend on."""
        return merged([self.identity(name), self.reference(name)])

    def identity(self, name: str) -> dict[str, Any]:
        """Everything that the scans of a sequence depend on, as plain data.

        A recording is known by its content, not by its path.
        """
        course = self.courses.get(name)
        others = {*SOURCES, *_AS_ESTIMATED, "cache"}
        config = self.config(name).model_dump(mode="json", exclude=others)
        config |= {} if course is None else course.model_dump(mode="json")
        recording = fingerprints(self.files(name).recording)
        about = {self._kind(name): {name: config}, "recording": {name: recording}}
        return about | {"reader": _READER}

    def reference(self, name: str) -> dict[str, Any]:
        """Everything that the reference of a sequence depends on besides its scans."""
        config = self.config(name).model_dump(mode="json", include=set(_OF_POSES))
        files = self.files(name).reference
        if files and config["reference"] is not None:
            config["reference"] = "a file"
        return {self._kind(name): {name: config}, "reference": {name: fingerprints(files)}}

    def _kind(self, name: str) -> str:
        return "courses" if name in self.courses else "sequences"

    def sources(self, name: str) -> dict[str, Sequence[Path]]:
        """The files of a sequence, by the keys of their digests in `inputs`."""
        files = self.files(name)
        return {f"recording.{name}": files.recording, f"reference.{name}": files.reference}

    def program_input(self, name: str) -> ProgramInput:
        """A sequence as a program reads it."""
        folder = self.folder / "inputs" / name
        # 4: with the inputs by name.
        about = {"version": 4, "input": self.layout} | self.identity(name)
        key = str(folder), json.dumps(about)
        if key not in _inputs:
            config = self.config(name)
            given = program_input(self.open(name), config, about, folder, self.layout)
            _inputs[key] = given._replace(logs=self.folder / "logs" / name)
        return _inputs[key]


# The folder of a study: its lock, and the configuration that it was begun with.


CONFIGURATION = "study.yaml"
"""The resolved configuration."""
MODEL = "model.safetensors"
"""The error model."""
FIXED_SET = "fixed.yaml"
"""The fixed set."""

WINDOW = 3.0
"""Seconds over which a selector averages descriptors."""

BANK_MEMORY = 16.0
"""Gigabytes that the members of a bank may take where nobody asks for one."""

_locks: dict[str, IO[str]] = {}
"""Open files whose locks last as long as the process."""


def is_written_to(folder: Path) -> bool:
    """Whether another process works in a study's folder."""
    lock = folder / ".lock"
    if str(folder) in _locks or not lock.exists():
        return False
    with lock.open() as file:
        return not locked(file, wait=False)


C_co = TypeVar("C_co", bound=StudyConfig, covariant=True, default=StudyConfig)

_log = logging.getLogger(__name__)

Mechanism = Literal["live", "bank"]


@dataclass(frozen=True)
class Study(Generic[C_co]):
    """A checked configuration and its folder."""

    config: C_co
    folder: Path  # keeps trials, model, replays and comparison

    def __repr__(self) -> str:
        odometries, training, test = (
            ", ".join(names)
            for names in (self.config.odometries, self.training, self.config.test or ["none"])
        )
        return f"<Study in {self.folder}: {odometries}; training: {training}; test: {test}>"

    @property
    def name(self) -> str:
        """Name of the study: its folder's."""
        return self.folder.name

    @property
    def model_path(self) -> Path:
        """File of the error model."""
        return self.folder / MODEL

    @cached_property
    def sequences(self) -> StudySequences:
        """The sequences by name."""
        config = self.config
        layout: Any = "bag"
        declared = [declared_odometry(one) for one in config.odometries.values()]
        for settings, described in declared:
            # A program that runs whole recordings is the only odometry.
            if described.whole:
                layout = getattr(settings, "input", layout)
        needs_imu = any(described.needs_imu for _, described in declared)
        of_study = (config.sequences, config.courses, self.folder)
        return StudySequences(*of_study, needs_imu, layout)

    @cached_property
    def odometry(self) -> Factory:
        """Makes instances of the odometry, or of any of several."""
        odometries = self.config.odometries
        factories = {label: self._factory(config) for label, config in odometries.items()}
        return OdometryPool(factories) if len(factories) > 1 else next(iter(factories.values()))

    def _factory(self, config: OdometryConfig) -> OdometryFactory:
        settings, described = declared_odometry(config)
        return OdometryFactory(
            config.name,
            settings,
            tuned_space(config, described),
            self.config.isolation,
            self.sequences.program_input if described.whole else None,
        )

    @property
    def fixed(self) -> ParameterSet | None:
        """The fixed set, once training has chosen it."""
        path = self.folder / FIXED_SET
        return yaml12.Document.of_file(path).data if path.exists() else None

    def own_file(self, fixed: ParameterSet) -> tuple[Path, OwnFile] | None:
        """The fixed set as its odometry's own tool reads it, and where; None if it has none."""
        factory, parameters = self.odometry.alone(fixed)
        if (own := factory.own_file(parameters)) is None:
            return None
        return self.folder / f"fixed_{own.name or factory.name}{own.suffix}", own

    @property
    def training(self) -> list[str]:
        """Names of the training sequences."""
        return list(self.config.training)

    @property
    def rules(self) -> tuple[str, ...]:
        """Selection rules; none where the odometry cannot adapt."""
        return () if self.mechanism is None else self.config.online.rules

    @property
    def window(self) -> int:
        """Number of selections over which descriptors are averaged."""
        return max(1, math.ceil(WINDOW / self.config.online.period))

    @cached_property
    def mechanism(self) -> Mechanism | None:
        """How the odometry changes its parameters during a replay; None if it cannot."""
        switching, described = self.config.online.switching, self.odometry.description
        if described.whole:
            return None
        if switching.mechanism != "auto":
            return switching.mechanism
        if available() > 1 and switching.size * self.config.isolation.memory <= BANK_MEMORY:
            return "bank"
        return "live" if described.live else None

    @property
    def odometry_inputs(self) -> dict[str, Any]:
        """Everything about the odometry that trials and replays depend on, as plain data."""
        odometry = self.odometry
        parameters = {"parameters": odometry.space.dump()}
        about = {"odometry": odometry.identity | parameters, "content": odometry.content}
        limits = {"limits": self.config.isolation.model_dump()} if odometry.apart else {}
        inputs: dict[str, Any] = manifest.plain(about | limits)
        return inputs

    def replay_inputs(self, name: str) -> dict[str, Any]:
        """What the replays of a sequence depend on in all modes, as plain data."""
        in_real_time = self.config.online.real_time
        return {
            "period": self.config.online.period,
            "real_time": in_real_time and in_real_time.model_dump(mode="json"),
            "health": self.config.health.model_dump(mode="json"),
            **self.odometry_inputs,
            **self.sequences.identity(name),
        }

    def archive(self, kind: str = "trials", more: Mapping[str, Any] | None = None) -> Archive:
        """The archive of the trials, or of other ones in the folder `kind`.

        It records what they depend on: odometry, sequences, descriptors, and `more`.
        """
        config = self.config
        shared = self.odometry_inputs | {
            "sub_trajectory": config.sub_trajectory,
            "lost_track": config.lost_track,
            "drives": {"health": config.health.model_dump(mode="json")},
            "descriptors": descriptor_content(config.descriptor),
            **(more or {}),
        }
        sources = Sources(shared, self.sequences.inputs, self.sequences.sources)
        return Archive(self.folder / kind, sources)

    @property
    def model_inputs(self) -> dict[str, Any]:
        """Everything that the study's trials, and so its error model, depend on."""
        archive = self.archive()
        inputs = manifest.merged(archive.inputs(name) for name in self.training)
        return {key: value for key, value in inputs.items() if key != "limits"}

    @property
    def model_inputs_path(self) -> Path:
        """File of what the error model was fitted to."""
        return self.model_path.with_suffix(f".{manifest.FILE}")

    def model(self, path: Path | None = None) -> ErrorModel:
        """Load an error model, by default the study's own.

        There is an AdaptuneError if there is none, it is of another odometry, other parameters or
        other sub-trajectories, or what the study's own was fitted to has changed.
        """
        path = path or self.model_path
        model = ErrorModel.load(path)
        files: dict[str, Any] = {}
        if path.resolve() == self.model_path.resolve():
            before, now = manifest.recorded(self.model_inputs_path), self.model_inputs
            if before is not None and model.provenance.get("inputs") != manifest.digest(before):
                before = None
            files = manifest.merged(map(self.sequences.sources, self.training))
        else:
            parameters = {"parameters": self.odometry.space.definition()}
            now = {"odometry": self.odometry.identity | parameters}
            now |= {"sub_trajectory": self.config.sub_trajectory}
            before = {"odometry": model.odometry | {"parameters": model.sets.space.definition()}}
            before = manifest.plain(before | {"sub_trajectory": model.length})
        if said := manifest.changes(before, now, files):
            raise ConfigurationError(
                f"{path}: is not of this study: {'; '.join(said)}; run `adaptune offline` with it"
            )
        return model

    def open(self) -> None:
        """Make and lock the folder, and write the resolved configuration to it.

        There is a ConfigurationError if it cannot be made, or another process works in it.
        """
        folder = self.folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"{folder}: the study's folder cannot be made ({error.strerror}); name another "
                f"with --folder"
            ) from error
        if str(folder) not in _locks:
            lock = (folder / ".lock").open("w")
            if not locked(lock, wait=False):
                lock.close()
                raise ConfigurationError(
                    f"{folder}: another adaptune is at work here; wait for it, or give this study "
                    f"another folder (--folder)"
                )
            _locks[str(folder)] = lock
        with contextlib.suppress(OdometryError):  # one that is not here, and not needed now
            write_text(folder / CONFIGURATION, yaml12.dump(self._resolved()))

    def _resolved(self) -> dict[str, Any]:
        """The configuration with nothing left to defaults."""
        resolved = self.config.resolved()
        given = resolved["odometry"]
        entries = given if isinstance(given, list) else [given]
        for entry, config in zip(entries, self.config.odometries.values(), strict=True):
            made = self._factory(config)
            entry["settings"] = made.settings.model_dump(mode="json")
            entry["parameters"] = made.space.definition()
        return resolved


def declared_odometry(config: OdometryConfig) -> tuple[Any, Description]:
    """The odometry's settings, and its description with them."""
    return declare(config.name, config.settings).sound(config.name)


def tuned_space(config: OdometryConfig, described: Description) -> ParameterSpace:
    """The parameters that are tuned: those that the study names, by default all."""
    own = described.space
    if config.parameters is None:
        return own or ParameterSpace({})
    definitions = config.parameters.items()
    return ParameterSpace.load({name: whole_definition(own, name, d) for name, d in definitions})


def whole_definition(
    space: ParameterSpace | None, name: str, given: Mapping[str, Any]
) -> dict[str, Any]:
    """Definition of a parameter: the study's values, and the odometry's own for the rest."""
    own = {} if space is None else space.parameters[name].model_dump()
    other = given.get("type", own.get("type")) != own.get("type")
    return dict(given) if other else own | dict(given)


# What `adaptune online` drives with a model, in the mode `adaptive`.


PER_STRETCH = 4
"""Sub-trajectories of a stretch, the unit of evidence."""
MIN_RECORDINGS = 6
"""With as many, whole recordings are left out; with fewer, stretches of them."""


def is_worth(ratio: float, high: float, worth: float) -> bool:
    """Whether a ratio of errors, whose 95 % interval ends at `high`, is worth the CPU time.

    It is where the error is less by the share `worth`, and the interval shows no loss.
    """
    return ratio <= 1.0 - worth and high < 1.0


BEST_DEFAULT, EQUAL_COST = "best_default", "equal_cost"
"""Rivals: the odometry that does best with its own parameters, and the best set that costs no more
than what is driven."""
RIVALS = (BEST_DEFAULT, EQUAL_COST)
RIVAL_WORDS = {
    BEST_DEFAULT: "the best odometry with its own parameters",
    EQUAL_COST: "the best set that costs no more",
}


class ModeError(AdaptuneError):
    """A mode that the model does not allow."""


def driven(
    model: ErrorModel, online: OnlineConfig, odometry: Factory, mechanism: Mechanism | None
) -> str:
    """What `adaptune online` will drive with a study's model, in a sentence or two.

    `mechanism` is the study's. A ModeError says that the model does not go with the study's bank.
    """
    fixed = f"`online` will drive the fixed set (trial {named(model, model.fixed)}"
    fixed += ")" if model.fixed else ", the baseline)"
    switching = online.switching
    if mechanism is None:
        return f"{fixed} only, because {cannot_adapt(odometry, None)}."
    if not online.rules:
        return f"{fixed} only, because no rule is named (online.modes)."
    if ADAPTIVE not in online.rules:
        return f"`online` will drive `{online.rules[0]}`, and not `{ADAPTIVE}` (online.modes)."
    how = mechanism_of(ADAPTIVE, model, mechanism, odometry.description.live)
    why = (
        f"there is too little to compare ways to adapt, which takes "
        f"{2 * PER_STRETCH * model.length:g} m of recordings, or a smaller sub_trajectory"
    )
    expected = expected_in_words(model.expected) if model.expected else ""
    if how == "bank" and model.bank_adapts:
        trials = always_at_work(switching, model)
        members = ", ".join(named(model, trial) for trial in trials)
        words = f"`online` will drive the bank of trials {members} as `adaptive`"
        if model.costs is not None and math.isfinite(cost := model.costs.adaptive(trials)):
            words += f", at {cost:.1f} ms of CPU time a scan"
        why = f", because it is worth that: {expected}" if expected else ""
        return f"{words}{why}."
    if mechanism == "live":
        why = "choosing one set at a time gains nothing, and there is no bank (online.switching)"
    elif expected:
        why = f"nothing else is worth its cost; the best alternative is a bank: {expected}"
    return f"{fixed} as `adaptive`, because {why}."


def cannot_adapt(odometry: Factory, mechanism: Mechanism | None) -> str:
    """Why an odometry keeps its set, given how it might change it."""
    if odometry.description.whole:
        return "a program that runs whole recordings cannot change its parameters"
    why = "the model has none"
    if mechanism is None:
        why = "there are too few cores or too little memory for one (online.switching)"
    return (
        f"{odometry.name} cannot change its parameters between scans: that takes a bank, and {why}"
    )


def named(model: ErrorModel, trial: int) -> str:
    """A trial's number, and its odometry where there are several."""
    odometry = model.sets[trial].get(ODOMETRY)
    return str(trial) if odometry is None else f"{trial} ({odometry})"


def expected_in_words(expected: Mapping[str, float]) -> str:
    """What a way to adapt is expected to gain, what it rests on, and how far that reaches.

    The figures are those of `offline.tuning.Figures`.
    """
    gain, low, high = (100.0 * (1.0 - expected[key]) for key in ("geometric", "high", "low"))
    stretches, recordings = int(expected["n_stretches"]), int(expected["n_recordings"])
    if recordings >= MIN_RECORDINGS:
        reach = "in other recordings"
    else:
        reach = f"elsewhere along {'this recording' if recordings == 1 else 'these recordings'}"
    of = "one recording" if recordings == 1 else f"{recordings} recordings"
    interval = (
        f"95 % interval {low:.0f} to {high:.0f} %" if low >= -1000.0 else "no interval: too few"
    )
    return (
        f"expected gain {gain:.0f} % ({interval}), in the worst tenth "
        f"{expected['worst_tenth']:.2f} times the fixed set's error, {reach} "
        f"({stretches} stretches of {of})"
    )


def mechanism_of(
    mode: str, model: ErrorModel, mechanism: Mechanism | None, live: bool
) -> Mechanism | None:
    """How a mode that adapts changes parameters; None if it cannot.

    The `mechanism` is the study's; `live`: whether the odometry changes its parameters between
    scans. A bank with more expected loss than the fixed set would only cost.
    """
    # A rule that chooses one set has all sets to choose from where it can.
    bank = model.bank_adapts or model.bank_rests if mode == ADAPTIVE else not live
    if mechanism == "bank" and bank:
        return "bank"
    return "live" if live else None


def bank_members(switching: SwitchingConfig, model: ErrorModel) -> dict[int, ParameterSet]:
    """The members of the study's bank by their trial numbers, the fixed set first.

    A ModeError says that the model was fitted for another bank.
    """
    if model.budget is not None:
        return {trial: model.sets[trial] for trial in model.bank}
    # Sets that are never chosen, because they fail, are in no bank.
    complete = np.asarray(~np.isnan(model.errors).any(axis=0))
    usable = [c for c, t in enumerate(model.sets) if model.costs is None or model.costs.usable(t)]
    n = len(model.bank) - model.bank_settings.reserve
    if n < min(switching.size, int(complete[usable].sum())):
        raise ModeError(
            "online.switching.size: the model was fitted for another bank; run `adaptune offline` "
            "again, which fits it to the finished trials"
        )
    chosen = (*model.bank[:n][: switching.size], *model.bank[n:])
    return {trial: model.sets[trial] for trial in chosen}


def always_at_work(switching: SwitchingConfig, model: ErrorModel) -> list[int]:
    """The members of the study's bank that work everywhere; see `ErrorModel.reserve`."""
    return [trial for trial in bank_members(switching, model) if trial not in model.reserve]


# What trials on the test sequences found, for the best choice in hindsight. Nothing learns from it.


class OracleErrors(NamedTuple):
    """Errors of several sets on a test sequence, as trials measure them."""

    trials: tuple[int, ...]  # numbers of the sets, the fixed one's first if it is among them
    # (n_frames, n_sets): sub-trajectory RTE in percent, NaN without a sub-trajectory, infinite
    # where the track was lost.
    errors: NDArray[np.float32]


def oracle_errors(archive: Archive, name: str, model: ErrorModel) -> OracleErrors | None:
    """The errors of a model's sets on a test sequence, from the study's trials on it.

    None where no trials were run; those of other inputs than now are left out, with a warning. An
    ArchiveError says that a file is damaged.
    """
    finished = archive.finished(name)
    known = [t for t in model.sets if t in finished and finished[t].parameters == model.sets[t]]
    if not known:
        return None
    if changes := archive.changes(name):
        words = "%s: the oracle's trials are of other inputs: %s; run `adaptune online --oracle`"
        _log.warning(words, name, "; ".join(changes))
        return None
    trials = tuple(sorted(known, key=lambda trial: (trial != model.fixed, trial)))
    return OracleErrors(trials, archive.read_errors(name, trials))
