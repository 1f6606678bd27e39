"""Which trials of a batch go on to more sequences, and which are given up.

The first batch is run in full. It tells which sequences are hard, and these come first from then
on: sets fail on them, if anywhere. Trials of later batches are run on growing shares of the
sequences; what a trial has seen when it is given up still feeds the model. Who goes on depends on
the batches before and on the batch itself so far, and on nothing else.

- ``halving``: the best third goes on to three times as many sequences (successive halving, Jamieson
  and Talwalkar, AISTATS 2016), the best of all trials of any batch that have come so far.
- ``hyperband``: the same, but batches begin with three, nine... sequences in turn (Li et al., JMLR
  2018), for where a few sequences say little about the others.
- ``wilcoxon``: one sequence after the other; given up is what a signed-rank test finds worse than
  the best trial on the same sequences (Optuna's pruner).

All of them give up what cannot win any more: values are never negative, so a trial that comes to
more on some sequences than the best one on all of them is worse.
"""

import warnings
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import optuna

Pruning = Literal["none", "halving", "hyperband", "wilcoxon"]

REDUCTION = 3
"""Of so many trials one goes on, to so many times the sequences."""
FEWEST = 3
"""Sequences, and not fewer, are taken to stand for the others."""
SIGNIFICANCE = 0.1
"""A difference is taken for more than chance where the test's p is below this."""

Values = Sequence[float]
"""A trial's objective on the sequences that it was run on, in their order."""


def rungs(pruning: Pruning, batch: int, n: int) -> list[int]:
    """Numbers of sequences after which trials of a batch are given up; the last is all of them.

    Parameters
    ----------
    pruning
        The rule.
    batch
        Number of the batch.
    n
        Number of sequences.
    """
    if pruning == "none" or batch == 0:
        return [n]
    if pruning == "wilcoxon":
        return [*range(2, n), n] if n > 2 else [n]
    sizes = [n]
    while sizes[0] > FEWEST:
        sizes.insert(0, max(FEWEST, -(-sizes[0] // REDUCTION)))
    return sizes[batch % len(sizes) :] if pruning == "hyperband" else sizes


def survivors(
    pruning: Pruning, m: int, batch: Mapping[int, Values], before: Mapping[int, Values]
) -> list[int]:
    """Numbers of the trials of a batch that go on.

    Parameters
    ----------
    pruning
        The rule.
    m
        Number of sequences that the trials of the batch have seen.
    batch, before
        Values of the trials of this batch that are left and of those before, by their numbers, of
        such that keep all limits.
    """
    if not before:
        return list(batch)
    n_sequences = max(map(len, before.values()))
    best = min((v for v in before.values() if len(v) == n_sequences), key=sum)
    can_win = {n: values for n, values in batch.items() if sum(values) <= sum(best)}
    if pruning == "wilcoxon":
        return [n for n, values in can_win.items() if not _worse(values, best)]
    means = {n: float(np.mean(v[:m])) for n, v in {**before, **batch}.items() if len(v) >= m}
    best_ones = sorted(means, key=lambda n: (means[n], n))[: -(-len(means) // REDUCTION)]
    return [n for n in can_win if n in best_ones]


def _worse(values: Values, best: Values) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        pruner = optuna.pruners.WilcoxonPruner(p_threshold=SIGNIFICANCE)
    study = optuna.create_study(pruner=pruner)
    told = {i: float(value) for i, value in enumerate(best)}
    study.add_trial(optuna.trial.create_trial(value=float(np.mean(best)), intermediate_values=told))
    trial = study.ask()
    for i, value in enumerate(values):
        trial.report(value, i)
    return trial.should_prune()


def estimate(values: Values, baseline: Values) -> float:
    """What a trial that was given up would have come to: as far from the baseline as it was.

    Parameters
    ----------
    values
        Of the trial, on the first sequences.
    baseline
        The baseline's, on all of them.
    """
    seen = float(np.mean(baseline[: len(values)]))
    return float(np.mean(values)) * (float(np.mean(baseline)) / seen if seen > 0.0 else 1.0)
