"""What a parameter set adds to a bank, from the errors that trials have recorded."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, Frames, Summary
from adaptune.model.rules import ERROR_FLOOR
from adaptune.model.weights import clip_errors, minimum_variance_weights
from offline.bank_simulation import error_vectors

MOST_FRAMES = 200
"""Frames of a sequence that are looked at, evenly along it."""

_NO_ERROR = 1e-12


class Portfolio:
    """Says by how much the validated loss of a bank falls when a set joins it.

    The loss of a bank is the mean over the sequences of the logarithm of the root mean square of
    its members' weighted mean, as a ratio to the fixed set's. The weights have the least variance
    on the other sequences (on the only one, where there is no other). The fixed set is the one
    with the least mean error.

    Parameters
    ----------
    archive
        Of the trials.
    names
        The sequences.
    length
        Metres of a sub-trajectory.
    size
        Members of a bank.
    """

    def __init__(self, archive: Archive, names: Sequence[str], length: float, size: int):
        self._archive, self._names = archive, list(names)
        self._length, self._size = length, size
        self._frames: dict[str, Frames] = {}
        self._vectors: dict[tuple[str, int], NDArray[np.float32]] = {}

    def __call__(self, trials: Sequence[int]) -> list[float]:
        """The loss of a bank that each of some trials joins; the lower, the more it adds.

        A set joins the best bank of the others, which has one member less. Trials that were not run
        on every sequence get the highest loss of all.
        """
        runs = [self._archive.finished(name) for name in self._names]
        errors = {t: np.mean([r[t].mean_error for r in runs]) for t in trials if _in_all(t, runs)}
        if not errors:
            return [0.0] * len(trials)
        complete = sorted(errors, key=lambda t: errors[t])
        squares = np.array([self._squares(name, complete) for name in self._names])
        bank = self._bank(squares)
        found = {}
        for j, trial in enumerate(complete):
            others = [member for member in bank if member != j][: self._size - 1]
            found[trial] = loss(squares, [*others, j])
        worst = max(found.values())
        return [found.get(trial, worst) for trial in trials]

    def _bank(self, squares: NDArray[np.float64]) -> list[int]:
        """Columns of the best bank, chosen one member after the other; the fixed set is first."""
        bank = [0]
        while len(bank) < min(self._size, squares.shape[1]):
            rest = [j for j in range(squares.shape[1]) if j not in bank]
            bank.append(min(rest, key=lambda j: loss(squares, [*bank, j])))
        return bank

    def _squares(self, name: str, trials: Sequence[int]) -> NDArray[np.float64]:
        """Mean products of the sets' errors on a sequence, of shape (n_trials, n_trials).

        They are ratios to the mean square of the first one.
        """
        vectors, lost = clip_errors(np.stack([self._read(name, t) for t in trials], axis=1), 0)
        rows = vectors.transpose(0, 2, 1).reshape(-1, len(trials)).astype(np.float64)
        products = rows.T @ rows + np.diag((lost.astype(np.float64) ** 2).sum(axis=0))
        return np.asarray(products / (products[0, 0] + len(lost) * ERROR_FLOOR**2))

    def _read(self, name: str, trial: int) -> NDArray[np.float32]:
        """Error vectors of a trial on some frames of a sequence, of shape (n_frames, 3)."""
        if name not in self._frames:
            self._frames[name] = self._archive.read_frames(name)
        if (name, trial) not in self._vectors:
            of = error_vectors(self._frames[name], self._archive.read(name, trial), self._length)
            known = np.flatnonzero(~np.isnan(of).any(axis=1))
            few = np.linspace(0, len(known) - 1, min(len(known), MOST_FRAMES)).round().astype(int)
            self._vectors[name, trial] = of[known[few]]
        return self._vectors[name, trial]


def loss(squares: NDArray[np.float64], members: Sequence[int]) -> float:
    """Mean logarithm of the root mean square of a bank's weighted mean, see `Portfolio`.

    Parameters
    ----------
    squares
        Mean products of the errors on each sequence, of shape (n_sequences, n_sets, n_sets).
    members
        Columns of the members.
    """
    few = squares[np.ix_(range(len(squares)), members, members)]
    others = few.sum(axis=0) - few if len(few) > 1 else few
    means = others / max(len(few) - 1, 1)
    weights = np.array([minimum_variance_weights(mean) for mean in means])
    mean_squares = np.einsum("si,sij,sj->s", weights, few, weights)
    # Where nobody errs, nothing is to be gained.
    return float(0.5 * np.log(np.maximum(mean_squares, _NO_ERROR)).mean())


def _in_all(trial: int, runs: Sequence[Mapping[int, Summary]]) -> bool:
    return all(trial in of_sequence for of_sequence in runs)
