"""Find the recording that a study is to learn from, and name it as the study names the others."""

from collections.abc import Collection, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from adaptune import files
from adaptune.errors import AdaptuneError, nearest
from adaptune.files import expand_user
from adaptune.recording.cache import fingerprints
from adaptune.recording.config import ESTIMATED, REFERENCE_FILES, SequenceConfig
from adaptune.recording.inspect import inspect
from adaptune.recording.opening import sequence_files
from adaptune.strict import Mistake, validated
from adaptune.study.config import role_name
from adaptune.study.inputs import trained_recording
from adaptune.study.loading import LearnedDrives, share_scans
from adaptune.study.study import Study

_KINDS = ("bag", "kitti", "folder")
_OF_DRIVE = {*_KINDS, "evalio", "start", "stop", "part", "views"}
"""Keys that tell one drive of a robot from another."""
_OF_REFERENCE = ("child_frame", "extrinsic", "clock_offset", "max_gap")
_LONGEST = 90
"""Bytes of a name."""


class DriveError(AdaptuneError):
    """A recording from which a study cannot learn."""


class NewDrive(NamedTuple):
    """A recording to learn from.

    Attributes
    ----------
    name : str
        Of the training sequence.
    entry : str or dict
        Under `training` of the study.
    sequences : dict
        Under `sequences` of the study; empty if the study has it already.
    was_test : bool
        Whether it has been a test sequence.
    begun : bool
        Whether it is among the study's learned drives, and the model does not know it yet.
    """

    name: str
    entry: str | dict[str, str]
    sequences: dict[str, dict[str, Any]]
    was_test: bool = False
    begun: bool = False

    @property
    def words(self) -> str:
        """What is learned from, in a line."""
        if self.begun:
            return f"Going on with {self.name}."
        if self.was_test:
            return (
                f"{self.name} was a test sequence. What is trained on proves nothing: from now on "
                f"it counts as training only, and is no longer replayed and compared."
            )
        if not self.sequences:
            return f"{self.name} becomes a training sequence."
        given = dict(self.sequences[self.name])
        reference = given.get("reference")
        told = {
            "points": given.get("points"),
            "reference": "its own" if reference is None and "bag" not in given else reference,
        }
        known = ", ".join(f"{key} {value}" for key, value in told.items() if value is not None)
        return f"{self.name} becomes a training sequence{': ' + known if known else ''}."


def find_drive(
    study: Study, drive: str, reference: str | None, trained: Collection[str]
) -> NewDrive:
    """Find a recording, and how to name it in the study.

    Parameters
    ----------
    study
        The study.
    drive
        Name of a sequence of the study, or the path of a bag or a folder.
    reference
        Topic or file of the reference of a recording that the study does not name, or `ESTIMATED`;
        by default as of the study's others.
    trained
        Names of the sequences that the study's error model knows.

    Raises
    ------
    AdaptuneError
        If there is no such recording, it cannot be opened, or it is trained on already.
    """
    names = [*study.config.sequences, *study.config.courses]
    if drive not in names:
        path = expand_user(drive).resolve()
        if not path.exists():
            help_ = nearest(drive, names)
            raise DriveError(
                f"{drive}: is neither a file or folder nor a sequence of the study: {help_}"
            )
        short, entry = _described(study, path, reference)
        config = _checked(path, entry)
        same = next(_same(study, config), None)
        if same is None:
            name = _free_name(study, short, config)
            return NewDrive(name, name, {name: entry})
        drive = same
    if reference is not None:
        raise DriveError(
            f"--reference: the study names {drive} already; give the key `reference` of that "
            f"sequence in the study's YAML, or leave this out"
        )
    return _of_study(study, drive, trained)


def _of_study(study: Study, name: str, trained: Collection[str]) -> NewDrive:
    """A sequence that the study names."""
    entry = study.sequences.entry(name)
    if name not in study.config.training:
        return NewDrive(name, entry, {}, was_test=name in study.config.test)
    learned = map(role_name, LearnedDrives.read(study.folder).training)
    if name in trained or name not in learned:
        raise DriveError(
            f"{name} is a training sequence of the study already: there is nothing to learn from "
            f"it; after a change of the study, run `adaptune offline`"
        )
    return NewDrive(name, entry, {}, begun=True)


