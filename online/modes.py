"""The modes of a replay: baseline, rivals, fixed, adaptive by each rule, and those on demand."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from adaptune.bank.bank import Bank
from adaptune.model import ErrorModel
from adaptune.model.weights import weighted_selection
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.factory import Factory
from adaptune.processes import together
from adaptune.recording.scan import Scan, part_name
from adaptune.report.paper import LINES
from adaptune.selection import Selection
from adaptune.selector import AnySelector, Selector, UntrainedSelector, untrained_sets
from adaptune.space import ParameterSet, ParameterSets
from adaptune.study.config import RealTimeConfig, SwitchingConfig
from adaptune.study.inputs import check_model
from adaptune.study.study import RIVALS, Mechanism, ModeError, Study, bank_members, mechanism_of

# Controls: selectors that look at nothing, and that adapting has to beat.


SEED = 0
"""Of random choices, together with the sequence's name and the number of the repeat."""


class _Control:
    """It has the methods of `adaptune.selector.Selector`, and neither sees nor measures."""

    def reset(self) -> None:
        """Forget all selections, as before a new recording."""

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See a scan; nothing depends on it."""

    def measure(self) -> None:
        """Measure nothing."""


class EvenSelector(_Control):
    """Gives all members of a bank the same weight, always.

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

    def select(self) -> Selection:
        """Even weights."""
        return self._selection

    def fall_back(self) -> Selection:
        """Even weights, too."""
        return self._selection


class RandomSelector(_Control):
    """Chooses a random set among a few, at every selection.

    Parameters
    ----------
    sets
        The parameter sets.
    candidates
        Trial numbers of the sets to choose among; all are equally likely.
    fixed
        Trial number of the set to begin with, and to return to where an odometry fails.
    seed
        Of the choices, which are the same with the same seed; see `random_seed`.
    """

    def __init__(
        self, sets: ParameterSets, candidates: Sequence[int], fixed: int, seed: Sequence[int]
    ):
        self._sets, self._candidates, self._fixed = sets, tuple(candidates), fixed
        self._seed = list(seed)
        self.reset()

    def reset(self) -> None:
        """Begin the same choices anew, as before a new recording."""
        self._rng = np.random.default_rng(self._seed)

    def select(self) -> Selection:
        """A random set."""
        trial = self._candidates[int(self._rng.integers(len(self._candidates)))]
        return Selection(trial, self._sets[trial])

    def fall_back(self) -> Selection:
        """The fixed set."""
        return Selection(self._fixed, self._sets[self._fixed])


def random_seed(sequence: str, repeat: int = 1) -> tuple[int, int, int]:
    """The seed of `RandomSelector` on a sequence: the same on every machine."""
    return SEED, zlib.crc32(sequence.encode()), repeat


BASELINE, UNTRAINED = "baseline", "untrained"
LEARNED, EVEN, RANDOM = "bank_learned", "even", "random"
BANKS = ("bank", LEARNED, EVEN)
"""The modes on demand that drive the study's bank, whatever `adaptive` drives."""
MEASURING = ("adaptive", "bank")
"""Those with live evidence."""
SINGLES = ("one_set", RANDOM)
"""Those that drive one set at a time."""
WITHOUT_MODEL = (BASELINE, UNTRAINED)
"""The modes that need neither trials nor a model."""


