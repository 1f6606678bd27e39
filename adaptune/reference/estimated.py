"""An estimated reference: poses, where they can be trusted, and how accurate they are."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError, Finding
from adaptune.geometry import Poses
from adaptune.metrics import sub_trajectory_rte, travelled
from adaptune.trajectory import Trajectory

BREAK = 1.0  # seconds; where the reference is not to be trusted, a longer gap without poses says so
HALVES_TO_WHOLE = 0.75
"""Error of the whole reference, as a share of the difference between its two halves: half of it if
they had nothing in common, but they share what all registrations get wrong."""
OF_BOTH = 0.02
"""Percent. Error that both halves share even where they agree. Both figures were found on simulated
courses, see docs/research/without-ground-truth.md."""


class EstimateError(AdaptuneError):
    """A recording from which no reference can be estimated."""


class Registrations(NamedTuple):
    """Direct registrations of scans to scans some metres before."""

    start: NDArray[np.intp]  # (m,): numbers of the scans
    end: NDArray[np.intp]
    accepted: NDArray[np.bool_]  # (m,): whether the pose graph agrees with it
    residual: NDArray[np.float64]  # (m,): metres off the pose graph; NaN if it failed


@dataclass(frozen=True, eq=False)
class EstimatedReference:
    """A reference that was computed from the recording."""

    stamps: NDArray[np.int64]  # (n,): of all scans, in nanoseconds
    T_world_sensor: Poses  # (n, 4, 4): the pose of every scan; the first is the identity
    trusted: NDArray[np.bool_]  # (n - 1,): whether the motion to the next scan can be trusted
    halves: Poses  # (2, n, 4, 4): the poses from either half of the registrations alone
    registrations: Registrations

    def part(self, within: NDArray[np.bool_]) -> "EstimatedReference":
        """That of a part of the recording; `within` says which scans are in it, of shape (n,)."""
        first, last = np.flatnonzero(within)[[0, -1]].tolist()
        of_part, found = slice(first, last + 1), self.registrations
        inside = (found.start >= first) & (found.end <= last)
        kept = Registrations._make(array[inside] for array in found)
        T_first_world = np.linalg.inv(self.T_world_sensor[first])
        T_first_halves = np.linalg.inv(self.halves[:, first])
        return EstimatedReference(
            self.stamps[of_part],
            T_first_world @ self.T_world_sensor[of_part],
            self.trusted[first:last],
            T_first_halves[:, None] @ self.halves[:, of_part],
            kept._replace(start=kept.start - first, end=kept.end - first),
        )

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

    def gaps(self) -> list[Finding]:
        """Where the reference is unknown, and why."""
        seconds = (self.stamps - self.stamps[0]) * 1e-9
        edges = np.flatnonzero(np.diff(self.known.astype(int), prepend=1, append=1))
        begins, ends = np.maximum(edges[::2] - 1, 0), np.minimum(edges[1::2], len(seconds) - 1)
        return [
            Finding((), self._reason(i, k), seconds=(float(seconds[i]), float(seconds[k])))
            for i, k in zip(begins.tolist(), ends.tolist(), strict=True)
        ]

    def _reason(self, first: int, last: int) -> str:
        """Why nothing is known between two scans."""
        breaks = np.diff(self.stamps[first : last + 1]) * 1e-9
        if breaks.max(initial=0.0) > BREAK + 2.0 * float(np.median(np.diff(self.stamps)) * 1e-9):
            return f"no scans for {breaks.max():.1f} s"
        found = self.registrations
        across = (found.start < last) & (found.end > first) & ~found.accepted
        if not across.any():
            return "too few registrations"
        differ = np.isfinite(found.residual[across]).mean()
        return "registrations contradict each other" if differ > 0.5 else "registrations fail"

    def trajectory(self) -> Trajectory:
        """The poses that are known."""
        known = self.known
        return Trajectory(self.stamps[known], self.T_world_sensor[known], BREAK)

    @property
    def known_poses(self) -> Poses:
        """The poses, of shape (n, 4, 4), NaN where they are unknown."""
        return np.asarray(np.where(self.known[:, None, None], self.T_world_sensor, np.nan))

    def path(self) -> float:
        """Metres travelled, as far as it is known."""
        return float(travelled(self.known_poses)[-1])

    def unknown_share(self) -> float:
        """Share of the scans whose pose is unknown."""
        return 1.0 - float(self.known.mean())

    def error(self, length: float) -> float:
        """Estimated mean RTE of the reference in percent over `length` metres; NaN if unknown."""
        known = self.known[:, None, None]
        one, other = (np.where(known, half, np.nan) for half in self.halves)
        errors = sub_trajectory_rte(one, other, length)
        errors = errors[np.isfinite(errors)]
        if not len(errors):
            return float("nan")
        return float(np.hypot(HALVES_TO_WHOLE * errors.mean(), OF_BOTH))
