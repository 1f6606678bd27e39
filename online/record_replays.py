"""Write replays as recordings to look at: Rerun, MCAP, Parquet."""

from collections import deque
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from itertools import count
from pathlib import Path

from adaptune.odometry.base import import_extra
from adaptune.study.study import Study
from online.mcap_recording import write_mcap
from online.parquet_tables import TABLES, write_parquet
from online.recordings import Cloud, Progress, RecordedReplays, clouds, gather
from online.rerun_recording import rerun_recording

FORMATS = ("rerun", "mcap", "parquet")
_PACKAGES = {"rerun": "rerun", "parquet": "pyarrow"}
"""What the extra of a format's name installs."""


def installed_formats() -> list[str]:
    """The formats whose packages are there."""
    return [f for f in FORMATS if f not in _PACKAGES or find_spec(_PACKAGES[f]) is not None]


def record_replays(
    study: Study,
    name: str,
    formats: Collection[str],
    progress: Progress = lambda *_: None,
) -> list[Path]:
    """Write the replays of a sequence as recordings.

    Parameters
    ----------
    study
        The study; ``recordings`` in its folder receives the files.
    name
        Of the sequence.
    formats
        Some of `FORMATS`.
    progress
        Called after every scan.

    Returns
    -------
    list of Path
        What was written: files of Rerun and Parquet, and MCAP files, each in a folder of its own.

    Raises
    ------
    AdaptuneError
        If there is no replay, it cannot be read, a package is not installed, or the disk is full.
    """
    for needed in formats:
        if needed in _PACKAGES:
            import_extra(needed, _PACKAGES[needed])
    replays, folder = gather(study, name), study.folder / "recordings"
    written: list[Path] = []
    for mode in replays.modes if "parquet" in formats else ():
        for table in TABLES:
            written.append(folder / f"{name}_{mode}_{table}.parquet")
            write_parquet(written[-1], study.folder / "replays" / name / mode / f"{table}.csv")
    if not {"rerun", "mcap"} & set(formats):
        return written
    with ExitStack() as stack:
        # The scans are read once for both.
        seen = _clouds(study, name, replays, progress)
        if "rerun" in formats:
            written.append(folder / f"{name}.rrd")
            seen = stack.enter_context(rerun_recording(written[-1], replays, seen))
        if "mcap" in formats:
            write_mcap(folder / name, replays, seen)
            written.append(folder / name / f"{name}.mcap")
        deque(seen, maxlen=0)
    return written


def _clouds(
    study: Study, name: str, replays: RecordedReplays, progress: Progress
) -> Iterator[Cloud]:
    sequence, done = study.sequences.open(name), count(1)
    n = sequence.n_messages
    show = partial(progress, name)
    yield from clouds(
        sequence, replays.modes[replays.placing].trajectory, lambda: show(next(done), n)
    )
    show(n, n)
