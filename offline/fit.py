"""Fit the error model to the labelled data set."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np

from adaptune.model import ErrorModel
from adaptune.study.config import SwitchingConfig
from offline.labelled import LabelledData
from offline.rivals import driven_cost, rivals
from offline.tuning import DO_NOT_ADAPT, NO_BANK, choose, reserve

_log = logging.getLogger(__name__)


def fit(
    data: LabelledData,
    fixed: int,
    odometry: dict[str, Any],
    length: float,
    window: int,
    provenance: dict[str, Any],
) -> ErrorModel:
    """Make the error model, which does not adapt yet.

    Sets have no errors (NaN) on the sequences that they were not run on.

    Parameters
    ----------
    data
        Of all trials that keep the limits.
    fixed
        Trial number of the fixed set.
    odometry
        Its name and settings.
    length
        Metres of a sub-trajectory.
    window
        Number of descriptors that are averaged.
    provenance
        Where the model comes from, for people.
    """
    sequences = data.sequences
    return ErrorModel(
        odometry=odometry,
        sets=data.sets,
        fixed=fixed,
        length=length,
        sequences=[s.name for s in sequences],
        blocks=dict(sequences[0].blocks or {}),
        window=window,
        descriptors=np.concatenate([s.descriptors for s in sequences]),
        sequence=np.repeat(np.arange(len(sequences)), [len(s.errors) for s in sequences]),
        errors=np.concatenate([s.errors for s in sequences]),
        elevations=[s.elevation for s in sequences],
        provenance=provenance,
        stretch=np.concatenate([s.stretch for s in sequences]),
        paired=DO_NOT_ADAPT,
        bank_settings=NO_BANK,
        budget=data.budget,
        costs=data.costs,
    )


def tuned(model: ErrorModel, data: LabelledData, switching: SwitchingConfig) -> ErrorModel:
    """Choose what is driven: the rule's settings, the bank and those of its weights.

    Parameters
    ----------
    model
        Fitted to `data`.
    data
        The labelled data set.
    switching
        Size of the bank, or its members.
    """
    complete = data.complete()
    bank = named_members(model, switching, complete) or switching.size
    chosen = choose(complete, bank, fixed=model.fixed)
    members = chosen.members or [model.fixed]
    # Where the user names the members, there are no others.
    besides = reserve(members, complete) if isinstance(bank, int) else []
    members = [*members, *besides]
    return replace(
        model,
        paired=chosen.one_set,
        bank=members,
        vectors=complete.vectors(members),
        bank_settings=chosen.bank.model_copy(update={"reserve": len(besides)}),
        # As they are read back, so that the same model is the same file.
        expected={
            way: {key: float(value) for key, value in figures._asdict().items()}
            for way, figures in chosen.expected.items()
        },
        rivals=rivals(complete, driven_cost(complete, chosen, model.fixed)),
    )


def named_members(
    model: ErrorModel, switching: SwitchingConfig, complete: LabelledData
) -> list[int]:
    """Trial numbers of the members that the study names; empty if they cannot be a bank."""
    named = [model.trial(n) for n in switching.sets or ()]
    members = [trial for trial in named if trial is not None and trial in complete.sets]
    if len(set(members)) == len(named):
        return members
    _log.warning(
        "online.switching.sets: one of them was not run on every training sequence, or is named "
        "twice; the bank is chosen without them (trials.csv lists the sets)"
    )
    return []
