"""A trajectory as a reference judges it: how wrong it is, where, and how it compares."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import Finding
from adaptune.geometry import Poses
from adaptune.metrics import span, travelled
from adaptune.paired import ERROR_FACTOR, Interval, Pair, Ratio, interval_of_mean, ratio
from adaptune.reference.carried import stands
from adaptune.reference.check import FEWEST, LONGER
from adaptune.reference.judge import Reference, columns_of
from adaptune.trajectory import Trajectory

_GIVES_NOTHING = 3.5
"""How many times its usual step a trajectory pauses, and a second at least, to give nothing."""
Verdict = Literal["above", "below", "unclear"]


class Judge(NamedTuple):
    """What judges the trajectories of a recording."""

    recording: str
    reference: Reference
    name: str  # in words
    scans: tuple[int, int]  # nanoseconds of the first one, and about those of the last
    unknown: Sequence[tuple[float, float, str]] = ()  # from when to when, in seconds, and why

    @property
    def trajectory(self) -> Trajectory:
        """The poses of the reference."""
        assert self.reference.trajectory is not None
        return self.reference.trajectory


def common_stamps(judge: Trajectory, *others: Trajectory) -> NDArray[np.int64]:
    """Where trajectories are compared: at the poses of the one that has the fewest, of shape (n,).

    All others go straight between theirs. In each gap of the judge lies one more, where nothing is
    known: no sub-trajectory crosses it.
    """
    every = [judge.stamps, *(other.stamps for other in others)]
    begin, end = max(s[0] for s in every), min(s[-1] for s in every)
    fewest = min((s[(s >= begin) & (s <= end)] for s in every), key=len)
    gaps = np.flatnonzero(np.diff(judge.stamps) > judge.max_gap * 1e9)
    middle = judge.stamps[gaps] + np.diff(judge.stamps)[gaps] // 2
    stamps = np.union1d(fewest, middle[(middle >= begin) & (middle <= end)])
    in_gaps = np.isnan(judge.at(stamps)[:, 0, 0])
    known = [np.isfinite(other.at(stamps)[:, 0, 0]) for other in others]
    return stamps[np.all(known, axis=0) | in_gaps]


@dataclass(frozen=True, eq=False)
class Judged:
    """A trajectory, judged."""

    name: str
    trajectory: Trajectory  # of the LiDAR's poses
    judge: Judge
    stamps: NDArray[np.int64]  # (n,): where it is judged
    causes: Sequence[Finding] = ()  # what its poses are, and what is wrong with them

    @property
    def title(self) -> str:
        """What it is of, in words."""
        return f"{self.name} on {self.judge.recording}"

    @cached_property
    def odometry(self) -> Trajectory:
        """Its poses where it is judged."""
        known = np.nan_to_num(self.trajectory.at(self.stamps, 1e9))
        return Trajectory(self.stamps, known)

    @cached_property
    def truth(self) -> Poses:
        """The judge's poses there, of shape (n, 4, 4); NaN where they are unknown."""
        return self.judge.trajectory.at(self.stamps)

    @cached_property
    def errors(self) -> NDArray[np.float64]:
        """Capped RTE in percent of the sub-trajectory from each pose, of shape (n,), or NaN."""
        return self.judge.reference.errors(self.odometry)

    @cached_property
    def around(self) -> NDArray[np.float64]:
        """Mean RTE in percent of the sub-trajectories through each pose, of shape (n,), or NaN."""
        return self.judge.reference.errors_around(self.odometry)

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Since the first scan, of shape (n,)."""
        return (self.stamps - self.judge.scans[0]) * 1e-9

    @property
    def known(self) -> NDArray[np.float64]:
        """The errors that are known."""
        return self.errors[np.isfinite(self.errors)]

    @property
    def rte(self) -> float | None:
        """Mean error in percent; None if no sub-trajectory fits into what is known."""
        return float(self.known.mean()) if len(self.known) else None

    @property
    def block(self) -> int:
        """Frames of a sub-trajectory."""
        return span(self.truth, self.judge.reference.length)

    @cached_property
    def interval(self) -> Interval:
        """Of the mean error, 95 %, with the judge's own error, where that is known."""
        own = self.judge.reference.error
        return interval_of_mean(self.known, self.block, own) if len(self.known) else None

    @property
    def blind(self) -> bool:
        """Whether the judge is about as wrong as what it judges."""
        own = self.judge.reference.error or 0.0
        low = self.interval[0] if self.interval else math.inf
        return self.rte is not None and (low == 0.0 or self.rte < ERROR_FACTOR * own)

    @cached_property
    def drift(self) -> tuple[float, float] | None:
        """Metres of error in a hundred, and over how many metres that was measured."""
        metres = float(travelled(self.truth)[-1])
        length = self.judge.reference.length
        fit = [m for m in LONGER if m > length and FEWEST * m <= metres]
        for longer in sorted({length, *fit}, reverse=True):
            errors = self.judge.reference._replace(length=longer).errors(self.odometry)
            if len(known := errors[np.isfinite(errors)]):
                return float(known.mean()), longer
        return None

    @property
    def worst(self) -> int | None:
        """Which pose the sub-trajectories with the greatest error go through."""
        return int(np.nanargmax(self.around)) if np.isfinite(self.around).any() else None

    @cached_property
    def unknown_share(self) -> float:
        """Share of the scans' time that it covers in which the judge knows no pose."""
        begin, end = max(self.stamps[0], self.judge.scans[0]), self.stamps[-1]
        stamps = np.linspace(begin, end, 2000).astype(np.int64)
        gap = max(self.judge.trajectory.max_gap, 0.0)
        return float(np.isnan(self.judge.trajectory.at(stamps, gap)[:, 0, 0]).mean())

    @cached_property
    def faults(self) -> list[Finding]:
        """Where it stood still while the robot moved, or gave nothing."""
        T, step = self.odometry.T_world_sensor, np.diff(self.trajectory.stamps) * 1e-9
        still = [
            Finding((), "stands still while the robot moves", seconds=(begin, end))
            for begin, end in _spans(stands(self.truth, T), self.seconds)
        ]
        long = np.flatnonzero(step > max(1.0, _GIVES_NOTHING * float(np.median(step))))
        ends = (self.trajectory.stamps - self.judge.scans[0]) * 1e-9
        nothing = [
            Finding((), "gives nothing", seconds=(float(ends[i]), float(ends[i + 1])))
            for i in long.tolist()
        ]
        return still + nothing

    @property
    def covered(self) -> str:
        """Where it covers only a part of the scans, in words."""
        begin, end = ((s - self.judge.scans[0]) * 1e-9 for s in self.trajectory.stamps[[0, -1]])
        seconds = (self.judge.scans[1] - self.judge.scans[0]) * 1e-9
        if max(begin, 0.0) + max(seconds - end, 0.0) <= max(1.0, 0.05 * seconds):
            return ""
        return f"covers {max(begin, 0.0):.1f} to {min(end, seconds):.1f} of {seconds:.1f} s"

    def verdict(self, most: float) -> Verdict:
        """Whether its error is surely above, or below, so many percent."""
        if self.rte is None or self.interval is None:
            return "unclear"
        low, high = self.interval
        return "above" if low > most else "below" if high <= most else "unclear"

    @property
    def row(self) -> dict[str, Any]:
        """The row of a table."""
        low, high = self.interval or (None, None)
        drift, worst = self.drift, self.worst
        x, y, z = (None,) * 3 if worst is None else self.truth[worst, :3, 3].tolist()
        return {
            "recording": self.judge.recording,
            "trajectory": self.name,
            "RTE [%]": self.rte,
            "95 %": None if low is None else f"{low:.2f}-{high:.2f}",
            "drift [m/100 m]": drift and drift[0],
            "worst [%]": None if worst is None else float(self.around[worst]),
            "at [s]": None if worst is None else float(self.seconds[worst]),
            "faults": len(self.faults) + len(self.causes),
            "unknown [%]": 100.0 * self.unknown_share,
            "_low": low,
            "_high": high,
            "_length_m": self.judge.reference.length,
            "_drift_over_m": drift and drift[1],
            "_worst_x_m": x,
            "_worst_y_m": y,
            "_worst_z_m": z,
            "_judge": self.judge.name,
            "_judge_error_percent": self.judge.reference.error,
            "_findings": "; ".join(map(str, [*self.causes, *self.faults])),
        }

    @property
    def standard(self) -> dict[str, Any]:
        """The row of a table of the errors that other tools give."""
        head = {"recording": self.judge.recording, "trajectory": self.name}
        return head | columns_of(self.judge.reference.standard(self.odometry))


def _spans(which: NDArray[np.bool_], seconds: NDArray[np.float64]) -> Iterable[tuple[float, float]]:
    """From when to when something holds, of shape (n,)."""
    edges = np.flatnonzero(np.diff(which, prepend=False, append=False)).reshape(-1, 2)
    return [(float(seconds[begin]), float(seconds[end - 1])) for begin, end in edges.tolist()]


def pair_of(one: Judged, other: Judged) -> Pair:
    """Two trajectories of a recording, at stamps that both have."""
    judge, length = one.judge, one.judge.reference.length
    stamps = common_stamps(judge.trajectory, one.trajectory, other.trajectory)
    both = [Judged(j.name, j.trajectory, judge, stamps) for j in (one, other)]
    errors = np.stack([j.errors for j in both])
    known = errors[:, np.isfinite(errors).all(axis=0)]
    block = span(judge.trajectory.at(stamps), length)
    return Pair(known, block, judge.recording, judge.reference.error)


def compared(pairs: Sequence[Pair]) -> Ratio | None:
    """The ratio of the errors of two trajectories over recordings; None if nothing is known."""
    known = [pair for pair in pairs if pair.errors.size]
    return ratio(known) if known else None
