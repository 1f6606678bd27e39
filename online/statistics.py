"""Statistics of stored replays: errors, intervals, and ratios to those of another mode."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.live.squares import SECONDS
from adaptune.metrics import (
    KittiError,
    absolute_error,
    bootstrap,
    kitti_error,
    relative_error,
    span,
    sub_trajectory_rte,
    window_ends,
)
from adaptune.reference.stored import StoredEstimate
from adaptune.trajectory import Trajectory, read_tum
from online.stored_replays import ReplaySummary, StoredReplay

ALL = "all"
"""In place of a sequence, all of them."""
ESTIMATED, LOST = "estimated [%]", "lost [s]"
"""Columns of what a bank has measured of itself."""
REFERENCE = "reference"
"""Column of the kind of reference."""
ERROR_FACTOR = 1.5
"""By how much more than estimated an estimated reference may err."""
Interval = tuple[float, float] | None
"""Ends of a 95 % interval, where it is known."""


class Reference(NamedTuple):
    """The reference that errors are measured against, and over which length."""

    trajectory: Trajectory | None  # None where nothing is known
    length: float  # metres of a sub-trajectory
    estimated: bool = False  # whether it was computed from the recording
    error: float | None = None  # estimated mean RTE of an estimated one, percent

    @classmethod
    def read(cls, folder: Path, length: float, stored: StoredEstimate | None = None) -> "Reference":
        """Read the reference of a replayed sequence, if it has one.

        Parameters
        ----------
        folder
            Of its replays.
        length
            Metres of a sub-trajectory.
        stored
            What is known about the reference if it is an estimated one.
        """
        path = folder / "reference.tum"
        trajectory = read_tum(path) if path.exists() else None
        error = math.nan if stored is None else stored.error(length)
        return cls(trajectory, length, stored is not None, None if math.isnan(error) else error)

    @property
    def kind(self) -> str:
        """Where it comes from, in a word."""
        if self.trajectory is None:
            return "none"
        return "estimated" if self.estimated else "given"

    @property
    def block(self) -> int:
        """Frames of a sub-trajectory."""
        return 1 if self.trajectory is None else span(self.trajectory.T_world_sensor, self.length)

    def errors(self, odometry: Trajectory) -> NDArray[np.float64]:
        """Sub-trajectory RTE at every frame in percent, NaN where it is unknown."""
        if self.trajectory is None:
            return np.full(len(odometry), np.nan)
        T_ref_sensor = self.trajectory.at(odometry.stamps)
        return sub_trajectory_rte(T_ref_sensor, odometry.T_world_sensor, self.length)

    def errors_behind(self, odometry: Trajectory) -> NDArray[np.float64]:
        """Mean RTE in percent of the sub-trajectories that ended in the last `SECONDS`.

        It is what an odometry estimates while it drives. NaN where none ended.
        """
        if self.trajectory is None:
            return np.full(len(odometry), np.nan)
        of = self.errors(odometry)
        ends = window_ends(self.trajectory.at(odometry.stamps), self.length)
        known = (ends >= 0) & np.isfinite(of)
        sums, counts = (
            np.concatenate([[0.0], np.cumsum(np.bincount(ends[known], w, len(odometry)))])
            for w in (of[known], None)
        )
        stop = np.arange(1, len(odometry) + 1)
        first = np.searchsorted(odometry.stamps, odometry.stamps - int(SECONDS * 1e9))
        with np.errstate(invalid="ignore"):
            return np.asarray((sums[stop] - sums[first]) / (counts[stop] - counts[first]))

    def standard(self, odometry: Trajectory) -> "StandardErrors | None":
        """The errors that other tools give, where there are reference poses to compare with."""
        if self.trajectory is None:
            return None
        T_ref_sensor, T = self.trajectory.at(odometry.stamps), odometry.T_world_sensor
        if np.isfinite(T_ref_sensor[:, 0, 0]).sum() < 2:
            return None
        ape, rpe = absolute_error(T_ref_sensor, T), relative_error(T_ref_sensor, T)
        return StandardErrors(ape, rpe, kitti_error(T_ref_sensor, T))


class StandardErrors(NamedTuple):
    """Errors of a trajectory as evo and KITTI's benchmark define them."""

    ape: float  # metres, after alignment
    rpe: float  # metres, from scan to scan
    kitti: KittiError

    @classmethod
    def pooled(cls, errors: "Sequence[StandardErrors]") -> "StandardErrors | None":
        """Means over sequences; KITTI's error over the sub-trajectories of all of them."""
        if not errors:
            return None
        ape, rpe, kitti = zip(*errors, strict=True)
        return cls(float(np.mean(ape)), float(np.mean(rpe)), KittiError.pooled(kitti))