def _same(study: Study, config: SequenceConfig) -> Iterator[str]:
    """The study's sequences with the same scans, those of training first."""
    own, sequences = study.config, study.sequences
    every = dict.fromkeys([*own.training, *own.test, *own.sequences, *own.courses])
    for name in every:
        if name in own.courses and not sequences.recording(name).exists():
            continue
        if share_scans(config, sequences.config(name)):
            yield name


def _free_name(study: Study, name: str, config: SequenceConfig) -> str:
    """A name that neither the study nor the trials on another recording have."""
    for number in count(1):
        free = name if number == 1 else f"{name}_{number}"
        if free in study.config.sequences or free in study.config.courses:
            continue
        before = trained_recording(study, free)
        if before is None or before == fingerprints(sequence_files(config).recording):
            return free
    raise AssertionError


def _described(study: Study, path: Path, reference: str | None) -> tuple[str, dict[str, Any]]:
    """Name and entry of a recording for a study."""
    found = inspect(path)
    named = (files.Document(found.entry).data or {}).get("sequences")
    if not named:
        raise DriveError(f"{path}: holds poses and no scans; name a bag, or a folder of scans")
    ((name, proposed),) = named.items()
    topics = {topic.name for topic in found.topics}
    like = _like_others(study, proposed, topics)
    # What was found has less to say than what the user has written for the others.
    entry = proposed if like is None else {**_source(proposed), **like}
    if reference is not None:
        entry = _with_reference(entry, reference, topics)
    elif like is None or entry.get("reference", ESTIMATED) not in (ESTIMATED, *topics):
        entry = _with_reference(entry, proposed.get("reference"), topics)
    return str(name).encode()[:_LONGEST].decode(errors="ignore"), entry


def _checked(path: Path, entry: Mapping[str, Any]) -> SequenceConfig:
    mistakes: list[Mistake] = []
    config = validated(SequenceConfig, entry, (), mistakes)
    if config is None:
        told = (f"{'.'.join(map(str, mistake.key))}: {mistake.message}" for mistake in mistakes)
        raise DriveError(f"{path}: {'; '.join(told)}")
    return config


def _source(given: Mapping[str, Any]) -> dict[str, Any]:
    return {kind: given[kind] for kind in _KINDS if kind in given}


def _like_others(
    study: Study, proposed: Mapping[str, Any], topics: Collection[str]
) -> dict[str, Any] | None:
    """The keys of the study's first sequence of the same kind whose topics are there, if any.

    They are as the user wrote them, also if its reference has been estimated since.
    """
    own = study.config
    for name in dict.fromkeys([*own.training, *own.test, *own.sequences, *own.courses]):
        config = study.sequences.unseen(name)
        (kind,) = _source(proposed)
        imu = None if config.imu is None else config.imu.topic
        needed = {topic for topic in (config.points, imu) if topic is not None}
        if getattr(config, kind) is not None and needed <= set(topics):
            like = config.model_dump(mode="json", exclude_defaults=True, exclude=_OF_DRIVE)
            if config.position_prior not in (None, *topics):
                # A file, whose poses are of that drive.
                return _without(like, "position_prior", *_OF_REFERENCE)
            return like
    return None


def _without(entry: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key not in keys}


def _with_reference(
    entry: Mapping[str, Any], reference: str | None, topics: Collection[str]
) -> dict[str, Any]:
    """The entry with another reference; keys of one of another kind are left out."""
    is_file = reference is not None and reference.endswith(REFERENCE_FILES)
    if reference is None:
        wanted = None
    elif is_file:
        wanted = str(expand_user(reference).resolve())
    else:
        wanted = reference
        if wanted != ESTIMATED and wanted not in topics:
            help_ = nearest(wanted, topics)
            raise DriveError(f"--reference: the recording has no topic {wanted!r}: {help_}")
    before = entry.get("reference")
    alike = before == wanted or (is_file and str(before).endswith(REFERENCE_FILES))
    # A prior goes with an estimate only, and these keys are then the prior's.
    alike = alike or (wanted == ESTIMATED and "position_prior" in entry)
    rest = _without(entry, "reference", *(() if alike else ("position_prior", *_OF_REFERENCE)))
    return rest if wanted is None else rest | {"reference": wanted}
