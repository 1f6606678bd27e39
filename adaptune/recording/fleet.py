"""Which recordings a folder holds: the parts of one, or several."""

import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from adaptune._system.files import entries
from adaptune.recording.bag import UNOPENED, BagSource
from adaptune.recording.config import BAG_SUFFIXES, bag_paths
from adaptune.recording.scan import SequenceError

if TYPE_CHECKING:
    from adaptune.recording.inspect import Inspection

Reading = Literal["one", "several"]
"""How the bags of a folder are read."""
_OVERLAP, _NEXT, LONGEST_GAP = -0.5, 2.0, 60.0
"""Seconds. Between parts of one recording lies no less and no more than the first two, between
separate ones less than the first or more than the last."""
_RATES = 1.25  # rates that differ by a larger factor are those of different sensors


class FolderReading(NamedTuple):
    """The recordings at a path."""

    recordings: tuple[Path, ...]  # each by its own; the path itself if there is one
    reading: Reading | None  # None where it is not clear
    why: str = ""


def read_folder(path: Path) -> FolderReading:
    """Tell the parts of one recording from separate recordings.

    Parts follow each other, and have one name with numbers. Separate recordings are a minute apart,
    or some overlap, or they are folders of their own. A SequenceError names a bag that is unfit.
    """
    alone = FolderReading((path,), "one")
    if not path.is_dir() or (path / "metadata.yaml").exists() or (path / "velodyne").is_dir():
        return alone
    there = entries(path)
    if active := next((p for p in there if p.suffix == ".active"), None):
        raise SequenceError(f"{active}: is still being recorded; run this again when it is closed")
    bags = [p for p in there if p.is_file() and p.suffix in BAG_SUFFIXES]
    if folders := [p for p in there if p.is_dir() and _is_recording(p)]:
        below = [(p, read_folder(p)) for p in folders]  # as one where that is not clear
        each = (one.recordings if one.reading == "several" else (p,) for p, one in below)
        return FolderReading((*chain(*each), *bags), "several", "in folders of their own")
    if len(bags) < 2:  # by its own name: there may be more later
        return FolderReading(tuple(bags), "one") if bags else alone
    spans = sorted((*_span(bag), bag) for bag in bags)
    ends = np.maximum.accumulate([end for _, end, _ in spans])
    gaps = np.array([spans[i + 1][0] - ends[i] for i in range(len(spans) - 1)]) * 1e-9
    names = {re.sub(r"[\d_.-]+$", "", bag.stem) for bag in bags}
    apart = f"{gaps.min():,.1f} to {gaps.max():,.1f} s lie between them"
    reading: Reading | None = None
    if (gaps > LONGEST_GAP).all() or (gaps < _OVERLAP).any():
        reading = "several"
    elif (gaps <= _NEXT).all() and len(names) == 1:
        reading = "one"
    why = "some overlap" if (gaps < 0.0).any() else apart
    return FolderReading(tuple(bag for *_, bag in spans), reading, why)


def _is_recording(path: Path, depth: int = 1) -> bool:
    """Whether a folder is one, or holds some: files, and folders so many levels down."""
    if (path / "metadata.yaml").exists() or (path / "velodyne").is_dir():
        return True
    return any(
        depth > 0 and _is_recording(p, depth - 1) if p.is_dir() else p.suffix in BAG_SUFFIXES
        for p in entries(path)
    )


def _span(bag: Path) -> tuple[int, int]:
    """First and last time of a bag, nanoseconds."""
    with BagSource(bag_paths([str(bag)]), about=UNOPENED).open(by_index=True) as reader:
        return reader.start_time, reader.end_time


def recordings_at(paths: Sequence[Path], reading: Reading | None = None) -> list[Path]:
    """The recordings at some paths; `reading` decides where a folder may be read in two ways.

    A SequenceError says that it is needed.
    """
    found: list[Path] = []
    for path in paths:
        folder = read_folder(path)
        if (way := reading or folder.reading) is None:
            raise SequenceError(f"{path}: {both_readings(folder)}")
        separate = way == "several" or len(folder.recordings) == 1
        found += folder.recordings if separate else (path,)
    return found


def both_readings(folder: FolderReading) -> str:
    """What a folder may hold, and the option that chooses."""
    n = len(folder.recordings)
    return (
        f"holds one recording in {n} parts, or {n} recordings: {folder.why}; choose with "
        f"`--as one` or `--as several`"
    )


def check_alike(recordings: Sequence["Inspection"]) -> None:
    """Refuse recordings of different sensors or rates by a SequenceError that lists them."""
    kinds: dict[str, list[str]] = {}
    rates: list[float] = []
    for drive in recordings:
        if (topic := drive.topics.get(drive.given.get("points", drive.used["points"]))) is None:
            continue  # opening it says so
        own_rate = topic.rate or 1.0
        rate = next((r for r in rates if max(r, own_rate) <= _RATES * min(r, own_rate)), own_rate)
        rates.append(rate)
        kind = f"{rate:.1f} Hz, {topic.type}, {' '.join(drive.fields) or 'scans'}"
        kinds.setdefault(kind, []).append(drive.path.name)
    if len(kinds) > 1:
        listed = "; ".join(f"{', '.join(names)} ({kind})" for kind, names in kinds.items())
        raise SequenceError(
            f"recordings of different sensors or rates do not tune one odometry: {listed}; give "
            f"those of one kind"
        )