@dataclass(frozen=True)
class ComparisonRow:
    """A mode on a sequence, or over all sequences."""

    sequence: str
    mode: str
    rte: float | None  # mean sub-trajectory RTE in percent; None where the reference is unknown
    ratio: float | None  # to that of the yardstick
    restarts: int  # by the health check
    switches: int  # changes of the parameters
    poor_scans: int  # too poor to register
    rte_interval: Interval = None
    ratio_interval: Interval = None
    median: float | None = None  # of the sub-trajectory RTE, percent
    standard: StandardErrors | None = None
    blocks: int | None = None  # independent pieces of the recording
    x_real_time: float | None = None  # speed of the odometry
    first_restart: float | None = None  # seconds from the start
    unhealthy: tuple[str, ...] = ()  # what the health check found
    yardstick: str = "fixed"  # the mode that others are compared with
    # Percent: the mean of the odometry's own error, measured while driving and without reference.
    estimated: float | None = None
    estimated_interval: Interval = None
    lost_seconds: float = 0.0  # how long the bank was lost
    reference: str = "given"  # `given`, `estimated` or `none`
    reference_error: float | None = None  # percent, of an estimated one
    cpu_ms: float | None = None  # milliseconds of CPU time a scan
    cores: float | None = None  # that this takes at the sensor's rate
    memory_mb: float | None = None  # most megabytes of all processes
    real_time: Mapping[str, float] | None = None  # see `ReplaySummary`

    def columns(self) -> dict[str, Any]:
        """The row of a table; columns that begin with an underscore are for files only."""
        rte_low, rte_high = self.rte_interval or (None, None)
        low, high = self.ratio_interval or (None, None)
        estimated_low, estimated_high = self.estimated_interval or (None, None)
        return {
            "sequence": self.sequence,
            "mode": self.mode,
            "RTE [%]": self.rte,
            f"vs {self.yardstick}": self.ratio,
            "95 %": None if low is None else f"{low:.2f}-{high:.2f}",
            ESTIMATED: self.estimated,
            LOST: self.lost_seconds,
            "restarts": self.restarts,
            "switches": self.switches,
            "ms a scan": self.cpu_ms,
            "cores": self.cores,
            "memory [MB]": self.memory_mb,
            REFERENCE: self.reference,
            "_reference_error": self.reference_error,
            "_poor_scans": self.poor_scans,
            "_x_real_time": self.x_real_time,
            "_rte_low": rte_low,
            "_rte_high": rte_high,
            "_ratio_low": low,
            "_ratio_high": high,
            "_blocks": self.blocks,
            "_median": self.median,
            "_estimated_low": estimated_low,
            "_estimated_high": estimated_high,
            **{f"_{key}": value for key, value in self._standard().items()},
            **{f"_{key}": value for key, value in (self.real_time or {}).items()},
        }

    def _standard(self) -> dict[str, Any]:
        keys = ("ape_m", "rpe_m", "kitti_percent", "kitti_deg_per_m", "kitti_lengths_m")
        if self.standard is None:
            return dict.fromkeys(keys)
        ape, rpe, kitti = self.standard
        if not kitti.lengths:
            return dict.fromkeys(keys) | {"ape_m": ape, "rpe_m": rpe}
        lengths = " ".join(f"{length:g}" for length in kitti.lengths)
        return dict(zip(keys, (ape, rpe, kitti.translation, kitti.rotation, lengths), strict=True))

    def standard_columns(self, kitti: bool = True) -> dict[str, Any]:
        """The row of a table of the errors that other tools give, with KITTI's or without."""
        ape, rpe, percent, degrees, listed = self._standard().values()
        of_evo = {"sequence": self.sequence, "mode": self.mode, "APE [m]": ape, "RPE [m]": rpe}
        if not kitti:
            return of_evo
        lengths = (listed or "").split()
        return of_evo | {
            "KITTI [%]": percent,
            "[deg/100 m]": None if degrees is None else 100.0 * degrees,
            "over [m]": "-".join(dict.fromkeys([*lengths[:1], *lengths[-1:]])) or None,
        }


def compare_modes(
    name: str, replays: Mapping[str, StoredReplay], reference: Reference
) -> list[ComparisonRow]:
    """Compare the modes on a sequence with `fixed`, or where it is not among them, `baseline`.

    Parameters
    ----------
    name
        Of the sequence.
    replays
        By mode.
    reference
        Of the sequence.
    """
    errors = _errors(replays, reference)
    yardstick = "fixed" if "fixed" in replays else "baseline"
    block = reference.block
    rows = []
    for mode, replay in replays.items():
        known = np.isfinite(errors[mode]) & np.isfinite(errors[yardstick])
        mine, others = errors[mode][known], errors[yardstick][known]
        summary = replay.summary
        intervals = bootstrap(mine, others, block) if len(mine) else None
        if intervals is not None and reference.error is not None:
            judge = ERROR_FACTOR * reference.error
            intervals = allowing_for(*intervals, float(others.mean()), judge)
        rte_interval, ratio_interval = intervals or (None, None)
        rte = float(mine.mean()) if len(mine) else None
        estimated, estimated_interval = _estimated(replay)
        rows.append(
            ComparisonRow(
                name,
                mode,
                rte,
                None if rte is None else rte / max(float(others.mean()), 1e-12),
                summary.restarts,
                _switches(replay),
                summary.poor_scans,
                rte_interval,
                ratio_interval,
                float(np.median(mine)) if len(mine) else None,
                reference.standard(replay.trajectory),
                len(mine) // block,
                round(summary.duration_s / replay.seconds, 2) if replay.seconds else None,
                _first_restart(replay),
                tuple(summary.unhealthy),
                yardstick,
                estimated,
                estimated_interval,
                summary.lost_seconds,
                reference.kind,
                reference.error,
                summary.cpu_ms,
                _cores(summary),
                summary.memory_mb,
                summary.real_time,
            )
        )
    return rows


