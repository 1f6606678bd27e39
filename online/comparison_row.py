"""A row of the comparison: what a mode did on a sequence, or on all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from adaptune.metrics import KittiError

ALL = "all"
"""In place of a sequence, all of them."""
ESTIMATED, LOST = "estimated [%]", "lost [s]"
"""Columns of what a bank has measured of itself."""
REFERENCE = "reference"
"""Column of the kind of reference."""
GAP = "gap closed [%]"
"""Column of the share of what the best set of each sequence would gain."""
NO_DIFFERENCE = 0.01
"""Share of the yardstick's error by which others may differ without it being told."""
ORACLES = ("oracle, sequence", "oracle, period")
"""Rows of what the best set of each sequence, and of each period, has in its trials."""
Interval = tuple[float, float] | None
"""Ends of a 95 % interval, where it is known."""


class Ratio(NamedTuple):
    """The ratio of the errors of two modes, over several sequences their geometric mean."""

    value: float
    interval: Interval = None


class StandardErrors(NamedTuple):
    """Errors of a trajectory as evo and KITTI's benchmark define them."""

    ape: float  # metres, after alignment
    rpe: float  # metres, from scan to scan
    kitti: KittiError
    height: float = np.nan  # percent of the sub-trajectory's length, see `height_error`

    @classmethod
    def pooled(cls, errors: "Sequence[StandardErrors]") -> "StandardErrors | None":
        """Means over sequences; KITTI's error over the sub-trajectories of all of them."""
        if not errors:
            return None
        ape, rpe, kitti, heights = zip(*errors, strict=True)
        known = [height for height in heights if np.isfinite(height)]
        height = float(np.mean(known)) if known else np.nan
        return cls(float(np.mean(ape)), float(np.mean(rpe)), KittiError.pooled(kitti), height)


@dataclass(frozen=True)
class ComparisonRow:
    """A mode on a sequence, or over all sequences."""

    sequence: str
    mode: str
    rte: float | None  # mean sub-trajectory RTE in percent; None where the reference is unknown
    ratio: float | None  # to that of the yardstick
    restarts: int  # by the health check, in all repeats
    switches: int  # changes of the parameters, in all repeats
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
    repeats: int = 1  # replays of which errors are means
    scans: int | None = None  # of the shortest replay
    # Over all sequences: geometric mean of the ratios over the worst tenth of the stretches, on how
    # many sequences the mode has less and more error by what counts, on how many of them surely,
    # and the share of what the best set of each sequence would gain.
    worst_tenth: float | None = None
    stretches: int | None = None
    recordings: int | None = None  # over all sequences, that they are of
    better: int | None = None
    worse: int | None = None
    surely_better: int | None = None
    surely_worse: int | None = None
    gap_closed: float | None = None
    # By mode, that of this mode's error to the other one's; of controls and rivals.
    against: Mapping[str, Ratio] = field(default_factory=dict)
    twin: str = ""  # the mode whose replay this is, of a mode that drives the same and is not shown

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
            "_repeats": self.repeats,
            "_twin": self.twin or None,
            "_worst_tenth": self.worst_tenth,
            "_stretches": self.stretches,
            "_better": self.better,
            "_worse": self.worse,
            "_surely_better": self.surely_better,
            "_surely_worse": self.surely_worse,
            "_gap_closed": self.gap_closed,
            **{f"_{key}": value for key, value in self._standard().items()},
            **{f"_{key}": value for key, value in (self.real_time or {}).items()},
        }

    def _standard(self) -> dict[str, Any]:
        found = dict.fromkeys(
            ("ape_m", "rpe_m", "height_percent", "kitti_percent", "kitti_deg_per_m")
        ) | {"kitti_lengths_m": None}
        if self.standard is None:
            return found
        ape, rpe, kitti, height = self.standard
        found |= {"ape_m": ape, "rpe_m": rpe, "height_percent": height}
        if kitti.lengths:
            lengths = " ".join(f"{length:g}" for length in kitti.lengths)
            found |= {"kitti_percent": kitti.translation, "kitti_deg_per_m": kitti.rotation}
            found["kitti_lengths_m"] = lengths
        return found

    def standard_columns(self, kitti: bool = True) -> dict[str, Any]:
        """The row of a table of the errors that other tools give, with KITTI's or without."""
        ape, rpe, height, percent, degrees, listed = self._standard().values()
        of_evo = {"sequence": self.sequence, "mode": self.mode, "APE [m]": ape, "RPE [m]": rpe}
        of_evo["height [%]"] = height
        if not kitti:
            return of_evo
        lengths = (listed or "").split()
        return of_evo | {
            "KITTI [%]": percent,
            "[deg/100 m]": None if degrees is None else 100.0 * degrees,
            "over [m]": "-".join(dict.fromkeys([*lengths[:1], *lengths[-1:]])) or None,
        }

    def summary_columns(self) -> dict[str, Any]:
        """The row of the table of the modes, over all sequences or on the only one."""
        low, high = self.ratio_interval or (None, None)
        driven = self.mode not in ORACLES
        return {
            "mode": self.mode,
            "RTE [%]": self.rte,
            f"vs {self.yardstick}": self.ratio,
            "95 %": None if low is None else f"{low:.2f}-{high:.2f}",
            "worst tenth": self.worst_tenth,
            "better / worse": None if self.better is None else f"{self.better} / {self.worse}",
            GAP: None if self.gap_closed is None else f"{100.0 * self.gap_closed:.0f}",
            ESTIMATED: self.estimated,
            LOST: self.lost_seconds or None,
            "restarts": self.restarts if driven else None,
            "switches": self.switches if driven else None,
            "ms a scan": self.cpu_ms,
            "cores": self.cores,
            "memory [MB]": self.memory_mb,
            REFERENCE: None if self.reference == "given" else self.reference,
        }
