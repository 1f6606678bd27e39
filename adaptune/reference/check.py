"""How wrong a reference is, by direct registrations of scans, and over which length to judge by."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import Finding
from adaptune.geometry import Poses, invert
from adaptune.live.evidence import hops_along
from adaptune.live.hops import LENGTHS as HOPS
from adaptune.live.hops import Hop, Hops
from adaptune.live.own_error import MIN_REACH, Link, OwnError, OwnErrors
from adaptune.metrics import cap, sub_trajectory_rte, travelled
from adaptune.recording.scan import Recording, Scan
from adaptune.reference.carried import Carried, begin_of, left_out
from adaptune.trajectory import Trajectory

if TYPE_CHECKING:
    from adaptune.reference.estimate import Advance


CONTRADICTS = "the reference contradicts the scans"
UNSEEN = 0.7  # share of a way that a registration does not show, from which it does not count


@dataclass(frozen=True, eq=False)
class MeasuredReference:
    """A reference at the scans' stamps, and registrations of the scans."""

    stamps: NDArray[np.int64]  # (n,): of the scans, in nanoseconds
    T_ref_sensor: Poses  # (n, 4, 4): poses of the reference; NaN where there is none
    hops: Hops  # direct registrations of the same scans
    doubt: str = ""  # why registrations of these scans prove nothing, see `hard_to_track`
    carried: Sequence[Finding] = ()  # segments that are left out, see `adaptune.reference.carried`

    def error(self, length: float) -> OwnError | None:
        """Mean error of the reference, in percent of sub-trajectories of `length` metres.

        That of the registrations is part of it. Over less than their length, the reference counts
        as wrong by as many metres. None if registrations that follow each other reach nowhere over
        the length, or most of them do not show motion along the way.
        """
        if self.unseen:
            return None
        longer = max(length, HOPS[0])
        metres, reach = self._metres(), 0.0
        part = np.cumsum(np.isnan(self.T_ref_sensor[:, 0, 0]))
        errors = OwnErrors(longer, whole=True)
        begun = None
        for i, (start, end) in enumerate(zip(self.hops.start, self.hops.end, strict=True)):
            if begun is None or part[start] != part[begun]:
                errors.interrupt()
                begun = start
            reach = max(reach, float(metres[end] - metres[begun]))
            errors.add(
                Link(
                    float(metres[start]),
                    float(metres[end]),
                    float(self.stamps[end]) * 1e-9,
                    self.T_ref_sensor[start],
                    self.T_ref_sensor[end],
                    Hop(self.hops.T_start_end[i], self.hops.projection[i]),
                )
            )
        found = errors.estimate() if reach >= MIN_REACH * longer else None
        scale = longer / length
        return None if found is None else OwnError(*(scale * value for value in found))

    def is_noisy(self, length: float) -> bool:
        """Whether the reference is surely wrong by more than `NOISY`; False if nothing is known."""
        error = None if self.doubt else self.error(length)
        return error is not None and error.low > NOISY

    @cached_property
    def unseen(self) -> str:
        """Axis of the sensor along which the place, as a tunnel, does not show motion, or empty."""
        T = invert(self.T_ref_sensor[self.hops.start]) @ self.T_ref_sensor[self.hops.end]
        way = T[:, :3, 3] / np.linalg.norm(T[:, :3, 3], axis=1, keepdims=True)
        lost = way - np.einsum("nij,nj->ni", self.hops.projection, way)
        far = np.linalg.norm(lost, axis=1) > UNSEEN
        if not len(way) or far.mean() < 0.5:
            return ""
        return "xyz"[int(np.abs(lost[far]).mean(axis=0).argmax())]

    def _metres(self) -> NDArray[np.float64]:
        """Metres driven until each end of a registration, of shape (n,); NaN elsewhere.

        Straight from one to the next: poses that are noisy make a longer path.
        """
        ends = np.unique(np.concatenate([self.hops.start, self.hops.end]))
        steps = np.linalg.norm(np.diff(self.T_ref_sensor[ends, :3, 3], axis=0), axis=1)
        metres = np.full(len(self.stamps), np.nan)
        metres[ends] = np.concatenate([np.zeros(min(len(ends), 1)), np.cumsum(steps)])
        return metres


def measure_reference(
    scans: Recording, reference: Trajectory, advance: "Advance" = lambda *_: None
) -> MeasuredReference:
    """Register the scans of a recording to find how wrong a reference of its LiDAR is."""
    stamps, poses = [], []
    n, doubt, carried = scans.n_messages, hard_to_track(scans), Carried()

    def with_poses() -> Iterator[tuple[Scan, Poses]]:
        for scan in scans:
            stamps.append(scan.stamp)
            poses.append(pose_at(reference, scan.stamp))
            carried.see(scan, poses[-1])
            yield scan, poses[-1]

    hops = hops_along(with_poses(), lambda done: advance(min(done, n), n))
    advance(len(stamps), len(stamps))
    at, T_ref_sensor = np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4)
    found = carried.findings(begin_of(scans, at))
    T_ref_sensor[left_out(at, found, begin_of(scans, at))] = np.nan
    gaps = np.cumsum(np.isnan(T_ref_sensor[:, 0, 0]))
    whole = (gaps[hops.start] == gaps[hops.end]) & ~np.isnan(T_ref_sensor[hops.start, 0, 0])
    hops = Hops._make(array[whole] for array in hops)
    return MeasuredReference(at, T_ref_sensor, hops, doubt, found)


def pose_at(reference: Trajectory, stamp: int) -> Poses:
    """The pose at a stamp, of shape (4, 4), without a look at the whole trajectory."""
    after = int(np.searchsorted(reference.stamps, stamp))
    near = slice(max(after - 1, 0), after + 1)
    around = Trajectory(reference.stamps[near], reference.T_world_sensor[near], reference.max_gap)
    return np.asarray(around.at(np.array([stamp], np.int64))[0])


