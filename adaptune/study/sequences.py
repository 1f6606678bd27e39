"""The sequences of a study by name: recordings and simulated courses."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

from adaptune._system.manifest import differences, merged
from adaptune._system.strict import ConfigurationError
from adaptune.errors import AdaptuneError
from adaptune.odometry.program import ProgramInput, program_input
from adaptune.recording.cache import fingerprints
from adaptune.recording.config import (
    NO_REFERENCE,
    REFERENCE_FILES,
    SOURCES,
    SequenceConfig,
    part_name,
)
from adaptune.recording.export import Layout
from adaptune.recording.recording import (
    RecordedSequence,
    SequenceFiles,
    open_sequence,
    sequence_files,
    wants_estimate,
)
from adaptune.recording.scan import Recording
from adaptune.reference.estimated import BREAK, EstimateError
from adaptune.reference.stored import StoredEstimate
from adaptune.simulation.course import Course

_READER = 3
"""Changes where the same files give other scans or poses than before."""
_OF_POSES = ("reference", "child_frame", "extrinsic", "clock_offset", "max_gap")
"""Keys of a sequence that change its reference only."""
_AS_ESTIMATED = {
    **{key: SequenceConfig.model_fields[key].default for key in _OF_POSES},
    # A gap as long says where the estimate is not to be trusted.
    "max_gap": BREAK,
}
"""Values of these keys where the poses are the LiDAR's own, estimated at its scans."""

_WHOLE = {"start": 0.0, "stop": None, "part": None}
"""Values of the keys that cut a recording."""
_inputs: dict[tuple[str, str], ProgramInput] = {}
"""What programs read, by folder and everything that it depends on."""


def _source_of(config: SequenceConfig) -> str:
    return str(next(path for key in SOURCES if (path := getattr(config, key)) is not None))


