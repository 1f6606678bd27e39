"""Studies made of RUSTLE's tests and tunings."""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from adaptune import yaml
from adaptune.odometry.base import OdometryError
from adaptune.odometry.template import Template
from adaptune.plain_words import Key
from adaptune.study.rustle_files import (
    Algorithms,
    Datasets,
    RustleError,
    RustleFile,
    RustleTest,
    RustleTests,
    Tuning,
    read,
    unknown_keys,
)
from adaptune.study.rustle_tuning import range_of, search_of

_TOPICS = {
    "points": ("lid_topic", "lidar_topic", "pointCloudTopic", "points_topic", "cloud_topic"),
    "imu": ("imu_topic", "imuTopic"),
}
"""How parameter files call the topics that a system reads."""
_WIDTH = 99


class ImportedStudy(NamedTuple):
    """A study made of RUSTLE's files.

    Attributes
    ----------
    name : str
        What distinguishes it from the other studies of the same file.
    about : str
        What it was made of.
    data : dict
        The study as plain data.
    notes : list of str
        What has no counterpart, and what is to be looked at.
    """

    name: str
    about: str
    data: dict[str, Any]
    notes: list[str]

    @property
    def text(self) -> str:
        """The study's YAML, with comments."""
        lines = [*_wrapped("# ", self.about), "# Not taken over, or to be looked at:"]
        for note in self.notes:
            lines += _wrapped("# - ", note)
        if not self.notes:
            lines.pop()
        sections = [yaml.dump({key: value}) for key, value in self.data.items()]
        return "\n".join([*lines, "", "\n".join(sections)])


def _wrapped(begin: str, text: str) -> list[str]:
    lines = [begin]
    for word in text.split():
        if len(lines[-1]) + len(word) >= _WIDTH and lines[-1].strip(" #-"):
            lines.append("# ".ljust(len(begin)))
        lines[-1] += f"{word} "
    return [line.rstrip() for line in lines]


def import_rustle(
    path: Path, algorithms: Path, datasets: Path
) -> tuple[list[ImportedStudy], list[str]]:
    """Make studies of a file of tests, or of one tuning.

    Parameters
    ----------
    path
        RUSTLE's tests (``test_definitions``), or a tuning (``tuning_algo``).
    algorithms, datasets
        RUSTLE's algorithms and data sets. Paths in them start from their folders.

    Returns
    -------
    studies : list of ImportedStudy
        One for every test, algorithm and speed, or that of the tuning.
    skipped : list of str
        What no study was made of, and why.

    Raises
    ------
    RustleError
        It names the file, the line and the key.
    """
    file = read(path)
    library = _Library(file, read(algorithms), read(datasets))
    keys: Mapping[str, Any] = file.document.data or {}
    if "test_definitions" in keys:
        return _of_tests(file, library)
    if "tuning_algo" in keys:
        return [_of_tuning(file, library)], []
    raise file.error((), "has neither test_definitions, as tests, nor tuning_algo, as a tuning")


