"""How accurate a reference is that came with a recording, by direct registrations of its scans."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert
from adaptune.live.evidence import MIN_REACH, Link, OwnError, OwnErrors, hops_along
from adaptune.live.hops import LENGTHS as HOPS
from adaptune.live.hops import Hops
from adaptune.metrics import cap, sub_trajectory_rte, travelled
from adaptune.recording.config import ESTIMATED, SequenceConfig
from adaptune.recording.inspect import Inspection
from adaptune.recording.recording import position_prior
from adaptune.recording.scan import Recording, Scan
from adaptune.reference.stored import EstimateError, StoredEstimate
from adaptune.trajectory import Trajectory

if TYPE_CHECKING:
    from adaptune.reference.estimate import Advance


UNSEEN = 0.7
"""Share of a way that a registration does not show, from which it does not count."""


@dataclass(frozen=True, eq=False)
class MeasuredReference:
    """A reference at the scans' stamps, and registrations of the scans."""

    stamps: NDArray[np.int64]  # (n,): of the scans, in nanoseconds
    T_ref_sensor: Poses  # (n, 4, 4): poses of the reference; NaN where there is none
    hops: Hops  # direct registrations of the same scans

    def error(self, length: float) -> OwnError | None:
        """Mean error of the reference, in percent of sub-trajectories of `length` metres.

        What the registrations themselves are wrong by is part of it. A registration is `HOPS`
        metres long at most; over less, the reference counts as wrong by as many metres. None if
        the registrations that follow each other reach nowhere over the length, or most of them do
        not show motion along the way.
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
                    self.hops.hop(i),
                )
            )
        found = errors.estimate() if reach >= MIN_REACH * longer else None
        scale = longer / length
        return None if found is None else OwnError(*(scale * value for value in found))

    @cached_property
    def unseen(self) -> str:
        """Axis of the sensor along which the place does not show motion, though it moves so.

        Empty where most registrations show it. All scans of a tunnel look alike along it.
        """
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
    """Register the scans of a recording to find how wrong a reference of its LiDAR is.

    `advance` is called after every scan.
    """
    stamps, poses = [], []
    n = scans.n_messages

    def with_poses() -> Iterator[tuple[Scan, Poses]]:
        for scan in scans:
            stamps.append(scan.stamp)
            poses.append(_pose_at(reference, scan.stamp))
            yield scan, poses[-1]

    hops = hops_along(with_poses(), lambda done: advance(min(done, n), n))
    advance(len(stamps), len(stamps))
    return MeasuredReference(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4), hops)


def _pose_at(reference: Trajectory, stamp: int) -> Poses:
    """The pose at a stamp, of shape (4, 4), without a look at the whole trajectory."""
    after = int(np.searchsorted(reference.stamps, stamp))
    near = slice(max(after - 1, 0), after + 1)
    around = Trajectory(reference.stamps[near], reference.T_world_sensor[near], reference.max_gap)
    return np.asarray(around.at(np.array([stamp], np.int64))[0])


def mean_difference(T_one: Poses, T_other: Poses, length: float) -> float:
    """Mean RTE in percent of one reference by another, over `length` metres.

    The poses are of shape (n, 4, 4), at the same stamps, and NaN where they are unknown. The
    result is NaN where both together hold no sub-trajectory.
    """
    known = np.isfinite(T_one + T_other).all(axis=(1, 2), keepdims=True)
    T_one, T_other = (np.where(known, T, np.nan) for T in (T_one, T_other))
    errors = sub_trajectory_rte(T_one, T_other, length)
    errors = cap(errors[~np.isnan(errors)])
    return float(errors.mean()) if len(errors) else float("nan")


# Which length of sub-trajectories to propose for a study, given how accurate its reference is.

LENGTHS = {25.0: 8, 10.0: 8, 5.0: 1.4, 2.0: 2}
"""Metres of a sub-trajectory, and how many of them the path of the test must hold: over short ones,
the noise of the reference counts too much."""
LONGER = (5.0, 10.0, 25.0, 50.0, 100.0)
"""Metres to choose from where the first of `LENGTHS` that fits is too short after all."""
FEWEST = 1.4
"""How many of them the path of the test must hold then."""
SECONDS = 2.0
"""A sub-trajectory lasts as long at least, up to the greatest of `LENGTHS`: who is fast often has
a reference of GPS, which is noisy."""
NOISY = 0.5
"""Percent by which a reference may be wrong, as far as registrations can tell."""
TRAINING = 0.6
"""Share of a recording's duration that is proposed for training, before the test."""


