"""How soon a watched odometry is in doubt where something is wrong, and how often where not.

    python benchmarks/watch.py [FOLDER] [--metres 100] [--planted 100] [--drifts 60]

GICP with its own parameters drives along simulated courses, and along the recordings of a folder.
The first table has the share of the time in each state, in doubt in vain (no second of the last
four was wrong by much), what watching takes of a core, and how often the interval holds the true
mean error of the last half minute. Then faults are planted into poses, or into the scans that GICP
gets: how many are in doubt within two seconds or five metres, and after how long. And drifts: after
how many metres the interval leaves what was told before.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert, rotation_angle
from adaptune.metrics import cap, sub_trajectory_rte, travelled
from adaptune.odometry.registry import odometry_class
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import RecordedSequence
from adaptune.recording.scan import Scan
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from online.watch import Told, Watch

RECORDINGS = ("town", "street", "road", "city", "hall")
SCENES = ("street", "mine", "open", "garden")
LENGTH, BEFORE, AFTER = 25.0, 12.0, 6.0
WRONG = 0.2, 3.0
"""Metres, and degrees, of a second from which an odometry is rightly doubted."""
SOON, NEAR = 2.0, 5.0
"""Seconds, and metres, within which a fault is to be noticed."""


class Driven(NamedTuple):
    """A drive with its odometry's poses."""

    name: str
    scans: Sequence[Scan]
    T_odom_sensor: Poses
    T_ref_sensor: Poses | None

    @property
    def seconds(self) -> np.ndarray:
        """Since the first scan."""
        stamps = np.array([scan.stamp for scan in self.scans])
        return (stamps - stamps[0]) * 1e-9


def odometry(scans: Sequence[Scan]) -> Poses:
    """Poses of GICP, which nothing restarts."""
    gicp = odometry_class("gicp")()
    gicp.start(gicp.prepare(scans[0]), np.eye(4))
    return np.array([np.eye(4), *(gicp.register(gicp.prepare(s)).T_odom_sensor for s in scans[1:])])


def drives(folder: Path | None, metres: float, seeds: Sequence[int]) -> Iterator[Driven]:
    """All drives, one after the other."""
    for seed in seeds:
        for scene in SCENES:
            course = Course(scenes=(scene,), length=metres, seed=seed)
            scans = list(simulate(course))
            T = np.array([scan.T_world_sensor for scan in scans])
            yield Driven(f"{scene} {seed}", scans, odometry(scans), T)
    for name in RECORDINGS if folder else ():
        sequence = RecordedSequence(inspect(Path(folder or "", f"{name}.bag")).config())
        scans = list(sequence)
        reference = sequence.reference()
        stamps = np.array([scan.stamp for scan in scans])
        T_ref = None if reference is None else reference.at(stamps)
        yield Driven(name, scans, odometry(scans), T_ref)


def told(scans: Sequence[Scan], T_odom_sensor: Poses) -> list[Told]:
    """What is told along a drive."""
    watch = Watch(LENGTH)
    every = (watch.see(*pair) for pair in zip(scans, T_odom_sensor, strict=True))
    return [one for one in every if one is not None]


Fault = Callable[[Sequence[Scan], Poses, int, np.random.Generator], tuple[Sequence[Scan], Poses]]


def _jump(scans, T, at, rng):
    angle, T = rng.uniform(0.0, 2.0 * np.pi), T.copy()
    T[at:, :2, 3] += 0.5 * np.array([np.cos(angle), np.sin(angle)])
    return scans, T


def _freeze(scans, T, at, rng):  # noqa: ARG001
    T = T.copy()
    T[at:] = T[at - 1]
    return scans, T


