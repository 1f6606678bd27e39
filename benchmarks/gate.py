"""How often the gate is wrong: on sides that are equal, and on such with a planted loss.

    python benchmarks/gate.py [--pairs 40] [--seed 7000] [--folder FOLDER]

Each pair is a simulated drive of 20 s of its own (a robot, 60 m). *Equal* sides are GICP with a
correspondence distance of 4 and of 4.0001 m: the same odometry, but not bit by bit. *More error*:
the old side's replay, whose deviations from the truth, from scan to scan, are larger by what makes
10 % more error; *scale*: whose motions are too long by as much. *More cost*: GICP that works for
30 % longer. All is driven anew, and judged as `adaptune compare --against` does.
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adaptune._system.progress import unseen
from adaptune.geometry import invert, scale, steps
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.simulation.course import SCENES, Course
from adaptune.simulation.record import record
from adaptune.trajectory import Trajectory, read_tum, write_tum
from adaptune.tuning.asked import Asked
from adaptune.tuning.sides import costs, sides
from offline.config import OfflineStudy, load_study
from online.gate import Gate, compare_sides, shared_replays

ODOMETRY = "gate:Plain"
LONGER, FURTHER = 1.3, 1.1


class Plain(KeyframeGicp):
    """GICP in this process."""


class Slow(Plain):
    """The same, which works for longer."""

    def prepare(self, scan: Any) -> Any:
        """Prepare a scan, and look busy."""
        return self._slowly(super().prepare, scan)

    def register(self, prepared: Any) -> Any:
        """Register a scan, and look busy."""
        return self._slowly(super().register, prepared)

    @staticmethod
    def _slowly(work: Any, given: Any) -> Any:
        begin = time.thread_time()
        found = work(given)
        until = begin + LONGER * (time.thread_time() - begin)
        while time.thread_time() < until:
            pass
        return found


def chained(first: Any, motions: Any) -> Any:
    """Poses from the first one and the motions between them."""
    poses = [first]
    for T in motions:
        poses.append(poses[-1] @ T)
    return np.array(poses)


def planted_poses(truth: Any, odometry: Any, length: float, kind: str) -> Any:
    """Poses with `FURTHER` times the error, by larger deviations or by a wrong scale."""
    motions = steps(truth)
    off = invert(motions) @ steps(odometry)

    def poses(by: float) -> Any:
        if kind == "error":
            larger = [scale(T, 1.0 + by) for T in off]
            return chained(odometry[0], motions @ np.array(larger))
        longer = steps(odometry)
        longer[:, :3, 3] *= 1.0 + by
        return chained(odometry[0], longer)

    def error(of: Any) -> float:
        return float(np.nanmean(cap(sub_trajectory_rte(truth, of, length))))

    low, high, aim = 0.0, 0.4, FURTHER * error(odometry)
    for _ in range(12):
        middle = (low + high) / 2.0
        low, high = (middle, high) if error(poses(middle)) < aim else (low, middle)
    return poses(high)


def planted(old: OfflineStudy, kind: str) -> OfflineStudy:
    """The old side with more error."""
    folder = old.folder.with_name(f"{old.folder.name}_{kind}")
    shutil.copytree(old.folder, folder, ignore=shutil.ignore_patterns(".lock"))
    for path in folder.glob("replays/*/baseline-*/trajectory.tum"):
        (judged,) = path.parents[1].glob("reference-*/reference.tum")
        replayed, reference = read_tum(path), read_tum(judged)
        truth, odometry = reference.at(replayed.stamps), replayed.T_world_sensor
        poses = planted_poses(truth, odometry, old.config.sub_trajectory, kind)
        write_tum(path, Trajectory(replayed.stamps, poses))
    return replace(load_study(str(folder)), called=kind)


def judge(new: OfflineStudy, old: OfflineStudy, *, cost: bool = True) -> Gate:
    """What the gate says."""
    shared = shared_replays(new, old)
    return compare_sides(shared, costs(shared, unseen) if cost else None, 0.05, 0.1)


def pair(seed: int) -> dict[str, Gate]:
    """The verdicts on one drive, by kind of pair."""
    bag, scene = Path(f"drive_{seed}.bag"), list(SCENES)[seed % len(SCENES)]
    record(Course(scenes=(scene,), length=60.0, sensor="vlp16", columns=360, seed=seed), bag)
    for name, distance in {"old": 4.0, "near": 4.0001}.items():
        Path(f"{name}.yaml").write_text(f"max_correspondence_distance: {distance}\n")

    def driven(given: str) -> tuple[OfflineStudy, OfflineStudy]:
        return sides((given, "old.yaml"), Asked([bag], ODOMETRY), None, unseen)

    new, old = driven("near.yaml")
    found = {"equal": judge(new, old)}
    found["scale"] = judge(planted(old, "scale"), old, cost=False)
    if seed % 2:
        found["cost"] = judge(*driven("gate:Slow"))
    else:
        found["error"] = judge(planted(old, "error"), old)
    return found


def main() -> None:
    """Judge all pairs, and count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=7000)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    sys.path.insert(0, str(Path(__file__).parent))
    found: list[tuple[str, str]] = []
    for seed in range(given.seed, given.seed + given.pairs):
        at = folder / str(seed)
        shutil.rmtree(at, ignore_errors=True)
        at.mkdir()
        os.chdir(at)
        for kind, gate in pair(seed).items():
            print(f"{seed} {kind}: {gate.words}", flush=True)
            found.append((kind, gate.verdict))
        os.chdir(folder)
        shutil.rmtree(at)
    for kind in ("equal", "error", "cost", "scale"):
        verdicts = [verdict for of, verdict in found if of == kind]
        counts = ", ".join(
            f"{v} {verdicts.count(v)}" for v in ("worse", "unclear", "equal", "better")
        )
        print(f"{kind}: {len(verdicts)} pairs: {counts}")
    print(f"CPU {time.process_time():.0f} s")


if __name__ == "__main__":
    main()
