"""The sequences of a study by name: recordings, simulated courses, and views of them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adaptune.manifest import merged
from adaptune.odometry.program import ProgramInput, program_input
from adaptune.recording.cache import fingerprints
from adaptune.recording.config import REFERENCE_FILES, SequenceConfig, ViewConfig
from adaptune.recording.export import Layout
from adaptune.recording.recording import (
    SequenceFiles,
    open_sequence,
    sequence_files,
    wants_estimate,
)
from adaptune.recording.scan import OF_VIEW, Recording, origin, part_name
from adaptune.recording.views import WithImu
from adaptune.reference.stored import BREAK, EstimateError, StoredEstimate
from adaptune.simulation.course import Course
from adaptune.strict import ConfigurationError

_PATHS = ("bag", "kitti", "folder", "evalio")
_OF_POSES = ("reference", "child_frame", "extrinsic", "clock_offset", "max_gap")
"""Keys of a sequence that change its reference only."""
_AS_ESTIMATED = {
    **{key: SequenceConfig.model_fields[key].default for key in _OF_POSES},
    "position_prior": None,
    # A gap as long says where the estimate is not to be trusted.
    "max_gap": BREAK,
}
"""Values of these keys where the poses are the LiDAR's own, estimated at its scans."""

_inputs: dict[tuple[str, str], ProgramInput] = {}
"""What programs read, by folder and everything that it depends on."""