def _altered(alter: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Fault:
    def fault(scans, T, at, rng):  # noqa: ARG001
        given = list(scans)
        for i in range(at, len(scans)):
            kept = alter(scans[i].points, rng).astype(np.float32)
            given[i] = replace(Scan(scans[i].stamp, kept))
        return given, odometry(given)

    return fault


def _half(points: np.ndarray, _: np.random.Generator) -> np.ndarray:
    return points[points[:, 1] > 0.0]


def _covered(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A hand before the sensor: a sixth of the view is left."""
    seen = np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.pi / 6.0
    hand = rng.normal([0.3, 0.0, 0.0], 0.05, (500, 3))
    return np.concatenate([points[seen], hand])


def _noise(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-10.0, 10.0, points.shape)


FAULTS: dict[str, Fault] = {
    "jump of 0.5 m": _jump,
    "freeze": _freeze,
    "covered sensor": _altered(_covered),
    "half of the points gone": _altered(_half),
    "noise": _altered(_noise),
}


def planted(drive: Driven, kind: str, rng: np.random.Generator) -> tuple[float, bool] | None:
    """Seconds until doubt, and whether that is soon enough; None where nothing moves."""
    seconds = drive.seconds
    starts = np.flatnonzero((seconds >= BEFORE) & (seconds <= seconds[-1] - AFTER))
    metres = travelled(drive.T_odom_sensor)
    ahead = np.searchsorted(seconds, seconds + SOON).clip(max=len(seconds) - 1)
    starts = starts[metres[ahead[starts]] - metres[starts] > 1.0]
    if not len(starts):
        return None
    at = int(rng.choice(starts))
    first = int(np.searchsorted(seconds, seconds[at] - BEFORE + rng.uniform()))
    last = int(np.searchsorted(seconds, seconds[at] + AFTER))
    scans, T = drive.scans[first:last], drive.T_odom_sensor[first:last]
    found = told(*FAULTS[kind](scans, T, at - first, rng))
    begin = seconds[at] - seconds[first]
    wrong = [one.seconds for one in found if one.seconds >= begin and _in_doubt(one)]
    if not wrong:
        return np.inf, False
    way = np.interp(seconds[at] + wrong[0] - begin, seconds, metres) - metres[at]
    return wrong[0] - begin, wrong[0] - begin <= SOON or way <= NEAR


def _in_doubt(one: Told) -> bool:
    return one.state in ("doubtful", "lost")


def drifted(drive: Driven, kind: str, rng: np.random.Generator) -> float | None:
    """Metres until the interval leaves what was told; None on drives that are too short."""
    metres, seconds = travelled(drive.T_odom_sensor), drive.seconds
    starts = np.flatnonzero((metres >= 40.0) & (metres <= metres[-1] - 40.0))
    if not len(starts):
        return None
    at = int(rng.choice(starts))
    steps = invert(drive.T_odom_sensor[:-1]) @ drive.T_odom_sensor[1:]
    turn = np.radians(np.diff(seconds))[at:]
    if kind == "scale of 0.97":
        steps[at:, :3, 3] *= 0.97
    else:
        c, s = np.cos(turn), np.sin(turn)
        yaw = np.tile(np.eye(4), (len(turn), 1, 1))
        yaw[:, 0, 0], yaw[:, 0, 1], yaw[:, 1, 0], yaw[:, 1, 1] = c, -s, s, c
        steps[at:] = steps[at:] @ yaw
    T = [drive.T_odom_sensor[0]]
    for step in steps:
        T.append(T[-1] @ step)
    found = told(drive.scans, np.array(T))
    before = [one.error for one in found if one.seconds <= seconds[at] and np.isfinite(one.error)]
    if not before:
        return None
    left = [one.seconds for one in found if one.seconds > seconds[at] and one.low > before[-1]]
    return float(np.interp(left[0], seconds, metres) - metres[at]) if left else np.inf


def in_vain(drive: Driven, found: Sequence[Told]) -> float:
    """Share of the time in doubt where no second of the last four was wrong by much."""
    seconds, T, T_ref = drive.seconds, drive.T_odom_sensor, drive.T_ref_sensor
    assert T_ref is not None
    behind = np.searchsorted(seconds, seconds - 1.0)
    wrong = invert(invert(T_ref[behind]) @ T_ref) @ (invert(T[behind]) @ T)
    off = np.linalg.norm(wrong[:, :3, 3], axis=1)
    bad = (off > WRONG[0]) | (np.degrees(rotation_angle(wrong)) > WRONG[1])
    at = [(seconds > one.seconds - 4.0) & (seconds <= one.seconds) for one in found]
    vain = [_in_doubt(one) and not bad[of].any() for one, of in zip(found, at, strict=True)]
    return float(np.mean(vain))


def held(drive: Driven, found: Sequence[Told]) -> list[bool]:
    """Whether each interval holds the mean error of sub-trajectories of the last half minute."""
    if drive.T_ref_sensor is None:
        return []
    rte = cap(sub_trajectory_rte(drive.T_ref_sensor, drive.T_odom_sensor, LENGTH))
    metres, seconds = travelled(drive.T_ref_sensor), drive.seconds
    end = np.searchsorted(metres, metres + LENGTH).clip(max=len(metres) - 1)
    inside = []
    for one in found:
        behind = (seconds[end] <= one.seconds) & (seconds[end] > one.seconds - 30.0)
        true = rte[behind & ~np.isnan(rte)]
        if len(true) and np.isfinite(one.error):
            inside.append(bool(one.low <= true.mean() <= one.high))
    return inside


def main() -> None:
    """Drive, plant, and print three tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--metres", type=float, default=100.0, help="of a course")
    parser.add_argument("--seeds", type=int, nargs="+", default=[211, 212])
    parser.add_argument("--planted", type=int, default=100)
    parser.add_argument("--drifts", type=int, default=60)
    given = parser.parse_args()
    rng, faults, drifts = np.random.default_rng(0), dict[str, list](), dict[str, list[float]]()
    every = list(drives(given.folder, given.metres, given.seeds))
    print(f"{'drive':12} {'s':>3}    good unknown doubtful lost  in vain    core  interval holds")
    for drive in every:
        begun = time.process_time()
        found = told(drive.scans, drive.T_odom_sensor)
        core = (time.process_time() - begun) / drive.seconds[-1]
        shares = [np.mean([one.state == state for one in found[3:]]) for state in STATES]
        inside = held(drive, found)
        cells = "  ".join(f"{share:6.1%}" for share in shares)
        holds = f"{np.mean(inside):6.1%} of {len(inside)}" if inside else "-"
        vain = f"{in_vain(drive, found[3:]):6.1%}" if drive.T_ref_sensor is not None else "     -"
        cells += f"  {vain}  {core:6.1%}"
        print(f"{drive.name:12} {drive.seconds[-1]:3.0f}  {cells}  {holds}", flush=True)
    for i in range(given.planted):
        kind, drive = list(FAULTS)[i % len(FAULTS)], every[i // len(FAULTS) % len(every)]
        if (found := planted(drive, kind, rng)) is not None:
            faults.setdefault(kind, []).append((drive.name, *found))
    for kind, rows in faults.items():
        missed = [f"{name} ({seconds:.1f} s)" for name, seconds, soon in rows if not soon]
        after = np.median([seconds for _, seconds, _ in rows])
        print(f"{kind:24} {len(rows) - len(missed)} of {len(rows)}, {after:.1f} s; {missed}")
    for i in range(given.drifts):
        kind, drive = ("heading, 1 degree/s", "scale of 0.97")[i % 2], every[i // 2 % len(every)]
        if (metres := drifted(drive, kind, rng)) is not None:
            drifts.setdefault(kind, []).append(metres)
    for kind, metres in drifts.items():
        soon = np.mean(np.array(metres) <= 30.0)
        print(
            f"{kind:24} {soon:.0%} of {len(metres)} within 30 m; median {np.median(metres):.0f} m"
        )


STATES = ("good", "unknown", "doubtful", "lost")

if __name__ == "__main__":
    main()
