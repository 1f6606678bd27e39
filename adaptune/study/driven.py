"""What `adaptune online` drives with a model, in the mode `adaptive`."""

import math
from collections.abc import Mapping

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.model.registry import ADAPTIVE
from adaptune.odometry.factory import Factory
from adaptune.space import ODOMETRY, ParameterSet
from adaptune.study.config import OnlineConfig, SwitchingConfig
from adaptune.study.study import Mechanism

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
    if mechanism is None:
        return f"{fixed} only, because {cannot_adapt(odometry, None)}."
    if not online.rules:
        return f"{fixed} only, because no rule is named (online.modes)."
    if ADAPTIVE not in online.rules:
        return f"`online` will drive `{online.rules[0]}`, and not `{ADAPTIVE}` (online.modes)."
    how = mechanism_of(ADAPTIVE, model, mechanism, odometry.description.live)
    expected = expected_in_words(model.expected) if model.expected else ""
    if how == "bank" and model.bank_adapts:
        bank = bank_members(online.switching, model)
        trials = [trial for trial in bank if trial not in model.reserve]  # work everywhere
        members = ", ".join(named(model, trial) for trial in trials)
        words = f"`online` will drive the bank of trials {members} as `adaptive`"
        if model.costs is not None and math.isfinite(cost := model.costs.adaptive(trials)):
            words += f", at {cost:.1f} ms of CPU time a scan"
        why = f", because it is worth that: {expected}" if expected else ""
        return f"{words}{why}."
    why = f"nothing else is worth its cost; the best alternative is a bank: {expected}"
    return f"{fixed} as `adaptive`, because {not_compared(model, mechanism) or why}."


def not_compared(model: ErrorModel, mechanism: Mechanism | None) -> str:
    """Why training compared no way to adapt with the fixed set; empty if it did."""
    if mechanism == "bank" and len(model.bank) < 2:
        return "no second set may join it in a bank (online.budget, or the others fail)"
    if mechanism == "live":
        return "choosing one set at a time gains nothing, and there is no bank (online.switching)"
    if model.expected:
        return ""
    return (
        f"there is too little to compare ways to adapt, which takes "
        f"{2 * PER_STRETCH * model.length:g} m of training recordings, or a smaller sub_trajectory"
    )


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
    sources = "one recording" if recordings == 1 else f"{recordings} recordings"
    interval = (
        f"95 % interval {low:.0f} to {high:.0f} %" if low >= -1000.0 else "no interval: too few"
    )
    equal = expected.get("equal_cost", math.nan)
    if math.isfinite(equal) and equal != expected["geometric"]:
        interval += f"; {100.0 * (1.0 - equal):.0f} % over the best single set that costs no more"
    return (
        f"expected gain {gain:.0f} % ({interval}), in the worst tenth "
        f"{expected['worst_tenth']:.2f} times the fixed set's error, {reach} "
        f"({stretches} stretches of {sources})"
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
