"""What `adaptune online` drives with a model."""

import logging
import math
from collections.abc import Iterable, Mapping
from itertools import islice

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.metrics import LOST_ABOVE
from adaptune.model import ErrorModel
from adaptune.model.registry import ADAPTIVE, STANDBY
from adaptune.odometry.base import InProcess
from adaptune.odometry.factory import Factory
from adaptune.odometry.registry import odometry_class
from adaptune.paired import MIN_RECORDINGS
from adaptune.reference.check import hard_to_track
from adaptune.reference.judge import Reference
from adaptune.runs.loop import replay
from adaptune.space import ODOMETRY, ParameterSet
from adaptune.study.config import OnlineConfig, SwitchingConfig
from adaptune.study.study import FIXED_SET, MODEL, Mechanism, Study

PER_SEGMENT = 4
"""Sub-trajectories of a segment, the unit of evidence."""
OWN, EQUAL, BELOW = "own parameters", "no more CPU time", "just below the budget"
WITHIN, ANY, UNTRAINED = "within the budget", "any CPU time", "bank without a model"
FILES = {
    OWN: "",
    EQUAL: "equal_cost.yaml",
    BELOW: "",
    WITHIN: FIXED_SET,
    ANY: "any_cost.yaml",
    ADAPTIVE: MODEL,
    UNTRAINED: "",
}
"""What may be driven, by rising budget, and the files with its parameters.

Rows have this order: that of measured costs would be another one each time.
"""
COST, ERROR = "cost [ms]", "error [%]"
"""Columns of CPU time a scan, preparation included, and of the mean error."""
MOST_SCANS = 600
"""Scans of a recording on which another odometry is tried: seconds."""
_log = logging.getLogger(__name__)


def another_odometry(study: Study, name: str) -> tuple[str, float]:
    """Another odometry, with its own parameters, and its mean error in percent on a sequence."""
    own = {one.name for one in study.config.odometries.values()}
    other = "kiss_icp" if "gicp" in own else "gicp"
    scans = study.sequences.open(name)
    if (reference := scans.reference()) is None:
        return other, math.inf
    _log.info("track is lost on %s: %s is tried there", name, other)
    instance = InProcess(odometry_class(other)())
    run = replay(islice(scans, MOST_SCANS), instance, study.config.health)
    errors = Reference(reference, study.config.sub_trajectory).errors(run.trajectory)
    known = errors[~np.isnan(errors)]
    return other, float(known.mean()) if len(known) else math.inf


def lost_in_words(
    study: Study, best: str, errors: Mapping[str, float], faults: Iterable[str] = ()
) -> list[str]:
    """A sentence where even the best does not track: the likeliest cause, and what to try.

    `errors` has by sequence the mean error of the best, in percent; `faults` are what went wrong in
    the odometry.
    """
    if not (mean := sum(errors.values()) / len(errors)) > LOST_ABOVE:
        return []
    where = ", ".join(name for name, error in errors.items() if error > LOST_ABOVE)
    lost = f"Even with {best} track is lost on {where}: RTE {mean:.1f} %. "
    if fault := next(filter(None, faults), ""):
        return [f"{lost}The odometry itself failed there: {fault}. Mend that first."]
    worst = max(errors, key=lambda name: errors[name])
    other, error = another_odometry(study, worst)
    if error <= LOST_ABOVE:
        return [
            f"{lost}{other} holds track on {worst}, with {error:.2f} %: it is the odometry, not "
            f"the data. Drive {other}, or widen the ranges of the parameters."
        ]
    if cause := hard_to_track(study.sequences.open(worst)):
        help_ = "Drive slower, record more scans a second, or, where there is an IMU, try `rko_lio`"
        return [f"{lost}The likeliest cause: {cause}. {help_}."]
    known = math.isfinite(error)
    why = f"{other} loses it, too, so" if known else "the odometry does not suit the recording, or"
    return [
        f"{lost}The likeliest cause is none of the tuned parameters: {why} points' times, motion "
        f"compensation, the range settings or the reference are wrong (`adaptune inspect --deep` "
        f"checks the recording)."
    ]