class _Library:
    """The algorithms and the data sets, as sections of a study."""

    def __init__(self, asking: RustleFile, algorithms: RustleFile, datasets: RustleFile):
        self._asking, self._algorithms, self._datasets = asking, algorithms, datasets
        self.algorithms = algorithms.check(Algorithms)
        self.datasets = datasets.check(Datasets)

    def unknown(self) -> Iterator[str]:
        """Notes on keys that say nothing here."""
        for file, model in (
            (self._algorithms, self.algorithms),
            (self._datasets, self.datasets),
        ):
            yield from _ignored(file, unknown_keys(model))

    def system(self, name: str, asked: Key) -> "_System | None":
        """An algorithm; None if it is one for ROS 2."""
        entries, file = self.algorithms.algorithms, self._algorithms
        i = file.find("algorithms", [e.name for e in entries], name, asked, self._asking)
        given, key = entries[i], ("algorithms", i)
        if _is_ros2(given.ros_version):
            return None
        try:
            template = Template((file.path.parent / given.parameters).resolve())
        except OdometryError as error:
            raise file.error((*key, "parameters"), str(error)) from error
        settings = {"image": given.image_name, "template": str(template.path)}
        settings |= {"odometry": given.odom_topics[0]}
        settings |= {kind: topic for kind in _TOPICS if (topic := _topic(template, kind))}
        notes = []
        if len(given.odom_topics) > 1:
            others = ", ".join(given.odom_topics[1:])
            notes.append(f"{name} has further topics of poses: {others}. Only the first is read.")
        notes.append(
            "Are the poses those of the LiDAR? If they are those of the IMU or of a camera, say so "
            "in odometry.settings.extrinsic; RUSTLE's errors do not know the difference."
        )
        return _System(name, settings, template, notes)

    def sequence(self, name: str, asked: Key, system: "_System") -> "_Section":
        """A data set as a sequence for a system."""
        entries, file = self.datasets.datasets, self._datasets
        i = file.find("datasets", [e.name for e in entries], name, asked, self._asking)
        given, folder = entries[i], file.path.parent / entries[i].dataset_path
        bags, notes = sorted(folder.glob("*.bag")), []
        if not folder.exists():
            notes.append(f"There is no {folder} here: correct the path of the bag.")
        elif not bags:
            notes.append(f"There is no bag in {folder}: correct the path of the bag.")
        elif len(bags) > 1:
            notes.append(f"The bags of {folder} are taken for one recording, as RUSTLE plays them.")
        bag = bags[0] if len(bags) == 1 else folder
        data: dict[str, Any] = {"bag": str(bag.resolve())}
        topics = system.settings
        data |= {"points": topics["points"]} if "points" in topics else {}
        data |= {"imu": {"topic": topics["imu"]}} if "imu" in topics else {}
        if given.ground_truth_topic is not None:
            data["reference"] = given.ground_truth_topic
        else:
            notes.append(f"{name} has no ground truth: adaptune estimates a reference.")
        return _Section(data, notes)


class _System(NamedTuple):
    name: str
    settings: dict[str, Any]
    template: Template
    notes: list[str]


class _Section(NamedTuple):
    data: dict[str, Any]
    notes: list[str]


def _is_ros2(version: str) -> bool:
    return version.lower().replace("_", "") == "ros2"


def _topic(template: Template, kind: str) -> str | None:
    for name in _TOPICS[kind]:
        try:
            value = template.value(name)
        except OdometryError:
            continue
        if isinstance(value, str) and value.startswith("/"):
            return value
    return None


def _ignored(file: RustleFile, keys: Iterator[str]) -> list[str]:
    return [f"{file.path.name}: {key} is not known here, and is ignored." for key in keys]


def _name(*parts: str) -> str:
    return "_".join(re.sub(r"[^\w.-]+", "_", part).strip("._-") or "unnamed" for part in parts)


def _study(
    system: _System, parameters: Mapping[str, Any], name: str, sequence: _Section, offline: Any
) -> dict[str, Any]:
    odometry = {"name": "rustle", "settings": system.settings, "parameters": dict(parameters)}
    return {
        "odometry": odometry,
        "sequences": {_name(name): sequence.data},
        "training": [_name(name)],
        "offline": offline,
    }


# Tests.


def _of_tests(file: RustleFile, library: _Library) -> tuple[list[ImportedStudy], list[str]]:
    tests = file.check(RustleTests)
    studies, skipped = [], [*_ignored(file, unknown_keys(tests)), *library.unknown()]
    for i, test in enumerate(tests.test_definitions):
        kind, key = test.test_type.type, ("test_definitions", i)
        if kind in ("drop", "cut"):
            skipped.append(
                f"Test {test.name!r} is left out: adaptune has no {kind} tests, which take a "
                f"sensor's messages away while a system runs. A sequence's `drop` view loses scans."
            )
            continue
        for j, name in enumerate(test.algo_list):
            system = library.system(name, (*key, "algo_list", j))
            if system is None:
                skipped.append(f"Test {test.name!r} is left out for {name}, an image of ROS 2.")
                continue
            sequence = library.sequence(test.dataset_name, (*key, "dataset_name"), system)
            speeds = _speeds(file, key, test)
            studies += [_of_test(file, test, system, sequence, speed) for speed in speeds]
    if not studies:
        raise RustleError("\n".join([f"{file.path}: no study can be made of it", *skipped]))
    return studies, skipped


