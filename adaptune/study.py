"""A study: what to tune, on what, and the folder in which everything about it is kept."""

import fcntl
import hashlib
import json
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_serializer,
    field_validator,
    model_validator,
)

from adaptune import yaml
from adaptune.cores import available
from adaptune.descriptor import DescriptorError, descriptor
from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.odometry.base import (
    Description,
    Odometry,
    OdometryError,
    OdometryInstance,
    WarmUp,
)
from adaptune.odometry.command import Command
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.isolation import Limits
from adaptune.odometry.program_input import ProgramInput, program_input
from adaptune.odometry.registry import odometry_class
from adaptune.sampling import NAMES, SETTINGS, SINGLE, SamplerError, check_sampler, optuna_class
from adaptune.sequence import SequenceConfig, open_sequence
from adaptune.sequence.bag import bag_paths
from adaptune.sequence.config import ViewConfig, check_sequence, expand
from adaptune.sequence.views import OF_VIEW, WithImu, origin
from adaptune.simulation import Course, as_sequence
from adaptune.space import (
    Categorical,
    Float,
    Integer,
    ParameterSet,
    ParameterSpace,
    Value,
    nearest,
)

Name = Annotated[str, Field(pattern=r"^\w[\w.-]*$", max_length=100)]
"""Becomes a file's name."""


