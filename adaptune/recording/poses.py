"""Poses that move as no robot moves: they jump, or one is sent again while the robot moves on."""

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.errors import Finding
from adaptune.trajectory import Trajectory

FASTEST = 100.0
"""Metres per second. No platform that carries a LiDAR is faster."""
_JUMP = 0.2
"""Metres; a radian counts as one. Smaller steps than that are noise."""
_ACCELERATION = 10.0  # metres per second squared of a robot, or of the hand that holds a sensor
_STAMPS = 0.5, 0.05  # share of a usual step, and seconds, by which stamps may be wrong
_NOISE_TIMES = 8.0  # times the median difference from neighbours: no noise is as large
_MANY = 0.1  # share of the poses; where more go to and fro, no segment between is right
_HELD, _AS_FAST = 0.02, 0.6
"""Metres that a robot moves at least while its pose is repeated, and the share of its usual speed
at which the next pose makes up for it."""
_POSE_PERIOD = 40_000_000  # nanoseconds; of poses that follow each other faster, some are enough
_AROUND = 5  # steps before, and after, that say how the robot moves
_ANGLES = ("degrees", 180.0, 1.11e5), ("radians", np.pi, 6.37e6)
"""Units of longitude and latitude, the largest of them, and metres of one on the ground."""
_SAID = 3  # segments that are told one by one


def sound(
    reference: Trajectory,
    begin: int | None = None,
    hole: float = 0.0,
    name: str = "the reference",
) -> tuple[Trajectory, list[Finding]]:
    """The poses without those that no robot can have had, and what was wrong with them.

    A pose that is repeated while the robot moves is left out. At a jump a gap of more than
    `max_gap`, and of `hole` seconds at least, is left: no sub-trajectory crosses it. Seconds of the
    findings count from `begin`, in nanoseconds, by default from the first pose; the text
    calls the poses `name`.
    """
    begin = int(reference.stamps[0]) if begin is None else begin
    lost = _repeated(reference)
    found = _in_words(f"{name} repeats a pose while the robot moves", reference, lost, begin)
    reference = _without(reference, lost)
    if metres := _to_and_fro(reference):
        what = f"{name} goes to and fro by {metres:.2g} m from pose to pose"
        mend = (
            "it is noise, or two nodes publish it by turns: name the poses of one of them, or use "
            "`reference: estimated`"
        )
        return reference, [*found, Finding((), what, mend, of="reference")]
    # A longer `max_gap` than any gap needs would cost more poses than the jump is worth.
    seconds = np.diff(reference.stamps) * 1e-9
    gap = min(reference.max_gap, float(seconds[seconds <= reference.max_gap].max(initial=1.0)))
    jumps, metres = _jumps(reference)
    lost = np.zeros(len(reference), bool)
    for start, end in jumps.tolist():
        after = max(end, start + round(max(gap, hole) * 1e9) + 1)
        lost |= (reference.stamps > start) & (reference.stamps < after)
    found += _in_words(f"{name} jumps by up to {metres:.3g} m (or radians)", reference, lost, begin)
    return _without(reference, lost, gap if lost.any() else None), found


def in_angles(reference: Trajectory) -> Finding | None:
    """What is said of positions that are longitude and latitude; None of those in metres.

    As metres, such a robot would creep by micrometres, far from the origin and without noise.
    """
    at = reference.T_world_sensor[:, :2, 3]
    ways = np.linalg.norm(np.diff(at, axis=0), axis=1)
    seconds = np.maximum(np.diff(reference.stamps) * 1e-9, 1e-3)
    far, usual = np.linalg.norm(at - at[0], axis=1).max(), np.median(ways)
    for unit, most, metres in _ANGLES:
        angles = np.abs(at).max() <= most and np.linalg.norm(at[0]) > most / 180.0
        moves = max(5.0 * usual, 5.0 / metres) < far < FASTEST * seconds.sum() / metres
        if angles and moves and np.quantile(ways / seconds, 0.9) * metres < FASTEST:
            what = f"the reference's positions are {unit} of longitude and latitude, not metres"
            mend = "convert them to metres, as of UTM, or use `reference: estimated`"
            return Finding((), what, mend, of="reference", lacks="a reference in metres")
    return None


def _without(
    reference: Trajectory, lost: NDArray[np.bool_], gap: float | None = None
) -> Trajectory:
    gap = reference.max_gap if gap is None else gap
    return Trajectory(reference.stamps[~lost], reference.T_world_sensor[~lost], gap)


