"""The reference beside the replays of a sequence, and the errors that it shows."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import manifest
from adaptune.files import write_text
from adaptune.live.own_error import OWN_SECONDS
from adaptune.metrics import (
    KittiError,
    absolute_error,
    cap,
    height_error,
    kitti_error,
    relative_error,
    span,
    sub_trajectory_rte,
    window_ends,
)
from adaptune.strict import ConfigurationError
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory, read_tum, write_tum
from online.record import StoredReplayError

_CONTRADICTIONS = "contradictions.txt"
_REFERENCE_INPUTS = f"reference.{manifest.FILE}"


def is_reference_of(folder: Path, about: manifest.Inputs) -> bool:
    """Whether the reference in a folder was made from just this."""
    known = (folder / "reference.tum").exists()
    try:
        made = manifest.recorded(folder / _REFERENCE_INPUTS)
    except ConfigurationError:
        return False
    return made is not None and not manifest.changes(made, {**about, "known": known})


def check_reference(folder: Path, about: manifest.Inputs) -> None:
    """Refuse a reference that was made from something else, by a StoredReplayError."""
    if not is_reference_of(folder, about):
        option = "" if (folder / "fixed").exists() else " --untrained"
        raise StoredReplayError(
            f"{folder}: was judged by another reference; run `adaptune online{option}` with this "
            f"study, which replays nothing for it"
        )


def write_reference(
    folder: Path,
    reference: Trajectory | None,
    odometry: Trajectory,
    about: manifest.Inputs,
    contradictions: Sequence[object] = (),
) -> None:
    """Write ``reference.tum``, at the stamps of a replay; remove it if there is none.

    `about` is what the reference is made from, see `adaptune.manifest`; `contradictions` is what
    scans say against it.
    """
    path = folder / "reference.tum"
    if reference is None:
        path.unlink(missing_ok=True)
    else:
        T = reference.at(odometry.stamps)
        known = ~np.isnan(T[:, 0, 0])
        if not known.any():
            raise StoredReplayError(
                f"{folder.name}: the reference does not overlap the scans in time; check that both "
                f"are of the same recording and clock"
            )
        write_tum(path, Trajectory(odometry.stamps[known], T[known]))
    write_text(folder / _CONTRADICTIONS, "".join(f"{what}\n" for what in contradictions))
    manifest.record(folder / _REFERENCE_INPUTS, {**about, "known": reference is not None})


def read_contradictions(folder: Path) -> list[str]:
    """What scans say against the reference of a sequence's replays."""
    path = folder / _CONTRADICTIONS
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


class StandardErrors(NamedTuple):
    """Errors of a trajectory as evo and KITTI's benchmark define them."""

    ape: float  # metres, after alignment
    rpe: float  # metres, from scan to scan
    kitti: KittiError
    height: float = np.nan  # percent of the sub-trajectory's length, see `height_error`

    @classmethod
    def pooled(cls, errors: "Sequence[StandardErrors]") -> "StandardErrors | None":
        """Means over sequences; KITTI's error over the sub-trajectories of all of them."""
        if not errors:
            return None
        ape, rpe, kitti, heights = zip(*errors, strict=True)
        known = [height for height in heights if np.isfinite(height)]
        height = float(np.mean(known)) if known else np.nan
        return cls(float(np.mean(ape)), float(np.mean(rpe)), KittiError.pooled(kitti), height)


class Reference(NamedTuple):
    """The reference that errors are measured against, and over which length."""

    trajectory: Trajectory | None  # None where nothing is known
    length: float  # metres of a sub-trajectory
    estimated: bool = False  # whether it was computed from the recording
    error: float | None = None  # estimated mean RTE of an estimated one, percent

    @classmethod
    def read(cls, study: Study, name: str) -> "Reference":
        """Read the reference of a replayed sequence, if it has one, from beside its replays."""
        path = study.folder / "replays" / name / "reference.tum"
        length = study.config.sub_trajectory
        trajectory = read_tum(path) if path.exists() else None
        if trajectory is not None:
            # Frames in a gap, and across a jump, have no label in training, and get none here.
            known = study.sequences.open(name).reference()
            gap = trajectory.max_gap if known is None else known.max_gap
            # Nor have those of a stretch that is left out, which is longer than this.
            steps = np.diff(trajectory.stamps) * 1e-9
            rare = 3.0 * float(np.median(steps)) if len(steps) else 0.0
            trajectory = replace(trajectory, max_gap=min(gap, max(1.9, rare)))
        stored = study.sequences.estimate(name)
        error = math.nan if stored is None else stored.error(length)
        return cls(trajectory, length, stored is not None, None if math.isnan(error) else error)

    @property
    def block(self) -> int:
        """Frames of a sub-trajectory."""
        return 1 if self.trajectory is None else span(self.trajectory.T_world_sensor, self.length)

    def errors(self, odometry: Trajectory) -> NDArray[np.float64]:
        """Capped sub-trajectory RTE at every frame in percent, NaN where it is unknown."""
        if self.trajectory is None:
            return np.full(len(odometry), np.nan)
        T_ref_sensor = self.trajectory.at(odometry.stamps)
        return cap(sub_trajectory_rte(T_ref_sensor, odometry.T_world_sensor, self.length))

    def errors_around(self, odometry: Trajectory) -> NDArray[np.float64]:
        """Mean RTE in percent of the sub-trajectories through each pose; NaN without any."""
        starts, ends, errors = self._known(odometry)
        poses = np.arange(len(odometry))
        return _means(errors, np.searchsorted(ends, poses), np.searchsorted(starts, poses, "right"))

    def errors_behind(self, odometry: Trajectory) -> NDArray[np.float64]:
        """Mean RTE in percent of the sub-trajectories that ended in the last `OWN_SECONDS`.

        It is what an odometry estimates while it drives. NaN where none ended.
        """
        _, ends, errors = self._known(odometry)
        oldest = np.searchsorted(odometry.stamps, odometry.stamps - int(OWN_SECONDS * 1e9))
        newest = np.searchsorted(ends, np.arange(len(odometry)), "right")
        return _means(errors, np.searchsorted(ends, oldest), newest)

    def _known(
        self, odometry: Trajectory
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """First and last frame and RTE in percent of the sub-trajectories that are known."""
        errors = self.errors(odometry)
        starts = np.flatnonzero(np.isfinite(errors))
        if self.trajectory is None:
            return starts, starts, errors[starts]
        ends = window_ends(self.trajectory.at(odometry.stamps), self.length)
        return starts, ends[starts], errors[starts]

    def standard(self, odometry: Trajectory) -> "StandardErrors | None":
        """The errors that other tools give, where there are reference poses to compare with."""
        if self.trajectory is None:
            return None
        T_ref_sensor, T = self.trajectory.at(odometry.stamps), odometry.T_world_sensor
        if np.isfinite(T_ref_sensor[:, 0, 0]).sum() < 2:
            return None
        ape, rpe = absolute_error(T_ref_sensor, T), relative_error(T_ref_sensor, T)
        height = height_error(T_ref_sensor, T, self.length)
        return StandardErrors(ape, rpe, kitti_error(T_ref_sensor, T), height)


def _means(
    values: NDArray[np.float64], first: NDArray[np.intp], stop: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Means of ``values[first:stop]`` for each pair of these, NaN where there is none."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    with np.errstate(invalid="ignore"):
        return np.asarray((sums[stop] - sums[first]) / (stop - first))