class ConfigurationError(AdaptuneError):
    """One or more mistakes in a study's YAML, a line each."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class OdometryConfig(_Section):
    """Which odometry, what is set once, and what is tuned in which range.

    Without `parameters`, all of them are tuned in their usual ranges; those not named in it keep
    their baseline. Those of a `command` are defined here, with their `type`.
    """

    name: str
    settings: dict[str, Any] = {}
    parameters: Annotated[dict[str, dict[str, Any]], Field(min_length=1)] | None = None


Metric = Literal["rte", "kitti", "rpe", "ape", "ms_per_scan", "cpu", "memory"]
"""What a trial can be judged by; `offline.objective` tells what each is."""
TIMED = ("ms_per_scan", "cpu", "memory")
"""Metrics that differ from run to run and from machine to machine."""
_Weighted = Annotated[
    dict[Metric, Annotated[float, Field(gt=0, allow_inf_nan=False)]], Field(min_length=1)
]


def _weighted(given: Any) -> Any:
    """A metric or a weighted sum of metrics, or several of them, all as weighted sums."""
    objectives = given if isinstance(given, list | tuple) else [given]
    weighted = tuple({one: 1.0} if isinstance(one, str) else one for one in objectives)
    metrics = get_args(Metric)
    for weights in weighted:
        for metric in weights if isinstance(weights, dict) else ():
            if metric not in metrics:
                raise ValueError(f"there is no metric {metric!r}: {nearest(str(metric), metrics)}")
    if any(weights in weighted[:i] for i, weights in enumerate(weighted)):
        raise ValueError("names an objective twice")
    return weighted


class Limit(_Section):
    """What a metric may not exceed, on any training sequence."""

    max: float = Field(gt=0, allow_inf_nan=False)


PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"sampler": "tpe", "trials": 256, "sets": "own", "runs": "whole"}
}
"""What presets of the offline stage set, where nothing else is said."""


class OfflineConfig(_Section):
    """How to search for parameter sets.

    Attributes
    ----------
    sampler : str
        One of `adaptune.sampling.NAMES`, or a class of Optuna's kind as ``package.module:Class``.
    sampler_settings : dict
        What may be set of it.
    sets : str
        `shared`: one search, each of whose sets is run on every training sequence. `own`: a search
        for every sequence, whose sets are run on that one alone. `both`: the one, and then the
        others.
    trials : int, optional
        Parameter sets of a search; the first is the baseline.
    hours, stagnation, target : optional
        Other budgets: hours that batches have taken; trials in a row without a new best; a value
        of the first objective that is good enough. The search stops at the border of the batch in
        which the first of all budgets is used up.
    initial : int
        Of the trials, the points of a Sobol sequence with which samplers begin that learn.
    batch : int
        A trial is proposed from the results of the batches before its own.
    workers : int, optional
        Processes; one a core when left out.
    memory : float
        Gigabytes that prepared scans may take, in all workers together.
    max_frames : int, optional
        Frames that the error model keeps, over all sequences; all when left out.
    storage : str, optional
        URL of a database to mirror the trials in; a journal file in the study's folder when left
        out.
    objective : tuple of dict
        What to minimise: a metric, or weighted metrics to be summed; several of them for a Pareto
        front, of which the first chooses the fixed set.
    limits : dict
        By metric what a set may not exceed.
    runs : str
        `restart`: an odometry that loses track starts anew at the reference. `whole`: every run
        goes from end to end, whatever happens. `episodes`: in overlapping pieces that each start
        anew, for what cannot be restarted where it gets lost.
    repeats : int
        Runs of every trial, for odometries that differ from run to run.
    augment : list of ViewConfig
        Each adds a view of every training sequence to the training.
    pruning : str
        How trials are given up that promise little, see `offline.pruning`.
    preset : str, optional
        `paper`: as Koide et al. (IROS 2021) did, see `PRESETS`.
    """

    sampler: str = "tpe"
    sampler_settings: dict[str, Any] = {}
    sets: Literal["shared", "own", "both"] = "shared"
    trials: int | None = Field(None, ge=1)
    hours: float | None = Field(None, gt=0, allow_inf_nan=False)
    stagnation: int | None = Field(None, ge=1)
    target: float | None = Field(None, gt=0, allow_inf_nan=False)
    initial: int = Field(32, ge=1)
    batch: int = Field(16, ge=1)
    seed: int = Field(0, ge=0)
    workers: int | None = Field(None, ge=1)
    memory: float = Field(4.0, gt=0, allow_inf_nan=False)
    max_frames: int | None = Field(None, ge=1)
    storage: Annotated[str, Field(pattern="://"), AfterValidator(expand)] | None = None
    objective: Annotated[tuple[_Weighted, ...], BeforeValidator(_weighted), Field(min_length=1)] = (
        {"rte": 1.0},
    )
    limits: dict[Metric, Limit] = {}
    runs: Literal["restart", "whole", "episodes"] = "restart"
    repeats: int = Field(1, ge=1)
    augment: tuple[ViewConfig, ...] = ()
    pruning: Literal["none", "halving", "hyperband", "wilcoxon"] = "none"
    preset: Literal["paper"] | None = None

    @model_validator(mode="after")
    def _check_pruning(self) -> Self:
        if self.pruning != "none" and len(self.objective) > 1:
            raise ValueError("pruning goes by one objective; give one, or set pruning: none")
        if self.pruning != "none" and self.sets == "own":
            raise ValueError(
                "pruning spares trials further sequences, and with sets: own each is run on one; "
                "set pruning: none, or sets: shared or both"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        preset = PRESETS.get(str(given.get("preset")), {}) if isinstance(given, dict) else {}
        return preset | given if preset else given

    @field_serializer("storage")
    def _hide_password(self, storage: str | None) -> str | None:
        return storage and re.sub(r"(://[^:/@]*):[^@]*@", r"\1@", storage)

    @property
    def metrics(self) -> set[str]:
        """All metrics that a trial is judged by."""
        return {*self.limits, *(metric for weights in self.objective for metric in weights)}

    @property
    def budgeted(self) -> bool:
        """Whether anything says when to stop."""
        return any((self.trials, self.hours, self.stagnation, self.target))


def _known_descriptor(name: str) -> str:
    try:
        descriptor(name)
    except DescriptorError as error:
        raise ValueError(str(error)) from error
    return name


class DescriptorConfig(_Section):
    """What a scan is known by.

    Attributes
    ----------
    names : tuple of str
        Of the descriptors, see `adaptune.descriptor`.
    window : float
        Seconds: the mean is taken over the selections that were made in so long a time; 0 is the
        newest scan alone.
    """

    names: Annotated[
        tuple[Annotated[str, AfterValidator(_known_descriptor)], ...], Field(min_length=1)
    ] = ("ndt",)
    window: float = Field(3.0, ge=0, allow_inf_nan=False)

    @field_validator("names")
    @classmethod
    def _once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError("a descriptor is named twice")
        return names

    @model_validator(mode="before")
    @classmethod
    def _names_alone(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {"names": (data,)}
        return {"names": data} if isinstance(data, list) else data


def _catches_up(scans: int) -> int:
    if scans == 1:
        raise ValueError("with 1 a new instance would never catch up; give 0, or 2 or more")
    return scans


class SwitchingConfig(_Section):
    """How an odometry comes by other parameters on the way.

    Attributes
    ----------
    mechanism : str
        `live`: by itself. `hand_over`: a new instance takes over. `bank`: instances with a few
        sets run side by side, and the mean of their motions is taken. `auto`: the first of bank
        (where there is more than one core, and memory), live and hand-over that can be had.
    warm_up : float, optional
        Seconds of scans that a new instance sees before it takes over; the odometry's own when
        left out, as the next two.
    full_rate : float, optional
        Seconds of the most recent ones, of which it sees all.
    stride : int, optional
        Every how many of those before it sees.
    catch_up_scans : int
        How many of them it sees with every new scan, while the old instance still gives the poses;
        with 0, all at once.
    size : int
        Instances in the bank.
    sets : list of int or dict, optional
        Parameter sets in the bank, or numbers of trials, the first of which counts as the fixed
        one; the fixed one and those whose errors cancel each other best when left out.
    cores, memory : int, float, optional
        What `auto` may spend on a bank: cores, all there are when left out; gigabytes, of which
        each instance may take `isolation.memory`.
    """

    mechanism: Literal["auto", "live", "hand_over", "bank"] = "auto"
    warm_up: float | None = Field(None, gt=0, allow_inf_nan=False)
    full_rate: float | None = Field(None, ge=0, allow_inf_nan=False)
    stride: int | None = Field(None, ge=1)
    catch_up_scans: Annotated[int, Field(ge=0), AfterValidator(_catches_up)] = 0
    size: int = Field(4, ge=2, le=6)
    sets: Annotated[
        tuple[Annotated[int, Field(ge=0)] | dict[str, Value], ...] | None,
        Field(min_length=2, max_length=6),
    ] = None
    cores: int | None = Field(None, ge=1)
    memory: float = Field(16.0, gt=0, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, given: Any) -> Any:
        if isinstance(given, dict) and "beside" in given:
            raise ValueError("the key `beside` is now called `catch_up_scans`")
        return given


class OnlineConfig(_Section):
    """How to replay.

    Attributes
    ----------
    period : float
        Seconds between selections.
    rules : list of str
        How to select: `paired`, `paper`.
    switching : SwitchingConfig
    """

    period: float = Field(1.0, gt=0, allow_inf_nan=False)
    rules: tuple[Literal["paired", "paper"], ...] = ("paired", "paper")
    switching: SwitchingConfig = SwitchingConfig()


class StudyConfig(_Section):
    """The YAML of a study.

    Attributes
    ----------
    sequences : dict
        Recordings by name.
    courses : dict
        Simulated sequences by name; `adaptune simulate` records them.
    training, test : list of str
        Names of sequences and courses.
    sub_trajectory : float
        Metres over which errors are measured.
    lost_track : float
        Metres a second: in a trial, a step that departs from the reference by more is a failure,
        and the odometry is started anew at the reference.
    health : HealthCheck
        In a replay, a step that the platform cannot have made; the odometry is started anew at its
        last healthy motion.
    isolation : Limits
        What an odometry may take that runs in a process of its own.
    """

    odometry: OdometryConfig
    sequences: dict[Name, SequenceConfig] = {}
    courses: dict[Name, Course] = {}
    training: tuple[str, ...] = Field(min_length=1)
    test: tuple[str, ...] = ()
    sub_trajectory: float = Field(25.0, gt=0, allow_inf_nan=False)
    lost_track: float = Field(3.0, gt=0, allow_inf_nan=False)
    health: HealthCheck = HealthCheck()
    isolation: Limits = Limits()
    descriptor: DescriptorConfig = DescriptorConfig()
    offline: OfflineConfig = OfflineConfig()
    online: OnlineConfig = OnlineConfig()


@dataclass(frozen=True)
class Study:
    """A checked configuration and its folder.

    Attributes
    ----------
    config : StudyConfig
    folder : Path
        Where trials, model, replays and comparison are kept.
    """

    config: StudyConfig
    folder: Path

    @property
    def name(self) -> str:
        """Name of the study, which is the folder's."""
        return self.folder.name

    @cached_property
    def factory(self) -> OdometryFactory:
        """Makes the study's odometry."""
        name, training = self.config.odometry.name, self.config.training
        limits = self.config.isolation
        return OdometryFactory(
            name, self.settings, self.space, limits, self._program_input, training
        )

    @cached_property
    def settings(self) -> Any:
        """Settings of the odometry."""
        odometry = self.config.odometry
        return odometry_class(odometry.name).settings_type.model_validate(odometry.settings)

    @property
    def identity(self) -> dict[str, Any]:
        """See `OdometryFactory.identity`."""
        return self.factory.identity

    @cached_property
    def described(self) -> Description:
        """Description of the odometry."""
        return odometry_class(self.config.odometry.name).describe(self.settings)

    @cached_property
    def space(self) -> ParameterSpace:
        """The parameters that are tuned."""
        tuned, space = self.config.odometry.parameters, self.described.space
        if tuned is None:
            return space or ParameterSpace({})
        return ParameterSpace.load(
            {name: _complete(space, name, given) for name, given in tuned.items()}
        )

    def odometry(
        self,
        parameters: ParameterSet | None = None,
        sequence: str | None = None,
        isolated: bool = False,
    ) -> OdometryInstance:
        """Make a new instance, see `OdometryFactory`."""
        return self.factory(parameters, sequence, isolated)

    def _program_input(self, name: str) -> ProgramInput:
        """A sequence as a program reads it."""
        folder = self.folder / "inputs" / name
        course = self.config.courses.get(name)
        config = self.sequence_config(name)
        about = {
            # 2: with intensities.
            "version": 2,
            "input": self.settings.input,
            "sequence": config.model_dump(mode="json"),
            "course": None if course is None else course.model_dump(mode="json"),
            "recording": self.recording_size(name),
        }
        key = str(folder), json.dumps(about)
        if key not in _inputs:
            sequence = self.sequence(name)
            _inputs[key] = program_input(sequence, config, about, folder, self.settings.input)
        return _inputs[key]

    @property
    def rules(self) -> tuple[str, ...]:
        """How to select; not at all where the odometry runs whole recordings only."""
        return () if self.described.whole else self.config.online.rules

    @property
    def window(self) -> int:
        """How many descriptors are averaged, a selection's and those of the selections before."""
        return max(1, math.ceil(self.config.descriptor.window / self.config.online.period))

    @cached_property
    def mechanism(self) -> Literal["live", "hand_over", "bank"]:
        """How the odometry comes by other parameters on the way."""
        asked = self.config.online.switching.mechanism
        if asked != "auto":
            return asked
        switching = self.config.online.switching
        instances = switching.size if switching.sets is None else len(switching.sets)
        cores = available() if switching.cores is None else switching.cores
        enough = instances * self.config.isolation.memory <= switching.memory
        if cores > 1 and enough:
            return "bank"
        return "live" if self.described.live else "hand_over"

    @cached_property
    def warm_up(self) -> WarmUp:
        """Which of the last scans a new instance sees."""
        switching = self.config.online.switching
        usual = self.described.warm_up
        return WarmUp(
            usual.seconds if switching.warm_up is None else switching.warm_up,
            usual.full_rate if switching.full_rate is None else switching.full_rate,
            usual.stride if switching.stride is None else switching.stride,
        )

    def price(self) -> float:
        """By how much switching as this study does raises the RTE, as `adaptune switching` found.

        Returns
        -------
        float
            A share of the RTE; 0.0 if it was not measured, or with another odometry or warm-up.
        """
        path = self.folder / "switching.json"
        try:
            measured = json.loads(path.read_text(encoding="utf-8"))
            if measured["of"] != self.switching_about():
                return 0.0
            return max(0.0, float(measured["price"]))
        except FileNotFoundError:
            return 0.0
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigurationError(
                f"{path}: is damaged ({error}); remove it, or run `adaptune switching` again"
            ) from error

    def switching_about(self) -> dict[str, Any]:
        """What the price of switching depends on, as plain data."""
        return {
            "odometry": self.config.odometry.name,
            "settings": self.settings.model_dump(mode="json"),
            "mechanism": self.mechanism,
            "warm_up": self.warm_up._asdict(),
        }

    def recording(self, course: str) -> Path:
        """Where a simulated course's bag is kept."""
        return self.folder / "recordings" / f"{course}.bag"

    @cached_property
    def _views(self) -> dict[str, ViewConfig]:
        """Views that the training is augmented with, by names that differ."""
        views: dict[str, ViewConfig] = {}
        for view in self.config.offline.augment:
            same = sum(other.name == view.name for other in views.values())
            views[f"{view.name}{same + 1}" if same else view.name] = view
        return views

    @property
    def training(self) -> list[str]:
        """Names of the training sequences, each with the views of it."""
        return [
            name + suffix
            for name in self.config.training
            for suffix in ("", *(f"{OF_VIEW}{view}" for view in self._views))
        ]

    def sequence_config(self, name: str) -> SequenceConfig:
        """What is known of a sequence, a course, or a view of one that is trained on."""
        if OF_VIEW in name:
            name, view = name.split(OF_VIEW)
            seen = self.sequence_config(name)
            return seen.model_copy(update={"views": (*seen.views, self._views[view])})
        if name in self.config.sequences:
            return self.config.sequences[name]
        return as_sequence(self.config.courses[name], self.recording(name))

    def sequence(self, name: str) -> Any:
        """Open a sequence or a recorded course.

        Raises
        ------
        SequenceError
            If it cannot be opened.
        ConfigurationError
            If the course has not been recorded.
        """
        course = origin(name)
        if course in self.config.courses and not self.recording(course).exists():
            raise ConfigurationError(
                f"{self.recording(course)}: the course {course} is not recorded yet; run "
                f"`adaptune simulate` with this study first"
            )
        sequence = open_sequence(self.sequence_config(name))
        return WithImu(sequence) if self.described.needs_imu else sequence

    def recording_size(self, name: str) -> list[int] | None:
        """Bytes of a recording's files, by which another recording in its place is noticed.

        None for simulated courses, which their configuration tells apart, and for folders of many
        files.
        """
        bag = self.sequence_config(name).bag
        if bag is None or name in self.config.courses:
            return None
        files = [
            file
            for path in bag_paths((bag,) if isinstance(bag, str) else bag)
            for file in (sorted(path.iterdir()) if path.is_dir() else [path])
        ]
        return [file.stat().st_size for file in files if file.is_file()]

    def check(self) -> None:
        """Make sure that what the folder holds, if anything, is of this very study.

        The number of trials, the number of workers and the replays may change between runs.

        Raises
        ------
        ConfigurationError
            Naming the keys that differ from those the folder was begun with.
        """
        path = self.folder / "study.yaml"
        if not path.exists():
            return
        try:
            data: Any = yaml.Document(path.read_text(encoding="utf-8")).data
            before = _lasting(data)
        except (yaml.YamlError, UnicodeDecodeError, AttributeError, KeyError, TypeError) as error:
            raise ConfigurationError(
                f"{path}: is damaged ({error}); give this study another folder (--folder), or "
                f"remove that one"
            ) from error
        if differing := sorted(_differences(before, _lasting(self._resolved()))):
            raise ConfigurationError(
                f"{self.folder} was begun with other values of {', '.join(differing)}; give "
                f"this study another folder (--folder), or remove that one"
            )

    def open(self) -> None:
        """Make the folder, and keep others from working in it while this process lives.

        Raises
        ------
        ConfigurationError
            If it cannot be made, another process is at work in it, or it is another study's (see
            `check`).
        """
        self.check()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"{self.folder}: the study's folder cannot be made ({error.strerror}); name "
                f"another with --folder"
            ) from error
        if str(self.folder) not in _locks:
            lock = (self.folder / ".lock").open("w")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                lock.close()
                raise ConfigurationError(
                    f"{self.folder}: another adaptune is at work here; wait for it, or give this "
                    f"study another folder (--folder)"
                ) from error
            _locks[str(self.folder)] = lock
        write_text(self.folder / "study.yaml", yaml.dump(self._resolved()))

    def _resolved(self) -> dict[str, Any]:
        """The configuration with nothing left to defaults, and what its recordings are."""
        resolved = self.config.model_dump(mode="json")
        resolved["odometry"]["settings"] = self.settings.model_dump(mode="json")
        resolved["odometry"]["parameters"] = self.space.dump()
        if settings := SETTINGS.get(self.config.offline.sampler):
            given = settings.model_validate(self.config.offline.sampler_settings)
            resolved["offline"]["sampler_settings"] = given.model_dump(
                mode="json", exclude_none=True
            )
        if template := getattr(self.settings, "template", None):
            text = Path(template).read_bytes()
            resolved["odometry"]["template"] = hashlib.sha256(text).hexdigest()[:16]
        resolved["recordings"] = {name: self.recording_size(name) for name in self.config.training}
        return resolved


