"""Statistics of stored replays: errors, intervals, and ratios to those of another mode."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.paired import Interval, Pair, Ratio, in_cell, interval_of_mean, ratio
from adaptune.reference.judge import Reference, StandardErrors, columns_of
from adaptune.runs.record import NO_RUN, Run, RunSummary, switched
from adaptune.trajectory import Trajectory

ALL = "all"
"""In place of a sequence, all of them."""
NO_DIFFERENCE = 0.01
"""Share of the yardstick's error by which others may differ without it being told."""
ORACLE = "oracle, sequence"
"""Row of what the best set of each sequence has in its trials."""


@dataclass(frozen=True)
class ComparisonRow:
    """A mode on a sequence, or over all sequences."""

    sequence: str
    mode: str
    # Mean sub-trajectory RTE in percent; None where the reference is unknown.
    rte: float | None = None
    ratio: float | None = None  # to that of the yardstick
    run: RunSummary = NO_RUN  # what was measured on the way; means, and sums of counts, over all
    switches: int = 0  # changes of the parameters
    rte_interval: Interval = None
    ratio_interval: Interval = None
    blocks: int | None = None  # sub-trajectories that follow each other: what intervals rest on
    standard: StandardErrors | None = None
    first_restart: float | None = None  # seconds from the start
    yardstick: str = "fixed"  # the mode that others are compared with
    # Percent: the mean of the odometry's own error, measured while driving and without reference.
    estimated: float | None = None
    estimated_interval: Interval = None
    reference: str = "given"  # `given`, `estimated` or `none`
    reference_error: float | None = None  # percent, of an estimated one
    # Over all sequences: geometric mean of the ratios over the worst tenth of the segments, and on
    # how many sequences the mode has less and more error by what counts.
    worst_tenth: float | None = None
    better: int | None = None
    worse: int | None = None
    # By mode, that of this mode's error to the other one's; of controls and rivals.
    against: Mapping[str, Ratio] = field(default_factory=dict)

    def columns(self) -> dict[str, Any]:
        """The row of a table in a file: all that is known, ends of intervals as numbers."""
        more: dict[str, Any] = {"reference_error": self.reference_error}
        for name in ("rte", "ratio", "estimated"):
            ends = getattr(self, f"{name}_interval")
            more[f"{name}_low"], more[f"{name}_high"] = ends or (None, None)
        more |= {n: getattr(self, n) for n in ("worst_tenth", "better", "worse")}
        more |= self._standard() | (self.run.real_time or {})
        shown = {key: value for key, value in self._shown().items() if key != "95 %"}
        return {"sequence": self.sequence, **shown, "blocks": self.blocks} | more

    def _shown(self) -> dict[str, Any]:
        itself = self.ratio is None or self.mode in (self.yardstick, ORACLE)
        return {
            "mode": self.mode,
            "RTE [%]": self.rte,
            f"vs {self.yardstick}": self.ratio,
            "95 %": None if itself else in_cell(self.ratio_interval),
            "estimated [%]": self.estimated,
            "lost [s]": self.run.lost_seconds,
            "restarts": self.run.restarts,
            "switches": self.switches,
            "cost [ms]": self.run.cpu_ms,
            "memory [MB]": self.run.memory_mb,
            "reference": self.reference,
        }

    def _standard(self) -> dict[str, Any]:
        known = self.standard
        kitti = known.kitti if known is not None and known.kitti.lengths else None
        return {
            "ape_m": known and known.ape,
            "rpe_m": known and known.rpe,
            "height_percent": known and known.height,
            "kitti_percent": kitti and kitti.translation,
            "kitti_deg_per_m": kitti and kitti.rotation,
            "kitti_lengths_m": kitti and " ".join(f"{length:g}" for length in kitti.lengths),
        }

    def standard_columns(self, kitti: bool = True) -> dict[str, Any]:
        """The row of a table of the errors that other tools give, with KITTI's or without."""
        shown = columns_of(self.standard)
        return {"mode": self.mode} | dict([*shown.items()][: None if kitti else 3])

    def summary_columns(self) -> dict[str, Any]:
        """The row of the table of the modes, over all sequences or on the only one."""
        shown, driven = self._shown(), self.mode != ORACLE
        head = {key: shown.pop(key) for key in list(shown)[:4]}
        over_all = {
            "worst tenth": self.worst_tenth,
            "better / worse": None if self.better is None else f"{self.better} / {self.worse}",
        }
        changed = {
            "lost [s]": self.run.lost_seconds or None,
            "restarts": self.run.restarts if driven else None,
            "switches": self.switches if driven else None,
            "reference": None if self.reference == "given" else self.reference,
        }
        return head | over_all | shown | changed