class ModeError(AdaptuneError):
    """A mode that the model does not allow."""


def driven(
    model: ErrorModel, online: OnlineConfig, odometry: Factory, mechanism: Mechanism | None
) -> str:
    """What is recommended with a study's model, and what a bank would gain, in a sentence or two.

    `mechanism` is the study's. A ModeError says that the model does not go with the study's bank.
    """
    fixed = f"trial {named(model, model.fixed)}" + ", the baseline" * (not model.fixed)
    expected = f": {expected_in_words(model.expected)}" if model.expected else ""
    if mechanism_of(ADAPTIVE, model, mechanism, odometry.description.live) != "bank":
        return f"Recommended: {fixed}. Nothing adapts: {no_bank(mechanism, odometry, model)}."
    trials = [t for t in bank_members(online.switching, model) if t not in model.reserve]
    members = ", ".join(named(model, trial) for trial in trials)
    bank = f"the bank of trials {members}"
    if model.costs is not None and math.isfinite(cost := model.costs.adaptive(trials)):
        bank += f", at {cost:.1f} ms of CPU time a scan"
    if model.recommended == ADAPTIVE:
        return f"Recommended: adaptive, {bank}{expected}."
    gains = not model.expected or model.expected["geometric"] < 1.0
    adapting = "With cores to spare: adaptive" if gains else "Adapting"
    return f"Recommended: {fixed}. {adapting}, {bank}{expected}."


def no_bank(mechanism: Mechanism | None, odometry: Factory, model: ErrorModel) -> str:
    """Why a model has no bank to drive."""
    if mechanism == "bank" and len(model.sets) < 2:
        return "no other set was tried"
    if mechanism == "bank":
        return "no second set may join the fixed one in a bank (online.budget, or the others fail)"
    if mechanism == "live":
        return "online.switching names no bank, or there are too few cores or too little memory"
    return cannot_adapt(odometry, mechanism)


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

    The figures are those of `offline.bank_choice.Figures`.
    """
    gain, low, high = (100.0 * (1.0 - expected[key]) for key in ("geometric", "high", "low"))
    segments, recordings = int(expected["n_segments"]), int(expected["n_recordings"])
    if recordings >= MIN_RECORDINGS:
        reach = "in other recordings"
    else:
        reach = f"elsewhere along {'this recording' if recordings == 1 else 'these recordings'}"
    sources = "one recording" if recordings == 1 else f"{recordings} recordings"
    interval = (
        f"95 % interval {low:.0f} to {high:.0f} %" if low >= -1000.0 else "no interval: too few"
    )
    return (
        f"expected gain {gain:.0f} % ({interval}), in the worst tenth "
        f"{expected['worst_tenth']:.2f} times the fixed set's error, {reach} "
        f"({segments} segments of {sources})"
    )


def mechanism_of(
    mode: str, model: ErrorModel, mechanism: Mechanism | None, live: bool
) -> Mechanism | None:
    """How a mode that adapts changes parameters; None if it cannot.

    The `mechanism` is the study's; `live`: whether the odometry changes its parameters between
    scans. `ADAPTIVE` is a bank, always.
    """
    # A rule that chooses one set has all sets to choose from where it can.
    weighs = mode in (ADAPTIVE, STANDBY)
    if mechanism == "bank" and len(model.bank) > 1 and (weighs or not live):
        return "bank"
    return "live" if live and mode != ADAPTIVE else None


def bank_members(switching: SwitchingConfig, model: ErrorModel) -> dict[int, ParameterSet]:
    """The members of the study's bank by their trial numbers, the fixed set first.

    A ModeError says that the model was fitted for another bank.
    """
    if switching.size > model.bank_size:
        raise ModeError(
            "online.switching.size: the model was fitted for another bank; run `adaptune offline` "
            "again, which fits it to the finished trials"
        )
    n = len(model.bank) - model.bank_settings.reserve
    chosen = (*model.bank[:n][: switching.size], *model.bank[n:])
    return {trial: model.sets[trial] for trial in chosen}
