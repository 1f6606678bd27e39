"""What fewer training sequences, or banks of other sizes, would gain."""

from typing import Any

import numpy as np

from adaptune.sequence.names import origin
from offline.labelled import LabelledData
from offline.leave_one_out import (
    BANK_SIZE,
    PAIRED,
    Maker,
    Progress,
    Validation,
    leave_one_out,
    leave_out,
    tuned_rules,
)

SIZES = (2, 3, 4, 5, 6)
"""Members of a bank that a study may ask for."""


def learning_curve(
    data: LabelledData,
    seed: int = 0,
    progress: Progress = lambda *_: None,
    bank: int | tuple[int, ...] | list[int] = BANK_SIZE,
) -> list[dict[str, Any]]:
    """What a bank, or where there is none the paired rule, gains with fewer training sequences.

    Each sequence is left out in turn. The rule and its settings are fitted on some of the others,
    drawn at random.

    Returns
    -------
    list of dict
        For each number of training sequences the ratio to the error of the set that is fixed on
        the same ones: geometric mean with its 95 % interval (Student's, over sequences), and the
        worst.
    """
    folds = data.folds()
    most = len(folds) - 1
    # Only one of them is reported.
    alone = not bank or data.sequences[0].simulation is None
    rules: dict[str, Maker] = {PAIRED: tuned_rules()[PAIRED]} if alone else {}
    sizes = sorted({n for n in (3, 5, 8, 11, 16, 24, 32) if n < most} | {most})
    rows = []
    for i, size in enumerate(sizes):
        rng = np.random.default_rng((seed, size))
        left_out = []
        for j, (sequence, others) in enumerate(folds):
            progress(i * len(folds) + j, len(sizes) * len(folds))
            names = sorted({origin(other.name) for other in others.sequences})
            drawn = set(rng.choice(names, size, replace=False))
            some = [other for other in others.sequences if origin(other.name) in drawn]
            left_out.append(leave_out(sequence, others._replace(sequences=some), rules, bank))
        validation = Validation(left_out)
        rows.append({"sequences": size} | validation.summary(validation.default))
    progress(len(sizes) * len(folds), len(sizes) * len(folds))
    return rows


def bank_curve(data: LabelledData, progress: Progress = lambda *_: None) -> list[dict[str, Any]]:
    """What banks gain by their number of members, each sequence left out in turn.

    Returns
    -------
    list of dict
        For each of `SIZES` for which there are enough sets, the ratio to the fixed set's error:
        geometric mean with its 95 % interval (Student's, over sequences), arithmetic, worst.
    """
    few = [size for size in SIZES if size <= len(data.sets)]
    rows = []
    for i, size in enumerate(few):

        def step(j: int, n: int, i: int = i) -> None:
            progress(i * n + j, len(few) * n)

        validation = leave_one_out(data, {}, step, size)
        rows.append({"instances": size} | validation.summary(PAIRED))
    return rows
