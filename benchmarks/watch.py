"""How soon a watched odometry is in doubt where something is wrong, and how often where not.

    python benchmarks/watch.py [FOLDER] [--metres 100] [--planted 100] [--drifts 60] [--columns 450]

GICP with its own parameters drives along simulated courses, and along the recordings of a folder.
The first table has the share of the time in each state, in doubt in vain (no second of the last
four was wrong by much), what watching takes of a core, and how often the interval holds the true
mean error of the metres that it is told of: watched; of a single set and of a bank of three,
measured once a second over the last minute; and of the single set with restarts planted. Where the
reference is as wrong as the odometry, nobody can tell (-).

Then faults are planted into poses, or into the scans that GICP gets: how many are in doubt within
two seconds or five metres, and after how long. And drifts: after how many metres the interval
leaves what was told before; also a slide along a smooth corridor whose ends are in sight. Last, the
share of the time that one is unknown whose ends are not. With fewer columns a sensor is quicker
simulated.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert, mean_motion, rectify, rotation_angle, steps
from adaptune.live.evidence import LiveEvidence
from adaptune.live.own_error import OWN_SECONDS
from adaptune.metrics import cap, sub_trajectory_rte, travelled
from adaptune.odometry.base import Motions
from adaptune.odometry.registry import odometry_class
from adaptune.paired import ERROR_FACTOR
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import RecordedSequence
from adaptune.recording.scan import Scan
from adaptune.reference.check import measure_reference
from adaptune.simulation import Course
from adaptune.simulation.course import directions
from adaptune.simulation.record import simulate
from adaptune.space import ParameterSet
from online.watch import WINDOW, Told, Watch

RECORDINGS = ("town", "street", "road", "city", "hall")
SCENES = ("street", "mine", "open", "garden")
LENGTH, BEFORE, AFTER = 25.0, 12.0, 6.0
WRONG = 0.2, 3.0
"""Metres, and degrees, of a second from which an odometry is rightly doubted."""
SOON, NEAR = 2.0, 5.0
"""Seconds, and metres, within which a fault is to be noticed."""
OTHERS: Sequence[ParameterSet] = (
    {"max_correspondence_distance": 1.5, "keyframe_interval": 2.0},
    {"max_correspondence_distance": 3.0, "keyframe_interval": 1.0, "downsampling": 0.7},
)
"""Members of a bank, beside the odometry's own parameters."""
METRES = 30.0  # over which errors are told at least
SPEED, AROUND = 1.5, (1.5, 1.4)
"""Metres a second along a corridor, and half of its width and height."""


class Driven(NamedTuple):
    """A drive with its odometry's poses."""

    name: str
    scans: Sequence[Scan]
    T_odom_sensor: Poses
    T_ref_sensor: Poses | None
    reference_error: float = 0.0  # percent

    @property
    def seconds(self) -> np.ndarray:
        """Since the first scan."""
        stamps = np.array([scan.stamp for scan in self.scans])
        return (stamps - stamps[0]) * 1e-9


def odometry(scans: Sequence[Scan], parameters: ParameterSet | None = None) -> Poses:
    """Poses of GICP, which nothing restarts."""
    cls = odometry_class("gicp")
    gicp = cls(cls.space.baseline | (parameters or {}))
    gicp.start(gicp.prepare(scans[0]), np.eye(4))
    return np.array([np.eye(4), *(gicp.register(gicp.prepare(s)).T_odom_sensor for s in scans[1:])])


def drives(given: argparse.Namespace) -> Iterator[Driven]:
    """All drives, one after the other."""
    folder, metres = given.folder, given.metres
    for seed in given.seeds:
        for scene in given.scenes:
            course = Course(scenes=(scene,), length=metres, seed=seed, columns=given.columns)
            scans = list(simulate(course))
            T = np.array([scan.T_world_sensor for scan in scans])
            yield Driven(f"{scene} {seed}", scans, odometry(scans), T)
    for name in RECORDINGS if folder else ():
        sequence = RecordedSequence(inspect(folder / f"{name}.bag").config())
        scans = list(sequence)
        reference = sequence.reference()
        stamps = np.array([scan.stamp for scan in scans])
        T_ref = None if reference is None else reference.at(stamps)
        own = None if reference is None else measure_reference(sequence, reference).error(LENGTH)
        yield Driven(name, scans, odometry(scans), T_ref, own.mean if own else 0.0)


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


