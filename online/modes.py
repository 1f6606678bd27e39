"""The modes of a replay: baseline, fixed, and adaptive by each selection rule."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

from adaptune.model import ErrorModel
from adaptune.odometry.bank import Bank
from adaptune.odometry.base import OdometryInstance, WarmUp
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.hand_over import HandOver
from adaptune.selector import Selector
from adaptune.space import ParameterSet
from adaptune.study.config import SwitchingConfig
from adaptune.study.driven import bank_members, mechanism_of
from adaptune.study.study import Mechanism, Study


class Mode(NamedTuple):
    """What runs along a recording, and what chooses its parameters, if anything does."""

    odometry: OdometryInstance
    selector: Selector | None


@dataclass(frozen=True)
class ReplaySetup:
    """What a replay depends on, besides the recording and the model."""

    odometry: OdometryFactory
    rules: tuple[str, ...]  # selection rules to compare
    switching: SwitchingConfig
    mechanism: Mechanism  # how the odometry changes its parameters
    warm_up: WarmUp
    lost_track: float  # metres a second by which the members of a bank may differ and agree
    switch_cost: float  # what a switch must promise, as a share of the fixed set's error
    descriptors: tuple[str, ...]  # those that the study names

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
            config.lost_track,
            study.switch_cost(),
            config.descriptor.names,
        )

    @property
    def modes(self) -> tuple[str, ...]:
        """What is compared: baseline, fixed, and each selection rule."""
        return ("baseline", "fixed", *self.rules)

    def check(self, model: ErrorModel, path: Path) -> None:
        """Refuse a model for another bank, or with a descriptor of somebody else's, from `path`."""
        model.check_descriptors(self.descriptors, path)
        if self.mechanism == "bank":
            bank_members(self.switching, model)

    def identity(self, mode: str, model: ErrorModel, digest: str) -> dict[str, Any]:
        """What a mode depends on, as plain data; `digest` is the model's."""
        if mode not in self.rules:
            parameters = self.parameters(mode, model)
            return {"mode": mode, "parameters": parameters, "model": None, "switching": None}
        used = {"live": set[str](), "hand_over": {"catch_up_scans"}, "bank": {"size", "sets"}}
        mechanism = self._mechanism(mode, model)
        settings = self.switching.model_dump(mode="json", include=used[mechanism])
        if mechanism != "live":
            settings["warm_up"] = self.warm_up._asdict()
        if mechanism != "bank":
            settings["switch_cost"] = self.switch_cost
        settings["mechanism"] = mechanism
        return {"mode": mode, "parameters": None, "model": digest, "switching": settings}

    def parameters(self, mode: str, model: ErrorModel) -> ParameterSet | None:
        """The parameters of baseline and fixed, which stay; None for adaptive modes."""
        constant = {"baseline": self.odometry.space.baseline, "fixed": model.sets[model.fixed]}
        return constant.get(mode)

    def start(self, mode: str, model: ErrorModel, sequence: str | None = None) -> Mode:
        """Make a new odometry, or a bank, and its selector.

        Parameters
        ----------
        mode
            One of `modes`.
        model
            The error model.
        sequence
            Name of the recording; a program that reads whole recordings needs it.

        Raises
        ------
        ModeError
            If the model does not go with the study's bank.
        """
        if mode not in self.rules:
            return Mode(self.odometry(self.parameters(mode, model), sequence), None)
        mechanism = self._mechanism(mode, model)
        if mechanism == "bank":
            sets = bank_members(self.switching, model)
            bank = Bank(self.odometry, sets, self.warm_up, self.lost_track)
            return Mode(bank, Selector(model, mode, list(sets), descriptors=self.descriptors))
        fixed = model.sets[model.fixed]
        selector = Selector(model, mode, (), self.switch_cost, self.descriptors)
        if mechanism == "live":
            return Mode(self.odometry(fixed), selector)
        scans = self.switching.catch_up_scans
        return Mode(HandOver(self.odometry, fixed, self.warm_up, scans), selector)

    def _mechanism(self, mode: str, model: ErrorModel) -> Mechanism:
        return mechanism_of(mode, model, self.mechanism, self.odometry.description.live)
