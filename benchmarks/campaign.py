"""What a campaign adds to the odometry's own work, and what it takes with many trials.

    python benchmarks/campaign.py speed [TRIALS] [SCANS]
    python benchmarks/campaign.py memory [ROUNDS]
    python benchmarks/campaign.py size [TRIALS]

*speed* records a simulated cave and runs TRIALS (64) sets of GICP over its SCANS (600): once in a
bare loop that reads, prepares and registers the clouds, once as two such loops at the same time
with half of the sets each, once as a campaign with one worker, once with two. Limits: 1.10 times
the bare loop's time with one worker, 1.8 times faster with two, where two bare loops are.

*memory* lets a worker, which may keep 0.4 GB of prepared scans, run a trial on each of four caves,
ROUNDS (4) times. Each cave makes room for the next one. It prints the worker's memory at the end,
as a ratio to what it keeps, and its CPU time: as it is, and without
`adaptune._system.machine.freeing_large_arrays`.
Limit: 2 times what it keeps.

*size* runs a campaign of TRIALS (10,000) whose trials of 600 scans are random numbers, and prints
the driver's memory on the way. Then it measures how long a resumed campaign takes: until it
proposes the next trial (limit 5 s), and until it ends, with its model, where it lacks nothing.
"""

import contextlib
import multiprocessing as mp
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Self

import numpy as np
import small_gicp
from stages import bare_gicp

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

import drives
from made_trials import run_along
from rooms import along_x

from adaptune._system import yaml12
from adaptune.odometry.keyframe import crop
from adaptune.runs.archive import Archive, Frames
from adaptune.runs.record import Run
from adaptune.simulation.record import record
from offline import shared_scans, workers
from offline import train as training
from offline.config import OfflineStudy, load_study
from offline.drive import TrialSetup
from offline.frames import Segment, describe, segments_along
from offline.workers import Result, Task

STUDY = """\
odometry: {{name: gicp, settings: {{downsampling: 0.5, iterations: 20}}}}
courses: {{cave: {{scenes: [cave], length: {length:.0f}, sensor: hdl32e, seed: 1}}}}
training: [cave]
offline: {{trials: {trials}}}
"""
N_FRAMES = 600


def bare(study: OfflineStudy, sets: Sequence[dict[str, Any]]) -> None:
    """What any program would have to do."""
    settings: Any = study.odometry.settings
    trial = [
        small_gicp.preprocess_points(
            crop(scan, settings.min_range), downsampling_resolution=settings.downsampling
        )
        for scan in study.sequences.open("cave")
    ]
    for parameters in sets:
        bare_gicp(
            trial,
            parameters["max_correspondence_distance"],
            parameters["keyframe_interval"],
            settings.iterations,
        )


def in_children(function: Callable[..., Any], *calls: tuple[Any, ...]) -> list[tuple[float, Any]]:
    """Time calls, each in a fresh process, all at once; return their seconds and results."""
    with ProcessPoolExecutor(len(calls), mp.get_context("spawn")) as pool:
        timed = [pool.submit(_timed, function, arguments) for arguments in calls]
        return [one.result() for one in timed]


