"""Pruning: which trials of a batch continue on more sequences, and which stop.

The first batch runs in full. It shows which sequences are hard, and these come first from then on:
sets fail on them, if anywhere. Trials of later batches run on growing shares of the sequences. The
model also uses what a trial saw before it stopped. The choice depends on the batches before and on
the batch so far, and on nothing else.

- ``halving``: the best third continues on three times as many sequences (successive halving,
  Jamieson and Talwalkar, AISTATS 2016): the best third of all trials that came so far.
- ``hyperband``: the same, but batches begin with three, nine... sequences in turn (Li et al., JMLR
  2018), for studies in which a few sequences say little about the others.
- ``wilcoxon``: one sequence after the other. A trial stops if a signed-rank test finds it worse
  than the best trial on the same sequences (Optuna's pruner).

All rules stop a trial that cannot win any more. Values are never negative, so a trial whose sum
over some sequences exceeds the best trial's sum over all sequences is worse.
"""

import warnings
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

Pruning = Literal["none", "halving", "hyperband", "wilcoxon"]

REDUCTION = 3
"""One of so many trials continues, on so many times the sequences."""
FEWEST = 3
"""The least number of sequences that may stand for the others."""
SIGNIFICANCE = 0.1
"""A difference counts as more than chance if the test's p is below this."""

Values = Sequence[float]
"""A trial's objective on the sequences on which it was run, in their order."""


def rungs(pruning: Pruning, batch: int, n: int) -> list[int]:
    """Numbers of sequences after which trials of a batch may stop; the last one is `n`, all."""
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
    """Numbers of the trials of a batch that continue.

    Parameters
    ----------
    pruning
        The rule.
    m
        Number of sequences on which the trials of the batch were run.
    batch, before
        Values by trial number: of the trials of this batch that are left, and of all trials before.
        Only trials that keep all limits.
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
    import optuna  # takes a second, and few studies need it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        pruner = optuna.pruners.WilcoxonPruner(p_threshold=SIGNIFICANCE)
    study = optuna.create_study(pruner=pruner)
    steps = {i: float(value) for i, value in enumerate(best)}
    mean = float(np.mean(best))
    study.add_trial(optuna.trial.create_trial(value=mean, intermediate_values=steps))
    trial = study.ask()
    for i, value in enumerate(values):
        trial.report(value, i)
    return trial.should_prune()


def estimate(values: Values, baseline: Values) -> float:
    """Estimate the mean of a stopped trial from its ratio so far to the whole baseline."""
    seen = float(np.mean(baseline[: len(values)]))
    return float(np.mean(values)) * (float(np.mean(baseline)) / seen if seen > 0.0 else 1.0)