class Mode(NamedTuple):
    """What runs along a recording, and what chooses its parameters, if anything does."""

    odometry: OdometryInstance
    selector: AnySelector | None


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
    pins: Mapping[str, Any] = field(default_factory=dict)  # values that parameters have in all sets
    also: tuple[str, ...] = ()  # modes on demand, see `OnlineConfig`

    @property
    def cores(self) -> int:
        """Cores that the members of a bank may use."""
        return min(self.switching.cores or together(), together())

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
            config.descriptor.names,
            config.online.budget,
            config.online.real_time,
            config.online.pin,
            config.online.also,
        )

    def modes(self, model: ErrorModel) -> tuple[str, ...]:
        """What is replayed with a model, in the order of `LINES`.

        Baseline, rivals, fixed, each selection rule, and the modes on demand that are possible. A
        mode whose replay is that of another one is not replayed again.
        """
        rivals = [rival for rival in RIVALS if model.rivals.get(rival, model.fixed) != model.fixed]
        also = [m for m in self.also if self.twin(m, model) == m and not self.obstacle(m, model)]
        rules = [rule for rule in self.rules if self._mechanism(rule, model) is not None]
        modes = {BASELINE, *rivals, "fixed", *rules, *also}
        return tuple(mode for mode in LINES if mode in modes)

    def twin(self, mode: str, model: ErrorModel) -> str:
        """The mode whose replay is also that of a mode on demand: usually itself."""
        if "adaptive" in self.rules:
            way = self._mechanism("adaptive", model)
            if mode == "bank" and way == "bank" and model.bank_adapts:
                return "adaptive"
            if mode == "one_set" and way != "bank" and model.paired.adapt:
                return "adaptive"
        return mode

    def obstacle(self, mode: str, model: ErrorModel) -> str:
        """Why a mode on demand cannot be replayed; empty if it can."""
        if self.odometry.description.whole:
            return "a program that runs whole recordings cannot change its parameters"
        if mode == UNTRAINED:
            try:
                self.untrained_sets()
            except ModeError as error:
                return str(error)
        elif mode != "one_set" and len(self.switching.sets or model.bank) < 2:
            return "the model's bank has no other member than the fixed set"
        return ""

    def model(self, study: Study, path: Path) -> ErrorModel:
        """An error model, with what is pinned.

        Raises
        ------
        AdaptuneError
            If it is of another odometry, other parameters or other sub-trajectories, or what the
            study's own model was fitted to has changed.
        """
        model = ErrorModel.load(path)
        if path.resolve() == study.model_path.resolve():
            check_model(study, model.sequences, model.provenance)
        length = study.config.sub_trajectory
        model.check_study(study.odometry.identity, study.odometry.space, length, path)
        self.check(model, path)
        return self.pinned(model)

    def pinned(self, model: ErrorModel) -> ErrorModel:
        """The model with what is pinned in all its sets."""
        return replace(model, sets=self._held(model.sets)) if self.pins else model

    def _held(self, sets: ParameterSets) -> ParameterSets:
        held = (
            own | {name: value for name, value in self.pins.items() if name in own}
            for own in sets.parameters
        )
        return replace(sets, parameters=tuple(held))

    def check(self, model: ErrorModel, path: Path) -> None:
        """Refuse a model for another bank, or with a descriptor of somebody else's, from `path`."""
        model.check_descriptors(self.descriptors, path)
        if model.budget != self.budget:
            raise ModeError(
                f"online.budget: {path} was fitted for another budget; run `adaptune offline` "
                f"again, which fits it to the finished trials"
            )
        on_demand = {*BANKS, RANDOM}.intersection(self.also)
        if self.mechanism == "bank" or any(not self.obstacle(m, model) for m in on_demand):
            bank_members(self.switching, model)

    def untrained_sets(self) -> ParameterSets:
        """The members of the bank that needs no model.

        Raises
        ------
        ModeError
            If the odometry cannot be in a bank, or has no parameters by which members differ.
        """
        what = f"{UNTRAINED}: a bank of {self.odometry.name} is not possible, because"
        if self.odometry.description.whole:
            raise ModeError(
                f"{what} the program runs whole recordings; try parameter sets on recordings with "
                f"a reference instead (`adaptune offline`)"
            )
        sets = self._held(untrained_sets(self.odometry.space, self.switching.size))
        if len(sets) < 2:
            raise ModeError(
                f"{what} it has no parameters by which its members would differ; name some "
                f"(odometry.parameters)"
            )
        return sets

    def identity(
        self, mode: str, model: ErrorModel | None = None, digest: str = ""
    ) -> dict[str, Any]:
        """What a mode depends on, as plain data; `digest` is the model's."""
        about = {"mode": mode, "parameters": None, "model": None, "switching": None}
        if mode == UNTRAINED:
            members = list(self.untrained_sets().parameters)
            switching = {"mechanism": "bank", "members": members, "warm_up": self.warm_up}
            return about | {"switching": switching}
        if not self.adapts(mode):
            return about | {"parameters": self.parameters(mode, model)}
        mechanism = self._mechanism(mode, needed(mode, model))
        used = {"size", "sets"} if mechanism == "bank" or mode == RANDOM else set()
        settings = self.switching.model_dump(mode="json", include=used)
        if mechanism == "bank":
            settings["warm_up"] = self.warm_up
        if mode == RANDOM:
            settings["seed"] = SEED
        settings["mechanism"] = mechanism
        return about | {"model": digest, "switching": settings}

    def parameters(self, mode: str, model: ErrorModel | None = None) -> ParameterSet | None:
        """The parameters of modes that keep them; None for adaptive modes."""
        if mode == BASELINE:
            return self.odometry.space.baseline
        if mode != "fixed" and mode not in RIVALS:
            return None
        model = needed(mode, model)
        return model.sets[model.rivals[mode] if mode in RIVALS else model.fixed]

    def start(
        self, mode: str, model: ErrorModel | None = None, sequence: str | None = None
    ) -> Mode:
        """Make a new odometry, or a bank, and its selector; see `instance` and `selector`."""
        selector = self.selector(mode, model, sequence)
        return Mode(self.instance(mode, model, sequence), selector)

    def instance(
        self, mode: str, model: ErrorModel | None = None, sequence: str | None = None
    ) -> OdometryInstance:
        """Make a new odometry, or a bank.

        Parameters
        ----------
        mode
            One of `modes`, or `untrained`.
        model
            The error model; baseline and untrained need none.
        sequence
            Name of the recording; a program that reads whole recordings needs it.

        Raises
        ------
        ModeError
            If the model is lacking, or does not go with the study's bank.
        """
        if mode == UNTRAINED:
            members = self.untrained_sets()
            by_number = dict(zip(members.trials, members.parameters, strict=True))
            return self._bank(by_number)
        if not self.adapts(mode):
            return self.odometry(self.parameters(mode, model), sequence)
        model = needed(mode, model)
        mechanism = self._mechanism(mode, model)
        if mechanism == "bank":
            return self._bank(self.members(mode, model))
        fixed = model.sets[model.fixed]
        return self.odometry(fixed)

    def selector(
        self,
        mode: str,
        model: ErrorModel | None = None,
        sequence: str | None = None,
        repeat: int = 1,
    ) -> AnySelector | None:
        """Make the selector of a mode; None if its parameters stay. See `start`.

        What `random` chooses depends on the sequence, and on which repeat of a replay it is.
        """
        if mode == UNTRAINED:
            return UntrainedSelector(self.untrained_sets(), self.sub_trajectory)
        if not self.adapts(mode):
            return None
        model = needed(mode, model)
        if mode == EVEN:
            return EvenSelector(model.sets, list(self.members(mode, model)))
        if mode == RANDOM:
            candidates = list(self.members(mode, model))
            seed = random_seed(sequence or "", repeat)
            return RandomSelector(model.sets, candidates, model.fixed, seed)
        descriptors, rule = self.descriptors, mode
        if mode not in self.rules:
            model, rule = _adapting(model), "adaptive"
        if self._mechanism(mode, model) != "bank":
            return Selector(model, rule, (), descriptors)
        members, measures = list(self.members(mode, model)), mode != LEARNED
        return Selector(model, rule, members, descriptors, measures)

    def members(self, mode: str, model: ErrorModel) -> dict[int, ParameterSet]:
        """The members of the bank that a mode drives, or among which it chooses.

        The bank's reserve joins in by what is measured: other modes than those have none.
        """
        members = bank_members(self.switching, model)
        if mode in MEASURING:
            return members
        reserve = _adapting(model).reserve
        return {trial: of for trial, of in members.items() if trial not in reserve}

    def adapts(self, mode: str) -> bool:
        """Whether a mode has a selector."""
        return mode in (UNTRAINED, *self.rules, *BANKS, *SINGLES)

    def fixed(self, mode: str, model: ErrorModel) -> int:
        """Trial number of the set that a mode begins with."""
        if mode == UNTRAINED:
            return self.untrained_sets().trials[0]
        if self.adapts(mode) and self._mechanism(mode, model) == "bank":
            return next(iter(self.members(mode, model)))
        return model.fixed

    def core_ms(self, mode: str, model: ErrorModel | None) -> float:
        """Milliseconds that a scan keeps the busiest core at work; NaN if that was not measured."""
        if mode == UNTRAINED or model is None or model.costs is None:
            return np.nan
        if mode == BASELINE:
            return model.costs.alone(0)
        if not self.adapts(mode):
            return model.costs.alone(model.rivals.get(mode, model.fixed))
        if self._mechanism(mode, model) != "bank":
            return max(model.costs.adaptive([trial]) for trial in model.sets)
        members = self.members(mode, model)
        return model.costs.adaptive(members) / min(len(members), self.cores)

    def _bank(self, sets: Mapping[int, ParameterSet]) -> Bank:
        # Where no scan is dropped, no member is left behind either.
        waits = self.real_time is None or not self.real_time.queue
        rate = None if self.real_time is None or waits else self.real_time.rate
        return Bank(self.odometry, sets, self.warm_up, self.lost_track, self.cores, rate)

    def _mechanism(self, mode: str, model: ErrorModel) -> Mechanism | None:
        if mode in BANKS:
            return "bank"
        mechanism = self.mechanism
        if mode in SINGLES and mechanism == "bank":
            mechanism = "live"
        return mechanism_of(mode, model, mechanism, self.odometry.description.live)


def _adapting(model: ErrorModel) -> ErrorModel:
    """The model with settings that adapt, also where the fixed set has less expected loss."""
    adapt = {"adapt": True}
    return replace(
        model,
        paired=model.paired.model_copy(update=adapt),
        bank_settings=model.bank_settings.model_copy(update=adapt),
    )


def needed(mode: str, model: ErrorModel | None) -> ErrorModel:
    """The model of a mode that cannot do without.

    Raises
    ------
    ModeError
        If there is none.
    """
    if model is None:
        raise ModeError(f"{mode}: needs an error model; run `adaptune offline`, which fits one")
    return model


def sequences_without_model(study: Study) -> tuple[str, ...]:
    """The sequences to replay without a model: those of the test, or if it names none, all.

    A recording of which `training` names parts is replayed as a whole.
    """
    config = study.config
    if config.test:
        return config.test
    recorded = {name: entry.part for name, entry in config.sequences.items()}
    parts = recorded | {name: course.part for name, course in config.courses.items()}

    def of_another(name: str) -> bool:
        part = parts[name]
        whole = name if part is None else name.removesuffix(part_name("", part))
        return whole != name and whole in parts

    return tuple(name for name in parts if not of_another(name))
