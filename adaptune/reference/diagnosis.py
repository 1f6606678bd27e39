"""The likeliest cause where poses contradict the scans, and what mends it.

Poses that do not show the motions that registrations of scans have measured break a convention:
another order of numbers, another frame, another clock. Each convention predicts the poses as they
would be without it; the one that fits the measured motions is the likeliest.
"""

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from itertools import accumulate, islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from adaptune.errors import Finding
from adaptune.geometry import (
    Poses,
    from_quaternions,
    invert,
    nearest_rotation,
    rotation_angle,
    steps,
    to_quaternions,
)
from adaptune.live.hops import OFFLINE_CLOUD, OFFLINE_REACHES, Hop, HopCloud, Hops, register
from adaptune.metrics import sub_trajectory_rte, window_ends
from adaptune.recording.compensation import neighbour_motions
from adaptune.recording.content import Content
from adaptune.recording.scan import Recording, Scan
from adaptune.reference.carried import Carried, begin_of, without
from adaptune.reference.check import CONTRADICTS, NOISY, pose_at
from adaptune.trajectory import Trajectory

_SEGMENTS, _SCANS = 4, 40
"""Segments of a recording that are looked at, evenly spread, and the scans of each."""
_METRES, _EACH = 4.0, 4
"""A motion is measured over so many metres, or over half a segment if that is less, and begins at
every fourth scan of it."""
_NEIGHBOURS = 0.6, 0.1, 0.5
"""Metres, radians and seconds between neighbours, below which scans in between are left out."""
_STANDING = 0.5  # metres below which a motion is noise
_ENOUGH = 10.0  # metres after which the rest of a segment is not looked at
_MOTIONS = 12  # motions after which no more are measured, an equal share of them in each segment
_SAME_METRES = 0.3  # metres by which two ways of registering the same scans may differ


