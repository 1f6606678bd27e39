"""How much of the work pruning saves, and what it loses, on simulated studies.

    python benchmarks/pruning.py [--seeds 0 1 2] [--each 3] [--trials 64] [--length 40]
    python benchmarks/pruning.py --scenes cave open street --each 2

For each seed, the script simulates three caves, open grounds, streets and gardens, and runs all
sets of a Sobol sequence on all of them, once. Every rule then receives the results that it asks
for. The trials are the same, so only the rules differ. The script prints the scans that a rule has
registered and the RTE of its fixed set, as ratios to those of the study without pruning. The limits
are 0.5 and 1.02.
"""

import argparse
import tempfile
from collections.abc import Collection
from pathlib import Path

from adaptune import files
from adaptune.archive import Archive
from adaptune.simulation.record import record
from offline.campaign import run_batches
from offline.config import OfflineStudy, load_study
from offline.objective import best_by_trials
from offline.train import train
from offline.workers import Outcome, Task, TaskResult

RULES = ("halving", "hyperband", "wilcoxon")


class Recorded:
    """A pool whose one worker reads the trials from an archive that holds all of them."""

    def __init__(self, archive: Archive):
        self._archive = archive
        self._tasks: list[Task] = []

    def workers(self) -> Collection[int]:
        """See `offline.workers.Pool`."""
        return range(1)

    def start(self, _worker: int, task: Task) -> None:
        """See `offline.workers.Pool`."""
        self._tasks.append(task)

    def wait(self) -> list[tuple[int, Outcome]]:
        """See `offline.workers.Pool`."""
        task = self._tasks.pop()
        trials = [self._archive.read(task.sequence, n) for n in task.numbers]
        frames = self._archive.read_frames(task.sequence) if task.frames else None
        return [(0, TaskResult(trials, frames))]


def study_file(folder: Path, seed: int, given: argparse.Namespace) -> Path:
    """Write a study of as many courses of each scene."""
    courses = {
        f"{scene}_{i}": {"scenes": [scene], "length": given.length, "seed": 10 * seed + i}
        for scene in given.scenes
        for i in range(given.each)
    }
    study = {
        "odometry": {"name": "gicp", "settings": {"downsampling": 0.5}},
        "courses": courses,
        "training": list(courses),
        "sub_trajectory": 10.0,
        "offline": {"sampler": "sobol", "trials": given.trials, "batch": max(4, given.trials // 8)},
    }
    path = folder / f"pruning_{seed}.yaml"
    path.write_text(files.dump(study))
    return path


def scans(study: OfflineStudy) -> int:
    """Number of scans registered in all trials of a study."""
    archive = Archive(study.folder / "trials")
    return sum(
        len(archive.finished(name)) * len(archive.read_frames(name).stamps)
        for name in study.training
    )


def main() -> None:
    """Measure everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--scenes", nargs="+", default=["cave", "open", "street", "garden"])
    parser.add_argument("--each", type=int, default=3, help="courses of each scene")
    parser.add_argument("--trials", type=int, default=64)
    parser.add_argument("--length", type=float, default=40.0)
    parser.add_argument("--folder", type=Path, help="to keep the full studies in")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in given.seeds:
            path = study_file(folder, seed, given)
            full = load_study(path, [], folder / f"full_{seed}")
            for name, course in full.config.courses.items():
                if not full.sequences.recording(name).exists():
                    record(course, full.sequences.recording(name))
            training = train(full)
            value = min(
                sum(means) / len(means) for means in zip(*training.means.values(), strict=True)
            )
            print(f"seed {seed}: {scans(full)} scans, fixed set {value:.3f} %", flush=True)
            for rule in RULES:
                pruned = load_study(
                    path, [f"offline.pruning={rule}"], Path(temporary) / f"{rule}_{seed}"
                )
                pruned.folder.mkdir()
                pool = Recorded(Archive(full.folder / "trials"))
                verdicts = run_batches(pruned, Archive(pruned.folder / "trials"), pool)
                best = verdicts[best_by_trials(pruned.config.offline, verdicts)].values[0]
                print(
                    f"  {rule:10} scans {scans(pruned) / scans(full):.2f}   "
                    f"RTE of the fixed set {best / value:.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