Interval = tuple[float, float, float]
"""Seconds since the first scan, and the ends."""


def held(
    drive: Driven, T_odom_sensor: Poses, found: Sequence[Interval], window: float
) -> list[bool]:
    """Whether intervals hold the mean error of the sub-trajectories that they are told of."""
    T_ref, seconds = drive.T_ref_sensor, drive.seconds
    if T_ref is None:
        return []
    rte = cap(sub_trajectory_rte(T_ref, T_odom_sensor, LENGTH))
    if np.nanmean(rte) < ERROR_FACTOR * drive.reference_error:
        return []
    metres = travelled(T_ref)
    end = np.searchsorted(metres, metres + LENGTH).clip(max=len(metres) - 1)
    inside = []
    for now, low, high in found:
        recent = seconds[end] > now - window
        near = metres >= np.interp(now, seconds, metres) - METRES
        true = rte[(seconds[end] <= now) & (recent | near) & ~np.isnan(rte)]
        if len(true) and np.isfinite(high):
            inside.append(bool(low <= true.mean() <= high))
    return inside


def measured(drive: Driven, members: Sequence[Poses], at: Sequence[int] = ()) -> list[bool]:
    """Whether intervals of a set, or of a bank, hold; restarts are planted at scans."""
    rng, seconds, found = np.random.default_rng(0), drive.seconds, list[Interval]()
    motions, T, T_driven = np.stack([steps(T) for T in members], axis=1), np.eye(4), [np.eye(4)]
    live = LiveEvidence(tuple(range(len(members))) if len(members) > 1 else (), LENGTH)
    for i, scan in enumerate(drive.scans):
        each = motions[i - 2] if i > 1 else np.tile(np.eye(4), (len(members), 1, 1))
        T = mean_motion(each, np.ones(len(members)))
        if i in at:  # it goes on by the motion before, and not quite
            T = motions[i - 3, 0].copy()
            T[:2, 3] += rng.normal(0.0, 0.15, 2)
        if i > 1:
            T_driven.append(rectify(T_driven[-1] @ T))
        starts = int(np.sum(np.array(at) <= i))
        live.observe(scan.stamp, scan, Motions(T, dict(enumerate(each)), starts))
        if i and seconds[i] // 1.0 > seconds[i - 1] // 1.0:
            live.measure()
            if (error := live.own_error()) is not None:
                found.append((seconds[i - 1], error.low, error.high))
    T_driven.append(T_driven[-1] @ motions[-1, 0])
    return held(drive, np.array(T_driven), found, OWN_SECONDS)


def coverage(drive: Driven, found: Sequence[Told]) -> list[list[bool]]:
    """Whether intervals hold: watched, of a single set, of a bank, and with restarts."""
    own, restarts = drive.T_odom_sensor, np.arange(12.0, drive.seconds[-1], 11.0)
    at = np.searchsorted(drive.seconds, restarts).tolist()
    told = [(one.seconds, one.low, one.high) for one in found]
    return [
        held(drive, own, told, WINDOW),
        measured(drive, [own]),
        measured(drive, [own, *(odometry(drive.scans, other) for other in OTHERS)]),
        measured(drive, [own], at),
    ]


def corridor(
    half_length: float, reach: float, metres: float, rng: np.random.Generator
) -> tuple[list[Scan], Poses]:
    """Scans and poses along a smooth corridor, of a sensor that sees so far."""
    looks, half = directions("hdl32e", 900).reshape(-1, 3), np.array([half_length, *AROUND])
    T = np.tile(np.eye(4), (int(10.0 * metres / SPEED), 1, 1))
    T[:, 0, 3] = np.linspace(-0.5, 0.5, len(T)) * metres
    T[:, 1, 3] = 0.2 * np.sin(T[:, 0, 3] / 5.0)
    scans = []
    for i, position in enumerate(T[:, :3, 3]):
        with np.errstate(divide="ignore"):
            ranges = ((np.copysign(half, looks) - position) / looks).min(axis=1)
        ranges += rng.normal(0.0, 0.015, len(ranges))
        points = (looks * ranges[:, None])[ranges < reach].astype(np.float32)
        scans.append(Scan(i * 10**8, points))
    return scans, T