def _speeds(file: RustleFile, key: Key, test: RustleTest) -> list[float]:
    """Speeds of the bag, as RUSTLE makes them."""
    given = test.test_type
    if given.type == "simple":
        return [1.0]
    if given.speed_factors is not None:
        speeds = list(map(float, given.speed_factors))
        return speeds if 1.0 in speeds else [*speeds, 1.0]
    if given.speed_range is None or given.speed_step is None:
        what = "give speed_factors, or speed_range and speed_step"
        raise file.error((*key, "test_type"), what)
    n = math.floor((given.speed_range - 1.0) / given.speed_step + 1e-9) + 1
    if n > 100:
        raise file.error((*key, "test_type", "speed_step"), f"makes {n} speeds; 100 at most")
    return [1.0 + i * float(given.speed_step) for i in range(n)]


def _of_test(
    file: RustleFile, test: RustleTest, system: _System, sequence: _Section, speed: float
) -> ImportedStudy:
    parameters = dict(_every_number(system.template))
    if not parameters:
        raise file.error((), f"{system.template.path} holds no number that could be tuned")
    own = system._replace(settings=system.settings | {"rate": speed})
    offline = {"objective": "rpe", "runs": "whole", "trials": 1}
    offline |= {"baseline_runs": test.iterations, "workers": test.workers}
    notes = [
        *(*system.notes, *sequence.notes),
        "A test tunes nothing, so the study has one trial, the baseline, which runs "
        f"{test.iterations} times. To tune, keep the parameters that you want, give them ranges "
        "that make sense (those below are half and twice the value), and raise offline.trials.",
    ]
    names = [test.name, system.name]
    if test.test_type.type == "speed":
        names.append(f"x{speed:g}")
        notes.append("RUSTLE's scores over all speeds (TES, FPT, ATAS, RTAS) are not computed.")
    about = (
        f"Made of the test {test.name!r} of {file.path.name}: {system.name} on "
        f"{test.dataset_name}, played {speed:g} times as fast as recorded."
    )
    data = _study(own, parameters, test.dataset_name, sequence, offline)
    return ImportedStudy(_name(*names), about, data, notes)


def _every_number(template: Template) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every number of a file that is in no list and not zero, from half of it to twice."""
    for dotted in template.names:
        parts = dotted.split(".")
        if any(part.isdigit() for part in parts):
            continue
        try:
            value = template.value(dotted)
        except OdometryError:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not value:
            continue
        ends = sorted((value / 2, 2 * value))
        if isinstance(value, int):
            ends = [math.ceil(ends[0]), math.floor(ends[1])]
        yield "/".join(parts), range_of(ends[0], ends[1], value)


# Tunings.


def _of_tuning(file: RustleFile, library: _Library) -> ImportedStudy:
    tuning = file.check(Tuning)
    system = library.system(tuning.algo_name, ("algo_name",))
    if system is None:
        raise file.error(("algo_name",), f"{tuning.algo_name} is an image of ROS 2, not of ROS 1")
    of = tuning.dataset_settings
    sequence = library.sequence(of.name, ("dataset_settings", "name"), system)
    part = {"start": float(of.start)} if of.start else {}
    if of.duration is not None and of.duration > 0:
        part["stop"] = float(of.start + of.duration)
    notes = [*_ignored(file, unknown_keys(tuning)), *library.unknown()]
    notes += [*system.notes, *sequence.notes]
    if part and "points" not in system.settings:
        notes.append(
            "Only a part of the recording is played, from a bag that adaptune writes: "
            "give odometry.settings points, and imu, the topics that the system reads."
        )
    parameters, offline = search_of(file, tuning, system.template, notes)
    weights = {k: float(w) for k, w in tuning.metric_weights if w and k in ("ape", "rpe")}
    if not weights:
        raise file.error(("metric_weights",), "give ape or rpe a weight above 0")
    total = sum(weights.values())
    objective = {key: weight / total for key, weight in weights.items()}
    offline = {"objective": objective, "runs": "whole", "workers": 1} | offline
    if tuning.time_limit is not None:
        offline["hours"] = float(tuning.time_limit)
    section = _Section(sequence.data | part, [])
    data = _study(system, parameters, of.name, section, offline)
    how = tuning.tuning_algo.replace("_", " ")
    what = f"Made of the tuning {tuning.name!r}, {file.path.name}"
    about = f"{what}: {how} for {system.name} on {of.name}."
    return ImportedStudy(_name(tuning.name), about, data, notes)
