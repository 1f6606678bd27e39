"""What a drive leaves on disk, written while it lasts."""

import csv
import io
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np

from adaptune.odometry.tracker import RegisteredScan
from adaptune.strict import in_one_line
from adaptune.trajectory import tum_lines
from online.record import FRAME_COLUMNS, SELECTION_COLUMNS, frame_row, selection_row
from online.replay import Choice

_log = logging.getLogger(__name__)


class DriveLog:
    """Writes ``trajectory.tum``, ``frames.csv`` and ``selections.csv``, line by line.

    Where the disk is full, the log ends and the drive goes on.

    `names` are those of the parameters, columns of ``selections.csv``. With `goes_on`, the drive
    goes on where nothing can be recorded from the start.

    Attributes
    ----------
    lost : str
        Why the log ended; empty while it lasts.

    Raises
    ------
    OSError
        If the files cannot be made, unless the drive goes on.
    """

    def __init__(self, folder: Path, names: list[str], *, goes_on: bool = False):
        self.folder, self.lost = folder, ""
        self._names = names
        self._files: dict[str, IO[str]] = {}
        try:
            folder.mkdir(parents=True)
            for name in ("trajectory.tum", "frames.csv", "selections.csv"):
                # A line is on disk when it is written: the robot may be switched off.
                file = (folder / name).open("w", buffering=1, newline="", encoding="utf-8")
                self._files[name] = file
        except OSError as error:
            if not goes_on:
                raise
            self._end(error)
        self._write("frames.csv", _csv(FRAME_COLUMNS))
        self._write("selections.csv", _csv((*SELECTION_COLUMNS, *names)))

    def scan(self, step: RegisteredScan, late: float) -> None:
        """Note a scan: its pose, and how late that was in seconds."""
        stamps = np.array([step.stamp], np.int64)
        (line,) = tum_lines(stamps, step.T_odom_sensor[None])
        self._write("trajectory.tum", line)
        self._write("frames.csv", _csv(frame_row(step, late)))

    def choice(self, choice: Choice) -> None:
        """Note a selection."""
        self._write("selections.csv", _csv(selection_row(choice, self._names)))

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            try:
                file.close()
            except OSError as error:
                self._end(error)

    def _write(self, name: str, line: str) -> None:
        if not self.lost:
            try:
                self._files[name].write(line)
            except OSError as error:
                self._end(error)

    def _end(self, error: OSError) -> None:
        if not self.lost:
            self.lost = in_one_line(error)
            _log.warning("%s: nothing more is recorded (%s); the drive goes on", self.folder, error)


def _csv(row: Iterable[Any]) -> str:
    text = io.StringIO()
    csv.writer(text).writerow(row)
    return text.getvalue()
