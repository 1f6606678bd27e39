"""The recording that a program reads: the sequence's own bag, or one that is written for it."""

import fcntl
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.files import replacing_folder
from adaptune.geometry import Poses
from adaptune.sequence.config import SequenceConfig
from adaptune.sequence.export import IMU, POINTS, Layout, export
from adaptune.sequence.scan import Scan
from adaptune.sequence.sequence import Sequence


class ProgramInput(NamedTuple):
    """A recording as a program reads it, the topics in it, and what is known of its n scans."""

    path: Path
    points: str
    imu: str  # empty if there is none
    stamps: NDArray[np.int64]  # nanoseconds, of shape (n,)
    T_ref_sensor: Poses | None  # of shape (n, 4, 4), NaN where there is no reference
    logs: Path | None = None  # folder for what a program leaves behind, one folder a parameter set


def program_input(
    sequence: Sequence, config: SequenceConfig, about: Any, folder: Path, layout: Layout
) -> ProgramInput:
    """Find or write the recording of a sequence for a program that reads `layout`.

    Parameters
    ----------
    sequence, config
        The sequence and its description.
    about
        All that the sequence depends on, as plain data. A recording with another is replaced.
    folder
        Where to keep what is written. Processes wait for each other.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    own = _own_bag(config, layout)
    name = {"bag": "input.bag", "ros2": "input", "kitti": "input"}[layout]
    with (folder.parent / f".{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if _about(folder) != about:
            stamps: list[int] = []
            with replacing_folder(folder) as temporary:
                temporary.mkdir()
                if own is None:
                    scans = _note_stamps(sequence, stamps)
                    export(scans, sequence.imu(), temporary / name, layout)
                else:
                    stamps += [scan.stamp for scan in sequence]
                np.save(temporary / "stamps.npy", np.array(stamps, np.int64))
                (temporary / "about.json").write_text(json.dumps(about), encoding="utf-8")
        at = np.load(folder / "stamps.npy")
    reference = sequence.reference()
    T_ref_sensor = None if reference is None else reference.at(at)
    if own is None:
        imu = "" if sequence.imu() is None else IMU
        return ProgramInput(folder / name, POINTS, imu, at, T_ref_sensor)
    source: Any = getattr(sequence, "source", None)
    imu = "" if config.imu is None else config.imu.topic or ""
    return ProgramInput(own, config.points or source.points, imu, at, T_ref_sensor)


def _note_stamps(sequence: Sequence, stamps: list[int]) -> Iterator[Scan]:
    for scan in sequence:
        stamps.append(scan.stamp)
        yield scan


def _own_bag(config: SequenceConfig, layout: Layout) -> Path | None:
    """The sequence's bag, if it is a single one, used as it is, and of the right kind."""
    if not isinstance(config.bag, str) or layout == "kitti":
        return None
    plain = SequenceConfig(bag=config.bag)
    changes = ("start", "stop", "stride", "part", "views", "compensate")
    if any(getattr(config, key) != getattr(plain, key) for key in changes):
        return None
    path = Path(config.bag)
    right = path.is_file() and path.suffix == ".bag"
    if layout == "ros2":
        right = (path / "metadata.yaml").exists()
    return path if right else None


def _about(folder: Path) -> Any:
    try:
        return json.loads((folder / "about.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
