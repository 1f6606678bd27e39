"""The modes of a replay: baseline, fixed, and adaptive by each selection rule."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.odometry.bank import Bank
from adaptune.odometry.base import OdometryInstance, WarmUp
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.hand_over import HandOver
from adaptune.selector import Selector
from adaptune.space import ParameterSet
from adaptune.study.config import SwitchingConfig
from adaptune.study.study import Mechanism, Study


class ModeError(AdaptuneError):
    """A mode that the model does not allow."""


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
            self.members(model)

    def identity(self, mode: str, model: ErrorModel, digest: str) -> dict[str, Any]:
        """What a mode depends on, as plain data; `digest` is the model's."""
        if mode not in self.rules:
            parameters = self.parameters(mode, model)
            return {"mode": mode, "parameters": parameters, "model": None, "switching": None}
        used = {"live": set[str](), "hand_over": {"catch_up_scans"}, "bank": {"size", "sets"}}
        settings = self.switching.model_dump(mode="json", include=used[self.mechanism])
        if self.mechanism != "live":
            settings["warm_up"] = self.warm_up._asdict()
        if self.mechanism != "bank":
            settings["switch_cost"] = self.switch_cost
        settings["mechanism"] = self.mechanism
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
        if self.mechanism == "bank" and (mode != "paired" or model.bank_adapts):
            sets = self.members(model)
            bank = Bank(self.odometry, sets, self.warm_up, self.lost_track)
            return Mode(bank, Selector(model, mode, list(sets), descriptors=self.descriptors))
        fixed = model.sets[model.fixed]
        selector = Selector(model, mode, (), self.switch_cost, self.descriptors)
        # A bank that was not shown to pay would only cost.
        if self.mechanism != "hand_over" and self.odometry.description.live:
            return Mode(self.odometry(fixed), selector)
        scans = self.switching.catch_up_scans
        return Mode(HandOver(self.odometry, fixed, self.warm_up, scans), selector)

    def members(self, model: ErrorModel) -> dict[int, ParameterSet]:
        """The members of the study's bank by their trial numbers, the fixed set first.

        Raises
        ------
        ModeError
            If the study names a set that the model does not know, or one twice, or the model was
            fitted for another bank.
        """
        if self.switching.sets is None:
            size = self.switching.size
            complete = int((~np.isnan(model.errors).any(axis=0)).sum())
            if len(model.bank) < min(size, complete):
                raise _another_bank("size")
            if model.bank[0] != model.fixed:
                raise _another_bank("sets")
            return {trial: model.sets[trial] for trial in model.bank[:size]}
        members: dict[int, ParameterSet] = {}
        for i, named in enumerate(self.switching.sets):
            trial = model.trial(named)
            where = f"online.switching.sets.{i}"
            if trial is None:
                raise ModeError(
                    f"{where}: is none of the {len(model.sets)} parameter sets of the model, so "
                    f"its errors are unknown; name the number of a trial, or the parameters of one "
                    f"(trials.csv lists them)"
                )
            if trial in members:
                raise ModeError(f"{where}: is in the bank already")
            if np.isnan(model.errors[:, model.sets.column(trial)]).any():
                raise ModeError(
                    f"{where}: was not run on every training sequence, so it cannot be compared "
                    f"with the others; name another set (trials.csv lists them)"
                )
            members[trial] = model.sets[trial]
        if list(members) != model.bank:
            raise _another_bank("sets")
        return members


def _another_bank(key: str) -> ModeError:
    return ModeError(
        f"online.switching.{key}: the model was fitted for another bank; run `adaptune offline` "
        f"again, which fits it to the finished trials"
    )