class JudgedModes(NamedTuple):
    """The modes on a sequence, judged by its reference."""

    name: str  # of the sequence
    rows: list[ComparisonRow]  # one a mode
    # Sub-trajectory RTE in percent by mode, each of shape (n,), at the same scans. NaN where it is
    # unknown.
    errors: Mapping[str, NDArray[np.float64]]
    block: int  # frames of a sub-trajectory
    recording: str = ""  # that it is a part of; itself if empty

    def pair(self, mode: str, other: str | None = None) -> Pair:
        """A mode and another one, by default the yardstick, at the frames where both are known."""
        both = np.stack([self.errors[mode], self.errors[other or self.rows[0].yardstick]])
        known, own = np.isfinite(both).all(axis=0), self.rows[0].reference_error
        return Pair(both[:, known], self.block, self.recording or self.name, own)


def compare_modes(name: str, replays: Mapping[str, Run], reference: Reference) -> JudgedModes:
    """Compare the modes on a sequence with `fixed`, or where it is not among them, `baseline`.

    Errors are those at the scans that no replay has dropped.
    """
    yardstick = "fixed" if "fixed" in replays else "baseline"
    common = reduce(np.intersect1d, (replay.trajectory.stamps for replay in replays.values()))
    rows, errors = [], {}
    for mode, replay in replays.items():
        odometry = replay.trajectory
        kept = np.isin(odometry.stamps, common)
        errors[mode] = reference.errors(odometry)[kept]
        of_common = Trajectory(odometry.stamps[kept], odometry.T_world_sensor[kept])
        row = ComparisonRow(name, mode, yardstick=yardstick, standard=reference.standard(of_common))
        rows.append(_measured(row, replay, reference))
    judged = JudgedModes(name, rows, errors, reference.block)
    return judged._replace(rows=[_with_errors(row, judged) for row in rows])


def _measured(row: ComparisonRow, replay: Run, reference: Reference) -> ComparisonRow:
    """Fill in what was measured while driving."""
    kind = "estimated" if reference.estimated else "given"
    restarts = replay.trajectory.seconds[replay.restarted]
    estimated, interval = _estimated(replay.estimated)
    return replace(
        row,
        run=replay.summary,
        switches=int(switched(replay.values).sum()),
        first_restart=float(restarts[0]) if len(restarts) else None,
        estimated=estimated,
        estimated_interval=interval,
        reference="none" if reference.trajectory is None else kind,
        reference_error=reference.error,
    )


def _with_errors(row: ComparisonRow, judged: JudgedModes) -> ComparisonRow:
    pair = judged.pair(row.mode)
    if not pair.errors.size:
        return row
    found, mine = ratio([pair]), pair.errors[0]
    return replace(
        row,
        rte=float(mine.mean()),
        ratio=found.value,
        rte_interval=interval_of_mean(mine, judged.block, row.reference_error),
        ratio_interval=found.interval,
        blocks=len(mine) // judged.block,
    )


def mean_of(values: Sequence[float | None]) -> float | None:
    """Mean of those that are known."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _estimated(estimates: NDArray[np.float64]) -> tuple[float | None, Interval]:
    """Mean of the estimated errors, and of the ends of their intervals.

    The interval is right if all estimates err together, and else too wide. There is none where less
    than half of the recording was estimated: the rest may be of another kind.
    """
    known = estimates[np.isfinite(estimates[:, 0])]
    if not len(known):
        return None, None
    if 2 * len(known) < len(estimates):
        return float(known[:, 0].mean()), None
    mean, low, high = known.mean(axis=0).tolist()
    return mean, (low, high) if np.isfinite([low, high]).all() else None


def oracle_row(
    judged: JudgedModes, oracle: Mapping[int, NDArray[np.float32]], fixed: int
) -> ComparisonRow | None:
    """Row of the best set of the sequence by the errors of trials; None where nothing is known.

    `fixed` is the number of the fixed set: without its trial, nothing is known.
    """
    yardstick = judged.rows[0].yardstick
    rte = next(row.rte for row in judged.rows if row.mode == yardstick)
    if rte is None or fixed not in oracle:
        return None
    errors = cap(np.stack([*oracle.values()], axis=1))
    known = ~np.isnan(errors).any(axis=1)
    if not known.any():
        return None
    means = errors[known].mean(axis=0)
    # A trial leaves its warm-up out, and a replay does not: only the ratio carries over.
    ratio = float(means.min()) / max(float(means[[*oracle].index(fixed)]), 1e-12)
    return ComparisonRow(judged.name, ORACLE, rte * ratio, ratio, yardstick=yardstick)