def in_child(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Time a call in a fresh process."""
    return in_children(function, arguments)[0]


def _timed(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[float, Any]:
    begin = time.monotonic()
    returned = function(*arguments)
    return time.monotonic() - begin, returned


def train(study: OfflineStudy) -> list[dict[str, Any]]:
    """Run a campaign, and return its parameter sets."""
    return list(training.train(study).model.sets.parameters)


def speed(trials: int, scans: int) -> None:
    """Compare campaigns with the bare loop."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        file = folder / "cave.yaml"
        file.write_text(STUDY.format(trials=trials, length=0.1 * scans))
        for n in (1, 2):
            study = load_study(file, [f"offline.workers={n}"], folder / f"{n}")
            study.sequences.recording("cave").parent.mkdir(parents=True)
            if n == 1:
                record(study.config.courses["cave"], study.sequences.recording("cave"))
            else:
                os.link(folder / "1/recordings/cave.bag", study.sequences.recording("cave"))
        one, two = (load_study(file, [f"offline.workers={n}"], folder / f"{n}") for n in (1, 2))
        for _ in one.sequences.open("cave"):
            pass  # into the cache
        wall_1, sets = in_child(train, one)
        wall, _ = in_child(bare, one, sets)
        halves = [(one, sets[i::2]) for i in range(2)]
        wall_halves = max(wall for wall, _ in in_children(bare, *halves))
        wall_2, _ = in_child(train, two)
        n_frames = len(Archive(one.folder / "trials").read_frames("cave").stamps)
        print(f"{len(sets)} trials of {n_frames} scans")
        print(f"bare loop             {wall:8.1f} s")
        print(f"two, half of it each  {wall_halves:8.1f} s: {wall / wall_halves:.2f} times faster")
        print(f"1 worker              {wall_1:8.1f} s: {wall_1 / wall:.3f} times the bare loop's")
        print(f"2 workers             {wall_2:8.1f} s: {wall_1 / wall_2:.2f} times faster than one")


def rounds(study: OfflineStudy, n: int, as_it_is: bool) -> tuple[float, float]:
    """Memory of a worker's process after some rounds, over what it keeps, and its CPU seconds."""
    if not as_it_is:
        shared_scans.freeing_large_arrays = contextlib.nullcontext  # type: ignore[assignment]
    setup = TrialSetup(study.config, study.odometry, study.sequences)
    bench = workers.Bench(setup, 0.4e9)
    frames = {name: describe(study.config, study.sequences, name) for name in study.training}
    segments = {name: segments_along(name, of.uncut)[0] for name, of in frames.items()}
    before, begin = _memory(), time.process_time()
    # All but the baseline's clouds are prepared while trials run.
    sets = [study.odometry.space.baseline | {"downsampling": d} for d in (0.25, 0.35, 0.7)]
    for i, name in enumerate(n * study.training):
        task = Task(name, segment=segments[name], sets={0: sets[i % len(sets)]})
        bench.run(task, lambda *_: None)
    kept = 1e-6 * sum(shared.nbytes for shared in bench._shared.values())
    return (_memory() - before) / kept, time.process_time() - begin


def memory(n: int) -> None:
    """Compare the memory of workers."""
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / "caves.yaml"
        caves = {f"cave_{i}": {"scenes": ["cave"], "length": 40, "seed": i} for i in range(4)}
        odometry = {"name": "gicp"}
        study = {"odometry": odometry, "courses": caves, "training": list(caves)}
        file.write_text(yaml12.dump(study))
        loaded = load_study(file, [], Path(temporary) / "caves")
        for name in caves:
            loaded.sequences.recording(name).parent.mkdir(parents=True, exist_ok=True)
            record(loaded.config.courses[name], loaded.sequences.recording(name))
            for _ in loaded.sequences.open(name):
                pass  # into the cache
        for what, as_it_is in (("as it is", True), ("with holes", False)):
            _, (ratio, seconds) = in_child(rounds, loaded, n, as_it_is)
            print(f"{what:10s} {ratio:5.2f} times what it keeps, {seconds:6.1f} s of CPU time")


class Drawn:
    """A pool that draws the results of trials."""

    def __init__(self, *_: object):
        self.asked = 0.0
        self._task: Task | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def workers(self) -> list[int]:
        """One."""
        return [0]

    def start(self, _worker: int, task: Task) -> None:
        """Remember the task, and when it came."""
        self.asked = self.asked or time.monotonic()
        self._task = task

    def wait(self) -> list[tuple[int, Result]]:
        """Draw its drives."""
        assert self._task is not None
        segment = self._task.segment
        if segment is not None:
            return [(0, {number: [_drawn(number, segment)] for number in self._task.sets})]
        frames = Frames(
            np.arange(N_FRAMES) * 10**8,
            along_x(0.3 * np.arange(N_FRAMES)),
            np.random.default_rng(0).integers(0, 99, (N_FRAMES, 90)).astype(np.float32),
            {"ndt": 90},
            np.zeros(N_FRAMES, np.float32),
            evidence_ms=0.0,
        )
        return [(0, frames)]


def _drawn(number: int, segment: Segment) -> Run:
    rng = np.random.default_rng(number)
    factor = 1.0 + 0.01 * rng.gamma(1.0)
    return run_along(segment.stamps, 0.3 * factor, rng.gamma(1.0))


def _memory() -> float:
    """Resident megabytes of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def fill(study: OfflineStudy) -> None:
    """Run a drawn campaign, and print the memory on the way."""
    training.Workers = Drawn  # type: ignore[assignment,misc]
    at = [100, 300, 1000, 3000, 10_000, 30_000]

    def show(what: str, done: int, *_: object) -> None:
        if what == "trials" and at and done >= at[0]:
            at.pop(0)
            print(f"{done:6d} trials: driver {_memory():6.1f} MB", flush=True)

    training.train(study, show)
    print(f"with the model: at most {_peak():.1f} MB")


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def resume(study: OfflineStudy) -> float:
    """Run a drawn campaign again; return the seconds until the first trial was asked for."""
    pool = Drawn()
    training.Workers = lambda *_: pool  # type: ignore[assignment,misc]
    begin = time.monotonic()
    training.train(study)
    return pool.asked - begin


def size(trials: int) -> None:
    """Fill an archive, and resume."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        file = drives.write_study(folder)
        given = ["training=[one]", "offline.sampler=random", "offline.batch=100"]

        def study(n: int) -> OfflineStudy:
            return load_study(file, [*given, f"offline.trials={n}"], folder / "run")

        wall, _ = in_child(fill, study(trials))
        print(f"filled in {wall:.1f} s")
        wall, _ = in_child(resume, study(trials))
        print(f"resumed with nothing to do: {wall:.2f} s")
        _, asked = in_child(resume, study(trials + 100))
        print(f"resumed with more to do: next trial asked for after {asked:.2f} s")


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in ("speed", "memory", "size"):
        sys.exit(__doc__)
    numbers = [int(word) for word in sys.argv[2:]]
    if sys.argv[1] == "speed":
        speed(*(numbers + [64, 600][len(numbers) :]))
    elif sys.argv[1] == "memory":
        memory(*(numbers or [4]))
    else:
        size(*(numbers or [10_000]))
