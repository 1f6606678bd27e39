"""A trajectory as a reference judges it: how wrong it is, where, and how surely."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError, Finding
from adaptune.geometry import Poses
from adaptune.metrics import FAILURE, LOST_ABOVE, span, travelled
from adaptune.paired import ERROR_FACTOR, Interval, Pair, in_cell, interval_of_mean
from adaptune.recording.poses import sound
from adaptune.reference.carried import stands
from adaptune.reference.check import FEWEST, LONGER
from adaptune.reference.judge import Reference
from adaptune.trajectory import Trajectory

_GAP = 3.5  # times its usual step, and seconds at least 1, after which a trajectory gives nothing
_RARE = 1.6  # times the judge's step, from which on a trajectory gives few poses, as keyframes
_JUDGED_MOMENTS = 2000  # at which it is asked whether the judge knows a pose


class Judge(NamedTuple):
    """What judges the trajectories of a recording."""

    recording: str
    reference: Reference  # it has poses
    name: str  # in words
    begin: int  # nanoseconds of the first scan, and about those of the last
    end: int
    unknown: Sequence[tuple[float, float, str]] = ()  # from when to when, in seconds, and why
    doubt: str = ""  # what the scans say against it

    @property
    def trajectory(self) -> Trajectory:
        """Its poses."""
        assert self.reference.trajectory is not None
        return self.reference.trajectory


def shared_stamps(judge: Trajectory, *others: Trajectory) -> NDArray[np.int64]:
    """Where trajectories are judged: at the poses of the one that has the fewest, (n,).

    All others go straight between theirs. In each gap of the judge lies one more, where nothing is
    known: no sub-trajectory crosses it.
    """
    every = [judge.stamps, *(other.stamps for other in others)]
    begin, end = max(one[0] for one in every), min(one[-1] for one in every)
    within = [one[(one >= begin) & (one <= end)] for one in every]
    gaps = np.diff(every[0]) > judge.max_gap * 1e9
    middle = (every[0][:-1] + np.diff(every[0]) // 2)[gaps]
    middle = middle[(middle > begin) & (middle < end)]
    stamps = np.union1d(min(within, key=len), middle)
    known = [np.isfinite(other.at(stamps)[:, 0, 0]) for other in others]
    return np.asarray(stamps[np.all(known, axis=0) | np.isin(stamps, middle)])


@dataclass(frozen=True, eq=False)
class Judged:
    """A trajectory of the LiDAR's poses, judged at stamps of shape (n,)."""

    name: str
    judge: Judge
    trajectory: Trajectory
    stamps: NDArray[np.int64]
    cause: Finding | None = None  # what its poses are, if not the LiDAR's at the stamps

    @property
    def title(self) -> str:
        """What it is of, in words."""
        return f"{self.name} on {self.judge.recording}"

    @cached_property
    def odometry(self) -> Trajectory:
        """Its poses at the stamps."""
        return Trajectory(self.stamps, np.nan_to_num(self.trajectory.at(self.stamps, 1e9)))

    @cached_property
    def truth(self) -> Poses:
        """The judge's poses there, of shape (n, 4, 4); NaN where they are unknown."""
        return self.judge.trajectory.at(self.stamps)

    @cached_property
    def seconds(self) -> NDArray[np.float64]:
        """From the first scan on, of shape (n,)."""
        return np.asarray((self.stamps - self.judge.begin) * 1e-9)

    @cached_property
    def errors(self) -> NDArray[np.float64]:
        """Clipped RTE in percent of the sub-trajectory from each pose, of shape (n,), or NaN."""
        return self.judge.reference.errors(self.odometry)

    @cached_property
    def around(self) -> NDArray[np.float64]:
        """Mean RTE in percent of the sub-trajectories through each pose, of shape (n,), or NaN."""
        return self.judge.reference.errors_around(self.odometry)

    @cached_property
    def rte(self) -> float:
        """Mean error in percent."""
        if np.isfinite(self.errors).any():
            return float(np.nanmean(self.errors))
        metres = self.judge.reference.length
        what = f"no {metres:g} m of it can be judged; name a longer one, or a smaller"
        raise AdaptuneError(f"{self.title}: {what} --sub-trajectory")

    @cached_property
    def interval(self) -> Interval:
        """95 % interval of the mean error, with the judge's own error as far as it is known."""
        known = self.errors[np.isfinite(self.errors)]
        block = span(self.truth, self.judge.reference.length)
        return interval_of_mean(known, block, self.judge.reference.error)

    @property
    def clipped(self) -> bool:
        """Whether any error is clipped."""
        return bool((self.errors >= FAILURE).any())

    @property
    def bounded(self) -> bool:
        """Whether most errors are clipped: their mean only says how wrong it is at least."""
        return bool(np.nanmedian(self.errors) >= FAILURE)

    @property
    def blind(self) -> bool:
        """Whether the judge is about as wrong as what it judges."""
        return self.rte < ERROR_FACTOR * (self.judge.reference.error or 0.0)

    @cached_property
    def drift(self) -> tuple[float, float]:
        """Metres of error in a hundred, and over how many metres that was measured."""
        reference, metres = self.judge.reference, float(travelled(self.truth)[-1])
        for length in (m for m in LONGER[::-1] if FEWEST * m <= metres and m > reference.length):
            errors = reference._replace(length=length).errors(self.odometry)
            if np.isfinite(errors).any():
                return float(np.nanmean(errors)), length
        return self.rte, reference.length

    @cached_property
    def unknown_share(self) -> float:
        """Share of its time in which the judge knows no pose."""
        begin = max(self.trajectory.stamps[0], self.judge.begin)
        at = np.linspace(begin, self.stamps[-1], _JUDGED_MOMENTS).astype(np.int64)
        return float(np.isnan(self.judge.trajectory.at(at)[:, 0, 0]).mean())

    @cached_property
    def silent(self) -> NDArray[np.float64]:
        """From when to when it gives nothing, in seconds of the recording, of shape (m, 2)."""
        ends = np.array([self.judge.begin, *self.trajectory.stamps, self.judge.end])
        steps = np.column_stack([ends[:-1], ends[1:]]) - self.judge.begin
        usual = max(1e9, _GAP * float(np.median(np.diff(ends))))
        return np.asarray(1e-9 * steps[np.diff(ends) > usual])

    @property
    def silent_share(self) -> float:
        """Share of the recording in which it gives nothing."""
        return float(1e9 * np.diff(self.silent).sum() / max(self.judge.end - self.judge.begin, 1))

    @cached_property
    def faults(self) -> list[Finding]:
        """Where it jumps, stands still while the robot moves, or gives nothing, or little."""
        judge, stamps = self.judge, self.trajectory.stamps
        found = [f._replace(mend="") for f in sound(self.trajectory, judge.begin, name="it")[1]]
        if found and found[-1].seconds is None:
            to_and_fro = found.pop()
            if self.cause is None and self.rte > LOST_ABOVE:
                what = f"{to_and_fro.what}; if two nodes publish it by turns, record one of them"
                raise AdaptuneError(f"{self.title}: {what}")
        still = stands(self.truth, self.odometry.T_world_sensor)
        edges = np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)
        step, of_judge = (np.median(np.diff(t)) for t in (stamps, judge.trajectory.stamps))
        for what, spans in (
            ("it stands still while the robot moves", self.seconds[edges.clip(max=len(still) - 1)]),
            ("it gives nothing", self.silent),
        ):
            found += [Finding((), what, seconds=(a, b)) for a, b in spans.tolist()]
        if (times := step / of_judge) > _RARE:
            what = f"it gives one pose for {times:.2g} of the judge's, and is judged there alone"
            found.append(Finding((), what))
        return found

    @property
    def row(self) -> dict[str, Any]:
        """The row of a table; columns that begin with an underscore are for files only."""
        (low, high), reference = self.interval or (None, None), self.judge.reference
        worst, (drift, over) = int(np.nanargmax(self.around)), self.drift
        return {
            "recording": self.judge.recording,
            "trajectory": self.name,
            "RTE [%]": self.rte,
            "95 %": in_cell(self.interval),
            "drift [m/100 m]": drift,
            "worst [%]": float(self.around[worst]),
            "at [s]": float(self.seconds[worst]),
            "x [m]": float(self.truth[worst, 0, 3]),
            "y [m]": float(self.truth[worst, 1, 3]),
            "unknown [%]": 100.0 * self.unknown_share,
            "faults": len(self.faults),
            "_low": low,
            "_high": high,
            "_length_m": reference.length,
            "_drift_over_m": over,
            "_judge": self.judge.name,
            "_judge_error_percent": reference.error,
            "_findings": "; ".join(map(str, [*([self.cause] if self.cause else []), *self.faults])),
        }


def pair_of(one: Judged, other: Judged) -> Pair:
    """Two trajectories of a recording, at stamps that both have."""
    judge = one.judge
    stamps = shared_stamps(judge.trajectory, one.trajectory, other.trajectory)
    errors = np.stack([Judged(j.name, judge, j.trajectory, stamps).errors for j in (one, other)])
    block = span(judge.trajectory.at(stamps), judge.reference.length)
    known = errors[:, np.isfinite(errors).all(axis=0)]
    return Pair(known, block, judge.recording, judge.reference.error)
