"""Estimate the references of a study's sequences that have none."""

import logging
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from adaptune._system import manifest
from adaptune.errors import Finding
from adaptune.geometry import Poses, to_pose
from adaptune.odometry.content import package_version
from adaptune.recording import cache
from adaptune.recording.config import Fractions, SequenceConfig
from adaptune.recording.recording import RecordedSequence, wants_estimate
from adaptune.reference import estimate
from adaptune.reference.carried import may_be_carried
from adaptune.reference.diagnosis import SUSPICIOUS, contradictions
from adaptune.reference.estimated import EstimatedReference, EstimateError
from adaptune.reference.stored import Refusal, StoredEstimate, keep, kept, write_estimate
from adaptune.study.sequences import StudySequences

_OF_CHANGES = ("compensate", "imu")
"""Keys of a sequence on which its scans as they were recorded do not depend."""

_AS_RECORDED = {"compensate": None}
"""Registrations undo the motion within the scans that they need."""
_WHOLE = {"part": None}
_MOST = 0.5
"""Parts that are a larger share of a recording take theirs from that of the whole."""
_wholes: dict[str, EstimatedReference | str] = {}
"""Estimates of whole recordings that were made in this process, or why there is none."""
ESTIMATES = "references"
"""Folder of the cache that keeps estimates for other studies of the same recordings."""

_log = logging.getLogger(__name__)


def to_estimate(sequences: StudySequences, names: Iterable[str]) -> list[str]:
    """Those of the sequences whose reference is to be estimated: none is given, or it is asked for.

    A course has a reference of its own.
    """
    recordings = sequences.recordings
    return [
        name
        for name in dict.fromkeys(names)
        if name in recordings and wants_estimate(recordings[name])
    ]


def ensure_references(
    sequences: StudySequences,
    names: Iterable[str],
    length: float,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    required: bool = True,
) -> dict[str, str]:
    """Estimate the references that are to be estimated and are not yet, or of something else.

    An estimate is made from the scans as they were recorded, without the study's odometry.
    One that was refused is not tried again before something has changed. The study's folder keeps
    them as ``references/<sequence>.tum``. Their accuracy is told over `length` metres.

    Returns by its name why the reference of a sequence cannot be estimated; where it is
    `required`, there is an EstimateError.
    """
    refused = {}
    for name in to_estimate(sequences, names):
        try:
            _ensure(sequences, name, length, partial(progress, f"{name}, estimating its reference"))
        except EstimateError as error:
            if required:
                raise
            refused[name] = str(error)
    return refused


def _ensure(
    sequences: StudySequences, name: str, length: float, advance: Callable[[int, int], None]
) -> None:
    path = sequences.estimate_path(name)
    stored, refusal = StoredEstimate.read(path), Refusal.read(path)
    about, before = _about(sequences, name), stored or refusal
    changes = []
    if before is not None:
        changes = manifest.changes(before.about, about, sequences.sources(name))
    if changes:
        _log.info("%s: its reference is estimated again: %s", name, "; ".join(changes))
    elif stored is not None and path.exists():
        return
    if refusal is None or changes:
        found = _estimate(sequences, name, advance)
        if isinstance(found, EstimatedReference):
            stored = write_estimate(path, found, about)
            accuracy = _accuracy(stored, length)
            message = "%s: its reference is estimated, %.0f m; %s (%s)"
            _log.info(message, name, stored.metres, accuracy, path)
            return
        refusal = Refusal(about, found)
        refusal.write(path)
    raise EstimateError(f"{sequences.key(name)}: {refusal.refused}")


def _about(sequences: StudySequences, name: str) -> dict[str, Any]:
    """Everything that an estimated reference depends on, as plain data."""
    scans = sequences.identity(name)
    scans["sequences"][name] |= dict.fromkeys(_OF_CHANGES)
    config = sequences.unseen(name).model_copy(update=_AS_RECORDED)
    whole = {"from": "the whole"} if _is_one_of_parts(sequences, config) else {}
    return dict(manifest.plain({"estimator": estimate.VERSION} | whole | scans))