def measured_motions(scans: Iterable[Scan], n_scans: int) -> Hops:
    """Register scans over some metres from standing still, here and there along a recording.

    Neighbours are registered one after the other, then scans some metres apart directly, which owes
    nothing to any poses. There is nothing where both ways end apart, as where the view is narrow.
    """
    n_segments = min(_SEGMENTS, max(n_scans // _SCANS, 1))
    begins = np.linspace(0, max(n_scans - _SCANS, 0), n_segments).astype(int)
    scans, position = iter(scans), 0
    found: list[tuple[int, int, Hop]] = []
    for begin in begins.tolist():
        segment = list(islice(scans, begin - position, begin - position + _SCANS))
        position = begin + _SCANS
        some = islice(_motions_over(segment), -(-_MOTIONS // n_segments))
        found += [(begin + i, begin + k, hop) for i, k, hop in some]
    return Hops.of(found)


def _stride(segment: list[Scan]) -> int:
    """Which scans are enough where the sensor moves slowly: every one, second or fourth."""
    *_, (_, T, seconds) = neighbour_motions(segment[:2])
    T = np.full((4, 4), np.nan) if T is None else T
    moved = np.array([np.linalg.norm(T[:3, 3]), rotation_angle(T), seconds])
    return max(n for n in (1, 2, _EACH) if n == 1 or (n * moved < _NEIGHBOURS).all())


def _motions_over(segment: list[Scan]) -> Iterator[tuple[int, int, Hop]]:
    """Numbers of two scans of a segment, and the registration of one to the other."""
    if len(segment) < 2:
        return
    stride = _stride(segment)
    segment = segment[::stride]
    T: list[Poses] = []
    clouds: list[HopCloud] = []
    start = 0
    for i, (scan, step, seconds) in enumerate(neighbour_motions(segment)):
        if i and step is None:
            break
        T.append(np.eye(4) if step is None else T[-1] @ step)
        motion = np.eye(4) if step is None else step
        clouds.append(HopCloud(scan, motion, seconds if i else 0.0, OFFLINE_CLOUD))
        if i == 1 and step is not None:
            clouds[0].moved(step, seconds)
        while start < i:
            guess = invert(T[start]) @ T[i]
            metres = np.linalg.norm(guess[:3, 3])
            if metres < _METRES and i - start < _SCANS // 2 // stride:
                break
            ends = clouds[start], clouds[i]
            given = [guess] if metres >= _STANDING else []
            if (hop := register(*ends, given, reaches=OFFLINE_REACHES)) is not None:
                difference = hop.projection @ (hop.T_start_end - guess)[:3, 3]
                if np.linalg.norm(difference) < _SAME_METRES:
                    yield start * stride, i * stride, hop
            start += _EACH // stride
        if np.linalg.norm(T[i][:3, 3]) > _ENOUGH:
            break


SUSPICIOUS = 1.5  # percent; poses that differ less from what scans show break no convention
EXPLAINED, SET_RIGHT, LEFT = 0.5, 0.2, 10.0
"""A cause explains the difference if it leaves no more than this share of it, the second if it can
be set right, and no more percent than the third."""
UNITS, UNLIKE = (10.0, 100.0, 1000.0, 1.0 / 0.3048), 0.05
"""How many of a unit are a metre, or how many metres one of it; by which share that may be off."""
SAME = 0.01  # share of a way or a turn, and radians, that count as none
FEWEST_HOPS = 5  # measured motions that a verdict needs
TRUSTED = 0.8  # share of the measured motions that are right at least, those that fit best
CLOCK_OFFSET = 30.0  # seconds by which clocks may differ to be found
FAR_APART = 0.25  # seconds between poses, from which on the way between them is not straight
TURNED = 0.1
"""Radians, the root of their mean square, by which motions must turn a lever arm to show it."""
END_LENGTH, ENDS = 10.0, 0.8
"""Metres over which poses of scans' ends show, and the share of the error that is left at most
where they are taken as these."""
SAME_CLOCK = 0.01  # seconds by which two clocks may differ and count as the same


def _cause(what: str, mend: str, before: float, after: float = np.nan) -> Finding:
    """What poses look like that differ by `before` percent, and by `after` without that."""
    left = "" if np.isnan(after) else f" ({after:.3g} % is left without that)"
    differ = f"over some metres they differ by {before:.3g} %, by registrations of scans"
    return Finding((), f"{differ}; they look {what}{left}", mend, of="reference")


UNEXPLAINED = ", which none of the known causes explains"


OWN_ERROR = "that is its own error, and no option mends it"


class Mends(NamedTuple):
    """What mends poses, as who gives them is told; braces stand for what was found."""

    clock: str = "add {:.3f} to `clock_offset`"
    place: str = "set `extrinsic: [{}]`, the LiDAR's pose in their frame"
    own: str = "no setting mends that: calibrate what made them, or use `reference: estimated`"
    rare: str = "give more poses a second, or use `reference: estimated`"
    unturned: str = "use `reference: estimated`"
    ends: str = (
        "a system that gives the pose of a scan's end needs odometry.settings.pose_time: end; if "
        "it does not, the reference is of another clock (`clock_offset`)"
    )


_OF_STUDY = Mends()
_OF_ODOMETRY = Mends(
    place="return the LiDAR's poses: multiply by its place in the body, {}",
    own="that is the odometry's own error, and no convention: tuning may lessen it",
)
_OPTIONS = Mends(
    clock="add {:.3f} to `--clock-offset`",
    place='give `--extrinsic "{1}"`, the LiDAR\'s pose in their frame',
    own=OWN_ERROR,
    rare="write more poses a second",
    unturned="write the orientations, too",
    ends="if they are of scans' ends, give `--pose-time end`",
)


class _Candidate(NamedTuple):
    what: str
    mend: str
    T_world_sensor: Poses  # (n, 4, 4): at the scans
    most: float = SET_RIGHT  # share of the difference that it may leave


def mismatch(T_world_sensor: Poses, hops: Hops) -> NDArray[np.float64]:
    """How far motions differ from measured ones, in percent of each, at most 100, of shape (n,).

    The poses are of shape (n_scans, 4, 4). Both translation and rotation (in radians) count, along
    the directions that the place shows; NaN where a pose is unknown.
    """
    T = invert(T_world_sensor[hops.start]) @ T_world_sensor[hops.end]
    T_difference = invert(hops.T_start_end) @ T
    metres = np.linalg.norm(hops.T_start_end[:, :3, 3], axis=1)
    shift = np.einsum("nij,nj->ni", hops.projection, T[:, :3, 3] - hops.T_start_end[:, :3, 3])
    share = np.linalg.norm(shift, axis=1) / np.maximum(metres, 1e-9)
    return np.asarray(100.0 * np.minimum(np.hypot(share, rotation_angle(T_difference)), 1.0))


def _mean(errors: NDArray[np.float64]) -> float:
    """Mean of most of the errors: registrations fail, too, now and then; NaN if there are few."""
    known = np.sort(errors[np.isfinite(errors)])
    most = known[: round(TRUSTED * len(known))]
    return float(most.mean()) if len(known) >= FEWEST_HOPS else np.nan


def diagnose_reference(
    reference: Trajectory,
    stamps: NDArray[np.int64],
    hops: Hops,
    place: Poses | None = None,
    mends: Mends = _OF_STUDY,
) -> Finding | None:
    """Why a reference contradicts measured motions; None if it does not, or nobody can tell.

    The stamps of the scans are of shape (n_scans,). `place` is the LiDAR's pose in the frame of the
    poses that were given, of shape (4, 4), as the study states it; by default the identity.
    """
    errors = mismatch(reference.at(stamps), hops)
    before = _mean(errors)
    if np.isnan(before) or before < SUSPICIOUS:
        return None
    T_given_sensor = np.eye(4) if place is None else place
    given = reference.T_world_sensor @ invert(T_given_sensor)
    turned = rotation_angle(invert(given[:1]) @ given).max()
    if turned < 1e-6 and rotation_angle(hops.T_start_end).max() > np.radians(2.0):
        return _cause("without orientation (all are alike)", mends.unturned, before)

    def at_scans(T_world_given: Poses) -> Poses:
        T = T_world_given @ T_given_sensor
        return Trajectory(reference.stamps, T, reference.max_gap).at(stamps)

    T_world_body = at_scans(given) @ invert(T_given_sensor)
    candidates = [
        *(c._replace(T_world_sensor=at_scans(c.T_world_sensor)) for c in _conventions(given)),
        *_far_apart(reference, stamps, mends),
        *_clock(reference, stamps, hops, mends),
        *_scales(T_world_body, hops, T_given_sensor, mends),
        *_places(T_world_body, hops, mends),
    ]
    return _likeliest(candidates, hops, errors)


def diagnose_odometry(T_odom_sensor: Poses, hops: Hops) -> Finding | None:
    """Why an odometry's poses, of shape (n_scans, 4, 4), contradict measured motions; else None."""
    errors = mismatch(T_odom_sensor, hops)
    before = _mean(errors)
    if np.isnan(before) or before < SUSPICIOUS:
        return None
    known = np.isfinite(T_odom_sensor).all(axis=(1, 2), keepdims=True)
    safe = np.where(known, T_odom_sensor, np.eye(4))
    candidates = [
        _Candidate(
            "like increments from scan to scan",
            "let the odometry return the pose of each scan in the frame of the first one",
            np.array([*accumulate(safe, np.matmul)]),
        ),
        *_conventions(T_odom_sensor),
        *_scales(T_odom_sensor, hops, np.eye(4), _OF_ODOMETRY),
        *_places(T_odom_sensor, hops, _OF_ODOMETRY),
    ]
    # What is left may be the odometry's own error.
    return _likeliest([c._replace(most=EXPLAINED) for c in candidates], hops, errors)


def _likeliest(
    candidates: Iterable[_Candidate], hops: Hops, contradicting: NDArray[np.float64]
) -> Finding | None:
    """What leaves nearly as little as the best candidate; on a straight way, two may fit alike."""
    before = _mean(contradicting)

    def after(errors: NDArray[np.float64]) -> float:
        # Where a candidate knows no pose, it explains nothing: the same motions are compared.
        same = _mean(np.where(np.isnan(errors), np.nan, contradicting))
        return _mean(errors) * before / max(same, 1e-9)

    left = [(c, after(mismatch(c.T_world_sensor, hops))) for c in candidates]
    left = [(c, rest) for c, rest in left if rest <= min(c.most * before, LEFT)]
    if not left:
        return None
    least = min(rest for _, rest in left)
    # The last one, with the most freedom, fits whatever others fit, and noise, too.
    most = max(1.25 * least, 0.1 * before)
    fit = [(c, rest) for c, rest in left if rest <= most]
    fit = fit[:-1] or fit
    what = ", or ".join(candidate.what for candidate, _ in fit[:2])
    mend = ", or ".join(candidate.mend for candidate, _ in fit[:2])
    return _cause(what, mend, before, fit[0][1])


def _conventions(T: Poses) -> Iterator[_Candidate]:
    """Poses as they would be if the file, or the odometry, wrote them by another convention."""
    known = np.isfinite(T[:, 0, 0])
    safe = np.where(np.isfinite(T), T, np.eye(4))
    in_order = from_quaternions(safe[:, :3, 3], to_quaternions(safe)[:, [1, 2, 3, 0]])
    turned_back = safe.copy()
    turned_back[:, :3, :3] = np.swapaxes(safe[:, :3, :3], 1, 2)
    for what, mend, T_right in (
        ("as if their quaternions began with w", "write the quaternions as qx qy qz qw", in_order),
        ("inverted", "write the poses of the LiDAR in the world", invert(safe)),
        ("as if their rotations were transposed", "write a rotation's rows as rows", turned_back),
    ):
        T_right[~known] = np.nan
        yield _Candidate(what, mend, T_right)


def _far_apart(
    reference: Trajectory, stamps: NDArray[np.int64], mends: Mends
) -> Iterator[_Candidate]:
    """Poses too rare to go straight from one to the next: on a smooth way through them."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import RotationSpline

    every = 1e-9 * float(np.median(np.diff(reference.stamps))) if len(reference) > 1 else 0.0
    if every < FAR_APART:
        return
    T = reference.at(stamps)
    known = np.isfinite(T[:, 0, 0])
    seconds, at = (1e-9 * (some - stamps[0]) for some in (reference.stamps, stamps[known]))
    R = Rotation.from_matrix(reference.T_world_sensor[:, :3, :3])
    T[known, :3, :3] = RotationSpline(seconds, R)(at).as_matrix()
    T[known, :3, 3] = CubicSpline(seconds, reference.T_world_sensor[:, :3, 3])(at)
    what = f"too rare: one every {every:.2g} s, and a straight way for the scans in between"
    yield _Candidate(what, mends.rare, T, EXPLAINED)


def _clock(
    reference: Trajectory, stamps: NDArray[np.int64], hops: Hops, mends: Mends
) -> Iterator[_Candidate]:
    """The reference by another clock, found by how fast both turn and move."""
    turned, moved = _turned_moved(hops.T_start_end)
    seconds = 1e-9 * (stamps[hops.end] - stamps[hops.start])
    ends = np.concatenate([stamps[hops.start], stamps[hops.end]])

    def shifted(offset: float, at: NDArray[np.int64]) -> Poses:
        return reference.at(at - round(offset * 1e9))

    def unlike(offset: float) -> float:
        start, end = np.split(shifted(offset, ends), 2)
        other_turned, other_moved = _turned_moved(invert(start) @ end)
        shares = np.hypot(other_turned - turned, (other_moved - moved) / np.maximum(moved, 1e-9))
        known = np.isfinite(shares)
        # Where half of it is unknown, an offset explains nothing.
        return float(np.minimum(shares[known], 1.0).mean()) if known.mean() > 0.5 else np.inf

    step = float(np.clip(0.2 * np.median(seconds), 0.05, 0.5))
    offsets = np.arange(-CLOCK_OFFSET, CLOCK_OFFSET + step / 2, step)
    costs = np.array([unlike(offset) for offset in offsets])
    if not np.isfinite(costs).any():
        return

    def left(offset: float) -> float:
        error = _mean(mismatch(shifted(offset, stamps), hops))
        return 100.0 if np.isnan(error) else error

    rough = float(offsets[costs.argmin()])
    bounds, options = (rough - step, rough + step), {"xatol": 1e-3}
    best = float(minimize_scalar(left, bounds=bounds, method="bounded", options=options).x)
    if abs(best) < SAME_CLOCK:
        return
    mend = mends.clock.format(best)
    yield _Candidate("like those of another clock", mend, shifted(best, stamps))


def _turned_moved(T: Poses) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Radians and metres of motions, which no frame changes much."""
    return rotation_angle(T), np.linalg.norm(T[:, :3, 3], axis=1)


def _scales(
    T_world_body: Poses, hops: Hops, T_body_sensor: Poses, mends: Mends
) -> Iterator[_Candidate]:
    """Poses in other units, or whose ways or turns are too long, or with a drift of their turns."""
    known = np.flatnonzero(np.isfinite(T_world_body[:, 0, 0]))
    there = np.isfinite(T_world_body[hops.start, 0, 0] + T_world_body[hops.end, 0, 0])
    if there.sum() < FEWEST_HOPS:
        return
    start, end, measured = hops.start[there], hops.end[there], hops.T_start_end[there]
    right, far = _turned_moved(measured)
    T = invert(T_world_body[start]) @ T_world_body[end]
    turned, turning = _turned_moved(T)[0], right > TURNED
    turn = float(np.median(turned[turning] / right[turning])) if turning.any() else 1.0
    apart = _rotation_vectors(T) - _rotation_vectors(measured)
    rate = np.median(apart / (end - start)[:, None], axis=0)  # radians a scan

    def turning_less(share: float, by: NDArray[np.float64]) -> Poses:
        """The poses if they turned less by a share, and by some radians a scan."""
        moved = steps(T_world_body[known])
        less = share * _rotation_vectors(moved) + by * np.diff(known)[:, None]
        half = np.tile(np.eye(4), (len(less), 1, 1))
        half[:, :3, :3] = Rotation.from_rotvec(-0.5 * less).as_matrix()
        found = T_world_body.copy()
        found[known] = [*accumulate([T_world_body[known[0]], *(half @ moved @ half)], np.matmul)]
        return found

    causes = [("", T_world_body)]
    if turn > 0.0 and abs(turn - 1.0) > SAME:
        what = f"turned {turn:.3g} times as far as the scans"
        causes.append((what, turning_less(1.0 - 1.0 / turn, np.zeros(3))))
    if np.linalg.norm(rate) * np.median(end - start) > SAME:
        what = f"turned by {np.degrees(np.linalg.norm(rate)):.2g} degrees too much with every scan"
        causes.append((what, turning_less(0.0, rate)))
    for what, poses in causes:
        if what:
            yield _Candidate(what, mends.own, poses @ T_body_sensor, EXPLAINED)
        way = _turned_moved(invert(poses[start]) @ poses[end])[1]
        scale = float(np.median(way / np.maximum(far, 1e-9)))
        if scale > 0.0 and abs(scale - 1.0) > SAME:
            scaled = poses.copy()
            scaled[:, :3, 3] /= scale
            said = f"{what}{', and ' * bool(what)}{scale:.4g} times as long as the scans' way"
            found = _Candidate(said, mends.own, scaled @ T_body_sensor, EXPLAINED)
            if not what and np.abs(np.abs(np.log(scale)) - np.log(UNITS)).min() < UNLIKE:
                found = found._replace(mend="write the positions in metres", most=SET_RIGHT)
            yield found


def _rotation_vectors(T: Poses) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_matrix(T[:, :3, :3]).as_rotvec())


def _places(T_world_body: Poses, hops: Hops, mends: Mends) -> Iterator[_Candidate]:
    """The poses of another body of the same platform."""
    T = invert(T_world_body[hops.start]) @ T_world_body[hops.end]
    known = np.isfinite(T).all(axis=(1, 2))
    T, measured = T[known], hops.T_start_end[known]
    if len(T) < FEWEST_HOPS:
        return
    turned, lever = _rotation(T, measured), _lever(T, measured, np.eye(3))
    turned_too, both = turned, lever
    for _ in range(5):  # each tells the other better
        both = _lever(T, measured, turned_too)
        beside = T.copy()
        beside[:, :3, 3] += (T[:, :3, :3] - np.eye(3)) @ both
        turned_too = _rotation(beside, measured)
    for R, t, what in (
        (np.eye(3), lever, "like those of another body, a lever arm away"),
        (turned, np.zeros(3), "like those of other axes"),
        (turned_too, both, "like those of another body, with other axes"),
    ):
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = R, t
        if (place == np.eye(4)).all():
            continue
        numbers = ", ".join(
            f"{value + 0.0:.4g}"
            for value in (*t.round(3), *to_quaternions(place[None])[0].round(4))
        )
        mend = mends.place.format(numbers, numbers.replace(",", ""))
        yield _Candidate(what, mend, T_world_body @ place)


def _rotation(T: Poses, measured: Poses) -> NDArray[np.float64]:
    """Rotation of shape (3, 3) from the measured frame to that of the poses, by all motions."""
    to, of = (np.concatenate([m[:, :3, 3], 10.0 * _rotation_vectors(m)]) for m in (T, measured))
    return nearest_rotation(of, to)


def _lever(T: Poses, measured: Poses, R_body_sensor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position of shape (3,) of the sensor in the body, as far as turns show it."""
    # (R - 1) t = R_body_sensor t_measured - t_body
    A = T[:, :3, :3] - np.eye(3)
    b = np.einsum("ij,nj->ni", R_body_sensor, measured[:, :3, 3]) - T[:, :3, 3]
    # Along the axis of nearly all turns, as the vertical one of a car, they show nothing.
    values, axes = np.linalg.eigh(np.einsum("nij,nik->jk", A, A) / len(A))
    A = A @ axes[:, values > TURNED**2]
    weights = np.ones(len(T))
    t = np.zeros(A.shape[2])
    for _ in range(10 if A.shape[2] else 0):
        t = np.linalg.lstsq(
            (weights[:, None, None] * A).reshape(len(b) * 3, -1), (weights[:, None] * b).ravel()
        )[0]
        residuals = np.linalg.norm(A @ t - b, axis=1)
        weights = 1.0 / np.sqrt(np.maximum(residuals, 1e-2 + np.median(residuals)))
    return np.asarray(axes[:, values > TURNED**2] @ t)


def contradictions(
    scans: Recording,
    T_odom_sensor: Poses,
    error: float,
    place: Poses | None,
    given: bool,
    seen: Collection[int] | None = None,
) -> Iterator[Finding]:
    """What scans say where a reference and an odometry differ by `error` percent, if that is large.

    Segments on which the scans stand still while the reference moves come first. The odometry's
    poses, of shape (n_scans, 4, 4), owe nothing to the reference, and are those of the scans with
    the stamps `seen`, or of all. `place` is as in `diagnose_reference`; `given` says whether the
    reference came with the recording.
    """
    stamps: list[int] = []
    spans: list[int] = []
    content, carried = Content(), Carried()
    reference = scans.reference() if given else None

    def read() -> Iterator[Scan]:
        for scan in (scan for scan in scans if seen is None or scan.stamp in seen):
            stamps.append(scan.stamp)
            spans.append(scan.span)
            content.see(scan)
            if reference is not None:
                carried.see(scan, pose_at(reference, scan.stamp))
            yield scan

    passing = read()
    hops = measured_motions(passing, len(T_odom_sensor))
    deque(passing, 0)
    at = np.array(stamps, np.int64)
    found = carried.findings(begin := begin_of(scans, at))
    yield from found
    if not error > SUSPICIOUS:
        return
    if reference is not None:
        reference = without(reference, found, begin)
        yield from content.of_place(reference, not len(hops.start))
        T_ref_sensor = reference.at(at)
        wrong, others = (mismatch(T, hops) for T in (T_ref_sensor, T_odom_sensor))
        if (cause := diagnose_reference(reference, at, hops, place)) is not None:
            yield cause.below((CONTRADICTS,))
        elif _surely_worse(wrong, others):
            yield _unexplained(_mean(wrong), _mean(others))
        elif (cause := _of_ends(reference, at, np.median(spans), T_odom_sensor)) is not None:
            yield cause
    if (cause := diagnose_odometry(T_odom_sensor, hops)) is not None:
        yield cause.below(("the odometry's poses contradict the scans",))


def _unexplained(wrong: float, others: float) -> Finding:
    """That a reference has so many percent where an odometry has others."""
    why = UNEXPLAINED * (wrong > SUSPICIOUS)
    what = (
        f"over some metres they differ by {wrong:.3g} %, by registrations of scans, and the "
        f"odometry by {others:.3g} %{why}; sets that differ by less cannot be told apart"
    )
    mend = (
        "use `reference: estimated` or a longer sub_trajectory, or check its file or topic "
        "(`reference`), the LiDAR's pose in its frame (`extrinsic`) and its clock (`clock_offset`)"
    )
    return Finding((CONTRADICTS,), what, mend, of="reference")


def _of_ends(
    reference: Trajectory,
    stamps: NDArray[np.int64],
    span: float,
    T_odom_sensor: Poses,
    mends: Mends = _OF_STUDY,
) -> Finding | None:
    """Whether an odometry's poses fit the reference best about one scan later than their stamps."""
    shares = (0.0, 1.0, -1.0, -0.5, 0.5, 1.5, 2.0)
    at = [reference.at(stamps + round(share * span)) for share in shares]
    errors = [_mean(sub_trajectory_rte(T, T_odom_sensor, END_LENGTH)) for T in at]
    if not span > 0 or errors[1] > min(ENDS * errors[0], *errors[2:]) or np.isnan(errors).any():
        return None
    what = (
        f"they fit the reference best {1e-9 * span:.2g} s, about one scan, after their stamps "
        f"({errors[1]:.3g} % over {END_LENGTH:g} m instead of {errors[0]:.3g} %)"
    )
    return Finding(("the odometry's poses",), what, mends.ends, of="reference")


_APART = 50.0  # percent by which most motions of another drive differ, or of a lost odometry
_EVENLY = 100  # motions of a reference that say what other poses are


def diagnose_trajectory(
    trajectory: Trajectory,
    judge: Trajectory,
    stamps: NDArray[np.int64],
    span: float,
    place: Poses | None = None,
) -> Finding | None:
    """What poses are that a trusted reference contradicts; None if it does not, or nobody can tell.

    The stamps, of shape (n,), are where both are compared; `span` is how many nanoseconds a scan
    takes, and `place` is as in `diagnose_reference`.
    """
    T_ref_sensor, T_odom_sensor = judge.at(stamps), trajectory.at(stamps)
    ends = window_ends(T_ref_sensor, _METRES)
    starts = np.flatnonzero(ends >= 0)
    starts = starts[:: max(1, len(starts) // _EVENLY)]
    T = invert(T_ref_sensor[starts]) @ T_ref_sensor[ends[starts]]
    hops = Hops(starts, ends[starts], T, np.tile(np.eye(3), (len(starts), 1, 1)))
    cause = diagnose_reference(trajectory, stamps, hops, place, _OPTIONS)
    ends_fit = _of_ends(judge, stamps, span, T_odom_sensor, _OPTIONS)
    if ends_fit is not None and (cause is None or "clock" in cause.what):
        return ends_fit._replace(where=())
    if cause is not None:
        what = cause.what.replace(", by registrations of scans", " from the reference")
        return cause._replace(what=what)
    if (differ := _mean(mismatch(T_odom_sensor, hops))) > _APART:
        what = f"over some metres they differ by {differ:.0f} % from the reference"
        return Finding((), what, "they are of another drive, or lost nearly everywhere")
    return None


def _surely_worse(wrong: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
    """Whether a reference differs more than an odometry, by the 95 % interval of the mean."""
    # What a registration itself is wrong by, both share.
    more = (wrong - others)[np.isfinite(wrong + others)]
    if len(more) < FEWEST_HOPS or not _mean(wrong) > max(NOISY, 2.0 * _mean(others)):
        return False
    return bool(more.mean() > 2.0 * more.std(ddof=1) / len(more) ** 0.5)
