"""What is compared on the sequences that `gain.py` leaves out, and the printed table."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from gain_data import KINDS, training_courses
from numpy.typing import NDArray

from adaptune.live.hops import Hop
from adaptune.live.own_error import Link, OwnErrors
from adaptune.metrics import sub_trajectory_rte, travelled, window_ends
from adaptune.model.weights import MEMBER_CLIP, clip_errors, minimum_variance_weights
from offline.bank_choice import cancelling_members
from offline.labelled import LabelledData, LabelledSequence, chained, periods
from offline.validate import Validation, leave_one_out, leave_out

Errors = dict[str, NDArray[np.float64]]
"""Clipped errors on a sequence in several modes, at each frame that has a sub-trajectory."""


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


def by_kind(data: LabelledData, size: int) -> None:
    """Leave out all sequences with one kind of scene after the other, and print the ratios."""
    scenes = {name: course.scenes for name, course in training_courses(0, 1.0).items()}
    every = []
    for kind in KINDS:
        others = data._replace(sequences=[s for s in data.sequences if kind not in scenes[s.name]])
        left_out = [
            leave_out(s, others, size, by_recording=True)
            for s in data.sequences
            if kind in scenes[s.name]
        ]
        every += left_out
        print(f"without {kind}, {len(left_out)} sequences: ", end="")
        print_summary(Validation(left_out), ["adaptive"])
    print("all of them: ", end="")
    print_summary(Validation(every), ["adaptive"])


def own_errors(data: LabelledData) -> None:
    """Compare what each set would have estimated of its own error with the true one.

    At every hop, the estimate is compared with the mean error of the sub-trajectories that begin
    and end where the estimate looked. Sets that lose track (more than 10 % on a sequence) are left
    out.
    """
    found = [compared for s in data.sequences for compared in own_errors_on(s)]
    estimate, low, high, true = np.array(found).T
    ratio = estimate / true
    print(
        f"estimated to true: geometric mean {np.exp(np.log(ratio).mean()):.2f}, 95 % of them "
        f"{np.quantile(ratio, 0.025):.2f}-{np.quantile(ratio, 0.975):.2f}, right within a quarter "
        f"{(np.abs(np.log(ratio)) < np.log(1.25)).mean():.0%}, intervals that hold the truth "
        f"{((low <= true) & (true <= high)).mean():.0%} of {len(found)}",
        flush=True,
    )


def own_errors_on(sequence: LabelledSequence) -> Iterator[tuple[float, float, float, float]]:
    """The estimate, its interval and the true error, after every hop of every set."""
    simulation = sequence.simulation
    T_ref, hops, length = simulation.T_ref_sensor, simulation.hops, simulation.length
    metres, ends = travelled(T_ref), window_ends(T_ref, length)
    seconds = (simulation.stamps - simulation.stamps[0]) * 1e-9
    for trial in sequence.vectors:
        T_odom = chained(simulation.healthy(simulation.motions((trial,))[:, 0]))
        true = sub_trajectory_rte(T_ref, T_odom, length)
        if not np.nanmean(true) <= 10.0:
            continue
        own = OwnErrors(length)
        for start, end, *hop in zip(*hops, strict=True):
            link = Link(
                *(metres[start], metres[end], seconds[end]),
                *(T_odom[start], T_odom[end], Hop(*hop)),
            )
            own.add(link)
            inside = (metres >= own.begin) & (ends >= 0) & (ends <= end)
            if inside.any() and (found := own.estimate()) is not None:
                yield *found, float(true[inside].mean())


def constantly(sequence: LabelledSequence, members: Sequence[int]) -> Errors:
    """Errors of a bank whose weights stay the same."""
    simulation = sequence.simulation
    vectors, lost = clip_errors(
        np.stack([sequence.vectors[m] for m in members], axis=1), MEMBER_CLIP
    )
    squares = np.einsum("ijx,ikx->jk", vectors, vectors) + np.diag((lost**2).sum(axis=0))
    modes = {
        "bank, even weights": np.full(len(members), 1.0 / len(members)),
        # Nobody who has not been there knows them.
        "bank, best weights": minimum_variance_weights(squares),
    }
    n_periods = len(periods(simulation.period)[0])
    constant = {mode: np.tile(weights, (n_periods, 1)) for mode, weights in modes.items()}
    return {
        mode: simulation.errors(tuple(members), weights)[sequence.known]
        for mode, weights in constant.items()
    }


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
