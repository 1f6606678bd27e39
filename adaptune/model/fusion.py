"""Weights of the instances in a bank, whose motions are averaged."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from adaptune.metrics import FAILURE
from adaptune.model.base import Selection, mean_errors
from adaptune.model.paired import ERROR_FLOOR, NOVEL, Near, PairedExpectedRatio, Settings

RIDGE = 0.05
"""Added to mean squares, as a share of the fixed set's, so that like members share the weight."""
STEADY = 5
"""Selections whose weights are averaged: errors cancel each other while weights stay the same."""
POOL = 64
"""A bank's members are sought among so many of the best sets."""


class PairedFusion(PairedExpectedRatio):
    """Weigh the members of a bank so that the mean of their motions is expected to err least.

    While errors are small, a weighted mean of motions errs by the weighted mean of the errors. With
    weights w its mean square is w'Sw, where S_jk is the mean product of the errors of members j
    and k, which are vectors: two that err in different directions are worth more together than the
    better one alone (as with forecasts: Bates and Granger, Operational Research Quarterly 1969).

    For each training sequence S is of the frames nearest to the scan, divided by the fixed set's
    mean square there. Sequences weigh as in `PairedExpectedRatio`, and no weight is negative.

    What is found at one scan is noise in part, and members' errors of some seconds cancel each
    other only while the weights stay: what is driven with is the mean over a few selections, see
    `steady`.

    Parameters
    ----------
    settings
        `sharpness`, `n_frames`, `hedge` and `limit` are heeded; `limit` not after the fit.
    """

    def _candidates(self) -> NDArray[np.intp]:
        data = self.data_
        if data.candidates is None or data.vectors is None or data.candidates[0] != data.fixed:
            raise ValueError("a bank needs members, the fixed set first, and their error vectors")
        return np.array(data.candidates)

    def _evidence(self) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Squared errors of the fixed set, and products of all members' errors, on every frame."""
        assert self.data_.vectors is not None
        products = np.empty((len(self.data_.features), *2 * [len(self.candidates_)]), np.float32)
        for s in np.unique(self.data_.sequence):
            members = self.data_.sequence == s
            vectors, lost = limited(self.data_.vectors[members], 0, self.settings.limit)
            products[members] = np.einsum("ijx,ikx->ijk", vectors, vectors)
            products[members] += lost[:, :, None] ** 2 * np.eye(len(self.candidates_))
        return products[:, 0, 0].astype(np.float64), products

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`; of a member alone."""
        near = self.near(feature[None])
        of_sequences = self.weights(near.squared)
        squares = np.einsum("qs,qsjj->qj", of_sequences, near.errors)
        predicted = np.full(len(self.data_.sets), np.inf)
        predicted[self.candidates_] = np.sqrt(squares[0])
        return predicted

    def weigh(self, near: Near) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Weights of the members, and the root mean square that is expected of their mean.

        Returns
        -------
        weights : ndarray of shape (n_scans, n_members)
        ratio : ndarray of shape (n_scans,)
            To the fixed set's.
        """
        relative = near.errors / (near.fixed + ERROR_FLOOR**2)[..., None, None]
        squares = np.einsum("qs,qsjk->qjk", self.weights(near.squared), relative)
        weights = np.array([least(of_scan) for of_scan in squares])
        trust = np.minimum(1.0, near.familiarity / NOVEL) * (1.0 - self.settings.hedge)
        weights *= trust[:, None]
        weights[:, 0] += 1.0 - trust
        mean_square = np.einsum("qj,qjk,qk->q", weights, squares, weights)
        # Without any error of the fixed set there is none to be gained on.
        of_fixed = np.maximum(squares[:, 0, 0], 1e-12)
        return weights, np.sqrt(mean_square / of_fixed)

    def select(
        self,
        feature: NDArray[np.float64],
        current: int | None = None,  # noqa: ARG002 - nothing is switched
    ) -> Selection:
        """See `Rule.select`."""
        near = self.near(feature[None])
        (weights,), (ratio,) = self.weigh(near)
        (of_sequences,) = self.weights(near.squared)
        fixed = float(np.sqrt(of_sequences @ near.fixed[0]))
        return Selection(
            int(self.candidates_[weights.argmax()]),
            float(ratio) * fixed,
            fixed,
            float(near.familiarity[0]),
            float(1.0 / (of_sequences @ of_sequences)),
            tuple(weights.tolist()),
        )


class Steady:
    """Averages the weights of the last selections, see `steady`."""

    def __init__(self) -> None:
        self._last: deque[Selection] = deque(maxlen=STEADY)

    def __call__(self, selection: Selection, members: Sequence[int]) -> Selection:
        """The selection with the weights to be driven with; what it predicts stays as it is.

        Parameters
        ----------
        selection
            By `PairedFusion`.
        members
            Numbers of the sets in the bank.
        """
        self._last.append(selection)
        found = np.array([s.weights for s in self._last])
        weights = steady(found, np.array([s.familiarity for s in self._last]))[-1]
        heaviest = members[int(weights.argmax())]
        return selection._replace(set_index=heaviest, weights=tuple(weights.tolist()))


def steady(weights: NDArray[np.float64], familiarity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the weights at each selection and at those before it, `STEADY` at most.

    Doubt does not wait: where a scan is unlike all training, the fixed set has as much weight at
    once as it allows.

    Parameters
    ----------
    weights
        Found at one selection after the other, of shape (n_selections, n_members).
    familiarity
        Of each scan, of shape (n_selections,).

    Returns
    -------
    ndarray of shape (n_selections, n_members)
    """
    total = weights.copy()
    for k in range(1, STEADY):
        total[k:] += weights[:-k]
    mean = total / np.minimum(np.arange(1, len(weights) + 1), STEADY)[:, None]
    trust = np.minimum(1.0, familiarity / NOVEL)
    others = np.maximum(mean[:, 1:].sum(axis=1), 1e-12)
    mean[:, 1:] *= np.minimum(1.0, trust / others)[:, None]
    mean[:, 0] = np.maximum(0.0, 1.0 - mean[:, 1:].sum(axis=1))
    return np.asarray(mean)


def limited(
    vectors: NDArray[np.float32], fixed: int, limit: float = Settings().limit
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Errors on the frames of a sequence, none of them beyond a limit.

    Parameters
    ----------
    vectors
        Percent, of shape (n_frames, n_sets, 3); not finite where the track was lost.
    fixed
        Number of the fixed set.
    limit
        See `Settings`.

    Returns
    -------
    vectors : ndarray of shape (n_frames, n_sets, 3)
        Zero where the track was lost.
    lost : ndarray of shape (n_frames, n_sets)
        What counts there instead, in no direction; zero elsewhere.
    """
    lengths = np.linalg.norm(vectors, axis=-1)
    lost = ~(lengths <= FAILURE)
    of_fixed = np.where(lost[:, fixed], FAILURE, lengths[:, fixed])
    most = limit * np.sqrt((of_fixed**2).mean() + ERROR_FLOOR**2)
    share = np.minimum(1.0, most / np.maximum(lengths, 1e-9))
    kept = np.where(lost[..., None], 0.0, vectors) * np.where(lost, 0.0, share)[..., None]
    return kept.astype(np.float32), np.where(lost, most, 0.0).astype(np.float32)


def least(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights w, none negative and adding up to 1, for which w'Sw is least.

    Parameters
    ----------
    squares
        S, of shape (n, n), the fixed set first.

    Returns
    -------
    ndarray of shape (n,)
    """
    n = len(squares)
    squares = squares + np.eye(n) * (RIDGE * squares[0, 0] + 1e-12)
    # Up to a factor they are those for which w'Sw - 2 sum w is least.
    root = np.linalg.cholesky(squares)
    weights, _ = nnls(root.T, np.linalg.solve(root, np.ones(n)))
    return np.asarray(weights / weights.sum())


def bank(
    vectors: Sequence[NDArray[np.float32]],
    errors: Sequence[NDArray[np.floating]],
    fixed: int,
    size: int,
) -> list[int]:
    """Choose sets whose errors cancel each other.

    Greedily, beginning with the fixed set: each next one lowers the mean over the sequences of the
    root mean square of a weighted mean most, if the best weights in every sequence were known.

    Parameters
    ----------
    vectors
        Of every sequence, see `limited`.
    errors
        Of every sequence, percent, of shape (n_frames, n_sets); NaN where a set was never run. One
        that was not run on every sequence is not chosen.
    fixed
        The fixed set.
    size
        How many to choose, if there are as many.

    Returns
    -------
    list of int
        Numbers of the sets, the fixed one first.
    """
    number = np.repeat(np.arange(len(errors)), [len(e) for e in errors])
    means = mean_errors(np.concatenate(errors), number)
    pool = [int(j) for j in np.argsort(means, kind="stable")[:POOL] if np.isfinite(means[j])]
    pool = [fixed, *(j for j in pool if j != fixed)]
    squares = []
    for of_sequence in vectors:
        few, lost = limited(of_sequence[:, pool], 0)
        rows = few.transpose(0, 2, 1).reshape(-1, len(pool)).astype(np.float64)
        products = (rows.T @ rows + np.diag((lost.astype(np.float64) ** 2).sum(axis=0))) / len(few)
        squares.append(products / (products[0, 0] + ERROR_FLOOR**2))
    chosen = [0]
    while len(chosen) < min(size, len(pool)):
        rest = [j for j in range(len(pool)) if j not in chosen]
        chosen.append(min(rest, key=lambda j: _worth(squares, [*chosen, j])))
    return [pool[j] for j in chosen]


def _worth(squares: list[NDArray[np.float64]], members: list[int]) -> float:
    of_members = [s[np.ix_(members, members)] for s in squares]
    return float(np.mean([np.sqrt(w @ s @ w) for s in of_members for w in [least(s)]]))
