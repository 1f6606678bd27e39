"""What several odometries gain in one bank.

    python benchmarks/pool.py runs/pool --seeds 61 62            # left out
    python benchmarks/pool.py runs/pool --seeds 61 --driven      # replays of eight other courses

On the 24 courses of `gain.py` (of 60 m) six odometries run the sets of `pool_data.py`: GICP, VGICP
and NDT with their downsampling and iterations tuned, KISS-ICP, GenZ-ICP and MAD-ICP. It takes two
hours a world on one core, and resumes. `more-SEED.json` in the folder may hold further sets.

Left out: one course after the other; fixed set and bank are chosen on the other 23. Driven:
chosen on all 24, and replayed on mixed courses of other worlds, with the health check. The script
prints ratios of mean errors over 25 m, and what each mode costs. With `--budget`, what is driven
costs that many milliseconds of CPU time a scan at most; `fixed` is what the fixed set costs. With
`--driven --kill ODOMETRY`, only the bank is driven, once as it is and once with that odometry's
process killed before every scan of the second half.
"""

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from gain_data import WINDOW, training_courses
from numpy.typing import NDArray
from pool_data import LENGTH, pool, pooled_data, run_course
from replays import ORDERS, mean_error

from adaptune._system.processes import server
from adaptune.bank.bank import Bank
from adaptune.model import ErrorModel
from adaptune.model.registry import ADAPTIVE
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.remote import SERVICE
from adaptune.recording.scan import Scan
from adaptune.runs.loop import replay
from adaptune.runs.record import Run
from adaptune.selector import Selector
from adaptune.simulation import Course
from adaptune.simulation.record import SimulatedScan, simulate
from adaptune.study.config import SwitchingConfig
from adaptune.study.driven import named
from offline.bank_choice import figures
from offline.labelled import LabelledData
from offline.train import fit, with_bank
from offline.validate import Validation, leave_one_out

DRIVEN_LENGTH = 40.0
"""Metres of each scene that is driven through."""


def left_out(data: LabelledData) -> None:
    """Leave each course out in turn, and print ratios and costs."""
    fixed_set = None if data.budget is None else data._replace(budget=None)
    validation = leave_one_out(data)
    print_left_out(validation)
    if fixed_set is not None:
        # The fixed set without a budget.
        free = leave_one_out(fixed_set, bank=0)
        pairs = zip(validation.left_out, free.left_out, strict=True)
        ratio = np.array([a.errors[ADAPTIVE].mean() / b.errors["fixed"].mean() for a, b in pairs])
        print(f"within the budget, adaptive / fixed without it: {_words(ratio)}")


def print_left_out(validation: Validation) -> None:
    """Print ratios to baseline and fixed set, over all courses and by their kind."""
    means = {
        mode: np.array([one.errors[mode].mean() for one in validation.left_out])
        for mode in ("baseline", "fixed", ADAPTIVE)
    }
    for mode, of in means.items():
        print(f"{mode:14} {np.exp(np.log(of).mean()):.3f} % at {validation.cost(mode):6.1f} ms")
    kinds = [one.name.rstrip("0123456789") for one in validation.left_out]
    for rival in ("baseline", "fixed"):
        ratio = means[ADAPTIVE] / means[rival]
        found = figures(np.log(ratio), kinds and [one.name for one in validation.left_out])
        by_kind = {
            kind: np.exp(np.log(ratio[[k == kind for k in kinds]]).mean())
            for kind in dict.fromkeys(kinds)
        }
        print(
            f"adaptive / {rival:13} {_words(ratio)}, 95 % {found.low:.2f}-{found.high:.2f}; "
            + ", ".join(f"{kind} {value:.2f}" for kind, value in by_kind.items())
        )
    each = zip(validation.left_out, means[ADAPTIVE] / means["baseline"], strict=True)
    print("each / baseline: " + ", ".join(f"{one.name} {ratio:.2f}" for one, ratio in each))
    print(flush=True)


def _words(ratio: NDArray[np.float64]) -> str:
    return f"geometric mean {np.exp(np.log(ratio).mean()):.3f}, worst {ratio.max():.2f}"


def model_of(data: LabelledData) -> ErrorModel:
    """The error model with its bank."""
    model = fit(data, data.fixed(), pool().identity, 25.0, WINDOW, {})
    return with_bank(model, data, SwitchingConfig())


