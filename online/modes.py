"""The modes of a replay: baseline, rivals, fixed, adaptive by each rule, and untrained."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from adaptune.cores import together
from adaptune.live.untrained import UntrainedSelector, untrained_sets
from adaptune.model import ErrorModel
from adaptune.odometry.bank import Bank
from adaptune.odometry.base import OdometryInstance, WarmUp
from adaptune.odometry.hand_over import HandOver
from adaptune.odometry.pool import Factory
from adaptune.parameter_sets import ParameterSets
from adaptune.selector import Selector
from adaptune.sequence.part import part_name
from adaptune.space import ParameterSet
from adaptune.study.config import RealTimeConfig, SwitchingConfig
from adaptune.study.driven import RIVALS, ModeError, bank_members, mechanism_of
from adaptune.study.inputs import check_model
from adaptune.study.study import Mechanism, Study

BASELINE, UNTRAINED = "baseline", "untrained"
WITHOUT_MODEL = (BASELINE, UNTRAINED)
"""The modes that need neither trials nor a model."""
CATCH_UP_SCANS = 4
"""Of a hand-over in real time, unless the study says otherwise: the sensor does not wait."""


class Mode(NamedTuple):
    """What runs along a recording, and what chooses its parameters, if anything does."""

    odometry: OdometryInstance
    selector: Selector | UntrainedSelector | None


@dataclass(frozen=True)
class ReplaySetup:
    """What a replay depends on, besides the recording and the model."""

    odometry: Factory
    rules: tuple[str, ...]  # selection rules to compare
    switching: SwitchingConfig
    mechanism: Mechanism  # how the odometry changes its parameters
    warm_up: WarmUp
    sub_trajectory: float  # metres
    lost_track: float  # metres a second by which the members of a bank may differ and agree
    switch_cost: float  # what a switch must promise, as a share of the fixed set's error
    descriptors: tuple[str, ...]  # those that the study names
    budget: float | None = None  # milliseconds of CPU time a scan
    real_time: RealTimeConfig | None = None
    pins: Mapping[str, Any] = field(default_factory=dict)  # values that parameters have in all sets
    dwell: float = 0.0  # seconds for which a set stays at least

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
            study.switch_cost(),
            config.descriptor.names,
            config.online.budget,
            config.online.real_time,
            config.online.pin,
            config.online.dwell,
        )

    def modes(self, model: ErrorModel) -> tuple[str, ...]:
        """What is replayed with a model: baseline, rivals, fixed, and each selection rule.

        A rival that is the fixed set is not replayed again.
        """
        rivals = [rival for rival in RIVALS if model.rivals.get(rival, model.fixed) != model.fixed]
        return (BASELINE, *rivals, "fixed", *self.rules)

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
        if self.mechanism == "bank":
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
            warm_up = self.warm_up._asdict()
            return about | {
                "switching": {"mechanism": "bank", "members": members, "warm_up": warm_up}
            }
        if mode not in self.rules:
            return about | {"parameters": self.parameters(mode, model)}
        used = {"live": set[str](), "hand_over": {"catch_up_scans"}, "bank": {"size", "sets"}}
        mechanism = self._mechanism(mode, needed(mode, model))
        settings = self.switching.model_dump(mode="json", include=used[mechanism])
        if mechanism != "live":
            settings["warm_up"] = self.warm_up._asdict()
        if mechanism != "bank":
            settings |= {"switch_cost": self.switch_cost} | (
                {"dwell": self.dwell} if self.dwell else {}
            )
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
        return Mode(self.instance(mode, model, sequence), self.selector(mode, model))

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
        if mode not in self.rules:
            return self.odometry(self.parameters(mode, model), sequence)
        model = needed(mode, model)
        mechanism = self._mechanism(mode, model)
        if mechanism == "bank":
            return self._bank(bank_members(self.switching, model))
        fixed = model.sets[model.fixed]
        if mechanism == "live":
            return self.odometry(fixed)
        scans = self.switching.catch_up_scans
        if self.real_time is not None and not scans:
            scans = CATCH_UP_SCANS
        return HandOver(self.odometry, fixed, self.warm_up, scans)

    def selector(
        self, mode: str, model: ErrorModel | None = None
    ) -> Selector | UntrainedSelector | None:
        """Make the selector of a mode; None if its parameters stay. See `start`."""
        if mode == UNTRAINED:
            return UntrainedSelector(self.untrained_sets(), self.sub_trajectory)
        if mode not in self.rules:
            return None
        model = needed(mode, model)
        if self._mechanism(mode, model) != "bank":
            return Selector(model, mode, (), self.switch_cost, self.descriptors, self.dwell)
        members = list(bank_members(self.switching, model))
        descriptors, dwell = self.descriptors, self.dwell
        return Selector(model, mode, members, descriptors=descriptors, dwell=dwell)

    def adapts(self, mode: str) -> bool:
        """Whether a mode has a selector."""
        return mode == UNTRAINED or mode in self.rules

    def fixed(self, mode: str, model: ErrorModel) -> int:
        """Trial number of the set that a mode begins with."""
        if mode in self.rules and self._mechanism(mode, model) == "bank":
            return next(iter(bank_members(self.switching, model)))
        return model.fixed

    def core_ms(self, mode: str, model: ErrorModel | None) -> float:
        """Milliseconds that a scan keeps the busiest core at work; NaN if that was not measured."""
        if model is None or model.costs is None:
            return np.nan
        if mode == BASELINE:
            return model.costs.alone(0)
        if mode not in self.rules:
            return model.costs.alone(model.rivals.get(mode, model.fixed))
        if self._mechanism(mode, model) != "bank":
            return max(model.costs.adaptive([trial]) for trial in model.sets)
        members = bank_members(self.switching, model)
        return model.costs.adaptive(members) / min(len(members), self.cores)

    def _bank(self, sets: Mapping[int, ParameterSet]) -> Bank:
        # Where no scan is dropped, no member is left behind either.
        waits = self.real_time is None or not self.real_time.queue
        rate = None if self.real_time is None or waits else self.real_time.rate
        return Bank(self.odometry, sets, self.warm_up, self.lost_track, self.cores, rate)

    def _mechanism(self, mode: str, model: ErrorModel) -> Mechanism:
        return mechanism_of(mode, model, self.mechanism, self.odometry.description.live)


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
