"""How far, and how long, an odometry that begins within a recording errs more.

    python benchmarks/warm_up.py RECORDING.bag ODOMETRY...

Each odometry drives the whole recording once, and then begins anew in the middle of it, again and
again, as a trial begins at a segment. The error over the next 2.5 m is divided by that of the drive
through, on the same frames. Columns: what is driven, then by metres since the beginning, and by
seconds since then, the mean error of what began there / that of the drive through. The baseline,
and on request some random sets.
"""

import argparse
import itertools
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune._system import yaml12
from adaptune._system.strict import ConfigurationError
from adaptune.geometry import Poses
from adaptune.metrics import cap, sub_trajectory_rte, travelled
from adaptune.runs.archive import Frames
from adaptune.simulation import Course
from adaptune.simulation.course import as_sequence
from adaptune.space import ParameterSet
from offline.config import OfflineStudy, load_study
from offline.drive import TrialSetup, drive_sets
from offline.frames import segments_along
from offline.shared_scans import SharedScans

WINDOW = 2.5
"""Metres of a sub-trajectory."""
METRES = (0.0, 1.0, 2.5, 5.0, 7.5, 10.0, 15.0, 20.0)
SECONDS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Bounds of the columns."""
LATER = 20.0 + 1.5 * WINDOW, 8.0
"""Metres and seconds that are driven from each beginning, whichever is more."""


def study_of(bag: Path, odometry: str, imu: bool, folder: Path) -> OfflineStudy:
    """A study of a recording."""
    course = Course(scenes=("garden",), imu=200 if imu else None)
    sequence = as_sequence(course, bag.resolve()).model_dump(mode="json", exclude_none=True)
    given: Mapping[str, Any] = {
        "odometry": {"name": odometry},
        "sequences": {"one": sequence},
        "training": ["one"],
        "test": [],
    }
    file = folder / "study.yaml"
    file.write_text(yaml12.dump(given), "utf-8")
    return load_study(file, [], folder / odometry)


def beginnings(T_ref_sensor: Poses, stamps: NDArray[np.int64], n: int) -> NDArray[np.intp]:
    """Frames at which drives begin, evenly along the path, and where each ends; shape (n, 3)."""
    metres, seconds = travelled(T_ref_sensor), (stamps - stamps[0]) * 1e-9
    last = max(metres[-1] - LATER[0], 0.3 * metres[-1])
    firsts = np.unique(np.searchsorted(metres, np.linspace(0.1 * metres[-1], last, n)))
    firsts = firsts[np.isfinite(T_ref_sensor[firsts, 0, 0])]
    far = np.searchsorted(metres, metres[firsts] + LATER[0])
    late = np.searchsorted(seconds, seconds[firsts] + LATER[1])
    ends = np.minimum(np.maximum(far, late) + 1, len(stamps))
    return np.stack([firsts, firsts, ends], axis=1).astype(np.intp)


def ratios(
    setup: TrialSetup, frames: Frames, sets: Sequence[ParameterSet]
) -> tuple[list[float], list[float], float]:
    """Errors to those of drives through by metres and by seconds, and the latter in percent."""
    scans = setup.sequences.open("one")
    (whole,) = segments_along("one", frames.uncut)
    driven = drive_sets(setup, SharedScans(4e9), scans, whole, sets)
    through = [run.trajectory.T_world_sensor for (run,) in driven]
    metres, seconds = travelled(frames.T_ref_sensor), (frames.stamps - frames.stamps[0]) * 1e-9
    of_through = [cap(sub_trajectory_rte(frames.T_ref_sensor, T, WINDOW)) for T in through]
    rows = []  # metres, seconds, error, that of the drive through
    for segment in segments_along("one", frames):
        part = slice(segment.first, segment.first + len(segment.stamps))
        T_ref_sensor, begin = frames.T_ref_sensor[part], segment.first
        driven = drive_sets(setup, SharedScans(2e9), scans, segment, sets)
        for (run,), errors in zip(driven, of_through, strict=True):
            began = cap(sub_trajectory_rte(T_ref_sensor, run.trajectory.T_world_sensor, WINDOW))
            since = metres[part] - metres[begin], seconds[part] - seconds[begin]
            rows.append(np.stack([*since, began, errors[part]], axis=1))
    table = np.concatenate(rows)
    # Where a robot stands, it starts no window anew.
    table = table[np.isfinite(table).all(axis=1)]

    def by(column: int, bounds: Sequence[float]) -> list[float]:
        bins = np.digitize(table[:, column], bounds) - 1
        means = [table[bins == k, 2:].mean(axis=0) for k in range(len(bounds) - 1)]
        return [float(began / through) for began, through in means]

    return by(0, METRES), by(1, SECONDS), float(table[:, 3].mean())


def main() -> None:
    """Print two rows for each odometry."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("odometry", nargs="+")
    parser.add_argument("--sets", type=int, default=1, help="the baseline included")
    parser.add_argument("--begin", type=int, default=12, help="beginnings")
    given = parser.parse_args()
    for bounds in (METRES, SECONDS):
        print(f"{'':32}" + "".join(f"{low:g}-{high:g}".rjust(9) for low, high in pairs(bounds)))
    with tempfile.TemporaryDirectory() as folder:
        for name in given.odometry:
            try:
                row(given, name, Path(folder))
            except Exception as error:
                print(f"{name:16} {type(error).__name__}: {str(error)[:160]}", flush=True)


def pairs(bounds: Sequence[float]) -> list[tuple[float, float]]:
    """Neighbours."""
    return list(itertools.pairwise(bounds))


def row(given: argparse.Namespace, name: str, folder: Path) -> None:
    """Measure an odometry, and print it."""
    try:
        study = study_of(given.recording, name, True, folder)
    except ConfigurationError:
        study = study_of(given.recording, name, False, folder)
    scans = study.sequences.open("one")
    reference = scans.reference()
    if reference is None:
        sys.exit(f"{given.recording}: has no /gt_poses")
    stamps = np.array([scan.stamp for scan in scans])
    T_ref_sensor, n = reference.at(stamps), len(stamps)
    segments = beginnings(T_ref_sensor, stamps, given.begin)
    none = np.zeros((n, 0), np.float32), {}, np.zeros(n, np.float32)
    frames = Frames(stamps, T_ref_sensor, *none, segments=segments)
    space, rng = study.odometry.space, np.random.default_rng(0)
    sets = [space.baseline, *space.from_unit(rng.random((given.sets - 1, len(space))))]
    setup = TrialSetup(study.config, study.odometry, study.sequences)
    of_metres, of_seconds, through = ratios(setup, frames, sets)
    for what, values in (("metres", of_metres), ("seconds", of_seconds)):
        label = f"{name:16} {len(sets):2} {through:6.2f} {what:7}"
        print(label + "".join(f"{value:9.2f}" for value in values), flush=True)


if __name__ == "__main__":
    main()