_inputs: dict[tuple[str, str], ProgramInput] = {}
"""Recordings for programs, by folder and all that they depend on."""

_locks: dict[str, IO[str]] = {}
"""Open files whose locks last as long as the process."""


def _lasting(config: Mapping[str, Any]) -> dict[str, Any]:
    """What trials depend on: all but what may be changed and added to later."""
    lasting = {key: config.get(key) for key in ("odometry", "sub_trajectory", "lost_track")}
    lasting["training"] = config["training"]
    lasting["recordings"] = config["recordings"]
    for name in config["training"]:
        for kind in ("sequences", "courses"):
            entry = dict(config.get(kind, {}).get(name) or {})
            entry.pop("cache", None)  # changes nothing but the time it takes
            lasting[f"{kind}.{name}"] = entry
    offline = config.get("offline", {})
    searched = ("sampler", "sampler_settings", "sets", "initial", "batch", "seed")
    judged = ("objective", "limits")
    learned = ("runs", "repeats", "augment", "pruning")
    keys = (*searched, *judged, *learned)
    lasting["offline"] = {key: value for key in keys if (value := offline.get(key))}
    return lasting


def _differences(a: Any, b: Any, path: str = "") -> Iterable[str]:
    if isinstance(a, dict) and isinstance(b, dict):
        for key in a.keys() | b.keys():
            yield from _differences(a.get(key), b.get(key), f"{path}.{key}" if path else str(key))
    elif a != b:
        yield path


