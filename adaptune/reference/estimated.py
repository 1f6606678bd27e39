"""An estimated reference: poses, where they can be trusted, and how accurate they are."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.metrics import sub_trajectory_rte, travelled
from adaptune.trajectory import Trajectory

BREAK = 1.0
"""Seconds. Where the reference is not to be trusted, a longer gap without poses says so."""
HALVES_TO_WHOLE = 0.75
"""Error of the whole reference, as a share of the difference between its two halves: half of it if
they had nothing in common, but they share what all registrations get wrong."""
OF_BOTH = 0.02
"""Percent. Error that both halves share even where they agree. Both figures were found on simulated
courses, see docs/research/without-ground-truth.md."""


class EstimateError(AdaptuneError):
    """A recording from which no reference can be estimated."""


class Gap(NamedTuple):
    """Seconds since the first scan between which a reference is unknown, and why."""

    begin: float
    end: float
    reason: str


class Registrations(NamedTuple):
    """Direct registrations of scans to scans some metres before.

    Attributes
    ----------
    start, end : ndarray of shape (m,)
        Numbers of the scans.
    accepted : ndarray of shape (m,)
        Whether the pose graph agrees with it.
    residual : ndarray of shape (m,)
        Metres by which it differs from the pose graph; NaN if the registration failed.
    """

    start: NDArray[np.intp]
    end: NDArray[np.intp]
    accepted: NDArray[np.bool_]
    residual: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EstimatedReference:
    """A reference that was computed from the recording.

    Attributes
    ----------
    stamps : ndarray of shape (n,)
        Of all scans, in nanoseconds.
    T_world_sensor : ndarray of shape (n, 4, 4)
        The pose of every scan; the first is the identity.
    trusted : ndarray of shape (n - 1,)
        Whether the motion from each scan to the next can be trusted.
    halves : ndarray of shape (2, n, 4, 4)
        The poses from either half of the registrations alone.
    registrations : Registrations
        All registrations.
    """

    stamps: NDArray[np.int64]
    T_world_sensor: Poses
    trusted: NDArray[np.bool_]
    halves: Poses
    registrations: Registrations

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which poses are given, of shape (n,).

        A motion that is not to be trusted leaves a gap of more than `BREAK` seconds, and of one
        pose at least. No sub-trajectory crosses it then, whoever reads the trajectory.
        """
        known = np.ones(len(self.stamps), bool)
        for i in np.flatnonzero(~self.trusted):
            end = np.searchsorted(self.stamps, self.stamps[i] + round(BREAK * 1e9), side="right")
            known[i + 1 : max(int(end), i + 2)] = False
        return known

    def gaps(self) -> list["Gap"]:
        """Where the reference is unknown, and why."""
        seconds = (self.stamps - self.stamps[0]) * 1e-9
        edges = np.flatnonzero(np.diff(self.known.astype(int), prepend=1, append=1))
        last = len(seconds) - 1
        return [
            Gap(
                float(seconds[max(first - 1, 0)]),
                float(seconds[min(stop, last)]),
                self._reason(max(first - 1, 0), min(stop, last)),
            )
            for first, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        ]

    def _reason(self, first: int, last: int) -> str:
        """Why nothing is known between two scans."""
        breaks = np.diff(self.stamps[first : last + 1]) * 1e-9
        if breaks.max(initial=0.0) > BREAK + 2.0 * float(np.median(np.diff(self.stamps)) * 1e-9):
            return f"no scans for {breaks.max():.1f} s"
        of = self.registrations
        across = (of.start < last) & (of.end > first) & ~of.accepted
        if not across.any():
            return "too few registrations"
        differ = np.isfinite(of.residual[across]).mean()
        return "registrations contradict each other" if differ > 0.5 else "registrations fail"

    def trajectory(self) -> Trajectory:
        """The poses that are known."""
        known = self.known
        return Trajectory(self.stamps[known], self.T_world_sensor[known], BREAK)

    def path(self) -> float:
        """Metres travelled, as far as it is known."""
        T = np.where(self.known[:, None, None], self.T_world_sensor, np.nan)
        return float(travelled(T)[-1])

    def unknown_share(self) -> float:
        """Share of the scans whose pose is unknown."""
        return 1.0 - float(self.known.mean())

    def error(self, length: float) -> float:
        """Estimated mean RTE of the reference itself.

        Parameters
        ----------
        length
            Metres of the sub-trajectories.

        Returns
        -------
        float
            Percent; NaN where no sub-trajectory is as long.
        """
        known = self.known[:, None, None]
        one, other = (np.where(known, half, np.nan) for half in self.halves)
        errors = sub_trajectory_rte(one, other, length)
        errors = errors[np.isfinite(errors)]
        if not len(errors):
            return float("nan")
        return float(np.hypot(HALVES_TO_WHOLE * errors.mean(), OF_BOTH))
