"""Stretches: recordings are cut into them, and one after the other is left out."""

from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from adaptune.geometry import Poses
from adaptune.metrics import travelled, window_ends
from adaptune.study.driven import PER_STRETCH
from offline.bank_simulation import BankSimulation

MARGIN = 2
"""Frames that a part of a simulation is longer than its stretch: a distance that is summed from
another frame may differ in its last bits, and a sub-trajectory then ends one frame later."""


class Extent(NamedTuple):
    """Where the labelled frames of a sequence are, and how far their sub-trajectories reach."""

    frames: NDArray[np.intp]  # (n,): their numbers among all frames of the sequence
    ends: NDArray[np.intp]  # (n,): last frames of their sub-trajectories
    # Metres: where these frames are, and where their sub-trajectories end, each of shape (n, 3).
    positions: NDArray[np.float64]
    end_positions: NDArray[np.float64]
    length: float  # of a sub-trajectory

    @classmethod
    def of(cls, T_ref_sensor: Poses, known: NDArray[np.bool_], length: float) -> Self:
        """The extent of the frames that are known to have errors.

        Parameters
        ----------
        T_ref_sensor
            Reference of all frames, of shape (n_frames, 4, 4).
        known
            Which frames are labelled, of shape (n_frames,).
        length
            Metres of a sub-trajectory.
        """
        frames = np.flatnonzero(known)
        ends = window_ends(T_ref_sensor, length)[frames]
        at = T_ref_sensor[:, :3, 3]
        return cls(frames, ends, at[frames], at[ends], length)

    def some(self, kept: NDArray[np.bool_]) -> Self:
        """The same of some of the frames."""
        return self._replace(
            frames=self.frames[kept],
            ends=self.ends[kept],
            positions=self.positions[kept],
            end_positions=self.end_positions[kept],
        )

    def near(self, left_out: "Extent", is_view: bool) -> NDArray[np.bool_]:
        """Which frames must not be known where others of the same recording are left out.

        That is each frame within the length of a sub-trajectory of where these are, and each whose
        sub-trajectory overlaps one of theirs.

        Parameters
        ----------
        left_out
            The frames that are left out.
        is_view
            Whether these frames are those of a view, which counts frames in another way, and may
            be played backwards.
        """
        path = cKDTree(left_out.positions)
        near = path.query(self.positions)[0] <= self.length
        if is_view:
            found = near | (path.query(self.end_positions)[0] <= self.length)
        else:
            before = self.ends < left_out.frames.min()
            found = near | ~(before | (self.frames > left_out.ends.max()))
        return np.asarray(found)


def cut(T_ref_sensor: Poses, extent: Extent) -> NDArray[np.intp]:
    """Number of each labelled frame's stretch along the reference, of shape (n,).

    The last piece joins the stretch before if it is shorter than half a stretch.
    """
    if not len(extent.frames):
        return np.empty(0, np.intp)
    size = PER_STRETCH * extent.length
    distance = travelled(T_ref_sensor)[extent.frames]
    distance -= distance[0]
    n_stretches = max(1, int(distance[-1] / size + 0.5))
    return np.minimum((distance / size).astype(np.intp), n_stretches - 1)


def stretches_of_view(
    view: Extent, recording: Extent, numbers: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Number of the stretch that each frame of a view shows, of shape (n,).

    It is that of the recording's nearest frame: a view shares the recording's reference.
    """
    return np.asarray(numbers[cKDTree(recording.positions).query(view.positions)[1]])


def part_of(simulation: BankSimulation, extent: Extent) -> tuple[BankSimulation, Extent]:
    """The part of a simulation that a stretch takes, and the stretch's extent in it."""
    first = int(extent.frames.min())
    stop = min(int(extent.ends.max()) + 1 + MARGIN, len(simulation.stamps))
    frames = slice(first, stop)

    def motions(members: tuple[int, ...]) -> Poses:
        return simulation.motions(members)[first : stop - 1]

    part = replace(
        simulation,
        stamps=simulation.stamps[frames],
        T_ref_sensor=simulation.T_ref_sensor[frames],
        descriptors=simulation.descriptors[frames],
        period=simulation.period[frames],
        hops=simulation.hops.part(first, stop),
        motions=motions,
    )
    return part, extent._replace(frames=extent.frames - first, ends=extent.ends - first)
