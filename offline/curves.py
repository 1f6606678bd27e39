"""What fewer training stretches, or banks of other sizes, would gain."""

from typing import Any

import numpy as np

from adaptune.study.study import MIN_RECORDINGS
from offline.labelled import LabelledData
from offline.leave_one_out import (
    BANK_SIZE,
    PAIRED,
    LeftOut,
    Progress,
    Validation,
    check_folds,
    joined,
    leave_one_out,
    leave_out,
)

SIZES = (2, 3, 4, 5, 6)
"""Members of a bank that a study may ask for."""
LEARNING = (3, 5, 8, 11, 16, 24, 32)
"""Training stretches of a learning curve, and as many as there are."""


def learning_curve(
    data: LabelledData,
    seed: int = 0,
    progress: Progress = lambda *_: None,
    bank: int | tuple[int, ...] | list[int] = BANK_SIZE,
) -> list[dict[str, Any]]:
    """What is gained with fewer training stretches, by a bank or, where there is none, by one set.

    Each recording or stretch is left out in turn. What is driven is chosen on some stretches of the
    rest, drawn at random.

    Returns
    -------
    list of dict
        For each number of training stretches the figures, see `Validation.summary`.
    """
    by_recording = len(data.recordings) >= MIN_RECORDINGS
    folds = data.folds(by_recording)
    check_folds(data, folds)
    # Only one of them is reported.
    alone = not bank or data.sequences[0].simulation is None
    most = min(len(np.unique(others.stretches())) for _, others in folds)
    sizes = sorted({n for n in LEARNING if n < most} | {most})
    rows = []
    for i, size in enumerate(sizes):
        rng = np.random.default_rng((seed, size))
        parts: dict[str, list[LeftOut]] = {}
        for j, (left_out, others) in enumerate(folds):
            progress(i * len(folds) + j, len(sizes) * len(folds))
            some = others.drawn(size, rng)
            found = leave_out(left_out, some, None if alone else {}, bank, by_recording)
            parts.setdefault(found.name, []).append(found)
        validation = Validation([joined(of) for of in parts.values()])
        rows.append({"stretches": size} | validation.summary(validation.default))
    progress(len(sizes) * len(folds), len(sizes) * len(folds))
    return rows


def bank_curve(data: LabelledData, progress: Progress = lambda *_: None) -> list[dict[str, Any]]:
    """What banks gain by their number of members, each recording or stretch left out in turn.

    Returns
    -------
    list of dict
        For each of `SIZES` for which there are enough sets the figures, see `Validation.summary`.
    """
    few = [size for size in SIZES if size <= len(data.sets)]
    rows = []
    for i, size in enumerate(few):

        def step(j: int, n: int, i: int = i) -> None:
            progress(i * n + j, len(few) * n)

        validation = leave_one_out(data, {}, step, size)
        rows.append({"instances": size} | validation.summary(PAIRED))
    return rows
