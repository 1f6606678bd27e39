"""The modes of a replay: what each one runs, and what chooses its parameters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from adaptune.bank.bank import Bank
from adaptune.model import ErrorModel
from adaptune.model.weights import weighted_selection
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.factory import Factory
from adaptune.processes import together
from adaptune.recording.scan import Scan, part_name
from adaptune.selection import Selection
from adaptune.selector import AnySelector, Selector, UntrainedSelector, untrained_sets
from adaptune.space import ParameterSet, ParameterSets
from adaptune.study.config import RealTimeConfig, StudyConfig, SwitchingConfig
from adaptune.study.study import (
    RIVALS,
    Mechanism,
    ModeError,
    Study,
    bank_members,
    cannot_adapt,
    mechanism_of,
)

BASELINE, FIXED, ADAPTIVE, PAPER = "baseline", "fixed", "adaptive", "paper"
EVEN, UNTRAINED = "even", "untrained"
MODES = (BASELINE, *RIVALS, FIXED, ADAPTIVE, UNTRAINED, EVEN, PAPER)
"""All modes, in the order of tables and of lines that lie on each other."""
WITHOUT_MODEL = (BASELINE, UNTRAINED)
"""The modes that need neither trials nor a model."""


class EvenSelector:
    """Gives all members of a bank the same weight, always: a control, which looks at nothing.

    It has the methods of `adaptune.selector.Selector`.

    Parameters
    ----------
    sets
        The parameter sets.
    members
        Trial numbers of the bank's members.
    """

    def __init__(self, sets: ParameterSets, members: Sequence[int]):
        even = dict.fromkeys(members, 1.0 / len(members))
        self._selection = weighted_selection(sets, even)

    def reset(self) -> None:
        """Nothing is remembered."""

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """Nothing depends on a scan."""

    def measure(self) -> None:
        """Nothing is measured."""

    def select(self) -> Selection:
        """Even weights."""
        return self._selection

    def fall_back(self) -> Selection:
        """Even weights, too."""
        return self._selection


class Mode(NamedTuple):
    """What runs along a recording, and what chooses its parameters, if anything does."""

    name: str
    sets: Mapping[int, ParameterSet]  # by trial: a bank's members, or the one set to begin with
    bank: bool = False
    selector: Callable[[], AnySelector] | None = None  # makes it; pickles

    @property
    def fixed(self) -> int:
        """Trial number of the set that it begins with."""
        return next(iter(self.sets))


@dataclass(frozen=True)
class ReplaySetup:
    """What a replay depends on, besides the recording and the model."""

    odometry: Factory
    rules: tuple[str, ...]  # selection rules to compare
    switching: SwitchingConfig
    mechanism: Mechanism | None  # how the odometry changes its parameters
    warm_up: float  # seconds of scans that a member of a bank sees when it restarts
    sub_trajectory: float  # metres
    lost_track: float  # metres a second by which the members of a bank may differ and agree
    descriptors: tuple[str, ...]  # those that the study names
    budget: float | None = None  # milliseconds of CPU time a scan
    real_time: RealTimeConfig | None = None
    also: tuple[str, ...] = ()  # modes on demand, see `OnlineConfig`

    @classmethod
    def of(cls, study: Study) -> Self:
        """The setup of a study."""
        config = study.config
        return cls(
            study.odometry,
            study.rules,
            config.online.switching,
            study.mechanism,
            study.warm_up,
            config.sub_trajectory,
            config.lost_track,
            config.descriptor,
            config.online.budget,
            config.online.real_time,
            config.online.also,
        )

    def mode(self, name: str, model: ErrorModel | None = None) -> Mode:
        """What a mode runs.

        Raises
        ------
        ModeError
            If it is not possible, if the model is lacking, or does not go with the study's bank.
        """
        if name == BASELINE:
            return Mode(name, {0: self.odometry.space.baseline})
        if why := self.obstacle(name, model):
            raise ModeError(f"{name} is not possible: {why}")
        if name == UNTRAINED:
            sets = self._untrained_sets()
            members = dict(zip(sets.trials, sets.parameters, strict=True))
            return Mode(name, members, True, partial(UntrainedSelector, sets, self.sub_trajectory))
        model = needed(name, model)
        if name in (FIXED, *RIVALS):
            trial = model.rivals.get(name, model.fixed)
            return Mode(name, {trial: model.sets[trial]})
        if name == EVEN:
            members = self._always(model)
            return Mode(name, members, True, partial(EvenSelector, model.sets, list(members)))
        if self._mechanism(name, model) == "live":
            one = {model.fixed: model.sets[model.fixed]}
            return Mode(name, one, False, partial(Selector, model, name, (), self.descriptors))
        # The bank's reserve joins in by what is measured: only this mode has one.
        members = bank_members(self.switching, model) if name == ADAPTIVE else self._always(model)
        make = partial(Selector, model, name, list(members), self.descriptors)
        return Mode(name, members, True, make)

    def obstacle(self, name: str, model: ErrorModel | None = None) -> str:
        """Why a mode is not possible; empty if it is, as far as is known without a model."""
        if name in (BASELINE, FIXED, *RIVALS):
            return ""
        if self.odometry.description.whole:
            return cannot_adapt(self.odometry, None)
        if name == UNTRAINED:
            differ = len(self._untrained_sets()) > 1
            why = "no parameters by which the members of a bank would differ (odometry.parameters)"
            return "" if differ else f"{self.odometry.name} has {why}"
        if name == EVEN and model is not None:
            alone = len(self.switching.sets or model.bank) < 2
            return "the model's bank has no other member than the fixed set" if alone else ""
        if model is not None and self._mechanism(name, model) is None:
            return cannot_adapt(self.odometry, self.mechanism)
        return ""

    def modes(self, model: ErrorModel) -> tuple[str, ...]:
        """What is replayed with a model, in the order of `MODES`: what is possible of all modes.

        A rival that is the fixed set is not replayed again.
        """
        rivals = [rival for rival in RIVALS if model.rivals.get(rival, model.fixed) != model.fixed]
        modes = {BASELINE, *rivals, FIXED, *self.rules, *self.also}
        return tuple(name for name in MODES if name in modes and not self.obstacle(name, model))

    def start(
        self, name: str, model: ErrorModel | None = None, sequence: str | None = None
    ) -> tuple[OdometryInstance, AnySelector | None]:
        """Make a new odometry, or a bank, and its selector; None if its parameters stay."""
        mode = self.mode(name, model)
        selector = None if mode.selector is None else mode.selector()
        return self.instance(mode, sequence), selector

    def instance(self, mode: Mode, sequence: str | None = None) -> OdometryInstance:
        """Make the odometry of a mode, or the bank.

        Parameters
        ----------
        mode
            What `mode` returned.
        sequence
            On which it will run; programs that run whole recordings need it.
        """
        if not mode.bank:
            return self.odometry(mode.sets[mode.fixed], sequence)
        # Where no scan is dropped, no member is left behind either.
        waits = self.real_time is None or not self.real_time.queue
        rate = None if self.real_time is None or waits else self.real_time.rate
        given = self.odometry, mode.sets, self.warm_up, self.lost_track, self._cores, rate
        return Bank(*given)

    def identity(
        self, name: str, model: ErrorModel | None = None, digest: str = ""
    ) -> dict[str, Any]:
        """What a mode depends on, as plain data; `digest` is the model's."""
        about = {"mode": name, "parameters": None, "model": None, "switching": None}
        if name in (BASELINE, FIXED, *RIVALS):
            mode = self.mode(name, model)
            return about | {"parameters": mode.sets[mode.fixed]}
        switching: dict[str, Any] = {"mechanism": "bank", "warm_up": self.warm_up}
        if name == UNTRAINED:
            members = list(self._untrained_sets().parameters)
            return about | {"switching": switching | {"members": members}}
        if name != EVEN and self._mechanism(name, needed(name, model)) != "bank":
            return about | {"model": digest, "switching": {"mechanism": "live"}}
        named = self.switching.model_dump(mode="json", include={"size", "sets"})
        return about | {"model": digest, "switching": switching | named}

    def model(self, study: Study, path: Path) -> ErrorModel:
        """Load an error model.

        Raises
        ------
        AdaptuneError
            If it is of another odometry, other parameters or other sub-trajectories, or what the
            study's own model was fitted to has changed.
        """
        model = study.model(path)
        self.check(model, path)
        return model

    def check(self, model: ErrorModel, path: Path) -> None:
        """Refuse a model for another bank, or with a descriptor of somebody else's, from `path`."""
        model.check_descriptors(self.descriptors, path)
        if model.budget != self.budget:
            raise ModeError(
                f"online.budget: {path} was fitted for another budget; run `adaptune offline` "
                f"again, which fits it to the finished trials"
            )
        is_even = EVEN in self.also and not self.obstacle(EVEN, model)
        if self.mechanism == "bank" or is_even:
            bank_members(self.switching, model)

    def _mechanism(self, name: str, model: ErrorModel) -> Mechanism | None:
        return mechanism_of(name, model, self.mechanism, self.odometry.description.live)

    def _always(self, model: ErrorModel) -> dict[int, ParameterSet]:
        """The bank's members without its reserve, which joins in by what is measured."""
        reserve = model.bank[len(model.bank) - model.bank_settings.reserve :]
        members = bank_members(self.switching, model)
        return {trial: own for trial, own in members.items() if trial not in reserve}

    def _untrained_sets(self) -> ParameterSets:
        """The members of the bank that needs no model."""
        return untrained_sets(self.odometry.space, self.switching.size)

    @property
    def _cores(self) -> int:
        """Cores that the members of a bank may use."""
        return min(self.switching.cores or together(), together())


def needed(name: str, model: ErrorModel | None) -> ErrorModel:
    """The model of a mode that cannot do without.

    Raises
    ------
    ModeError
        If there is none.
    """
    if model is None:
        raise ModeError(f"{name}: needs an error model; run `adaptune offline`, which fits one")
    return model


def sequences_without_model(config: StudyConfig) -> tuple[str, ...]:
    """The sequences to replay without a model: those of the test, or if it names none, all.

    A recording of which `training` names parts is replayed as a whole.
    """
    if config.test:
        return config.test
    recorded = {name: entry.part for name, entry in config.sequences.items()}
    parts = recorded | {name: course.part for name, course in config.courses.items()}

    def is_part(name: str) -> bool:
        part = parts[name]
        whole = name if part is None else name.removesuffix(part_name("", part))
        return whole != name and whole in parts

    return tuple(name for name in parts if not is_part(name))