def mean_difference(T_one: Poses, T_other: Poses, length: float) -> float:
    """Mean RTE in percent of one reference by another, over `length` metres; NaN if unknown.

    The poses are of shape (n, 4, 4), at the same stamps, and NaN where they are unknown.
    """
    known = np.isfinite(T_one + T_other).all(axis=(1, 2), keepdims=True)
    T_one, T_other = (np.where(known, T, np.nan) for T in (T_one, T_other))
    errors = sub_trajectory_rte(T_one, T_other, length)
    errors = cap(errors[~np.isnan(errors)])
    return float(errors.mean()) if len(errors) else float("nan")


NARROW, RARE = 180.0, 5.0
"""Degrees of view, and scans a second, below which an odometry loses track easily."""


def hard_to_track(scans: Iterable[Scan]) -> str:
    """What makes a recording hard to track; empty where nothing is known of it."""
    some = list(islice(scans, 20))
    x, y, _ = np.concatenate([scan.points for scan in some]).T
    view = 5.0 * len(np.unique(np.degrees(np.arctan2(y, x)) // 5.0))
    rate = 1e9 / float(np.median(np.diff([scan.stamp for scan in some]))) if some[1:] else np.inf
    found = [f"the sensor sees {view:.0f} degrees only"] * (view < NARROW)
    found += [f"it gives {rate:.2g} scans a second"] * (rate < RARE)
    return ", and ".join(found)


LENGTHS = {25.0: 8, 10.0: 8, 5.0: 1.4, 2.0: 2}
"""Metres of a sub-trajectory, and how many of them the path of the test must hold: over short ones,
the noise of the reference counts too much."""
LONGER = (5.0, 10.0, 25.0, 50.0, 100.0)
"""Metres to choose from where the first of `LENGTHS` that fits is too short after all."""
FEWEST = 1.4  # how many of them the path of the test must hold then
LEAST_SECONDS = 2.0
"""A sub-trajectory lasts as long at least, up to the greatest of `LENGTHS`: who is fast often has
a reference of GPS, which is noisy."""
NOISY = 0.5  # percent by which a reference may be wrong, as far as registrations can tell
TRAINING = 0.6  # share of a recording's duration that is proposed for training, before the test


def path_after(reference: Trajectory, training: float) -> tuple[float, float]:
    """Metres and seconds of a reference after the share `training` of its duration."""
    first, last = reference.stamps[[0, -1]]
    after = reference.stamps >= first + training * (last - first)
    seconds = float(last - reference.stamps[after][0]) * 1e-9
    return float(travelled(reference.T_world_sensor[after])[-1]), seconds


def greatest_speed(reference: Trajectory) -> float:
    """Metres that a reference moves in its fastest second."""
    stamps = np.arange(reference.stamps[0], reference.stamps[-1], 10**9)
    metres = np.linalg.norm(np.diff(reference.at(stamps)[:, :3, 3], axis=0), axis=1)
    return float(np.nan_to_num(metres).max(initial=0.0))


def proposed_sub_trajectory(
    reference: Trajectory, measured: MeasuredReference | None = None, training: float = TRAINING
) -> float:
    """Metres of the sub-trajectories that a study should judge by.

    The first of `LENGTHS` for which the path after the share `training` of the time is long enough,
    1 m if none is, or a longer one if that does not last `LEAST_SECONDS`. Where registrations say
    that the reference is too noisy for it, the first longer one that fits and for which it is not;
    where it is for all, the longest that fits, up to the greatest of `LENGTHS`.
    """
    path, seconds = path_after(reference, training)
    usual = next((length for length, n in LENGTHS.items() if n * length <= path), 1.0)
    least = min(LEAST_SECONDS * path / seconds, max(LENGTHS)) if seconds else 0.0
    fit = [usual, *(length for length in LONGER if length > usual and FEWEST * length <= path)]
    usual = next((length for length in fit if length >= least), fit[-1])
    if measured is None or not measured.is_noisy(usual):
        return usual
    for length in (length for length in fit if length > usual):
        if measured.error(length) is not None and not measured.is_noisy(length):
            return length
    return max(length for length in fit if length <= max(LENGTHS))


def accuracy_words(measured: MeasuredReference, *lengths: float) -> str:
    """How wrong a reference is over some metres, in words."""
    words = []
    for length in dict.fromkeys(lengths):
        if (error := measured.error(length)) is not None:
            most = "at most " if length < HOPS[0] else ""
            interval = f"({error.low:.2g}-{error.high:.2g})"
            words.append(f"{most}{error.mean:.2g} % {interval} over {length:g} m")
    if measured.unseen:
        axis = measured.unseen
        return f"its error cannot be measured: the place does not show motion along {axis}"
    if not words:
        return f"its error over {lengths[0]:g} m cannot be measured: too few scans agree"
    unsure = f", but they prove little: {measured.doubt}" if measured.doubt else ""
    return f"wrong by {', '.join(words)}, as registrations of scans tell{unsure}"


def advice(measured: MeasuredReference, reference: Trajectory, training: float = TRAINING) -> str:
    """What to do about a reference that is too noisy for the usual length; empty if it is not."""
    if not measured.is_noisy(proposed_sub_trajectory(reference, training=training)):
        return ""
    length = proposed_sub_trajectory(reference, measured, training)
    less = "sets that differ by less cannot be told apart"
    if measured.is_noisy(length):
        return f"{less}, at no length that fits: use `reference: estimated`"
    return f"{less}: use a sub_trajectory of {length:g} m, or `reference: estimated`"
