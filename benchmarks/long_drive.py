"""What segments save of the CPU time of `adaptune offline` on one long recording.

    python benchmarks/long_drive.py RECORDING.bag [--seconds 180] [--sets 16] [--length 4.0]

It trains GICP twice in this process, on twelve segments and on all of the recording's begin, and
prints for each: CPU seconds of all, and of these of drives, of descriptions, and of hops; scans
that were registered; the fixed set, and its error in percent over all of it. CPU time hardly
depends on what else the machine does.
"""

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Self

from adaptune._system import yaml12
from adaptune.runs.archive import Archive
from adaptune.simulation import Course
from adaptune.simulation.course import as_sequence
from offline import train as training
from offline import workers
from offline.config import load_study
from offline.drive import TrialSetup
from offline.workers import Bench, Task, attempt

spent: Counter[str] = Counter()
"""CPU seconds by function, and scans."""


class Here:
    """One worker, in this process."""

    def __init__(self, setup: TrialSetup, _n: int, memory: float):
        self._bench, self._tasks = Bench(setup, memory), list[Task]()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def workers(self) -> Collection[int]:
        """See `offline.workers.Pool`."""
        return [0]

    def start(self, _worker: int, task: Task) -> None:
        """See `offline.workers.Pool`."""
        self._tasks.append(task)

    def wait(self) -> list[tuple[int, Any]]:
        """See `offline.workers.Pool`."""
        return [(0, attempt(self._bench, self._tasks.pop()))]


def timed(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same, with its CPU time noted."""

    def call(*args: Any, **more: Any) -> Any:
        begin = time.process_time()
        found = function(*args, **more)
        spent[function.__name__] += time.process_time() - begin  # type: ignore[assignment]
        if function.__name__ == "drive_sets":
            spent["scans"] += sum(len(run.steps) for of in found for run in of)
        return found

    return call


def main() -> None:
    """Print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--sets", type=int, default=16)
    parser.add_argument("--length", type=float, default=4.0, help="of a sub-trajectory in metres")
    given = parser.parse_args()
    training.Workers = Here  # type: ignore[assignment,misc]
    for name in ("drive_sets", "describe", "with_measured_hops"):
        setattr(workers, name, timed(getattr(workers, name)))
    course = as_sequence(Course(scenes=("street",)), given.recording.resolve())
    sequence = course.model_dump(mode="json", exclude_none=True) | {"stop": given.seconds}
    about = {
        "odometry": {"name": "gicp"},
        "sequences": {"long": sequence},
        "training": ["long"],
        "sub_trajectory": given.length,
        "offline": {"trials": given.sets, "workers": 1},
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "long.yaml"
        file.write_text(yaml12.dump(about), "utf-8")
        for segments in ("12", "all"):
            study = load_study(file, [f"offline.segments={segments}"], Path(folder) / segments)
            n = sum(1 for _ in study.sequences.open("long"))  # it is in the cache from now on
            spent.clear()
            begin = time.process_time()
            found = training.train(study)
            seconds, archive = time.process_time() - begin, Archive(study.folder / "trials")
            error = archive.summary("long", found.model.fixed, kind="whole").mean_error
            driven = archive.read_frames("long").n_driven / n
            parts = "  ".join(f"{name} {value:.1f}" for name, value in sorted(spent.items()))
            print(f"segments {segments:3}  {n} scans, {driven:.2f} driven  all {seconds:.1f} s")
            print(f"    {parts}  fixed {found.model.fixed}: {error:.4f} %", flush=True)


if __name__ == "__main__":
    main()
