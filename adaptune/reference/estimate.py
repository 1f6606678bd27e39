"""Estimate a reference from a recording alone.

Several odometries run side by side; their consensus gives the motion from scan to scan. Scans are
also registered directly to scans some metres before. A pose graph brings both to agree.
"""

import os
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptune._system.machine import pin
from adaptune.bank.members import LEVER
from adaptune.errors import import_extra
from adaptune.geometry import Poses, invert, mean_motion, rectify, rotation_angle, steps
from adaptune.recording.config import SequenceConfig
from adaptune.recording.inspect import Inspection
from adaptune.recording.scan import Recording, Scan
from adaptune.reference.estimated import EstimatedReference, EstimateError, Registrations
from adaptune.reference.graph import (
    HALVES,
    LENGTHS,
    SPACING,
    Edge,
    Guess,
    Pass,
    closed,
    loops,
    optimised,
    pass_over,
)

VERSION = 1  # counts changes after which the same recording has another estimate
SHORTEST = 10.0  # metres; on a shorter path, nothing is known about any odometry
FEWEST = 2  # registrations that must span a motion, so that it can be trusted
MOST_UNKNOWN = 0.5  # share of the scans whose pose may be unknown
_AGREES = (0.1, 0.02)
"""A registration agrees with the graph within so many metres and this share of its length."""
_LITTLE_IN_COMMON = 0.8 * LENGTHS[-1]  # metres from which on scans may have too little in common
_HALF_WEIGHT = 0.1
"""Metres within which a member's motion from scan to scan counts for a half of the reference."""

Advance = Callable[[int, int], None]
"""Called with how many scans are done, and about how many there are."""


def estimate_reference(scans: Recording, advance: Advance = lambda *_: None) -> EstimatedReference:
    """Estimate the reference of a recording; its own is not used.

    `advance` is called after every scan; the pose graphs take about a twentieth of the time, after
    that. There is an EstimateError if the robot hardly moves, or nothing can be registered.
    """
    import_extra("reference", "gtsam")
    n = scans.n_messages
    found = pass_over(scans, lambda done: advance(done, round(1.05 * max(n, done))))
    # GTSAM's sums may depend on its threads: only on one core do results repeat bit by bit.
    with pin(os.getpid()):
        return estimated(scans.name, found, scans)


def estimated(name: str, found: Pass, scans: Iterable[Scan] = ()) -> EstimatedReference:
    """The reference that follows from a pass over a recording, see `estimate_reference`.

    The scans are read again if the path comes by again.
    """
    _check(name, found)
    T_odom_sensor, edges = _revised(found)
    T = optimised(T_odom_sensor, edges)
    again = loops(T, np.unique([edge.end for edge in edges]))
    by_loops = closed(scans, again, T) if again else []
    if by_loops:
        T = optimised(T_odom_sensor, [*edges, *by_loops], T)
    registrations = _judged(found.guesses, edges, T)
    reference = EstimatedReference(
        found.stamps,
        T,
        _trusted(T, registrations, edges),
        _halves(found, [*edges, *by_loops], T),
        registrations,
    )
    if (share := reference.unknown_share()) > MOST_UNKNOWN:
        raise EstimateError(
            f"{name}: {100 * share:.0f} % of its scans cannot be registered to scans some metres "
            f"before, so no reference can be estimated: the scene may be too bare (open water, a "
            f"long corridor), or too much may move in it"
        )
    return reference


def _check(name: str, found: Pass) -> None:
    way = _way(found.T_odom_sensor[:, :3, 3]) if len(found.stamps) else 0.0
    if way < SHORTEST:
        raise EstimateError(
            f"{name}: by its scans, the robot comes {way:.1f} m far, and a reference needs "
            f"{SHORTEST:g} m: name another part, or record a longer drive, in a place that does "
            f"not look the same all along; where the clouds are in the frame of a map, name the "
            f"topic of the sensor's driver"
        )


def _way(positions: NDArray[np.float64]) -> float:
    """Metres along positions of shape (n, 3); jitter of a robot that stands adds nothing."""
    way, last = 0.0, positions[0]
    for position in positions:
        if (metres := float(np.linalg.norm(position - last))) >= SPACING[0]:
            way, last = way + metres, position
    return way


def _revised(found: Pass) -> tuple[Poses, list[Edge]]:
    """The consensus, replaced where registrations confirm only a member; the registrations used."""
    edges = _edges(found.guesses, -1)
    motions = steps(found.T_odom_sensor)
    weak = _support(len(found.stamps), edges) < FEWEST
    of_members = [_edges(found.guesses, m) for m in range(found.T_previous_current.shape[1])]
    # First number, and number after the last one, of every run of weak motions.
    runs = np.flatnonzero(np.diff(weak, prepend=False, append=False)).reshape(-1, 2)
    for first, stop in runs.tolist():
        near = [
            [e for e in member_edges if e.start < stop and e.end > first]
            for member_edges in of_members
        ]
        best = max(range(len(near)), key=lambda m: len(near[m]))
        supported = _support(len(found.stamps), near[best])[first:stop]
        theirs = found.T_previous_current[first + 1 : stop + 1, best]
        if supported.min() < FEWEST or not np.isfinite(theirs).all():
            continue
        motions[first:stop] = theirs
        edges += near[best]
    # One that spans two such runs was found twice.
    once = {(edge.start, edge.end): edge for edge in edges}
    return _chained(found.T_odom_sensor[0], motions), list(once.values())


def _edges(guesses: Iterable[Guess], member: int) -> list[Edge]:
    """Registrations that began at the motion of a member; of the consensus for -1."""
    return [
        Edge(guess.start, guess.end, guess.hop)
        for guess in guesses
        if guess.member == member and guess.hop is not None
    ]