def load_study(
    path: Path, overrides: Sequence[str] = (), folder: Path | None = None, runs: Path = Path("runs")
) -> Study:
    """Read and check a study's YAML.

    Parameters
    ----------
    path
        The YAML.
    overrides
        ``key.of.a.key=value``, the value in YAML.
    folder
        The study's folder; the YAML's name under `runs` when left out.
    runs
        Folder of all studies.

    Raises
    ------
    ConfigurationError
        Telling all mistakes at once, each with its line, its key and what to do.
    """
    try:
        document = yaml.Document(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigurationError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read as text ({error})") from error
    except yaml.YamlError as error:
        raise ConfigurationError(f"{path}: {error}") from error
    if not isinstance(document.data, dict):
        raise ConfigurationError(f"{path}: a study is a mapping of keys, see `adaptune --help`")
    data = document.data
    overridden = [_override(data, text) for text in overrides]
    config, problems = _check(data, path.parent.resolve())
    if problems or config is None:
        lines = []
        for key, message in sorted(problems, key=lambda p: document.line(p[0]) or 0):
            # A mistake told of a whole section may be that of a value in it.
            by_option = any(key[: len(o)] == o[: len(key)] for o in overridden)
            line = None if by_option else document.line(key)
            where = "-o" if by_option else f"{path}" + (f", line {line}" if line else "")
            dotted = ".".join(map(str, key))
            lines.append(f"{where}: {dotted + ': ' if dotted else ''}{message}")
        raise ConfigurationError("\n".join(dict.fromkeys(lines)))
    return Study(config, folder or runs / path.stem)


def _override(data: dict[str, Any], text: str) -> tuple[str, ...]:
    """Set one key of nested mappings, and tell its path."""
    dotted, equals, value = text.partition("=")
    if not equals or not dotted:
        raise ConfigurationError(f"-o {text}: give a key and a value, as in -o offline.trials=32")
    *parents, last = path = tuple(dotted.split("."))
    for part in parents:
        data = data.setdefault(part, {})
        if not isinstance(data, dict):
            raise ConfigurationError(f"-o {text}: {part} has no keys below it")
    try:
        data[last] = yaml.scalar(value)
    except yaml.YamlError as error:
        raise ConfigurationError(f"-o {text}: {error}") from error
    return path


_M = TypeVar("_M", bound=BaseModel)
_Problem = tuple[tuple[str | int, ...], str]


def _check(data: dict[str, Any], folder: Path) -> tuple[StudyConfig | None, list[_Problem]]:
    """Validate what pydantic can, and beside it what only the odometry and the files can tell."""
    problems: list[_Problem] = []
    if isinstance(odometry := data.get("odometry"), dict):
        _check_odometry(odometry, problems, folder)
    config = _validated(StudyConfig, data, (), problems, {"folder": folder})
    if config is not None:
        _check_box(config, problems)
        _check_sampling(config, problems)
    sequences, courses = data.get("sequences") or {}, data.get("courses") or {}
    if not isinstance(sequences, dict) or not isinstance(courses, dict):
        return None, problems
    for name, entry in sequences.items():
        # Mistakes in the entry itself are among those of the whole: only open what can be.
        found = _validated(SequenceConfig, entry, (), [], {"folder": folder})
        if name in courses:
            problems.append((("courses", name), "there is a sequence of the same name"))
        if found is not None:
            try:
                check_sequence(found)
            except AdaptuneError as error:
                problems.append((("sequences", name), str(error)))
    _check_roles(data, {*sequences, *courses}, problems)
    return config, problems


def _check_roles(data: dict[str, Any], known: set[Any], problems: list[_Problem]) -> None:
    training = data.get("training")
    training = training if isinstance(training, list) else []
    for role in ("training", "test"):
        names = data.get(role)
        if not isinstance(names, list):
            continue
        for i, name in enumerate(names):
            if not isinstance(name, str):
                continue  # pydantic has told
            if name not in known:
                help_ = nearest(name, map(str, known))
                problems.append(((role, i), f"there is no sequence {name!r}: {help_}"))
            elif name in names[:i]:
                problems.append(((role, i), f"{name!r} is named twice"))
            elif role == "test" and name in training:
                problems.append(((role, i), f"{name!r} is trained on, and proves nothing here"))


def _check_odometry(data: dict[str, Any], problems: list[_Problem], folder: Path) -> None:
    """Check all that depends on the odometry; paths in its settings are made absolute."""
    name = data.get("name")
    if not isinstance(name, str):
        return
    try:
        box = odometry_class(name)
    except OdometryError as error:
        problems.append((("odometry", "name"), str(error)))
        return
    key: tuple[str, ...] = ("odometry", "settings")
    settings = data.get("settings") or {}
    if not isinstance(settings, dict):
        return
    found: Any = _validated(box.settings_type, settings, key, problems, {"folder": folder})
    if found is not None:
        data["settings"] = found.model_dump(mode="json", exclude_unset=True)
    elif not issubclass(box, Odometry):
        return
    try:
        space = box.describe(found).space
        _check_parameters(name, space, data.get("parameters"), problems)
        if issubclass(box, Command) and isinstance(parameters := data.get("parameters"), dict):
            box.check(found, dict.fromkeys(parameters, 0))
    except OdometryError as error:
        problems.append((key, str(error)))


def _check_parameters(
    name: str, space: ParameterSpace | None, parameters: Any, problems: list[_Problem]
) -> None:
    if space is None and not parameters:
        what = f"define what is tuned: a {name} does not tell what its parameters are"
        problems.append((("odometry", "parameters"), what))
    if not isinstance(parameters, dict):
        return
    for parameter, given in parameters.items():
        key = ("odometry", "parameters", parameter)
        if space is not None and parameter not in space.names:
            help_ = nearest(str(parameter), space.names)
            problems.append((key, f"{name} has no parameter {parameter!r}: {help_}"))
        elif isinstance(given, dict):
            complete = _complete(space, parameter, given)
            kinds: Any = {"float": Float, "integer": Integer, "categorical": Categorical}
            if complete.get("type") not in kinds:
                problems.append((key, f"give its type, one of {', '.join(kinds)}"))
            else:
                _validated(kinds[complete["type"]], complete, key, problems)


def _check_box(config: StudyConfig, problems: list[_Problem]) -> None:
    """Find what is asked of the odometry that it cannot do, and what it lacks."""
    try:
        box: Any = odometry_class(config.odometry.name)
        found = box.describe(box.settings_type.model_validate(config.odometry.settings))
    except (OdometryError, ValidationError):
        return
    if found.needs_imu:
        needs = f"{config.odometry.name} needs an IMU"
        for name, sequence in config.sequences.items():
            if sequence.imu is None:
                help_ = "name its topic and its place, imu: {topic: ..., extrinsic: ...}"
                problems.append((("sequences", name), f"{needs}; {help_}"))
        for name, course in config.courses.items():
            if course.imu is None:
                problems.append((("courses", name), f"{needs}; simulate one, imu: 200"))
    _check_switching(config, found, problems)


def _check_switching(config: StudyConfig, found: Description, problems: list[_Problem]) -> None:
    online = config.online
    names = (config.odometry.parameters or {}) if found.space is None else found.space.names
    for i, given in enumerate(online.switching.sets or ()):
        for name in given if isinstance(given, dict) else ():
            if name not in names:
                key = ("online", "switching", "sets", i, name)
                problems.append((key, f"no such parameter; {nearest(name, names)}"))
    if found.whole and "rules" in online.model_fields_set and online.rules:
        what = "a command runs whole recordings: it cannot adapt on the way; leave this out"
        problems.append((("online", "rules"), what))
    if found.whole and online.switching.mechanism != "auto":
        what = "a command runs whole recordings: it cannot change its parameters; leave this out"
        problems.append((("online", "switching", "mechanism"), what))
    elif online.switching.mechanism == "live" and not found.live:
        problems.append(
            (
                ("online", "switching", "mechanism"),
                f"{config.odometry.name} cannot change its parameters between scans; choose auto, "
                f"hand_over or bank",
            )
        )


def _check_sampling(config: StudyConfig, problems: list[_Problem]) -> None:
    offline = config.offline
    name, given = offline.sampler, offline.sampler_settings
    if len(offline.objective) > 1 and name in SINGLE:
        others = ", ".join(sorted(set(NAMES) - set(SINGLE)))
        problems.append(
            (("offline", "sampler"), f"{name} knows one objective only; choose one of {others}")
        )
    key = ("offline", "sampler_settings")
    if name in SETTINGS:
        if _validated(SETTINGS[name], given, key, problems) is None:
            return
    else:
        try:
            optuna_class(name)
        except SamplerError as error:
            problems.append((("offline", "sampler"), str(error)))
            return
    if not any(path[0] == "odometry" for path, _ in problems):
        space = Study(config, Path()).space
        found = check_sampler(name, given, space, budgeted=offline.budgeted)
        problems.extend((key + path, message) for path, message in found)


def _complete(space: ParameterSpace | None, name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """What is given of a parameter, and for the rest what the odometry says of it."""
    return ({} if space is None else space.parameters[name].model_dump()) | dict(given)


def _validated(
    model: type[_M],
    data: Any,
    prefix: tuple[str, ...],
    problems: list[_Problem],
    context: dict[str, Any] | None = None,
) -> _M | None:
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        told: set[tuple[str | int, ...]] = set()
        for detail in error.errors(include_url=False):
            # Where several types will do, pydantic names each of them in the path.
            tried = [isinstance(part, str) and "[" in part for part in detail["loc"]]
            path = tuple(
                part for part, is_type in zip(detail["loc"], tried, strict=True) if not is_type
            )
            if any(tried) and path in told:
                continue
            told.add(path)
            message = detail["msg"].removeprefix("Value error, ")
            if detail["type"] == "extra_forbidden":
                message = f"unknown key; {nearest(str(path[-1]), _keys(model, path[:-1]))}"
            elif detail["type"] == "missing":
                message = "this key is missing"
            elif detail["type"] == "tuple_type":
                message = f"give a list, not {json.dumps(detail['input'], default=str)}"
            elif (
                not isinstance(detail["input"], dict | list) and "Value error" not in detail["msg"]
            ):
                message = f"{message}, not {json.dumps(detail['input'], default=str)}"
            problems.append((prefix + path, message))
        return None


def _keys(annotation: Any, path: Sequence[str | int]) -> list[str]:
    """Keys that a model has at a path below it."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if not path:
            return list(annotation.model_fields)
        field = annotation.model_fields.get(str(path[0]))
        return _keys(field.annotation, path[1:]) if field else []
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) in (dict, list, tuple) and path:
        # The part of the path is a key or an index; the last argument is the values' type.
        return _keys(next(a for a in reversed(arguments) if a is not Ellipsis), path[1:])
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) in (
        typing.Union,
        Annotated,
    ):
        return [key for a in arguments for key in _keys(a, path)]
    return []