def proposed_sub_trajectory(
    reference: Trajectory, measured: MeasuredReference | None = None
) -> float:
    """Metres of the sub-trajectories that a study of a recording alone should judge by.

    The first of `LENGTHS` for which the test's part of the path is long enough, 1 m if none is,
    or a longer one if that does not last `SECONDS`. Where registrations say that the reference is
    too noisy for it, the first longer one that fits and for which it is not; where it is for all,
    the longest that fits, up to the greatest of `LENGTHS`.
    """
    first, last = reference.stamps[[0, -1]]
    tested = reference.stamps >= first + TRAINING * (last - first)
    seconds = float(last - reference.stamps[tested][0]) * 1e-9
    path = float(travelled(reference.T_world_sensor[tested])[-1])
    usual = next((length for length, n in LENGTHS.items() if n * length <= path), 1.0)
    least = min(SECONDS * path / seconds, max(LENGTHS)) if seconds else 0.0
    fit = [usual, *(length for length in LONGER if length > usual and FEWEST * length <= path)]
    usual = next((length for length in fit if length >= least), fit[-1])
    if measured is None or not is_noisy(measured.error(usual)):
        return usual
    for length in (length for length in fit if length > usual):
        error = measured.error(length)
        if error is not None and not is_noisy(error):
            return length
    return max(length for length in fit if length <= max(LENGTHS))


def is_noisy(error: OwnError | None) -> bool:
    """Whether a reference is surely wrong by more than `NOISY`; False where nothing is known."""
    return error is not None and error.low > NOISY


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
    return f"wrong by {', '.join(words)}, as registrations of scans tell"


def advice(measured: MeasuredReference, reference: Trajectory) -> str:
    """What to do about a reference that is too noisy for the usual length; empty if it is not."""
    if not is_noisy(measured.error(proposed_sub_trajectory(reference))):
        return ""
    length = proposed_sub_trajectory(reference, measured)
    less = "sets that differ by less cannot be told apart"
    if is_noisy(measured.error(length)):
        return f"{less}, at no length that fits: use `reference: estimated`"
    return f"{less}: use a sub_trajectory of {length:g} m, or `reference: estimated`"


# Estimate the reference of a single recording, and compare it with the one that came with it.


def recording_config(
    found: Inspection, points: str | None = None, reference: str | None = None
) -> SequenceConfig:
    """The sequence that an inspected recording is.

    `points` and `reference` are topics in place of those that were found; the reference may be a
    file, too. There is an `EstimateError` if there are no scans.
    """
    if not found.name:
        raise EstimateError(f"{found.path}: is a file of poses; give a recording of scans")
    if points is None and (lacking := found.missing["online"]):
        raise EstimateError(f"{found.path}: lacks {' and '.join(lacking)}; see `adaptune inspect`")
    given = found.config().model_dump(exclude_unset=True)
    chosen = {"points": points, "reference": reference}
    given |= {key: value for key, value in chosen.items() if value is not None}
    return SequenceConfig(**given)


def read_prior(config: SequenceConfig, source: str) -> Trajectory:
    """Positions that are right over long distances, from a topic of the recording or a file.

    There is an `AdaptuneError` if there are none, or they are of another time.
    """
    given = config.model_dump(exclude_unset=True, exclude={"max_gap"})
    joined = {"reference": ESTIMATED, "position_prior": source}
    prior = position_prior(SequenceConfig(**given | joined))
    if prior is None:
        raise EstimateError(
            f"--position-prior {source}: holds no pose; name a topic or a file of poses"
        )
    return prior


def check_writable(path: Path) -> None:
    """Make sure that an estimate can be written, and that nothing of the user's is overwritten.

    There is an `EstimateError` if the folder of the TUM file cannot be written to, or there is a
    file that is no estimate.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise EstimateError(
            f"{path.parent}: cannot be written to ({error.strerror}); write elsewhere with --out"
        ) from error
    if StoredEstimate.read(path) is None:
        files = (path.with_suffix(suffix) for suffix in (".tum", ".json", ".png"))
        if there := [file for file in files if file.exists()]:
            raise EstimateError(
                f"{there[0]}: is there, and is not of an estimate that is complete; move it away, "
                f"or write elsewhere with --out"
            )
