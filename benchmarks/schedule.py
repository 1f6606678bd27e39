"""How much faster several workers are, on a machine on which nothing else runs.

    python benchmarks/schedule.py

It runs campaigns of GICP whose tasks take a made-up time by a clock of their own: so what counts is
the order in which `offline.campaign.Schedule` gives them out, and the load of this machine does
not. To prepare a scan, and to align it, takes longer the denser it is; a worker that has prepared
scans keeps so many of them. Columns: seconds of the baseline with descriptions and hops, of the
search, of the whole drives, of all; share of the time in which workers work; times faster than one.
"""

import heapq
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

import drives
from made_trials import run_along
from rooms import along_x

from adaptune._system.progress import unseen
from adaptune.runs.archive import Archive, Frames
from adaptune.runs.record import Run
from adaptune.space import ParameterSet
from offline import campaign
from offline.campaign import Campaign, run_baseline
from offline.choice import FINALISTS
from offline.config import load_study
from offline.frames import Segment, segments_of
from offline.whole import drive_whole
from offline.workers import Result, Task

CASES = {
    "20 min": ({"one": 12000}, 32, 1500.0),
    "20 min, memory enough": ({"one": 12000}, 32, np.inf),
    "2 x 20 min": ({"one": 12000, "two": 12000}, 32, 1500.0),
    "60 s, driven whole": ({"one": 600}, 64, np.inf),
    "3 x 100 s, driven whole": ({"one": 1000, "two": 1000, "three": 1000}, 64, 1500.0),
}
"""By what is recorded, at 3 m/s and 10 Hz: scans, trials, and how many scans a worker keeps."""
STEP, LENGTH = 0.3, 25.0
DESCRIBE, HOPS = 2.5e-3, 8e-3
"""Seconds a scan."""


def align_seconds(parameters: Mapping[str, Any]) -> float:
    """What it takes to align a scan."""
    wide = np.log1p(parameters["max_correspondence_distance"])
    return 1e-3 * float(1.2 * (0.5 / parameters["downsampling"]) ** 1.2 + 0.5 * wide)


def prepare_seconds(parameters: Mapping[str, Any]) -> float:
    """What it takes to prepare a scan."""
    return 1e-3 * (4.0 + 1.5 * float((0.5 / parameters["downsampling"]) ** 0.7))


class Made:
    """A pool of `n` workers with a clock of their own."""

    def __init__(self, n: int, scans: Mapping[str, int], kept: float, segments: int | None):
        self.n, self.now, self.busy = n, 0.0, 0.0
        self._scans, self._most, self._segments = scans, kept, segments
        self._running: list[tuple[float, int, int, Result]] = []
        self._begun = 0
        self._kept: list[dict[Any, int]] = [{} for _ in range(n)]

    def workers(self) -> range:
        """See `offline.workers.Pool`."""
        return range(self.n)

    def start(self, worker: int, task: Task) -> None:
        """See `offline.workers.Pool`."""
        seconds, result = self._do(worker, task)
        self.busy += seconds
        self._begun += 1
        heapq.heappush(self._running, (self.now + seconds, self._begun, worker, result))

    def wait(self) -> list[tuple[int, Result]]:
        """See `offline.workers.Pool`."""
        self.now, _, worker, result = heapq.heappop(self._running)
        return [(worker, result)]

    def _do(self, worker: int, task: Task) -> tuple[float, Result]:
        n = self._scans[task.sequence]
        if task.frames is not None:
            return HOPS * n, replace(task.frames, evidence_ms=1e3 * HOPS)
        if task.segment is None:
            T_ref_sensor, stamps = along_x(STEP * np.arange(n)), np.arange(n) * 10**8
            segments = segments_of(T_ref_sensor, stamps, LENGTH, self._segments)
            seen = (np.zeros((n, 90), np.float32), {"ndt": 90}, np.zeros(n, np.float32))
            return DESCRIBE * n, Frames(stamps, T_ref_sensor, *seen, segments=segments)
        seconds, fresh, kept = 0.0, set(), self._kept[worker]
        n = len(task.segment.stamps)
        for parameters in task.sets.values():
            seconds += align_seconds(parameters) * n
            key = (task.segment.key, density := parameters["downsampling"])
            if key not in kept and density not in fresh:
                seconds += prepare_seconds(parameters) * n
                fresh.add(density)
                if sum(kept.values()) + n <= self._most:
                    kept[key] = n
        return seconds, {i: [_drive(task.segment, one)] for i, one in task.sets.items()}


def _drive(segment: Segment, parameters: ParameterSet) -> Run:
    """A run with some error."""
    given, n = dict[str, Any](parameters), len(segment.stamps)
    off = abs(np.log(given["max_correspondence_distance"] / 2.0)) + 0.3 * given["downsampling"]
    run = run_along(segment.stamps, STEP * (1.003 + 0.01 * off), align_seconds(given))
    run.usage = run.usage._replace(cpu=align_seconds(given) * n)
    return run


def run(n: int, scans: Mapping[str, int], trials: int, kept: float) -> list[float]:
    """Run a campaign with `n` workers; returns the columns, see above."""
    with tempfile.TemporaryDirectory() as temporary:
        file = drives.write_study(Path(temporary))
        given = [f"training=[{', '.join(scans)}]", "test=[]", f"sub_trajectory={LENGTH}"]
        given += ["odometry={name: gicp}", f"offline={{trials: {trials}}}"]
        study = load_study(file, given, Path(temporary) / "study")
        study.folder.mkdir()
        pool, archive = Made(n, scans, kept, study.config.segments), Archive(study.folder / "t")
        run_baseline(study, archive, pool, unseen)
        ends = [pool.now]
        judged = Campaign(study, archive, pool).run()
        ends.append(pool.now)
        best = sorted(judged, key=lambda number: judged[number].value)[:FINALISTS]
        sets = {number: judged[number].parameters for number in sorted({0, *best})}
        drive_whole(study, sets, archive, pool, unseen)
        ends.append(pool.now)
        return [*np.diff(ends, prepend=0.0).tolist(), pool.now, pool.busy / pool.now / n]


def main() -> None:
    """Print a line for each case and number of workers."""
    campaign.contradictions_of = lambda *_: []  # its scans are none
    for name, case in CASES.items():
        one = run(1, *case)
        for n in (1, 2, 4):
            *seconds, busy = run(n, *case)
            told = " ".join(f"{of:6.0f}" for of in seconds)
            faster = f"search {one[1] / seconds[1]:.2f}, all {one[3] / seconds[3]:.2f}"
            print(f"{name:24} {n} workers {told} s  busy {busy:.3f}  {faster}", flush=True)


if __name__ == "__main__":
    main()
