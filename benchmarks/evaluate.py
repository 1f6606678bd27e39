"""How well `adaptune evaluate` judges without ground truth, beside three metrics of maps.

    python benchmarks/evaluate.py runs/judged          # half an hour on two idle cores; resumes
    python benchmarks/evaluate.py runs/judged --maps FOLDER

Sets of GICP, NDT and KISS-ICP drive simulated courses that nothing was chosen by, and `hall.bag` if
ADAPTUNE_TEST_DATA names its folder. Each trajectory is judged by the reference that is estimated
from the scans, and by the truth (of the hall, its given reference). The script prints for each
course the rank correlation of both over the sets within twice the best one's error, how often the
95 % interval holds the true mean, how wide it is, and the share of the time that is unknown; of the
recorded drives that share only; and the seconds of the command on `hall.bag`.

With `--maps`, it also prints the rank correlation of MME, MPV and MOM (Kornilova and Ferrer 2021).
FOLDER is where ``pip install --no-deps --target FOLDER map-metrics==0.0.4 'networkx<3'`` put them.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
import types
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from adaptune._system.open3d import load
from adaptune.errors import AdaptuneError
from adaptune.evaluation.judged import Judge, Judged
from adaptune.geometry import Poses
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.odometry.registry import odometry_class
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import RecordedSequence
from adaptune.recording.scan import Scan
from adaptune.reference.estimate import estimate_reference, estimated
from adaptune.reference.graph import pass_over
from adaptune.reference.judge import Reference
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from adaptune.trajectory import Trajectory, write_tum

KINDS = ("cave", "street", "open", "garden", "corridor")
SETS: list[tuple[str, dict[str, float]]] = [
    *(
        ("gicp", {"max_correspondence_distance": d, "keyframe_interval": k})
        for d, k in ((1.0, 1.0), (2.0, 1.0), (1.5, 4.0), (3.0, 2.0), (5.0, 6.0))
    ),
    *(
        ("ndt", {"resolution": r, "keyframe_interval": k})
        for r, k in ((1.5, 1.0), (2.5, 2.0), (4.0, 4.0))
    ),
    *(("kiss_icp", {"voxel_size": v}) for v in (0.5, 1.0, 1.5)),
]
RECORDED = ("hall", "town", "road", "city")
WITHIN = 2.0  # times the best one's error; sets beyond are told apart by anything
OVER = 5.0  # metres of a sub-trajectory
EVERY, CELL = 20, 0.5  # scans of a map, and metres between points of its clouds
Maps = Iterator[dict[str, float]]
DATA = Path(os.environ.get("ADAPTUNE_TEST_DATA", "none"))


def driven(name: str, parameters: dict[str, float], scans: Sequence[Scan]) -> Poses:
    """The poses of one set; nothing restarts it where it is lost."""
    cls: Any = odometry_class(name)
    space = cls.space
    odometry = cls({**space.baseline, **{k: v for k, v in parameters.items() if k in space.names}})
    prepared = (odometry.prepare(scan) for scan in scans)
    odometry.start(next(prepared), np.eye(4))
    return np.array([np.eye(4), *(odometry.register(p).T_odom_sensor for p in prepared)])


def map_metrics(scans: Sequence[Scan], every: Sequence[Poses], folder: str) -> Maps:
    """MME, MPV and MOM of the map that each trajectory makes, where these are installed."""
    sys.path.append(folder)
    # Written for an nptyping of its time, which it needs for annotations only.
    typing = types.ModuleType("nptyping")
    typing.NDArray = type("NDArray", (), {"__class_getitem__": lambda *_: Any})  # type: ignore[attr-defined]
    sys.modules.setdefault("nptyping", typing)
    from map_metrics.metrics import mme, mom, mpv  # type: ignore[import-not-found]
    from map_metrics.utils.orthogonal import extract_orthogonal_subsets  # type: ignore[import-not-found]

    o3d, some = load(), range(0, len(scans), EVERY)
    clouds = [
        o3d.geometry.PointCloud(
            o3d.utility.Vector3dVector(scans[i].points.astype(float))
        ).voxel_down_sample(CELL)
        for i in some
    ]
    try:
        planes, *_ = extract_orthogonal_subsets(clouds[0], eps=1e-1)
    except Exception as error:  # no three planes at right angles
        print(f"no MOM: {error}", flush=True)
        planes = None
    for T in every:
        poses = [T[i] for i in some]
        found = {"mme": float(mme(clouds, poses)), "mpv": float(mpv(clouds, poses))}
        yield found | {"mom": float(mom(clouds, poses, planes)) if planes is not None else math.nan}


def judged(name: str, scans: Sequence[Scan], truth: Poses, maps: str | None) -> dict[str, Any]:
    """All sets on a course, by the estimated reference and by the truth."""
    found = estimated(name, pass_over(scans), scans)
    stamps = np.array([scan.stamp for scan in scans], np.int64)
    poses = [driven(*one, scans) for one in SETS]
    reference = Reference(found.trajectory(), OVER, True, found.error(OVER))
    rows = scored(name, reference, stamps, poses, truth)
    if maps is not None:
        for row, more in zip(rows, map_metrics(scans, poses, maps), strict=True):
            row.update(more)
    errors = cap(sub_trajectory_rte(truth, found.known_poses, OVER))
    own = {"says": reference.error, "is": float(np.nanmean(errors))}
    return {"rows": rows, "unknown": found.unknown_share()} | own


def scored(
    name: str,
    reference: Reference,
    stamps: NDArray[np.int64],
    poses: Sequence[Poses],
    truth: Poses,
) -> list[dict[str, Any]]:
    """A row for each set: its true error, and what the reference says of it."""
    judge = Judge(name, reference, "an estimated reference", int(stamps[0]), int(stamps[-1]))
    rows = []
    for (odometry, parameters), T in zip(SETS, poses, strict=True):
        mine = Trajectory(stamps, T)
        one = Judged(name, judge, mine, judge.stamps(mine))
        errors = cap(sub_trajectory_rte(truth, T, OVER))
        row: dict[str, Any] = {
            "set": " ".join([odometry, *map("{:g}".format, parameters.values())])
        }
        row |= {"true": float(np.nanmean(errors)), "judged": one.rte}
        rows.append(row | {"interval": one.interval, "blind": one.blind})
    return rows


def recorded(name: str) -> RecordedSequence:
    """A recorded drive, with its given reference."""
    return RecordedSequence(SequenceConfig(bag=f"{DATA}/{name}.bag", reference="/gt_poses"))


def work(name: str, seed: int, length: float, maps: str | None) -> dict[str, Any]:
    """A simulated course, or a recording."""
    try:
        if name not in RECORDED:
            kind, number = name[:-1], int(name[-1])
            course = Course(scenes=(kind,), length=length, seed=1000 * seed + number)  # type: ignore[arg-type]
            scans = list(simulate(course))
            return judged(name, scans, np.array([scan.T_world_sensor for scan in scans]), maps)
        recording = recorded(name)
        if name != "hall":
            return {"rows": [], "unknown": estimate_reference(recording).unknown_share()}
        scans = list(recording)
        given = recording.reference()
        assert given is not None
        return judged(name, scans, given.at(np.array([scan.stamp for scan in scans])), maps)
    except AdaptuneError as error:
        return {"rows": [], "unknown": 1.0, "refused": str(error)}


def correlations(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Rank correlation of each judge with the truth, over the sets that are near the best."""
    best = min(row["true"] for row in rows)
    near = [row for row in rows if row["true"] <= WITHIN * best]
    names = [name for name in ("judged", "mme", "mpv", "mom") if name in rows[0]]
    if len(near) < 3:
        return dict.fromkeys(names, math.nan)
    of = {n: [row[n] for row in near] for n in ("true", *names)}
    return {n: float(spearmanr(of["true"], of[n]).statistic) for n in names} | {"sets": len(near)}