def _errors(
    replays: Mapping[str, StoredReplay], reference: Reference
) -> dict[str, NDArray[np.float64]]:
    """Percent by mode, each of shape (n,): at the scans that no mode has dropped."""
    common = reduce(np.intersect1d, [replay.trajectory.stamps for replay in replays.values()])
    return {
        mode: reference.errors(replay.trajectory)[np.isin(replay.trajectory.stamps, common)]
        for mode, replay in replays.items()
    }


def _cores(summary: ReplaySummary) -> float | None:
    """CPU time over the recording's duration."""
    if summary.cpu_ms is None or not summary.duration_s:
        return None
    return 1e-3 * summary.cpu_ms * summary.scans / summary.duration_s


def allowing_for(
    rte: tuple[float, float], ratio: tuple[float, float], other: float, error: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Intervals that hold, too, what would be measured by a reference without error.

    If what the reference errs has nothing to do with a mode, it adds to the mode's error, in
    quadrature: taken out, errors become smaller, and ratios lie further from 1. If a mode errs as
    the reference does, as one that averages motions may, that part of its error is not seen.

    Parameters
    ----------
    rte, ratio
        Intervals of a mean error in percent, and of its ratio to that of another mode.
    other
        Mean error of that mode in percent, as measured.
    error
        Of the reference, percent: any from 0 on up to this is possible.
    """

    def true(mean: float) -> float:
        return math.sqrt(max(mean**2 - error**2, 0.0))

    def further(end: float) -> float:
        if end == 1.0:
            return end
        if true(other) == 0.0:  # nothing of it may be the mode's own
            return 0.0 if end < 1.0 else math.inf
        return true(end * other) / true(other)

    (rte_low, rte_high), (low, high) = rte, ratio
    hidden = math.hypot(high * other, error) / other, low * other / math.hypot(other, error)
    interval = min(low, further(low), hidden[1]), max(high, further(high), hidden[0])
    return (true(rte_low), math.hypot(rte_high, error)), interval


def _estimated(replay: StoredReplay) -> tuple[float | None, Interval]:
    """Mean of the estimated errors, and of the ends of their intervals.

    The interval is right if all estimates err together, and else too wide. There is none where less
    than half of the recording was estimated: the rest may be of another kind.
    """
    known = replay.estimated[np.isfinite(replay.estimated[:, 0])]
    if not len(known):
        return None, None
    if 2 * len(known) < len(replay.estimated):
        return float(known[:, 0].mean()), None
    mean, low, high = known.mean(axis=0).tolist()
    return mean, (low, high) if np.isfinite([low, high]).all() else None


def _first_restart(replay: StoredReplay) -> float | None:
    stamps = replay.trajectory.stamps
    restarts = stamps[replay.restarted]
    return float(restarts[0] - stamps[0]) * 1e-9 if len(restarts) else None


def _switches(replay: StoredReplay) -> int:
    if len(replay.choice_stamps) < 2:
        return 0
    values = zip(*replay.choices.values(), strict=True)
    return sum(a != b for a, b in itertools.pairwise(values))


def pooled(rows: Sequence[ComparisonRow]) -> list[ComparisonRow]:
    """For every mode the mean errors over all sequences, and the geometric mean of the ratios."""
    made = []
    for mode in dict.fromkeys(row.mode for row in rows):
        mine = [row for row in rows if row.mode == mode and row.rte is not None]
        ratios = [row.ratio for row in mine if row.ratio is not None]
        estimated = [row.estimated for row in mine if row.estimated is not None]
        made.append(
            ComparisonRow(
                ALL,
                mode,
                float(np.mean([row.rte for row in mine if row.rte is not None])),
                float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-12))))),
                sum(row.restarts for row in mine),
                sum(row.switches for row in mine),
                sum(row.poor_scans for row in mine),
                standard=StandardErrors.pooled([row.standard for row in mine if row.standard]),
                yardstick=mine[0].yardstick,
                estimated=float(np.mean(estimated)) if estimated else None,
                lost_seconds=sum(row.lost_seconds for row in mine),
                reference=" and ".join(sorted({row.reference for row in mine})),
                cpu_ms=_mean([row.cpu_ms for row in mine]),
                cores=_mean([row.cores for row in mine]),
                memory_mb=max(
                    (m for row in mine if (m := row.memory_mb) is not None), default=None
                ),
            )
        )
    return made


def _mean(values: Sequence[float | None]) -> float | None:
    """Mean of those that are known."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
