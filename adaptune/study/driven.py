"""What `adaptune online` drives with a model, in the mode `paired`."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.pooled_space import ODOMETRY
from adaptune.space import ParameterSet
from adaptune.study.config import SwitchingConfig
from adaptune.study.study import Mechanism, Study

PER_STRETCH = 4
"""Sub-trajectories of a stretch, the unit of evidence."""
MIN_RECORDINGS = 6
"""With as many, whole recordings are left out; with fewer, stretches of them."""
BANK, ONE_SET = "bank", "one set"
"""Names of the ways to adapt."""
BEST_DEFAULT, EQUAL_COST = "best_default", "equal_cost"
"""Rivals: the odometry that does best with its own parameters, and the best set that costs no more
than what is driven."""
RIVALS = (BEST_DEFAULT, EQUAL_COST)
RIVAL_WORDS = {
    BEST_DEFAULT: "the best odometry with its own parameters",
    EQUAL_COST: "the best set that costs no more",
}
RELIES_ON_LIVE = True
"""Whether a bank adapts where too little is known to compare it: only if it measures the errors of
its members while it drives."""


class ModeError(AdaptuneError):
    """A mode that the model does not allow."""


class Driven(NamedTuple):
    """What is driven, and by what."""

    mechanism: Mechanism | None  # of `paired`; None if the fixed set is its plan
    words: str  # a sentence
    paper: Mechanism | None = None  # of `paper`, if the study names it

    @property
    def switches(self) -> bool:
        """Whether one set follows another; a bank changes weights only."""
        return self.mechanism in ("live", "hand_over")


def driven(study: Study, model: ErrorModel) -> Driven:
    """What `adaptune online` will drive with the study's model.

    Raises
    ------
    ModeError
        If the model does not go with the study's bank.
    """
    number = f"trial {named(model, model.fixed)}" + ("" if model.fixed else ", the baseline")
    fixed = f"`online` will drive the fixed set ({number})"
    if not study.rules:
        why = "no rule is named (online.rules)"
        if study.odometry.description.whole:
            why = "a program that runs whole recordings cannot change its parameters"
        return Driven(None, f"{fixed} only, because {why}.")
    mechanism, paper = (
        mechanism_of(mode, model, study.mechanism, study.odometry.description.live)
        if mode in study.rules
        else None
        for mode in ("paired", "paper")
    )
    if mechanism is None:
        return Driven(None, "`online` will drive `paper`, and not `paired` (online.rules).", paper)
    if mechanism == "bank" and model.bank_adapts:
        trials = always_at_work(study.config.online.switching, model)
        members = ", ".join(named(model, trial) for trial in trials)
        words = f"`online` will drive the bank of trials {members} as `paired`"
        if model.costs is not None and math.isfinite(cost := model.costs.adaptive(trials)):
            words += f", at {cost:.1f} ms of CPU time a scan"
        if BANK in model.expected:
            words += f", because it has the least expected loss: {_expected(model, BANK)}."
        else:
            words += f". It relies on what it measures while it drives, for {_too_little(model)}."
        words += _who_joins_in(study, model)
        return Driven("bank", words, paper)
    if model.paired.adapt:
        how = "changed live" if mechanism == "live" else "by hand-over"
        words = f"`online` will drive one set at a time as `paired`, {how}"
        if ONE_SET in model.expected:
            words += f", because it has the least expected loss: {_expected(model, ONE_SET)}"
        return Driven(mechanism, f"{words}.", paper)
    why = _why_fixed(study, model, mechanism)
    return Driven(None, f"{fixed} as `paired`, because {why}", paper)


def _why_fixed(study: Study, model: ErrorModel, mechanism: Mechanism) -> str:
    """Why the fixed set is driven, and where it is left."""
    ways = [BANK, ONE_SET] if study.mechanism == "bank" else [ONE_SET]
    known = [way for way in ways if way in model.expected]
    if known:
        way = min(known, key=lambda way: model.expected[way]["loss"])
        best = "a bank" if way == BANK else "one set at a time"
        why = (
            f"it has the least expected loss; the best alternative is {best}: "
            f"{_expected(model, way)}"
        )
    else:
        why = _too_little(model)
    return f"{why}.{_who_joins_in(study, model) if mechanism == 'bank' else ''}"


def _who_joins_in(study: Study, model: ErrorModel) -> str:
    """Which members of a bank rest, and when they do not; empty if none rests."""
    switching = study.config.online.switching
    always = always_at_work(switching, model)
    others = [named(model, t) for t in bank_members(switching, model) if t not in always]
    if not others:
        return ""
    # With a single stretch, nothing tells what is far from it.
    knows = len(np.unique(model.stretches())) > 1
    is_new = "In places that training does not know, and after" if knows else "After"
    who = "trials {} join in" if len(others) > 1 else "trial {} joins in"
    return f" {is_new} failures, {who.format(', '.join(others))}."


def named(model: ErrorModel, trial: int) -> str:
    """A trial's number, and its odometry where there are several."""
    odometry = model.sets[trial].get(ODOMETRY)
    return str(trial) if odometry is None else f"{trial} ({odometry})"