def slid(T: Poses, at: int, share: float, rng: np.random.Generator) -> Poses:
    """Poses of an odometry that tells, from one scan on, such a share of the way."""
    moved = steps(T)
    moved[:, :3, 3] += rng.normal(0.0, 0.003, (len(moved), 3)) * (1.0, 0.3, 0.3)
    moved[at:, :3, 3] *= share
    found = [np.eye(4)]
    for step in moved:
        found.append(found[-1] @ step)
    return np.array(found)


def slides(n: int, rng: np.random.Generator) -> tuple[list[float], list[str]]:
    """Metres until slides are told; and the states along a corridor without ends."""
    metres, states = [], []
    for _ in range(n):
        half_length = rng.uniform(28.0, 40.0)
        scans, T = corridor(half_length, 100.0, 2.0 * half_length - 8.0, rng)
        at = int(rng.uniform(0.4, 0.5) * len(T))
        found = told(scans, slid(T, at, rng.uniform(0.8, 0.95), rng))
        before = [one.error for one in found if 10.0 * one.seconds <= at]
        left = [o.seconds for o in found if 10.0 * o.seconds > at and o.low > np.nanmax(before)]
        metres.append(SPEED * (left[0] - 0.1 * at) if left else np.inf)
        scans, T = corridor(500.0, rng.uniform(30.0, 100.0), 40.0, rng)
        states += [one.state for one in told(scans, slid(T, 0, rng.uniform(0.9, 1.0), rng))]
    return metres, states


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
    parser.add_argument("--slides", type=int, default=12)
    parser.add_argument("--columns", type=int, help="of the simulated sensor")
    parser.add_argument("--scenes", nargs="*", default=SCENES)
    parser.add_argument("--states", action="store_true", help="only states, not intervals")
    given = parser.parse_args()
    rng, faults, drifts = np.random.default_rng(0), dict[str, list](), dict[str, list[float]]()
    every, sums = list[Driven](), np.zeros(5)
    print(f"{'drive':12} {'s':>3}    good unknown doubtful lost  in vain    core  intervals hold")
    for drive in drives(given):
        if given.planted or given.drifts:
            every.append(drive)
        begun = time.process_time()
        found = told(drive.scans, drive.T_odom_sensor)
        core = (time.process_time() - begun) / drive.seconds[-1]
        shares = [np.mean([one.state == state for one in found[3:]]) for state in STATES]
        inside = [] if given.states else coverage(drive, found)
        cells = "  ".join(f"{share:6.1%}" for share in shares)
        holds = " ".join(f"{np.mean(one):4.0%} of {len(one)}" if one else "-" for one in inside)
        vain = np.nan if drive.T_ref_sensor is None else in_vain(drive, found[3:])
        sums += [drive.seconds[-1] * x for x in (1.0, *shares[1:], np.nan_to_num(vain))]
        cells += f"  {vain:6.1%}  {core:6.1%}"
        print(f"{drive.name:12} {drive.seconds[-1]:3.0f}  {cells}  {holds}", flush=True)
    rest = "  ".join(f"{share:6.2%}" for share in sums[1:] / max(sums[0], 1.0))
    print(f"{sums[0] / 60.0:.1f} minutes: unknown, doubtful, lost, in vain {rest}", flush=True)
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
    if given.slides:
        metres, states = slides(given.slides, rng)
        print(f"slide along a corridor: metres {np.round(metres).tolist()}")
        unknown = np.mean([state == "unknown" for state in states])
        print(f"a corridor without ends is unknown for {unknown:.1%} of {len(states)} seconds")


STATES = ("good", "unknown", "doubtful", "lost")

if __name__ == "__main__":
    main()