@dataclass(frozen=True)
class StudySequences:
    """Opens the sequences of a study by name, in any process."""

    recordings: Mapping[str, SequenceConfig]
    courses: Mapping[str, Course]
    # The study's folder: it keeps recorded courses, estimated references and what programs read.
    folder: Path
    with_imu: bool = False  # whether scans bring along the IMU's measurements
    layout: Layout = "bag"  # the format that a program reads

    def recording(self, course: str) -> Path:
        """The bag of a simulated course; the parts of a course share it."""
        return self.folder / "recordings" / f"{self.courses[course].of or course}.bag"

    def config(self, name: str) -> SequenceConfig:
        """Configuration of a sequence or a course."""
        config = self.unseen(name)
        if self._is_made(name):
            reference = str(self.estimate_path(name).absolute())
            config = config.model_copy(update=_AS_ESTIMATED | {"reference": reference})
        return config

    def unseen(self, name: str) -> SequenceConfig:
        """Configuration of a sequence, or a course, without an estimate that was made of it."""
        if name in self.recordings:
            return self.recordings[name]
        from adaptune.simulation.course import as_sequence

        return as_sequence(self.courses[name], self.recording(name))

    def estimate_path(self, name: str) -> Path:
        """The TUM file of an estimated reference."""
        return self.folder / "references" / f"{name}.tum"

    def _is_made(self, name: str) -> bool:
        """Whether an estimated reference of a sequence is in the study's folder."""
        given, path = self.recordings.get(name), self.estimate_path(name)
        # The file beside it is written last.
        there = given is not None and path.exists() and path.with_suffix(".json").exists()
        return there and wants_estimate(self.recordings[name])

    def estimate(self, name: str) -> StoredEstimate | None:
        """What is known about an estimated reference, also a file's; None if it is not one."""
        if self._is_made(name):
            return StoredEstimate.read(self.estimate_path(name))
        given = self.recordings.get(name)
        if given is None or not (given.reference or "").endswith(REFERENCE_FILES):
            return None
        # The user's own file of poses may have any file beside it.
        with contextlib.suppress(EstimateError):
            return StoredEstimate.read(Path(given.reference or ""))
        return None

    def key(self, name: str) -> str:
        """The key under which the user finds a sequence: a part has none of its own."""
        part = self.config(name).part
        whole = name if part is None else name.removesuffix(part_name("", part))
        if part is None or whole == name:
            return f"sequences.{name}"
        return f"[{whole}: {100.0 * part[0]:.10g}-{100.0 * part[1]:.10g}%]"

    def unjudged(self, names: Sequence[str]) -> list[str]:
        """Those of some sequences that are to have no reference, not even an estimated one."""
        every = self.recordings
        return [name for name in names if name in every and every[name].reference == NO_REFERENCE]

    def recorded_in(self, name: str) -> str:
        """What a sequence was recorded in: parts and copies of a recording share it."""
        own = _source_of(self.config(name))
        return self._copies.get(own, own)

    @cached_property
    def _copies(self) -> dict[str, str]:
        """By recordings that hold scans of another one, as where they are cut from it, that one."""
        each = {_source_of(one): one for one in self.recordings.values()}
        opened, found = dict[str, RecordedSequence](), dict[str, str]()
        for name in each if len(each) > 1 else ():
            with contextlib.suppress(AdaptuneError):  # who opens it is told
                opened[name] = RecordedSequence(each[name].model_copy(update=_WHOLE))
        for (first, one), (copy, other) in combinations(opened.items(), 2):
            with contextlib.suppress(AdaptuneError):
                if one.shares_scans(other):
                    found.setdefault(copy, found.get(first, first))
        return found

    def open(self, name: str) -> Recording:
        """Open a sequence, or a recorded course.

        A SequenceError says that it cannot be opened, a ConfigurationError that the course has not
        been recorded, or as another one.
        """
        self.check_recorded(name)
        return open_sequence(self.config(name), self.with_imu)

    def check_recorded(self, name: str) -> None:
        """Raise a ConfigurationError for a course that is not recorded, or as another one."""
        if name not in self.courses:
            return
        bag, course = self.recording(name), self.courses[name]
        if not bag.exists():
            raise ConfigurationError(
                f"{bag}: the course {name} is not recorded yet; run `adaptune simulate` with this "
                f"study first"
            )
        if not (file := bag.with_suffix(".json")).exists():  # a copy of the bag alone
            return
        mend = "remove its .bag, .tum and .json, then run `adaptune simulate`"
        try:
            made = Course.model_validate_json(file.read_bytes()).recorded()
        except ValueError as error:
            what = "is damaged, or of another adaptune"
            raise ConfigurationError(f"{file}: {what}; {mend}") from error
        for key, was, now in differences(made, course.recorded()):
            raise ConfigurationError(
                f"{bag} is of another course: {key} is {was} there, and {now} in the study; "
                f"{mend}, or name another --folder"
            )

    def files(self, name: str) -> SequenceFiles:
        """The files that a sequence is read from; errors as of `open`."""
        self.check_recorded(name)
        return sequence_files(self.config(name))

    def inputs(self, name: str) -> dict[str, Any]:
        """Everything that the scans and the reference of a sequence depend on."""
        return merged([self.identity(name), self.reference(name)])

    def identity(self, name: str) -> dict[str, Any]:
        """Everything that the scans of a sequence depend on, as plain data.

        A recording is known by its content, not by its path.
        """
        course = self.courses.get(name)
        others = {*SOURCES, *_AS_ESTIMATED, "cache"}
        config = self.config(name).model_dump(mode="json", exclude=others)
        config |= {} if course is None else course.model_dump(mode="json")
        recording = fingerprints(self.files(name).recording)
        about = {self._kind(name): {name: config}, "recording": {name: recording}}
        return about | {"reader": _READER}

    def reference(self, name: str) -> dict[str, Any]:
        """Everything that the reference of a sequence depends on besides its scans."""
        config = self.config(name).model_dump(mode="json", include=set(_OF_POSES))
        files = self.files(name).reference
        if files and config["reference"] is not None:
            config["reference"] = "a file"
        return {self._kind(name): {name: config}, "reference": {name: fingerprints(files)}}

    def _kind(self, name: str) -> str:
        return "courses" if name in self.courses else "sequences"

    def sources(self, name: str) -> dict[str, Sequence[Path]]:
        """The files of a sequence, by the keys of their digests in `inputs`."""
        files = self.files(name)
        return {f"recording.{name}": files.recording, f"reference.{name}": files.reference}

    def program_input(self, name: str) -> ProgramInput:
        """A sequence as a program reads it."""
        folder = self.folder / "inputs" / name
        # 5: with the time that a scan takes.
        about = {"version": 5, "input": self.layout} | self.identity(name)
        key = str(folder), json.dumps(about)
        if key not in _inputs:
            config = self.config(name)
            given = program_input(self.open(name), config, about, folder, self.layout)
            _inputs[key] = given._replace(logs=self.folder / "logs" / name)
        return _inputs[key]
