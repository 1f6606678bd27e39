"""Trials on disk: what was run, where it went, and how wrong it was at every frame."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.files import DAMAGED_NPZ, replacing
from adaptune.geometry import Poses
from adaptune.metrics import cap
from adaptune.space import ParameterSet


class ArchiveError(AdaptuneError):
    """A file of the archive that is not what it should be."""


@dataclass(frozen=True, eq=False)
class Frames:
    """What all trials on a sequence share.

    Attributes
    ----------
    stamps : ndarray of shape (n,)
        Nanoseconds.
    T_ref_sensor : ndarray of shape (n, 4, 4)
        Reference poses, NaN where there is none.
    histograms : ndarray of shape (n, 90)
        Environment descriptors.
    """

    stamps: NDArray[np.int64]
    T_ref_sensor: Poses
    histograms: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trial:
    """One parameter set on one sequence.

    Attributes
    ----------
    parameters : dict
    T_odom_sensor : ndarray of shape (n, 4, 4)
    errors : ndarray of shape (n,)
        Sub-trajectory RTE in percent; NaN without a sub-trajectory, infinite where the track was
        lost.
    restarted : ndarray of shape (n,)
        Frames at which the track was lost and the odometry started anew at the reference.
    registered : ndarray of shape (n,)
        False where the scan was too poor.
    seconds : ndarray of shape (n,)
        What the odometry took for each scan, without preparing it.
    faults : tuple of str
        What ended the odometry's process, or was no pose, each with the odometry's last words.
    """

    parameters: ParameterSet
    T_odom_sensor: Poses
    errors: NDArray[np.float64]
    restarted: NDArray[np.bool_]
    registered: NDArray[np.bool_]
    seconds: NDArray[np.float64]
    faults: tuple[str, ...] = ()

    @property
    def mean_error(self) -> float:
        """Mean capped error in percent over the frames with a sub-trajectory."""
        return float(np.nanmean(cap(self.errors)))


class Archive:
    """The trials of a study, a file for each trial and sequence.

    Parameters
    ----------
    folder
        Where they are kept: ``<sequence>/frames.npz`` and ``<sequence>/<number>.npz``.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def trial_path(self, sequence: str, number: int, whole: bool = False) -> Path:
        """File of a trial; of its whole run, without new starts at the reference, if `whole`."""
        return self.folder / sequence / f"{number:05d}{'-whole' if whole else ''}.npz"

    def tidy(self) -> None:
        """Remove what a killed process was writing; no other must be writing now."""
        for unfinished in self.folder.glob("*/.*.npz"):
            unfinished.unlink()

    def has_frames(self, sequence: str) -> bool:
        """Whether what all trials on a sequence share is there."""
        return (self.folder / sequence / "frames.npz").exists()

    def write_frames(self, sequence: str, frames: Frames) -> None:
        """Keep what all trials on a sequence share."""
        path = self.folder / sequence / "frames.npz"
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez_compressed(
                file,
                stamps=frames.stamps,
                T_ref_sensor=frames.T_ref_sensor,
                histograms=frames.histograms.astype(np.uint16),
            )

    def read_frames(self, sequence: str) -> Frames:
        """Read what all trials on a sequence share.

        Raises
        ------
        ArchiveError
        """
        data = _read(self.folder / sequence / "frames.npz")
        try:
            return Frames(data["stamps"], data["T_ref_sensor"], data["histograms"].astype(float))
        except KeyError as error:
            raise ArchiveError(f"{self.folder / sequence / 'frames.npz'}: lacks {error}") from error

    def write(self, sequence: str, number: int, trial: Trial, whole: bool = False) -> None:
        """Keep a trial."""
        path = self.trial_path(sequence, number, whole)
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez(
                file,
                parameters=np.frombuffer(json.dumps(trial.parameters).encode(), np.uint8),
                T_odom_sensor=trial.T_odom_sensor,
                errors=trial.errors.astype(np.float32),
                restarted=trial.restarted,
                registered=trial.registered,
                seconds=trial.seconds.astype(np.float32),
                faults=np.frombuffer(json.dumps(trial.faults).encode(), np.uint8),
            )

    def read(self, sequence: str, number: int, whole: bool = False) -> Trial:
        """Read a trial.

        Raises
        ------
        ArchiveError
        """
        path = self.trial_path(sequence, number, whole)
        data = _read(path)
        try:
            return Trial(
                json.loads(data["parameters"].tobytes()),
                data["T_odom_sensor"],
                data["errors"].astype(np.float64),
                data["restarted"],
                data["registered"],
                data["seconds"].astype(np.float64),
                tuple(json.loads(data["faults"].tobytes())),
            )
        except (KeyError, ValueError) as error:
            raise ArchiveError(f"{path}: is damaged ({error}); remove it and run again") from error

    def read_errors(self, sequence: str, numbers: Sequence[int]) -> NDArray[np.float32]:
        """Errors of several trials on a sequence, of shape (n_frames, n_trials)."""
        errors = [self.read(sequence, n).errors for n in numbers]
        if len({len(of_trial) for of_trial in errors}) > 1:
            raise ArchiveError(
                f"{self.folder / sequence}: trials are of recordings of different lengths; remove "
                f"the folder and run again"
            )
        return np.stack(errors, axis=1).astype(np.float32)


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: there is no such file; run `adaptune offline`") from error
    except DAMAGED_NPZ as error:
        raise ArchiveError(f"{path}: is damaged ({error}); remove it and run again") from error