def report(found: dict[str, dict[str, Any]]) -> None:
    """Print what was asked."""
    ranks = {name: correlations(one["rows"]) for name, one in found.items() if one["rows"]}
    for name, one in found.items():
        rank = "  ".join(f"{key} {value:.2f}" for key, value in ranks.get(name, {}).items())
        own = ""
        if one["rows"]:
            own = f"judge wrong by {one['is']:.3f} %, says {one['says']:.3f} %, "
            own += f"over {OVER:g} m; "
        print(f"{name:10} unknown {100 * one['unknown']:5.1f} %; {own}{one.get('refused', rank)}")
    for title, names in (
        ("all but gardens", [n for n in ranks if not n.startswith("garden")]),
        ("gardens", [n for n in ranks if n.startswith("garden")]),
    ):
        for judge in ("judged", "mme", "mpv", "mom"):
            values = [ranks[n][judge] for n in names if judge in ranks[n]]
            known = [value for value in values if math.isfinite(value)]
            if known:
                least = f"median {np.median(known):.2f}, least {min(known):.2f}"
                print(f"rank correlation, {title}, {judge}: {least}, {len(known)} courses")
    # Of the hall, the given reference is more wrong than the estimate.
    rows = [row for name, one in found.items() if name not in RECORDED for row in one["rows"]]
    known = [row for row in rows if row["interval"] is not None]
    if not known:
        print("no interval: the courses are too short")
        return
    inside = [row["interval"][0] <= row["true"] <= row["interval"][1] for row in known]
    width = [row["interval"][1] / max(row["interval"][0], 1e-3) for row in known]
    print(
        f"the interval holds the true mean for {np.mean(inside):.1%} of {len(known)} of "
        f"{len(rows)} trajectories; high / low: median {np.median(width):.2f}; better than can "
        f"be told: {np.mean([row['blind'] for row in known]):.1%}"
    )


