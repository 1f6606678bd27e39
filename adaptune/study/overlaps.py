"""Recordings that a study trains on and tests on under two names."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from adaptune.sequence.config import SequenceConfig
from adaptune.sequence.fingerprint import MANY, fingerprint
from adaptune.sequence.opening import interval_of, sequence_files
from adaptune.study.config import StudyConfig
from adaptune.study.mistakes import Mistake

_NOTES = (".txt", ".yaml")
"""Files beside scans: two recordings may have the same."""


def overlaps(config: StudyConfig) -> Iterator[Mistake]:
    """Find test sequences that hold scans of a training sequence, by the content of their files.

    Files are read only where their sizes agree.
    """
    for i, test in enumerate(config.test):
        for training in config.training:
            if test != training and _overlap(config, test, training):
                message = (
                    f"{test!r} is the recording of the training sequence {training!r}, and proves "
                    f"nothing here; leave one of them out, or give both a `start` or a `stop` so "
                    f"that they share no scan"
                )
                yield Mistake(("test", i), message)


def _overlap(config: StudyConfig, one: str, other: str) -> bool:
    if one in config.courses and other in config.courses:
        return config.courses[one] == config.courses[other]
    a, b = config.sequences.get(one), config.sequences.get(other)
    return a is not None and b is not None and share_scans(a, b)


def share_scans(a: SequenceConfig, b: SequenceConfig) -> bool:
    """Whether two sequences hold the same scans, by the content of their files.

    Raises
    ------
    SequenceError
        If one of them cannot be opened.
    """
    return _same_files(a, b) and _same_time(a, b)


def _same_files(a: SequenceConfig, b: SequenceConfig) -> bool:
    if a.evalio is not None and a.evalio == b.evalio:
        return True
    mine, others = _scan_files(a), _scan_files(b)
    if set(mine) & set(others):
        return True
    if len(mine) >= MANY:
        mine = [mine[0], mine[len(mine) // 2], mine[-1]]
    for file in mine:
        size = file.stat().st_size
        alike = [path for path in others if path.stat().st_size == size]
        if alike and fingerprint(file) in map(fingerprint, alike):
            return True
    return False


def _scan_files(config: SequenceConfig) -> Sequence[Path]:
    files = sequence_files(config).recording
    return [file.resolve() for file in files if file.suffix not in _NOTES]


def _same_time(a: SequenceConfig, b: SequenceConfig) -> bool:
    """Whether sections overlap, by the stamps of their recordings."""
    (begin, end), (other_begin, other_end) = interval_of(a), interval_of(b)
    return begin < other_end and other_begin < end
