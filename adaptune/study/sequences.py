"""The sequences of a study by name: recordings, simulated courses, and views of them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adaptune.odometry.program_input import ProgramInput, program_input
from adaptune.sequence.bag_files import bag_paths
from adaptune.sequence.config import SequenceConfig, ViewConfig
from adaptune.sequence.export import Layout
from adaptune.sequence.names import OF_VIEW, origin
from adaptune.sequence.opening import open_sequence
from adaptune.sequence.sequence import Sequence
from adaptune.sequence.views import WithImu
from adaptune.simulation.course import Course
from adaptune.study.mistakes import ConfigurationError

_inputs: dict[tuple[str, str], ProgramInput] = {}
"""What programs read, by folder and everything that it depends on."""


@dataclass(frozen=True)
class StudySequences:
    """Opens the sequences of a study by name, in any process."""

    recordings: Mapping[str, SequenceConfig]
    courses: Mapping[str, Course]
    views: Mapping[str, ViewConfig]  # views that may be had of every sequence
    folder: Path  # the study's folder, which keeps recorded courses and what programs read
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
            return self.recordings[name]
        from adaptune.simulation.rig import as_sequence

        return as_sequence(self.courses[name], self.recording(name))

    def open(self, name: str) -> Sequence:
        """Open a sequence, a recorded course, or a view.

        Raises
        ------
        SequenceError
            If it cannot be opened.
        ConfigurationError
            If the course has not been recorded.
        """
        course = origin(name)
        if course in self.courses and not self.recording(course).exists():
            raise ConfigurationError(
                f"{self.recording(course)}: the course {course} is not recorded yet; run "
                f"`adaptune simulate` with this study first"
            )
        sequence = open_sequence(self.config(name))
        return WithImu(sequence) if self.with_imu else sequence

    def recording_size(self, name: str) -> list[int] | None:
        """Sizes in bytes of a recording's files, which show that another one is in its place.

        None for simulated courses, which their configuration identifies, and for folders of scans.
        """
        bag = self.config(name).bag
        if bag is None or name in self.courses:
            return None
        files = [
            file
            for path in bag_paths((bag,) if isinstance(bag, str) else bag)
            for file in (sorted(path.iterdir()) if path.is_dir() else [path])
        ]
        return [file.stat().st_size for file in files if file.is_file()]

    def identity(self, name: str) -> dict[str, Any]:
        """Everything that the scans of a sequence depend on, as plain data."""
        course = self.courses.get(name)
        return {
            "sequence": self.config(name).model_dump(mode="json"),
            "course": None if course is None else course.model_dump(mode="json"),
            "recording": self.recording_size(name),
        }

    def program_input(self, name: str) -> ProgramInput:
        """A sequence as a program reads it."""
        folder = self.folder / "inputs" / name
        # 2: with intensities.
        about = {"version": 2, "input": self.layout} | self.identity(name)
        key = str(folder), json.dumps(about)
        if key not in _inputs:
            config = self.config(name)
            _inputs[key] = program_input(self.open(name), config, about, folder, self.layout)
        return _inputs[key]
