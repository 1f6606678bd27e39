"""How wrong the members of a bank were over the last hops, and what that says of their weights."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.live.hop import NOISE

SECONDS, METRES = 30.0, 30.0
"""A hop counts as long as it is no older, or no farther behind, than this."""
CLIP = 5.0
"""Percent of a hop by which a member may differ from the best one, for weights: beyond that it is
lost, and how far says nothing more."""


class HopErrors(NamedTuple):
    """Errors over some hops, the newest last."""

    # (n_hops, n_members, 3): percent of the hop, in the frame of its start; NaN where a member gave
    # no pose.
    errors: NDArray[np.float64]
    start: NDArray[np.float64]  # (n_hops,): metres driven at the start of each hop
    end: NDArray[np.float64]  # (n_hops,): and at its end
    seconds: NDArray[np.float64]  # (n_hops,): time of its end

    def with_hop(
        self, errors: NDArray[np.float64], start: float, end: float, seconds: float
    ) -> "HopErrors":
        """Add a hop, and drop those that no longer count."""
        added = HopErrors(
            np.concatenate([self.errors, errors[None]]),
            np.append(self.start, start),
            np.append(self.end, end),
            np.append(self.seconds, seconds),
        )
        return added.recent(end, seconds)

    def filled(self, members: NDArray[np.bool_]) -> "HopErrors":
        """Let some members be as wrong as the worst one was, where they gave no pose.

        So they are neither lost nor at an advantage over hops that say nothing of them.

        Parameters
        ----------
        members
            Of shape (n_members,).
        """
        lengths = np.linalg.norm(self.errors, axis=-1)
        missing = np.isnan(lengths)
        worst = np.where(missing, -1.0, lengths).argmax(axis=1)
        of_worst = self.errors[np.arange(len(worst)), worst][:, None]
        gaps = (missing & members)[..., None]
        return self._replace(errors=np.where(gaps, of_worst, self.errors))

    def recent(self, metres: float, seconds: float) -> "HopErrors":
        """Those that count when so much was driven, at this time."""
        young = seconds - self.seconds <= SECONDS
        kept = np.flatnonzero(young | (metres - self.start <= METRES))
        return HopErrors(*(array[kept] for array in self))


class LiveSquares(NamedTuple):
    """Mean products of the errors of members over hops."""

    products: NDArray[np.float64]  # (n_members, n_members): percent squared
    noise: float  # percent squared: what of each of them is the registrations' own
    windows: float  # number of hops that share no part of the path


def live_squares(hops: HopErrors) -> LiveSquares | None:
    """Mean products of the errors over hops; None if there is no hop.

    The registration's error is common to all members. It adds the same to all products, so it
    does not change the minimum-variance weights.
    """
    n_hops = len(hops.errors)
    if not n_hops:
        return None
    length = hops.end - hops.start
    errors, missing = clip_to_best(hops.errors)
    products = np.einsum("hix,hjx->ij", errors, errors) / n_hops
    products += np.diag(missing.mean(axis=0)) * CLIP**2
    noise = float(((100.0 * NOISE / length) ** 2).mean())
    return LiveSquares(products, noise, windows(hops.start, hops.end))


def windows(start: NDArray[np.float64], end: NDArray[np.float64]) -> float:
    """How many stretches of a path that overlap amount to as much as if they did not.

    Parameters
    ----------
    start, end
        Metres driven, of shape (n,).
    """
    order = np.argsort(start)
    start, end = start[order], end[order]
    length = float((end - start).mean())
    reached = np.maximum.accumulate(end)
    new = np.maximum(0.0, end[1:] - np.maximum(start[1:], reached[:-1]))
    return max(1.0, (float(end[0] - start[0]) + float(new.sum())) / length)


def clip_to_best(
    errors: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Clip errors at `CLIP` from those of the member with the least error of each hop.

    Parameters
    ----------
    errors
        Of shape (n_hops, n_members, 3); NaN where a member gave no pose.

    Returns
    -------
    errors : ndarray of the same shape
        The best member's where there was none.
    missing : ndarray of shape (n_hops, n_members)
        Where there was none.
    """
    missing = np.asarray(~np.isfinite(errors).all(axis=-1))
    known = np.where(missing[..., None], np.nan, errors)
    known[missing.all(axis=1)] = 0.0
    best = np.nanargmin(np.linalg.norm(known, axis=-1), axis=1)
    centre = known[np.arange(len(known)), best][:, None]
    apart = np.where(missing[..., None], 0.0, known - centre)
    lengths = np.linalg.norm(apart, axis=-1, keepdims=True)
    return centre + apart * np.minimum(1.0, CLIP / np.maximum(lengths, 1e-9)), missing


def blend(
    prior: NDArray[np.float64], prior_windows: float, live: LiveSquares | None
) -> NDArray[np.float64]:
    """Mean products of a prior and of what was measured, each weighted by its number of windows.

    What is measured is scaled to the prior: only how members compare counts, as in the prior, and
    not how hard the place is for all of them. Without the registrations' own part, the harmonic
    means of the members' squares are then the same.

    Parameters
    ----------
    prior
        Of shape (n_members, n_members).
    prior_windows
        How many windows it counts as.
    live
        None if nothing was measured.
    """
    if live is None:
        return prior
    squares = live.products.diagonal()
    # Registrations that are as wrong as the members say little; never divide by nothing.
    own = np.maximum(squares - live.noise, 0.25 * squares) + 1e-12
    scale = (1.0 / own).mean() / (1.0 / np.maximum(prior.diagonal(), 1e-12)).mean()
    total = prior_windows + live.windows
    return np.asarray((prior_windows * prior + live.windows * scale * live.products) / total)
