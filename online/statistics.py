"""Statistics of stored replays: errors, intervals, and ratios to the fixed set's."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import KittiError, bootstrap, kitti_error, span, sub_trajectory_rte
from adaptune.trajectory import Trajectory, read_tum
from online.stored_replays import StoredReplay

Interval = tuple[float, float] | None
"""Ends of a 95 % interval, where it is known."""


class Reference(NamedTuple):
    """The reference that errors are measured against, and over which length."""

    trajectory: Trajectory | None  # None where nothing is known
    length: float  # metres of a sub-trajectory

    @classmethod
    def read(cls, folder: Path, length: float) -> "Reference":
        """Read the reference of a replayed sequence, if it has one."""
        path = folder / "reference.tum"
        return cls(read_tum(path) if path.exists() else None, length)

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

    def kitti(self, odometry: Trajectory) -> KittiError:
        """KITTI's error over 100 to 800 m, where the recording is long enough."""
        if self.trajectory is None:
            return KittiError(np.nan, np.nan, ())
        both = np.isin(odometry.stamps, self.trajectory.stamps)
        return kitti_error(self.trajectory.T_world_sensor, odometry.T_world_sensor[both])


@dataclass(frozen=True)
class ComparisonRow:
    """A mode on a sequence, or over all sequences."""

    sequence: str
    mode: str
    rte: float | None  # mean sub-trajectory RTE in percent; None where the reference is unknown
    vs_fixed: float | None  # its ratio to that of the fixed set
    restarts: int  # by the health check
    switches: int  # changes of the parameters
    poor_scans: int  # too poor to register
    rte_interval: Interval = None
    ratio_interval: Interval = None
    median: float | None = None  # of the sub-trajectory RTE, percent
    kitti: KittiError | None = None
    blocks: int | None = None  # independent pieces of the recording
    x_real_time: float | None = None  # speed of the replay

    def columns(self) -> dict[str, Any]:
        """The row of a table; columns that begin with an underscore are for files only."""
        rte_low, rte_high = self.rte_interval or (None, None)
        low, high = self.ratio_interval or (None, None)
        return {
            "sequence": self.sequence,
            "mode": self.mode,
            "RTE [%]": self.rte,
            "vs fixed": self.vs_fixed,
            "95 %": None if low is None else f"{low:.2f}-{high:.2f}",
            "restarts": self.restarts,
            "switches": self.switches,
            "_poor_scans": self.poor_scans,
            "_x_real_time": self.x_real_time,
            "_rte_low": rte_low,
            "_rte_high": rte_high,
            "_ratio_low": low,
            "_ratio_high": high,
            "_blocks": self.blocks,
            "_median": self.median,
            "_kitti_percent": None if self.kitti is None else self.kitti.translation,
            "_kitti_deg_per_m": None if self.kitti is None else self.kitti.rotation,
        }


def compare_modes(
    name: str, replays: Mapping[str, StoredReplay], reference: Reference
) -> list[ComparisonRow]:
    """Compare the modes on a sequence, one of which is `fixed`.

    Parameters
    ----------
    name
        Of the sequence.
    replays
        By mode.
    reference
        Of the sequence.
    """
    errors = {mode: reference.errors(replay.trajectory) for mode, replay in replays.items()}
    block = reference.block
    rows = []
    for mode, replay in replays.items():
        known = np.isfinite(errors[mode]) & np.isfinite(errors["fixed"])
        mine, fixed = errors[mode][known], errors["fixed"][known]
        summary = replay.summary
        intervals = bootstrap(mine, fixed, block) if len(mine) else None
        rte_interval, ratio_interval = intervals or (None, None)
        rte = float(mine.mean()) if len(mine) else None
        rows.append(
            ComparisonRow(
                name,
                mode,
                rte,
                None if rte is None else rte / max(float(fixed.mean()), 1e-12),
                summary.restarts,
                _switches(replay),
                summary.poor_scans,
                rte_interval,
                ratio_interval,
                float(np.median(mine)) if len(mine) else None,
                reference.kitti(replay.trajectory),
                len(mine) // block,
                round(summary.duration_s / summary.replay_s, 2),
            )
        )
    return rows


def _switches(replay: StoredReplay) -> int:
    if len(replay.choice_stamps) < 2:
        return 0
    values = zip(*replay.choices.values(), strict=True)
    return sum(a != b for a, b in itertools.pairwise(values))


def pooled(rows: Sequence[ComparisonRow]) -> list[ComparisonRow]:
    """For every mode the mean RTE over all sequences, and the geometric mean of the ratios."""
    made = []
    for mode in dict.fromkeys(row.mode for row in rows):
        mine = [row for row in rows if row.mode == mode and row.rte is not None]
        ratios = [row.vs_fixed for row in mine if row.vs_fixed is not None]
        made.append(
            ComparisonRow(
                f"all {len(mine)}",
                mode,
                float(np.mean([row.rte for row in mine if row.rte is not None])),
                float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-12))))),
                sum(row.restarts for row in mine),
                sum(row.switches for row in mine),
                sum(row.poor_scans for row in mine),
            )
        )
    return made
