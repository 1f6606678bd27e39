"""What parameter sets do on the courses of a design and on recordings, for `portfolio.py`."""

import csv
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
from gain_data import DEFAULTS, NO_SEQUENCES, Simulated
from numpy.typing import NDArray
from recorded import CARS, RECORDINGS, Direction, definition

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

from made_drives import trials_of

from adaptune._system import yaml12
from adaptune._system.files import replacing, write_text
from adaptune.geometry import invert
from adaptune.metrics import travelled
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.portfolio import ScanKind
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.recording.compensation import compensate, compensate_neighbours
from adaptune.recording.scan import Scan
from adaptune.runs.archive import Frames
from adaptune.simulation import Course
from adaptune.simulation.course import MOTIONS
from adaptune.simulation.record import SimulatedDrive, SimulatedScan
from adaptune.space import ParameterSet
from adaptune.study.references import ensure_references
from offline.choice import PER_BLOCK
from offline.config import OfflineConfig, load_study
from offline.drive import TrialSetup
from offline.frames import describe
from offline.labelled import block_means
from offline.samplers import make_sampler

FIRST = 6
"""Sets that a search begins with."""
SCENES = ("cave", "street", "open", "garden", "corridor", "mine")
SENSORS = ("vlp16", "hdl32e", "hdl64e", "narrow")
GROUPS = ("robot", "agile", "car")
STRIDES = {"robot": (1, 2, 5, 10), "agile": (1, 2, 5, 10), "car": (1, 1, 2, 3)}
"""Of the 10 scans a second, every so manieth is kept: a robot is as fast as 3 m/s, a car 10."""
STEP = 5
"""From course to course of the product of all, so that the first ones are of many kinds."""
NARROW = 70.0
"""Degrees that a narrow view spans, ahead."""
COLUMNS = {"hdl64e": 1024, "os0-64": 1024}
OF_RECORDINGS = {
    **dict.fromkeys(("town", "road", "city", "street"), "hdl64e"),
    **dict.fromkeys(("livox_hku_1", "livox_hku_2"), "narrow"),
    "campus": "hdl32e",
    "hall": "wide",
}
"""Recordings that are long enough, and their sensors."""


@dataclass(frozen=True)
class Place:
    """A course or a recording, and how the sets did there."""

    name: str
    sensor: str
    kind: ScanKind
    recorded: bool
    begin: NDArray[np.float64]  # (n_blocks,): where each block begins, as a share of the scans
    errors: NDArray[np.float64]  # (n_blocks, n_sets): mean clipped error in percent
    costs: NDArray[np.float64]  # (n_sets,): ms of CPU time a scan
    restarts: NDArray[np.float64]  # (n_sets,): infinite for a set that failed


