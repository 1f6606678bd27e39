"""What both sides of a gate cost: each is driven twice, by turns."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system import manifest
from adaptune._system.files import write_text
from adaptune._system.progress import Progress, unseen
from adaptune.errors import AdaptuneError
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.tracker import Tracker
from adaptune.paired import Pair, Ratio, along, joined, pooled
from adaptune.runs.record import RunSummary, machine
from adaptune.study.study import Study
from online.modes import Mode, run_mode

COST, P99 = "cost", "pose, 99th percentile"
"""Milliseconds: of CPU time a scan; in real time, within which 99 % of the poses are there."""
Costs = Mapping[str, NDArray[np.float64]]
"""On a recording, by quantity: of shape (2, 2, n), by side, the new one first, turn, and scan."""
_FIRST = 20
"""Scans that each side takes before: a process is slower at first."""
_BLOCK, _PARTS = 10, 4
"""Scans whose costs count as one, and parts of a recording in each of which turns are compared."""


class StoredReplay(NamedTuple):
    """A side as it was replayed on a recording."""

    study: Study
    name: str  # of the recording
    folder: Path  # of the replay
    summary: RunSummary

    @property
    def made(self) -> float:
        """When, in seconds."""
        return (self.folder / "replay.json").stat().st_mtime

    @property
    def obstacle(self) -> str:
        """Why the same cannot be driven again; empty if it can."""
        recorded = self.summary.inputs
        try:
            now = self.study.replay_inputs(self.name)
        except AdaptuneError as error:
            return f"{self.study.name} cannot be driven again: {error}"
        said = manifest.changes({key: recorded.get(key) for key in now}, now)
        return f"{self.study.name} has changed since: {'; '.join(said)}" if said else ""

    def odometry(self) -> OdometryInstance:
        """The odometry with the parameters of the replay."""
        return self.study.odometry(self.summary.inputs["parameters"], self.name)

    def run(self, show: Progress) -> dict[str, float]:
        """Drive it from end to end: its cost, as one figure a quantity."""
        recording, what = self.study.sequences.open(self.name), f"cost of {self.study.name}"
        mode = Mode(COST, {0: self.summary.inputs["parameters"]})
        given = self.study, recording, self.odometry, mode, f"{self.name}, {what}", show
        run = run_mode(*given)
        kept = run.summary.real_time
        return {COST: run.cpu_ms} | ({} if kept is None else {P99: kept["pose_ms_p99"]})


def by_turns(both: Sequence[StoredReplay], folder: Path, show: Progress) -> Costs:
    """What both sides cost, the new one first; `folder` keeps it.

    They take turns at each scan, and so meet the same state of the machine. Programs that run whole
    recordings, and what keeps time, take turns at each run.
    """
    about = manifest.plain([machine(), *(one.summary.inputs for one in both)])
    path = folder / f"{manifest.digest(about)}.json"
    with suppress(OSError, ValueError, AttributeError):  # damaged, it is measured again
        found = {key: np.array(of, float) for key, of in json.loads(path.read_text()).items()}
        if COST in found and all(of.shape[:2] == (2, 2) for of in found.values()):
            return found
    if both[0].study.config.online.real_time or any(
        one.study.odometry.description.whole for one in both
    ):
        runs = [both[side].run(show) for side in (0, 1, 1, 0)]
        sides = (runs[0], runs[3]), (runs[1], runs[2])
        costs = {key: [[[run[key]] for run in side] for side in sides] for key in runs[0]}
    else:
        _scan_by_scan(both, 0, unseen, _FIRST)
        turns = [_scan_by_scan(both, turn, show) for turn in (0, 1)]
        costs = {COST: [list(side) for side in zip(*turns, strict=True)]}
    write_text(path, json.dumps(costs))
    return {key: np.array(of) for key, of in costs.items()}


def _scan_by_scan(
    both: Sequence[StoredReplay], turn: int, show: Progress, first: int | None = None
) -> list[list[float]]:
    """Drive both sides at the same time; milliseconds of each scan, by side."""
    # With the IMU, if one needs it: what is read anew is read as the same.
    reads = max(both, key=lambda one: one.study.sequences.with_imu)
    recording = reads.study.sequences.open(reads.name)
    what, n = f"{both[0].name}, cost of both", recording.n_messages
    costs: list[list[float]] = [[], []]
    with ExitStack() as stack:
        odometries = [stack.enter_context(closing(one.odometry())) for one in both]
        trackers = [
            Tracker(odometry, one.study.config.health)
            for odometry, one in zip(odometries, both, strict=True)
        ]
        for i, scan in enumerate(islice(recording, first)):
            for side in (0, 1) if (i + turn) % 2 else (1, 0):
                before = _used(odometries[side])
                trackers[side].register(scan)
                costs[side].append(round(1e3 * (_used(odometries[side]) - before), 4))
            show(what, i + 1, n)
    show(what, n, n)
    return costs


def _used(odometry: OdometryInstance) -> float:
    """Seconds of CPU time of this process, and of the odometry's own ones."""
    return time.process_time() + odometry.usage.other_cpu


def cost_ratios(
    every: Sequence[NDArray[np.float64]], recordings: Sequence[str], share: float
) -> list[Ratio]:
    """Ratio of new to old on each recording, and if there are several, over all.

    How sure they are comes from the scans, and from the difference between the turns: that of all
    recordings, or of one where that is more.
    """
    n, scans = len(every), [along(Pair(costs.mean(axis=1), _BLOCK)) for costs in every]
    parts = min(_PARTS, every[0].shape[2])
    split = [np.array_split(np.maximum(costs, 1e-12), parts, axis=2) for costs in every]
    logs = np.log([[part.mean(axis=2) for part in of] for of in split])
    of_turns = np.diff(logs, axis=3)[..., 0]  # by recording, part and side
    if parts == 1:  # one figure a run
        turns, free = (of_turns**2).sum(axis=2)[:, 0] / 4.0, 2.0
        scans = [(log, 0.0, math.inf) for log, *_ in scans]
    else:  # what both have met at the same scan is no difference
        turns, free = (np.diff(of_turns, axis=2) ** 2).mean(axis=(1, 2)) / 4.0, float(parts)
    usual, found = float(turns.mean()), list[Ratio]()
    for (log, error, own), turn in zip(scans, turns.tolist(), strict=True):
        joint = np.array(joined((error, max(usual, turn) ** 0.5), (own, n * free)))
        found.append(pooled(np.array([log]), joint[:1], joint[1:], [""], share))
    if n > 1:
        both = [joined((error, usual**0.5), (own, free)) for _, error, own in scans]
        errors, owns = np.array(both).T
        found.append(pooled(np.array([log for log, *_ in scans]), errors, owns, recordings, share))
    return found