def _support(n: int, edges: Sequence[Edge]) -> NDArray[np.intp]:
    """How many registrations span the motion from each of n scans to the next."""
    return _spanning(n, [edge.start for edge in edges], [edge.end for edge in edges])


def _spanning(n: int, start: ArrayLike, end: ArrayLike) -> NDArray[np.intp]:
    """How many of the spans from `start` to `end` hold each of n - 1 motions."""
    changes = np.zeros(n, np.intp)
    np.add.at(changes, np.asarray(start, np.intp), 1)
    np.add.at(changes, np.asarray(end, np.intp), -1)
    return np.asarray(np.cumsum(changes)[:-1])


def _chained(first: Poses, motions: Poses) -> Poses:
    """Poses of shape (n, 4, 4) from the first one and n - 1 motions."""
    poses = [first]
    for T in motions:
        poses.append(rectify(poses[-1] @ T))
    return np.array(poses)


def _judged(guesses: Sequence[Guess], edges: Sequence[Edge], T: Poses) -> Registrations:
    """Which registrations the graph agrees with; one that failed is rejected, too."""
    by_pair = {(edge.start, edge.end): edge.hop for edge in edges}
    pairs = list(dict.fromkeys((guess.start, guess.end) for guess in guesses))
    residual, accepted = np.full(len(pairs), np.nan), np.zeros(len(pairs), bool)
    for i, pair in enumerate(pairs):
        if (hop := by_pair.get(pair)) is None:
            continue
        start, end = pair
        way = (invert(T[start]) @ T[end])[:3, 3]
        residual[i] = np.linalg.norm(hop.projection @ (hop.T_start_end[:3, 3] - way))
        metres, share = _AGREES
        accepted[i] = residual[i] <= metres + share * np.linalg.norm(way)
    starts, ends = np.array(pairs, np.intp).reshape(-1, 2).T
    return Registrations(starts, ends, accepted, residual)


def _trusted(
    T_world_sensor: Poses, found: Registrations, edges: Sequence[Edge]
) -> NDArray[np.bool_]:
    """Which motions from scan to scan can be trusted, of shape (n - 1,).

    Enough registrations must confirm a motion, in every direction, and no more speak against it:
    those that differ, and those over short ways that fail.
    """
    n = len(T_world_sensor)
    way = (invert(T_world_sensor[found.start]) @ T_world_sensor[found.end])[:, :3, 3]
    short = np.linalg.norm(way, axis=1) < _LITTLE_IN_COMMON
    against = ~found.accepted & (short | np.isfinite(found.residual))
    confirmed, doubted = (
        _spanning(n, found.start[which], found.end[which]) for which in (found.accepted, against)
    )
    known = _in_every_direction(T_world_sensor, found, edges) >= FEWEST - 1e-3
    return known & ((doubted < FEWEST) | (confirmed >= doubted))


def _in_every_direction(
    T_world_sensor: Poses, found: Registrations, edges: Sequence[Edge]
) -> NDArray[np.float64]:
    """How many registrations confirm each motion where it is least known, as along a corridor."""
    known = {(edge.start, edge.end): edge.hop.projection for edge in edges}
    changes = np.zeros((len(T_world_sensor), 3, 3))
    for start, end in zip(found.start[found.accepted], found.end[found.accepted], strict=True):
        R = T_world_sensor[start, :3, :3]
        projection = R @ known[start, end] @ R.T
        changes[start] += projection
        changes[end] -= projection
    return np.asarray(np.linalg.eigvalsh(np.cumsum(changes, axis=0)[:-1])[:, 0])


def _halves(found: Pass, edges: Sequence[Edge], T_world_sensor: Poses) -> Poses:
    """The reference twice, each from half of the pool and half of the scans: (2, n, 4, 4)."""
    ends = {end: i % 2 for i, end in enumerate(sorted({edge.end for edge in edges}))}
    halves = []
    for half, members in enumerate(HALVES):
        T = _chained(T_world_sensor[0], _steps_of(found, T_world_sensor, members))
        half_edges = [edge for edge in edges if ends[edge.end] == half]
        halves.append(optimised(T, half_edges, T_world_sensor))
    return np.array(halves)


def _steps_of(found: Pass, T_world_sensor: Poses, members: Sequence[int]) -> Poses:
    """Mean motions of some members; those far from the reference count only where none is near."""
    whole = steps(T_world_sensor)[:, None]
    theirs = found.T_previous_current[1:, list(members)]
    distance = np.linalg.norm((theirs - whole)[..., :3, 3], axis=-1)
    distance += LEVER * rotation_angle(invert(whole) @ theirs)
    near = distance <= _HALF_WEIGHT
    near |= ~near.any(axis=1, keepdims=True)
    theirs = np.where(np.isfinite(distance)[..., None, None], theirs, whole)
    return mean_motion(theirs, near.astype(np.float64))


def recording_config(
    found: Inspection, points: str | None = None, reference: str | None = None
) -> SequenceConfig:
    """The sequence that an inspected recording is, with the topics or file that the user chose.

    These are written to `found`. There is an `EstimateError` if there are no scans.
    """
    if not found.name:
        raise EstimateError(f"{found.path}: is a file of poses; give a recording of scans")
    if points is None and (lacking := found.missing["online"]):
        raise EstimateError(f"{found.path}: lacks {' and '.join(lacking)}; see `adaptune inspect`")
    chosen = {"points": points, "reference": reference}
    found.given |= {key: value for key, value in chosen.items() if value is not None}
    return found.config()