@dataclass(frozen=True)
class StudySequences:
    """Opens the sequences of a study by name, in any process."""

    recordings: Mapping[str, SequenceConfig]
    courses: Mapping[str, Course]
    views: Mapping[str, ViewConfig]  # views that may be had of every sequence
    # The study's folder: it keeps recorded courses, estimated references and what programs read.
    folder: Path
    with_imu: bool = False  # whether scans bring along the IMU's measurements
    layout: Layout = "bag"  # the format that a program reads

    def recording(self, course: str) -> Path:
        """The bag of a simulated course; the parts of a course share it."""
        return self.folder / "recordings" / f"{self.courses[course].of or course}.bag"

    def config(self, name: str) -> SequenceConfig:
        """Configuration of a sequence, a course, or a view."""
        if OF_VIEW in name:
            name, view = name.split(OF_VIEW)
            config = self.config(name)
            return config.model_copy(update={"views": (*config.views, self.views[view])})
        if name in self.recordings:
            made = self._is_made(name)
            return self.by_estimate(name, self.estimate_path(name)) if made else self.unseen(name)
        return self.unseen(name)

    def unseen(self, name: str) -> SequenceConfig:
        """Configuration of a sequence, or a course, without an estimate that was made of it."""
        if name in self.recordings:
            return self.recordings[name]
        from adaptune.simulation.course import as_sequence

        return as_sequence(self.courses[name], self.recording(name))

    def estimate_path(self, name: str) -> Path:
        """The TUM file of an estimated reference; the views of a sequence share it."""
        return self.folder / "references" / f"{origin(name)}.tum"

    def by_estimate(self, name: str, path: Path) -> SequenceConfig:
        """Configuration of a sequence, or a course, with an estimate of it as its reference."""
        reference = str(path.absolute())
        return self.unseen(name).model_copy(update=_AS_ESTIMATED | {"reference": reference})

    def _is_made(self, name: str) -> bool:
        """Whether an estimated reference of a sequence, or a view, is in the study's folder."""
        given, path = self.recordings.get(origin(name)), self.estimate_path(name)
        # The file beside it is written last.
        there = given is not None and path.exists() and path.with_suffix(".json").exists()
        return there and wants_estimate(self.recordings[origin(name)])

    def estimate(self, name: str) -> StoredEstimate | None:
        """What is known about an estimated reference, also a file's; None if it is not one."""
        if self._is_made(name):
            return StoredEstimate.read(self.estimate_path(name))
        given = self.recordings.get(origin(name))
        if given is None or not (given.reference or "").endswith(REFERENCE_FILES):
            return None
        try:
            return StoredEstimate.read(Path(given.reference or ""))
        except EstimateError:
            # The user's own file of poses may have any file beside it.
            return None

    def key(self, name: str) -> str:
        """The key under which the user finds a sequence: a part has none of its own."""
        entry = self.entry(origin(name))
        if isinstance(entry, str):
            return f"sequences.{name}"
        ((whole, part),) = entry.items()
        return f"[{whole}: {part}]"

    def entry(self, name: str) -> str | dict[str, str]:
        """How `training` or `test` names a sequence: ``{hall: 0-60%}`` for a part."""
        part = self.config(name).part
        whole = name if part is None else name.removesuffix(part_name("", part))
        if part is None or whole == name:
            return name
        return {whole: f"{100.0 * part[0]:.10g}-{100.0 * part[1]:.10g}%"}

    def recorded_in(self, name: str) -> str:
        """What a sequence was recorded in: parts of a recording, and views, share it."""
        config = self.config(origin(name))
        return str(next(path for key in _PATHS if (path := getattr(config, key)) is not None))

    def open(self, name: str) -> Recording:
        """Open a sequence, a recorded course, or a view.

        Raises
        ------
        SequenceError
            If it cannot be opened.
        ConfigurationError
            If the course has not been recorded.
        """
        self._check_recorded(name)
        sequence = open_sequence(self.config(name))
        return WithImu(sequence) if self.with_imu else sequence

    def _check_recorded(self, name: str) -> None:
        course = origin(name)
        if course in self.courses and not self.recording(course).exists():
            raise ConfigurationError(
                f"{self.recording(course)}: the course {course} is not recorded yet; run "
                f"`adaptune simulate` with this study first"
            )

    def files(self, name: str) -> SequenceFiles:
        """The files that a sequence is read from; errors as of `open`."""
        self._check_recorded(name)
        return sequence_files(self.config(name))

    def inputs(self, name: str) -> dict[str, Any]:
        """Everything that the scans and the reference of a sequence depend on."""
        return merged([self.identity(name), self.reference(name)])

    def identity(self, name: str) -> dict[str, Any]:
        """Everything that the scans of a sequence depend on, as plain data.

        A recording is known by its content, not by its path.
        """
        course = self.courses.get(origin(name))
        others = {*_PATHS, *_AS_ESTIMATED, "cache"}
        config = self.config(name).model_dump(mode="json", exclude=others)
        own = {} if course is None else course.model_dump(mode="json")
        recording = fingerprints(self.files(name).recording)
        return {self._kind(name): {name: config | own}, "recording": {name: recording}}

    def reference(self, name: str) -> dict[str, Any]:
        """Everything that the reference of a sequence depends on besides its scans."""
        config = self.config(name).model_dump(mode="json", include=set(_OF_POSES))
        files = self.files(name).reference
        if files and config["reference"] is not None:
            config["reference"] = "a file"
        return {self._kind(name): {name: config}, "reference": {name: fingerprints(files)}}

    def _kind(self, name: str) -> str:
        return "courses" if origin(name) in self.courses else "sequences"

    def sources(self, name: str) -> dict[str, Sequence[Path]]:
        """The files of a sequence, by the keys of their digests in `inputs`."""
        files = self.files(name)
        return {f"recording.{name}": files.recording, f"reference.{name}": files.reference}

    def program_input(self, name: str) -> ProgramInput:
        """A sequence as a program reads it."""
        folder = self.folder / "inputs" / name
        # 4: with the inputs by name.
        about = {"version": 4, "input": self.layout} | self.identity(name)
        key = str(folder), json.dumps(about)
        if key not in _inputs:
            config = self.config(name)
            given = program_input(self.open(name), config, about, folder, self.layout)
            _inputs[key] = given._replace(logs=self.folder / "logs" / name)
        return _inputs[key]
