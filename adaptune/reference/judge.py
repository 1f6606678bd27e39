"""A reference that judges: the errors that it shows of an odometry."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from adaptune.reference.stored import StoredEstimate
from adaptune.trajectory import Trajectory


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


def columns_of(known: StandardErrors | None) -> dict[str, Any]:
    """The cells of a table of the errors that other tools give; None where they are not known."""
    kitti = known.kitti if known is not None and known.kitti.lengths else None
    lengths = [f"{length:g}" for length in kitti.lengths] if kitti else []
    return {
        "APE [m]": known and known.ape,
        "RPE [m]": known and known.rpe,
        "height [%]": known and known.height,
        "KITTI [%]": kitti and kitti.translation,
        "[deg/100 m]": kitti and 100.0 * kitti.rotation,
        "over [m]": "-".join(dict.fromkeys([*lengths[:1], *lengths[-1:]])) or None,
    }


class Reference(NamedTuple):
    """The reference that errors are measured against, and over which length."""

    trajectory: Trajectory | None  # None where nothing is known
    length: float  # metres of a sub-trajectory
    estimated: bool = False  # whether it was computed from the recording
    error: float | None = None  # its own mean RTE in percent, as far as it is known

    @classmethod
    def known(
        cls, trajectory: Trajectory | None, length: float, stored: StoredEstimate | None
    ) -> "Reference":
        """The reference with these poses, and with the error of an estimated one."""
        error = np.nan if stored is None else stored.error(length)
        return cls(trajectory, length, stored is not None, None if np.isnan(error) else error)

    @property
    def block(self) -> int:
        """Frames of a sub-trajectory."""
        return 1 if self.trajectory is None else span(self.trajectory.T_world_sensor, self.length)

    def errors(self, odometry: Trajectory) -> NDArray[np.float64]:
        """Clipped sub-trajectory RTE at every frame in percent, NaN where it is unknown."""
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