def drive(model: ErrorModel, course: Course) -> dict[str, tuple[float, Run]]:
    """Replay a course in all modes; the mean error in percent and the replay of each."""
    scans, make = list(simulate(course)), pool()
    trials = {"baseline": 0, "fixed": model.fixed}
    found = {}
    for mode in [*trials, ADAPTIVE]:
        if mode == ADAPTIVE:
            result = drive_bank(model, scans)
        else:
            alone = make(model.sets[trials[mode]])
            result = replay(scans, alone, HealthCheck())
            alone.close()
        found[mode] = mean_error(scans, result), result
    return found


def drive_bank(model: ErrorModel, scans: Iterable[Scan]) -> Run:
    """Replay scans with the model's bank."""
    sets = {trial: model.sets[trial] for trial in model.bank}
    bank = Bank(pool(), sets)
    result = replay(scans, bank, HealthCheck(), Selector(model, ADAPTIVE, list(sets)))
    bank.close()
    return result


def drive_killed(model: ErrorModel, course: Course, odometry: str) -> str:
    """Errors of the bank as it is, and with a member killed in the second half."""
    scans = list(simulate(course))
    as_it_is = mean_error(scans, drive_bank(model, scans))
    result = drive_bank(model, killing(scans, odometry))
    killed, restarts = mean_error(scans, result), result.restarted.sum()
    return f"bank {as_it_is:.3f} %, {odometry} killed {killed:.3f} % ({restarts} restarts)"


def killing(scans: list[SimulatedScan], odometry: str) -> Iterator[Scan]:
    """Scans, and an end to an odometry's processes before each of the second half."""
    for i, scan in enumerate(scans):
        if 2 * i >= len(scans):
            for watcher in _children(server(SERVICE, odometry).process.pid):
                for process in _children(watcher):
                    os.kill(process, signal.SIGKILL)
        yield scan


def _children(process: int) -> list[int]:
    path = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in path.read_text().split()]


def driven(data: LabelledData, seed: int, every: slice, kill: str | None) -> None:
    """Replay courses of other worlds."""
    model = model_of(data)
    members = ", ".join(named(model, trial) for trial in model.bank)
    print(f"bank {members}: {model.bank_settings}")
    print(f"fixed {named(model, model.fixed)}", flush=True)
    for i in range(len(ORDERS))[every]:
        course = Course(scenes=ORDERS[i], length=DRIVEN_LENGTH, seed=1000 * seed + 500 + i)
        if kill:
            print(f"{seed} driven {i} {' '.join(ORDERS[i])}: {drive_killed(model, course, kill)}")
            continue
        row = ", ".join(
            f"{mode} {error:.3f} % at {result.cpu_ms:.0f} ms ({result.restarted.sum()} restarts)"
            for mode, (error, result) in drive(model, course).items()
        )
        print(f"{seed} driven {i} {' '.join(ORDERS[i])}: {row}", flush=True)


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[61, 62])
    parser.add_argument("--budget", help="milliseconds of CPU time a scan, or `fixed`")
    parser.add_argument("--driven", action="store_true", help="replay other courses")
    parser.add_argument("--every", default="0:8", help="which of them, as in 0:4")
    parser.add_argument("--kill", metavar="ODOMETRY", help="kill a member of the bank halfway")
    parser.add_argument("--course", help=argparse.SUPPRESS)  # in a process of its own
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.course:
        run_course(folder, arguments.seeds[0], arguments.course)
        return
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    for seed in arguments.seeds:
        for name in training_courses(seed, LENGTH):
            # Prepared scans of a course take gigabytes.
            again = [sys.executable, __file__, str(folder), "--seeds", str(seed)]
            subprocess.run([*again, "--course", name], check=True)
        data = pooled_data(folder, seed)
        assert data.costs is not None
        if arguments.budget:
            fixed = arguments.budget == "fixed"
            budget = data.costs.alone(data.fixed()) if fixed else float(arguments.budget)
            data = data._replace(budget=budget)
            print(f"world {seed}, within {budget:.1f} ms of CPU time a scan")
        if arguments.driven:
            driven(data, seed, slice(*map(int, arguments.every.split(":"))), arguments.kill)
        else:
            left_out(data)


if __name__ == "__main__":
    main()