def seconds(folder: Path) -> float:
    """Of the command on the hall, without a cache."""
    stamps, T = [], []
    for i, scan in enumerate(recorded("hall")):
        stamps.append(scan.stamp)
        T.append(np.eye(4))
        T[-1][0, 3] = 0.4 * i
    write_tum(folder / "any.tum", Trajectory(np.array(stamps, np.int64), np.array(T)))
    with tempfile.TemporaryDirectory() as fresh:
        command = [sys.executable, "-m", "adaptune", "evaluate", str(DATA / "hall.bag")]
        command += [str(folder / "any.tum"), "--reference", "estimated", "--out", f"{fresh}/out"]
        begin = time.monotonic()
        fresh_cache = os.environ | {"ADAPTUNE_CACHE": fresh}
        subprocess.run(command, check=True, env=fresh_cache, stdout=subprocess.DEVNULL)
        return time.monotonic() - begin


def main() -> None:
    """Run what is not in the folder yet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=72, help="of the worlds")
    parser.add_argument("--courses", type=int, default=2, help="of each kind")
    parser.add_argument("--length", type=float, default=40.0, help="metres of a course")
    parser.add_argument("--kinds", nargs="+", default=KINDS)
    parser.add_argument("--maps", help="folder of map-metrics")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    names = [f"{kind}{i}" for i in range(arguments.courses) for kind in arguments.kinds]
    names += [name for name in RECORDED if (DATA / f"{name}.bag").exists()]
    paths = {n: arguments.folder / f"{arguments.seed}-{arguments.length:g}-{n}.json" for n in names}
    due = [name for name, path in paths.items() if not path.exists()]
    with ProcessPoolExecutor(arguments.workers, get_context("forkserver")) as pool:
        rest = arguments.seed, arguments.length, arguments.maps
        jobs = {name: pool.submit(work, name, *rest) for name in due}
        for name, job in jobs.items():
            paths[name].write_text(json.dumps(job.result()))
            print(f"{name}: done", flush=True)
    report({name: json.loads(path.read_text()) for name, path in paths.items()})
    if (DATA / "hall.bag").exists():
        print(f"adaptune evaluate hall.bag: {seconds(arguments.folder):.0f} s")


if __name__ == "__main__":
    main()
