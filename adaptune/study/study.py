"""A study: a checked configuration, and what is made of it."""

import contextlib
import logging
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any, Generic, Literal

from typing_extensions import TypeVar

from adaptune._system import manifest, yaml12
from adaptune._system.files import locked, needing_room, write_text
from adaptune._system.machine import available
from adaptune._system.strict import ConfigurationError
from adaptune.errors import OdometryError
from adaptune.model import ErrorModel
from adaptune.model.descriptor import descriptor_content
from adaptune.odometry.base import OwnFile
from adaptune.odometry.factory import Factory, OdometryFactory, OdometryPool
from adaptune.runs.archive import Archive, Sources
from adaptune.space import ParameterSet
from adaptune.study.config import OdometryConfig, StudyConfig
from adaptune.study.portfolios import portfolio_sets
from adaptune.study.sequences import StudySequences

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

_locks: dict[Path, IO[str]] = {}
"""Open files whose locks last as long as the process, or until `Study.close`."""


def is_written_to(folder: Path) -> bool:
    """Whether another process works in a study's folder."""
    lock = folder / ".lock"
    if folder.resolve() in _locks or not lock.exists():
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
    model_file: Path | None = None  # of another error model than the study's own
    called: str = ""  # as a side of a comparison

    def __repr__(self) -> str:
        odometries, training, test = (
            ", ".join(names)
            for names in (self.config.odometries, self.training, self.config.test or ["none"])
        )
        return f"<Study in {self.folder}: {odometries}; training: {training}; test: {test}>"

    @property
    def name(self) -> str:
        """What it is called, by default as its folder."""
        return self.called or self.folder.name

    @property
    def model_path(self) -> Path:
        """File of the error model."""
        return self.model_file or self.folder / MODEL

    @cached_property
    def sequences(self) -> StudySequences:
        """The sequences by name."""
        config = self.config
        layout: Any = "bag"
        declared = [one.declared for one in config.odometries.values()]
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

    @cached_property
    def portfolio(self) -> tuple[ParameterSet, ...]:
        """The sets of its portfolios, see `portfolio_sets`."""
        sets, said = portfolio_sets(self.config, self.odometry.space)
        for what in said:
            _log.warning("offline.portfolio: %s", what)
        return sets

    def _factory(self, config: OdometryConfig) -> OdometryFactory:
        settings, described = config.declared
        return OdometryFactory(
            config.name,
            settings,
            config.space,
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
        limits = {"limits": self.config.isolation.model_dump()} if odometry.isolated else {}
        return dict(manifest.plain(about | limits))

    def replay_inputs(self, name: str) -> dict[str, Any]:
        """What the replays of a sequence depend on in all modes, as plain data."""
        in_real_time = self.config.online.real_time
        return {
            "real_time": in_real_time and in_real_time.model_dump(mode="json"),
            "health": self.config.health.model_dump(mode="json"),
            **self.odometry_inputs,
            **self.sequences.identity(name),
        }

    def archive(self, kind: Literal["trials", "oracle", "odometries"] = "trials") -> Archive:
        """The archive of the trials, or of those on the test sequences in the folder `kind`.

        It knows what they depend on: odometry, sequences, descriptors, and the search.
        """
        config = self.config
        names = config.training if kind == "trials" else config.test
        shared = self.odometry_inputs | {
            "sub_trajectory": config.sub_trajectory,
            "lost_track": config.lost_track,
            "drives": {"health": config.health.model_dump(mode="json")},
            "descriptors": descriptor_content(config.descriptor),
            "offline": config.search_inputs,
        }
        sources = Sources(names, shared, self.sequences.inputs, self.sequences.sources)
        return Archive(self.folder / kind, sources)

    @property
    def model_inputs(self) -> dict[str, Any]:
        """Everything that the study's trials, and so its error model, depend on."""
        archive = self.archive()
        inputs = manifest.merged(archive.inputs(name) for name in self.training)
        return {key: value for key, value in inputs.items() if key not in ("limits", "offline")}

    @property
    def model_inputs_path(self) -> Path:
        """File of what the study's own error model was fitted to."""
        return (self.folder / MODEL).with_suffix(f".{manifest.FILE}")

    def model(self, path: Path | None = None) -> ErrorModel:
        """Load an error model, by default the study's own.

        There is an AdaptuneError if there is none, it is of another odometry, other parameters or
        other sub-trajectories, or what the study's own was fitted to has changed.
        """
        path = path or self.model_path
        model = ErrorModel.load(path)
        files: dict[str, Any] = {}
        if path.resolve() == (self.folder / MODEL).resolve():
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

        There is a FullError if it cannot be, a ConfigurationError if another process works in it.
        """
        folder = self.folder
        with needing_room(folder / ".lock"):
            folder.mkdir(parents=True, exist_ok=True)
            lock = None if folder.resolve() in _locks else (folder / ".lock").open("w")
        if lock is not None:
            if not locked(lock, wait=False):
                lock.close()
                raise ConfigurationError(
                    f"{folder}: another adaptune is at work here; wait for it, or give this study "
                    f"another folder (--folder)"
                )
            _locks[folder.resolve()] = lock
        with contextlib.suppress(OdometryError):  # one that is not here, and not needed now
            write_text(folder / CONFIGURATION, yaml12.dump(self._resolved()))

    def close(self) -> None:
        """Let other processes work in the folder."""
        if lock := _locks.pop(self.folder.resolve(), None):
            lock.close()

    def _resolved(self) -> dict[str, Any]:
        """The configuration with nothing left to defaults."""
        resolved = self.config.resolved()
        given = resolved["odometry"]
        entries = given if isinstance(given, list) else [given]
        for entry, config in zip(entries, self.config.odometries.values(), strict=True):
            entry["settings"] = config.declared[0].model_dump(mode="json")
            entry["parameters"] = config.space.definition()
        return resolved
