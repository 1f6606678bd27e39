"""What is compared on the sequences that `gain.py` leaves out, and the printed table."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from gain_data import PERIOD, WINDOW
from numpy.typing import NDArray

from adaptune.descriptor import DESCRIPTORS, averaged
from adaptune.model.bank_weights import MemberWeights, clip_errors, minimum_variance_weights
from offline.curves import learning_curve
from offline.labelled import LabelledData, LabelledSequence, periods
from offline.leave_one_out import Validation, leave_one_out
from offline.tuning import cancelling_members, on_labelled, simulated_with

Errors = dict[str, NDArray[np.float64]]
"""Capped errors on a sequence in several modes, at each frame that has a sub-trajectory."""


def validate(data: LabelledData, size: int) -> None:
    """Leave each sequence out in turn, and print the ratios."""
    left_out = leave_one_out(data, bank=size).left_out
    for of, (sequence, others) in zip(left_out, data.folds(), strict=True):
        members = cancelling_members(others, others.fixed(), size)
        of.errors.update(constantly(sequence, members))
    validation = Validation(left_out)
    print_summary(validation, validation.ratios)
    for mode in validation.modes:
        each = zip(left_out, validation.ratios[mode], strict=True)
        print(f"{mode}: " + ", ".join(f"{of.name} {ratio:.2f}" for of, ratio in each))
    known = " ".join(f"{ratio:.3f}" for ratio in validation.portfolio())
    print(f"if the best of 1, 2, ... complementary sets were known: {known}", flush=True)


def constantly(sequence: LabelledSequence, members: Sequence[int]) -> Errors:
    """Errors of a bank whose weights stay the same."""
    assert sequence.simulation is not None
    vectors, lost = clip_errors(np.stack([sequence.vectors[m] for m in members], axis=1), 0)
    squares = np.einsum("ijx,ikx->jk", vectors, vectors) + np.diag((lost**2).sum(axis=0))
    modes = {
        "bank, even weights": np.full(len(members), 1.0 / len(members)),
        # Nobody who has not been there knows them.
        "bank, best weights": minimum_variance_weights(squares),
    }
    n_periods = len(periods(sequence.simulation.period)[0])
    return {
        mode: on_labelled(
            sequence,
            simulated_with(
                sequence, MemberWeights(tuple(members), np.tile(weights, (n_periods, 1)))
            ),
        )
        for mode, weights in modes.items()
    }


def by_descriptor(data: LabelledData, paths: list[Path], described: list[Path], size: int) -> None:
    """Leave each sequence out in turn, with one way to describe scans after the other.

    Between two full seconds a scan counts as described like the last one, in all ways alike. Its
    motion is known at once.
    """
    pairs = (("ndt", name) for name in DESCRIPTORS if name != "ndt")
    for names in (*((name,) for name in DESCRIPTORS), *pairs):
        sequences = []
        for sequence, path, file in zip(data.sequences, paths, described, strict=True):
            with np.load(path) as found, np.load(file) as its:
                known = ~np.isnan(found["errors"]).any(axis=1)
                stamps = found["stamps"]
                blocks = [its[name][np.arange(len(stamps)) // PERIOD] for name in names]
            of_frames = averaged(np.hstack(blocks), stamps, WINDOW, 1.0)
            assert sequence.simulation is not None
            changed = replace(
                sequence,
                descriptors=of_frames[known],
                blocks={n: block.shape[1] for n, block in zip(names, blocks, strict=True)},
                simulation=replace(sequence.simulation, descriptors=of_frames),
            )
            sequences.append(changed)
        print(f"by {' and '.join(names)}: ", end="")
        validation = leave_one_out(data._replace(sequences=sequences), {}, bank=size)
        print_summary(validation, ["paired"])


def curve(data: LabelledData) -> None:
    """Print the gain with fewer training sequences."""
    for row in learning_curve(data):
        print(" ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)


def print_summary(validation: Validation, modes: Iterable[str]) -> None:
    """Print the ratios to the fixed set's error."""
    print("geometric, arithmetic, worst tenth, worst ratio to the fixed set's error")
    for mode in modes:
        s = validation.summary(mode)
        print(
            f"{mode:30}{s['geometric']:8.3f}{s['arithmetic']:8.3f}{s['worst_tenth']:8.2f}"
            f"{s['worst']:8.2f}"
            f"   (95 % {s['low']:.2f}-{s['high']:.2f})",
            flush=True,
        )