def _expected(model: ErrorModel, way: str) -> str:
    return expected_in_words(model.expected[way])


def _too_little(model: ErrorModel) -> str:
    return (
        f"there is too little to compare ways to adapt, which takes {metres_to_compare(model):g} m "
        f"of recordings, or a smaller sub_trajectory"
    )


def metres_to_compare(model: ErrorModel) -> float:
    """Metres of recordings that hold two stretches: one is left out, the other trained on."""
    return 2 * PER_STRETCH * model.length


def expected_in_words(expected: Mapping[str, float]) -> str:
    """What a way to adapt is expected to gain, what it rests on, and how far that reaches.

    Parameters
    ----------
    expected
        See `offline.expected_loss.Figures`.
    """
    gain, low, high = (100.0 * (1.0 - expected[key]) for key in ("geometric", "high", "low"))
    stretches, recordings = int(expected["n_stretches"]), int(expected["n_recordings"])
    if recordings >= MIN_RECORDINGS:
        reach = "in other recordings"
    else:
        reach = f"elsewhere along {'this recording' if recordings == 1 else 'these recordings'}"
    of = "one recording" if recordings == 1 else f"{recordings} recordings"
    interval = f"95 % interval {low:.0f} to {high:.0f} %" if low >= -1000.0 else "no interval"
    return (
        f"expected gain {gain:.0f} % ({interval}), in the worst tenth "
        f"{expected['worst_tenth']:.2f} times the fixed set's error, {reach} "
        f"({stretches} stretches of {of})"
    )


def mechanism_of(mode: str, model: ErrorModel, mechanism: Mechanism, live: bool) -> Mechanism:
    """How a mode that adapts changes parameters.

    Parameters
    ----------
    mode
        A selection rule.
    model
        The error model. A bank with more expected loss than one set at a time would only cost.
    mechanism
        The study's.
    live
        Whether the odometry changes its parameters between scans.
    """
    if mechanism == "bank" and (mode != "paired" or model.bank_adapts or model.bank_rests):
        return "bank"
    return "live" if mechanism != "hand_over" and live else "hand_over"


def bank_members(switching: SwitchingConfig, model: ErrorModel) -> dict[int, ParameterSet]:
    """The members of the study's bank by their trial numbers, the fixed set first.

    Raises
    ------
    ModeError
        If the study names a set that the model does not know, or one twice, or the model was
        fitted for another bank.
    """
    if switching.sets is None and model.budget is not None:
        return {trial: model.sets[trial] for trial in model.bank}
    if switching.sets is None:
        size = switching.size
        complete = int((~np.isnan(model.errors).any(axis=0)).sum())
        n = len(model.bank) - model.bank_settings.reserve
        chosen, reserve = model.bank[:n], model.bank[n:]
        if len(chosen) < min(size, complete):
            raise _another_bank("size")
        if model.bank[0] != model.fixed:
            raise _another_bank("sets")
        return {trial: model.sets[trial] for trial in (*chosen[:size], *reserve)}
    members: dict[int, ParameterSet] = {}
    for i, named in enumerate(switching.sets):
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


def always_at_work(switching: SwitchingConfig, model: ErrorModel) -> list[int]:
    """The members of the study's bank that work everywhere; see `ErrorModel.reserve`."""
    return [trial for trial in bank_members(switching, model) if trial not in model.reserve]


def _another_bank(key: str) -> ModeError:
    return ModeError(
        f"online.switching.{key}: the model was fitted for another bank; run `adaptune offline` "
        f"again, which fits it to the finished trials"
    )