def _in_words(
    what: str, reference: Trajectory, lost: NDArray[np.bool_], begin: int
) -> list[Finding]:
    """A finding for each run of poses that are lost, or one for all where there are many."""
    edges = np.flatnonzero(np.diff(lost, prepend=False, append=False)).reshape(-1, 2)
    spans = reference.stamps[(edges - (1, 0)).clip(max=len(reference) - 1)]
    if len(spans) > _SAID:
        what, spans = f"{what} ({len(spans)} times)", np.array([[spans[0, 0], spans[-1, 1]]])
    mend = "these poses are left out"
    seconds = ((spans - begin) * 1e-9).tolist()
    return [Finding((), what, mend, (start, end), of="reference") for start, end in seconds]


def _repeated(reference: Trajectory) -> NDArray[np.bool_]:
    """Which poses repeat the one before while the robot moves, of shape (n,).

    Where it stands, poses that are free of noise repeat, too. Those count whose next pose lies as
    far away as if the robot had moved on.
    """
    stamps, T = reference.stamps, reference.T_world_sensor
    again = np.append(False, (T[1:] == T[:-1]).all(axis=(1, 2)))
    first = np.flatnonzero(~again)
    if not again.any() or len(first) < 3:
        return np.zeros(len(stamps), bool)
    at, poses = stamps[first], T[first]
    start, end = np.arange(len(first) - 1), np.arange(1, len(first))

    def speed(one: NDArray[np.intp], other: NDArray[np.intp]) -> NDArray[np.float64]:
        motion = geometry.invert(poses[one]) @ poses[other]
        metres = np.linalg.norm(motion[:, :3, 3], axis=1) + geometry.rotation_angle(motion)
        return np.asarray(metres / np.maximum((at[other] - at[one]) * 1e-9, 1e-3))

    # Over some poses: the noise of each would count for motion.
    before = np.minimum(np.searchsorted(at, at[start] - _AROUND * _POSE_PERIOD), start - 1).clip(0)
    after = np.maximum(np.searchsorted(at, at[end] + _AROUND * _POSE_PERIOD), end + 1)
    usual = np.maximum(speed(before, start), speed(end, after.clip(max=len(at) - 1)))
    seconds = (stamps[first[end] - 1] - at[start]) * 1e-9
    held = (usual * seconds > _HELD) & (speed(start, end) > _AS_FAST * usual)
    return np.asarray(again & np.append(held, False)[np.cumsum(~again) - 1])


def _to_and_fro(reference: Trajectory) -> float:
    """Metres by which poses lie to both sides of the way; 0 if few do."""
    steps = np.diff(reference.T_world_sensor[:, :3, 3], axis=0)
    turned = np.linalg.norm(steps[1:] - steps[:-1], axis=1)
    back = turned > np.maximum(2.0 * _JUMP, np.linalg.norm(steps[1:] + steps[:-1], axis=1))
    return float(np.median(turned[back])) / 2.0 if len(back) > 3 and back.mean() > _MANY else 0.0


def _jumps(reference: Trajectory) -> tuple[NDArray[np.int64], float]:
    """Stamps around steps that nothing explains, (n, 2), and how far the farthest leads."""
    from scipy.spatial.transform import Rotation

    _, some = np.unique((reference.stamps - reference.stamps[0]) // _POSE_PERIOD, return_index=True)
    if len(some) < 2:
        return np.empty((0, 2), np.int64), 0.0
    stamps, T = reference.stamps[some], geometry.steps(reference.T_world_sensor[some])
    seconds = np.maximum(np.diff(stamps) * 1e-9, 1e-3)
    steps = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_rotvec()])
    around = _around(steps / seconds[:, None])
    departure = np.linalg.norm(steps - around * seconds[:, None], axis=2).min(axis=0)
    speed = np.linalg.norm(around, axis=2).max(axis=0)
    share, late = _STAMPS
    explained = np.maximum(_ACCELERATION * seconds**2, speed * np.maximum(share * seconds, late))
    jumps = departure > np.maximum(
        explained, max(_JUMP, _NOISE_TIMES * float(np.median(departure)))
    )
    jumps |= np.linalg.norm(T[:, :3, 3], axis=1) > FASTEST * seconds
    far = np.linalg.norm(steps[jumps], axis=1).max(initial=0.0)
    return np.column_stack([stamps[:-1], stamps[1:]])[jumps], float(far)


def _around(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Medians of the values, of shape (n, k), before and after each one: (2, n, k)."""
    n, k = values.shape
    if n < _AROUND:
        return np.stack([values, values])
    padding = np.full((_AROUND, k), np.nan)
    padded = np.concatenate([padding, values, padding])
    windows = np.lib.stride_tricks.sliding_window_view(padded, _AROUND, axis=0)
    sides = np.stack([windows[:n], windows[_AROUND + 1 :]])
    # At the ends, where there are fewer, the other side stands for both.
    few = np.isfinite(sides[..., 0, :]).sum(axis=-1) < 3
    sides = np.where(few[..., None, None], sides[::-1], sides)
    return np.asarray(np.nanmedian(sides, axis=-1))