def design(seed: int = 0) -> dict[str, tuple[str, Course]]:
    """Sensors and courses by name: each scene with each sensor, and once with each stride.

    One is like a hall at two scans a second, in hard turns.
    """
    courses, pairs = {}, list(enumerate(product(SCENES, SENSORS)))
    for i, (scene, sensor) in sorted(pairs, key=lambda pair: STEP * pair[0] % len(pairs)):
        a, b = divmod(i, len(SENSORS))
        motion = GROUPS[(a // 2 + b) % len(GROUPS)]
        stride, called = STRIDES[motion][(a + b) % 4], sensor
        carries = "hdl64e" if sensor == "narrow" else sensor
        if (scene, sensor) == ("corridor", "hdl64e"):
            called, carries, motion, stride = "wide", "os0-64", "agile", 5
        course = Course(
            scenes=(scene,),
            length=1000.0,
            sensor=carries,
            motion=motion,
            seed=100 * seed + i,
            stride=stride,
            columns=None if sensor == "narrow" else COLUMNS.get(carries),
        )
        courses[f"{scene}-{called}"] = called, course
    return courses


def sets_of(odometry: str, n: int) -> list[ParameterSet]:
    """The sets that a search begins with, and then points of its Sobol sequence as they are.

    Of the others, every second one is given values of the baseline.
    """
    sampler = make_sampler(odometry_class(odometry).space, OfflineConfig(initial=2 * n))
    history: list[tuple[ParameterSet, float]] = []
    while len(history) < 2 * n and (found := sampler.propose(history)) is not None:
        history.append((found.parameters, 0.0))
    numbers = [*range(FIRST), *range(FIRST + 1, 2 * n, 2)]
    return [history[number][0] for number in numbers[:n]]


def scans_of(sensor: str, course: Course, n: int) -> Iterator[SimulatedScan]:
    """The first scans of a course: without the motion within them, of a narrow view cropped."""
    drive = SimulatedDrive(course)
    scans: Iterator[Scan] = islice(drive.scans(), n)
    if course.stride == 1:
        scans = compensate_neighbours(scans)
    for scan in scans:
        assert isinstance(scan, SimulatedScan)
        if course.stride > 1:  # as keyframes are recorded
            start = drive.seconds(np.array([scan.stamp]))
            (T_world_end,) = drive.ride.poses(start + 1.0 / course.turns)
            moved = invert(scan.T_world_sensor) @ T_world_end
            scan = compensate(scan, moved, 1.0 / course.turns)  # noqa: PLW2901
        if sensor == "narrow":
            azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
            seen = scan.select(np.abs(azimuth) <= NARROW / 2.0)
            scan = replace(scan, points=seen.points, times=seen.times, rings=None, intensities=None)  # noqa: PLW2901
        yield scan


def drive_course(name: str, odometry: str, n_sets: int, n_scans: int, seed: int) -> Place:
    """Drive all sets along a course."""
    sensor, course = design(seed)[name]
    scans = list(scans_of(sensor, course, n_scans))
    n, stamps = len(scans), np.array([scan.stamp for scan in scans])
    T_ref_sensor = np.array([scan.T_world_sensor for scan in scans])
    few, elevation = np.zeros((n, 1), np.float32), np.zeros(n, np.float32)
    frames = Frames(stamps, T_ref_sensor, few, {"none": 1}, elevation)
    speed, spacing = MOTIONS[course.motion].speed, travelled(T_ref_sensor)[-1] / n
    length = 10.0 if speed > 5.0 or spacing > 1.0 else 5.0
    changed = {"sub_trajectory": length, "health": HealthCheck(max_speed=2.0 * speed)}
    factory = OdometryFactory(odometry, {}, odometry_class(odometry).space, Limits())
    setup = TrialSetup(DEFAULTS.model_copy(update=changed), factory, NO_SEQUENCES)
    read = Simulated(name, scans)
    return drive_sets(setup, name, sensor, frames, read, sets_of(odometry, n_sets), recorded=False)


def drive_recording(name: str, odometry: str, n_sets: int, folder: Path) -> Place:
    """Drive all sets along a recording; estimated references judge a car's drives."""
    direction = Direction((name,), (), RECORDINGS[name])
    defined = definition(direction, odometry, n_sets, 0, name in CARS)
    write_text(path := folder / f"{name}.yaml", yaml12.dump(defined))
    study = load_study(path, folder=folder / name)
    study.open()
    ensure_references(study.sequences, study.training, direction.sub_trajectory)
    frames = describe(study.config, study.sequences, name).uncut
    setup = TrialSetup(study.config, study.odometry, study.sequences)
    of = (setup, name, OF_RECORDINGS[name], frames, study.sequences.open(name))
    return drive_sets(*of, sets_of(odometry, n_sets), recorded=True)


def drive_sets(
    setup: TrialSetup,
    name: str,
    sensor: str,
    frames: Frames,
    scans: Any,
    sets: Sequence[ParameterSet],
    *,
    recorded: bool,
) -> Place:
    """Drive sets side by side on one pass, along all of a recording."""
    trials = trials_of(setup, sets, name, frames, scans, memory=0)
    errors, length = np.stack([t.errors for t in trials], axis=1), setup.config.sub_trajectory
    known = np.flatnonzero(~np.isnan(errors[:, ~np.isnan(errors).all(axis=0)]).any(axis=1))
    n, metres = len(frames.stamps), travelled(frames.T_ref_sensor)[known]
    n_blocks = max(1, round((metres[-1] - metres[0]) / (PER_BLOCK * length)))
    block = np.minimum((metres - metres[0]) / (PER_BLOCK * length), n_blocks - 1).astype(int)
    first = np.unique(block, return_index=True)[1]
    rate = 1e9 / float(np.median(np.diff(frames.stamps)))
    middle = next(islice(scans.since(int(frames.stamps[n // 2])), 1))
    return Place(
        name,
        sensor,
        ScanKind.of(middle, rate),
        recorded,
        known[first] / n,
        block_means(errors[known], block),
        np.array([trial.cost for trial in trials]),
        np.array([np.inf if t.failure else float(t.restarted.sum()) for t in trials]),
    )


COLUMNS_OF_PLACES = ("place", "sensor", "recorded", "rate", "points", "view", "what", "begin")


def write_places(path: Path, places: Sequence[Place]) -> None:
    """Write places as a table: a row for each block, for costs and for restarts."""
    rows = []
    for place in places:
        kind = place.kind
        about = [place.name, place.sensor, int(place.recorded)]
        about += [f"{kind.rate:.3g}", kind.points, kind.view]
        for begin, errors in zip(place.begin, place.errors, strict=True):
            rows.append([*about, "error", f"{begin:.3f}", *(f"{x:.4g}" for x in errors)])
        rows.append([*about, "cost", "", *(f"{x:.3g}" for x in place.costs)])
        rows.append([*about, "restarts", "", *(f"{x:g}" for x in place.restarts)])
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        n_sets = len(places[0].costs)
        csv.writer(file).writerows([[*COLUMNS_OF_PLACES, *range(n_sets)], *rows])


def read_places(path: Path) -> list[Place]:
    """Read what `write_places` wrote."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    places = []
    for name in dict.fromkeys(row["place"] for row in rows):
        mine = [row for row in rows if row["place"] == name]
        numbers = [key for key in mine[0] if key.isdigit()]

        def values(
            what: str, of: Sequence[dict[str, str]] = mine, keys: Sequence[str] = numbers
        ) -> NDArray[np.float64]:
            return np.array([[float(r[k]) for k in keys] for r in of if r["what"] == what])

        one = mine[0]
        kind = ScanKind(float(one["rate"]), int(one["points"]), int(one["view"]))
        begin = np.array([float(row["begin"]) for row in mine if row["what"] == "error"])
        of = (begin, values("error"), values("cost")[0], values("restarts")[0])
        places.append(Place(name, one["sensor"], kind, one["recorded"] == "1", *of))
    return places


def driven_places(given: Namespace, folder: Path) -> list[Place]:
    """All places that were asked for; what is not in the folder yet is driven."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for name in [*given.recordings, *list(design(given.seed))[: given.courses]]:
        if not (path := folder / f"{name}.csv").exists():
            if name in RECORDINGS:
                place = drive_recording(name, given.odometry, given.sets, folder / "recordings")
            else:
                place = drive_course(name, given.odometry, given.sets, given.scans, given.seed)
            write_places(path, [place])
            means = np.exp(np.log(place.errors + 1e-6).mean(axis=0))
            print(f"{name}: baseline {means[0]:.3g} %, best {means.min():.3g} %", flush=True)
        found += read_places(path)
    return found