def _estimate(
    sequences: StudySequences, name: str, advance: Callable[[int, int], None]
) -> EstimatedReference | str:
    """The reference of a sequence, or why it cannot be estimated."""
    config = sequences.unseen(name).model_copy(update=_AS_RECORDED)
    if _is_one_of_parts(sequences, config):
        of_whole = config.model_copy(update=_WHOLE)
        if (whole := _wholes.get(_key(sequences, name, of_whole))) is None:
            whole = _estimated(sequences, name, of_whole, advance)
        within = RecordedSequence(config).holds
        if isinstance(whole, EstimatedReference) and (inside := within(whole.stamps)).any():
            found = whole.part(inside)
            if found.path() >= estimate.SHORTEST and found.unknown_share() < estimate.MOST_UNKNOWN:
                return found
    return _estimated(sequences, name, config, advance)


def _estimated(
    sequences: StudySequences,
    name: str,
    config: SequenceConfig,
    advance: Callable[[int, int], None],
) -> EstimatedReference | str:
    """The same of scans that are read in some way, unless the cache keeps it."""
    scans, key = RecordedSequence(config), _key(sequences, name, config)
    path = cache.folder() / ESTIMATES / f"{key}.npz"
    found: EstimatedReference | str | None = kept(path) if cache.cap() else None
    if found is not None:
        _log.info("%s: its reference was estimated before (%s)", name, path)
        with suppress(OSError):
            path.touch()  # what was used last is removed last
    else:
        try:
            found = estimate.estimate_reference(scans, advance)
            if cache.cap():
                keep(path, found)
                cache.make_room()
        except EstimateError as error:
            found = str(error) if scans.name in str(error) else f"{scans.name}: {error}"
    if config.part is None:
        _wholes[key] = found
    return found


def _key(sequences: StudySequences, name: str, config: SequenceConfig) -> str:
    """Digest of all that the estimated reference of a recording depends on, not of its name."""
    about = _about(sequences, name)
    scans = about["sequences"][name] | {"part": config.part}
    by = [about["estimator"], about["reader"], *map(package_version, ("small_gicp", "gtsam"))]
    return manifest.digest([*by, about["recording"][name], scans])


def _is_one_of_parts(sequences: StudySequences, config: SequenceConfig) -> bool:
    """Whether a sequence is one of several parts that are most of a recording."""
    if config.part is None or config.stride > 1:
        return False
    whole, parts = config.model_copy(update=_WHOLE), set[Fractions]()
    for one in sequences.recordings.values():
        if one.part is not None and one.model_copy(update=_AS_RECORDED | _WHOLE) == whole:
            parts.add(one.part)
    return len(parts) > 1 and sum(end - begin for begin, end in parts) > _MOST


def _accuracy(stored: StoredEstimate, length: float) -> str:
    """How accurate an estimated reference is over `length` metres, and for how many scans."""
    error = stored.error(length)
    own = "its own error is not known" if math.isnan(error) else f"its own error is {error:.2g} %"
    share = 100.0 * stored.unknown_share
    return f"{own} over {length:g} m, unknown for {share:.0f} % of the scans"


def estimates_of(sequences: StudySequences, names: Iterable[str]) -> dict[str, StoredEstimate]:
    """The estimated references of those of the sequences that have one, by their names."""
    found = {name: sequences.estimate(name) for name in dict.fromkeys(names)}
    return {name: stored for name, stored in found.items() if stored is not None}


def estimates_in_words(estimates: Mapping[str, StoredEstimate], length: float) -> list[str]:
    """A sentence about the sequences that an estimated reference judges, if there are any."""
    each = "; ".join(f"{name} ({_accuracy(stored, length)})" for name, stored in estimates.items())
    words = f"Judged by an estimated reference: {each}. Intervals do not include its error."
    return [words] if each else []


def contradictions_of(
    sequences: StudySequences,
    name: str,
    T_odom_sensor: Poses,
    error: float,
    seen: Collection[int] | None = None,
    T_ref_sensor: Poses | None = None,
) -> list[Finding]:
    """What the scans of a sequence say where its reference and an odometry disagree.

    For the parameters see `adaptune.reference.diagnosis.contradictions`; the reference's poses tell
    where it may move while the scans stand still.
    """
    config = sequences.config(name)
    if not error > SUSPICIOUS and (
        T_ref_sensor is None or not may_be_carried(T_ref_sensor, T_odom_sensor)
    ):
        return []
    scans = RecordedSequence(config.model_copy(update=_AS_RECORDED))
    given = sequences.estimate(name) is None
    place = None if config.extrinsic is None else to_pose(config.extrinsic)
    return list(contradictions(scans, T_odom_sensor, error, place, given, seen))
