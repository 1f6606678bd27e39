"""Studies made of RUSTLE's YAML files: its algorithms, data sets, tests and tunings.

RUSTLE (https://github.com/mjpc13/rustle) ignores keys that it does not know; so does this module.
"""

import logging
import math
import re
import textwrap
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AliasChoices, AliasPath, ConfigDict, Field

from adaptune._system import yaml12
from adaptune._system.strict import StrictModel, validated
from adaptune.errors import AdaptuneError, Finding, Key, OdometryError, nearest
from adaptune.odometry.template import Template

_Number = int | float
_Some = Field(min_length=1)

_log = logging.getLogger(__name__)


class RustleError(AdaptuneError):
    """A file of RUSTLE that cannot be imported."""


def _at(path: str, default: Any = None) -> Any:
    """A value below a section of RUSTLE's; the name of the field is ours."""
    return Field(default, validation_alias=AliasPath(*path.split(".")))


class _Section(StrictModel):
    model_config = ConfigDict(extra="ignore")


class _Algorithm(_Section):
    name: str
    image_name: str
    parameters: str  # a file
    odom_topics: Annotated[tuple[str, ...], _Some]
    ros_version: str = "ROS_1"


class _Dataset(_Section):
    name: str
    dataset_path: str  # a folder of bags
    ground_truth: str | None = Field(
        None, validation_alias=AliasChoices("ground_truth_topic", "groundtruth_topic")
    )


class _Test(_Section):
    name: str
    dataset_name: str
    algo_list: Annotated[tuple[str, ...], _Some]
    type: Literal["simple", "speed", "drop", "cut"] = _at("test_type.type", ...)
    speed_factors: Annotated[tuple[float, ...], _Some] | None = _at("test_type.speed_factors")
    speed_range: Annotated[float, Field(ge=1)] | None = _at("test_type.speed_range")
    speed_step: Annotated[float, Field(gt=0)] | None = _at("test_type.speed_step")
    workers: int = 1
    iterations: int = Field(1, validation_alias=AliasChoices("iterations", "num_iterations"))


class _Lists(_Section):
    """What the files of algorithms, data sets and tests hold."""

    algorithms: tuple[_Algorithm, ...] = ()
    datasets: tuple[_Dataset, ...] = ()
    test_definitions: tuple[_Test, ...] = ()


class _Annealing(_Section):
    # For each parameter its first value, its bounds, and perhaps its step: the longest one, or mean
    # and standard deviation.
    bounds: Annotated[
        dict[str, Annotated[tuple[_Number, ...], Field(min_length=3, max_length=5)]], _Some
    ] = _at("parameter_bounds", ...)
    max_iterations: int | None = None
    initial_temperature: float = _at("temperature.initial_value", ...)
    alpha: float | None = _at("temperature.alpha")
    function: str | None = _at("temperature.function")
    reanneal_fixed: int | None = _at("reanneal.fixed")
    reanneal_accepted: int | None = _at("reanneal.accepted")
    reanneal_best: int | None = _at("reanneal.best")
    stall_accepted: int | None = _at("halting_conditions.accepted")
    stall_best: int | None = _at("halting_conditions.best")
    # For parameters that have no step of their own.
    delta_max: int | None = _at("perturbation_functions.integer_delta_max")
    mu: float | None = _at("perturbation_functions.float_mean")
    sigma: float | None = _at("perturbation_functions.float_std_dev")


_COUNTS = ("reanneal_fixed", "reanneal_accepted", "reanneal_best", "stall_accepted", "stall_best")


class _Tuning(_Section):
    name: str
    algo_name: str
    dataset: str = _at("dataset_settings.name", ...)
    start: float = _at("dataset_settings.start", 0.0)
    duration: float | None = _at("dataset_settings.duration")  # all if it is not positive
    tuning_algo: Literal["grid_search", "random_search", "simulated_annealing"]
    ape: Annotated[float, Field(ge=0)] | None = _at("metric_weights.ape")
    rpe: Annotated[float, Field(ge=0)] | None = _at("metric_weights.rpe")
    tolerance: int | None = _at("early_stopping.tolerance")
    hours: float | None = _at("time_limit")
    parameters: dict[str, Any] | None = None
    tuning_settings: _Annealing | None = None


class _File:
    """A file, its content, and where things stand in it."""

    def __init__(self, path: Path):
        self.path = path
        try:
            self._document = yaml12.Document.of_file(path)
        except yaml12.YamlError as error:
            raise RustleError(str(error)) from error
        self.data: Any = self._document.data

    def error(self, key: Key, message: str) -> RustleError:
        """An error about the value at a key."""
        return RustleError(f"{self._document.where(self.path, key)}: {Finding(key, message)}")

    def check(self, model: type[_Section]) -> Any:
        """The content, or an error that lists the mistakes in it."""
        mistakes: list[Finding] = []
        if (content := validated(model, self.data, (), mistakes)) is None:
            raise RustleError(
                "\n".join(str(self.error(mistake.where, mistake.what)) for mistake in mistakes)
            )
        return content

    def find(self, key: str, name: str, asking: "_File", asked: Key) -> tuple[int, Any]:
        """The entry of a list for which another file asks, and its place."""
        entries = getattr(self.check(_Lists), key)
        names = [entry.name for entry in entries]
        if name not in names:
            what = f"{self.path.name} has no {name!r} in {key}: {nearest(name, names)}"
            raise asking.error(asked, what)
        return names.index(name), entries[names.index(name)]


_MOST_TRIALS = 10**6
"""Of a random search over a grid."""
_ALPHA = 0.95
"""What RUSTLE's exponential cooling multiplies the temperature by."""

_Parameters = dict[str, dict[str, Any]]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _range(low: _Number, high: _Number, baseline: _Number) -> dict[str, Any]:
    """A parameter of a study; it is a whole number if all three are."""
    ends = {"low": low, "high": high, "baseline": baseline}
    if all(isinstance(value, int) for value in ends.values()):
        return {"type": "integer", **ends}
    return {"type": "float", **{name: float(value) for name, value in ends.items()}}


def _default(file: _File, key: Key, template: Template, kinds: Any) -> Any:
    """What a parameter is in the parameter file, which has its type."""
    try:
        default = template.value(str(key[-1]))
    except OdometryError as error:
        raise file.error(key, str(error)) from error
    if not _is_number(default) and not isinstance(default, kinds):
        raise file.error(key, f"is {default!r} in the parameter file, which cannot be tuned")
    return default


def _grid(
    file: _File, tuning: _Tuning, template: Template, notes: list[str]
) -> tuple[_Parameters, dict[str, Any]]:
    parameters: _Parameters = {}
    axes: dict[str, list[Any]] = {}
    size = 1
    for name, given in (tuning.parameters or {}).items():
        key = ("parameters", name)
        default = _default(file, key, template, str | bool)
        if not isinstance(given, list):
            notes.append(f"{name} is fixed at {given!r}: write that into {template.path}.")
            continue
        axes[name] = given
        if _is_number(default):
            parameters[name] = _axis(file, key, given, default)
            size *= given[2]
        else:
            choices = given if default in given else [default, *given]
            parameters[name] = {"type": "categorical", "choices": choices, "baseline": default}
            size *= len(given)
            if any(type(value) is not type(default) for value in given):
                raise file.error(key, f"give a list of values like {default!r}")
    if not parameters:
        raise file.error(("parameters",), "give at least one as [first, step, number]")
    offline: dict[str, Any] = {"sampler": "grid", "sampler_settings": {"grid": axes}}
    if tuning.tuning_algo == "random_search":
        offline["sampler"] = "random"
        if tuning.hours is None:
            offline["trials"] = min(size + 1, _MOST_TRIALS)
    if tuning.tolerance is not None and tuning.hours is None:  # as in RUSTLE
        offline["stagnation"] = tuning.tolerance
        what = "early_stopping.delta has no counterpart: any better trial counts as a new best."
        notes.append(what)
    return parameters, offline


def _axis(file: _File, key: Key, given: list[Any], default: _Number) -> dict[str, Any]:
    """A range that holds the grid's points and the default."""
    if len(given) != 3 or not all(map(_is_number, given)) or not isinstance(given[2], int):
        raise file.error(key, f"give [first, step, number], not {given!r}")
    first, step, number = given
    points = (first, first + step * (number - 1), default)
    low, high = min(points), max(points)
    return _range(low, high if high > low else low + (abs(step) or 1), default)


def _annealing(
    file: _File, tuning: _Tuning, template: Template, notes: list[str]
) -> tuple[_Parameters, dict[str, Any]]:
    if (given := tuning.tuning_settings) is None:
        raise file.error(("tuning_settings",), "is missing")
    parameters: _Parameters = {}
    steps: dict[str, dict[str, Any]] = {}
    for name, (first, low, high, *own) in given.bounds.items():
        key = ("tuning_settings", "parameter_bounds", name)
        default = _default(file, key, template, ())
        if not low <= first <= high or low == high:
            raise file.error(key, "give [first, low, high, ...], low below high and first in them")
        # A range must hold the default; the walk keeps RUSTLE's bounds.
        parameters[name] = _range(min(low, default), max(high, default), default)
        of_step, form = ["mu", "sigma"], "[first, low, high, mean, standard deviation]"
        if parameters[name]["type"] == "integer":
            of_step, form = ["delta_max"], "[first, low, high, longest step]"
        if own and len(own) != len(of_step):
            raise file.error(key, f"{default!r} is its default, so give {form}")
        # A step of its own, or the one of all parameters.
        values = own or [getattr(given, key) for key in of_step]
        step = {key: value for key, value in zip(of_step, values, strict=True) if value is not None}
        if not low <= default <= high:
            step |= {"low": low} if default < low else {"high": high}
            outside = f"The default of {name} lies outside of its bounds; the walk keeps to them."
            notes.append(outside)
        if step:
            steps[name] = step
    if given.function in ("fast", "boltzman"):
        what = f"temperature.function {given.function} has no counterpart: adaptune"
        notes.append(f"{what} multiplies the temperature by alpha after every step.")
    settings: dict[str, Any] = {"chains": 1, "energy_scale": 1.0}
    settings |= {"initial_temperature": given.initial_temperature, "alpha": given.alpha or _ALPHA}
    settings |= {name: count for name in _COUNTS if (count := getattr(given, name))}
    settings["start"] = {name: bounds[0] for name, bounds in given.bounds.items()}
    settings["steps"] = steps
    offline: dict[str, Any] = {"sampler": "annealing", "sampler_settings": settings}
    offline |= {"initial": 1, "batch": 1, "seed": 0}
    if given.max_iterations is not None:
        offline["trials"] = given.max_iterations + 1  # and the baseline
    return parameters, offline


_TOPICS = {
    "points": ("lid_topic", "lidar_topic", "pointCloudTopic", "points_topic", "cloud_topic"),
    "imu": ("imu_topic", "imuTopic"),
}
"""How parameter files call the topics that a system reads."""


class ImportedStudy(NamedTuple):
    """A study made of RUSTLE's files."""

    name: str  # what distinguishes it from the other studies of the same file
    about: str  # what it was made of
    data: dict[str, Any]
    notes: list[str]  # what has no counterpart, and what is to be looked at

    @property
    def text(self) -> str:
        """The study's YAML, with comments."""
        fill = partial(textwrap.fill, width=98, break_long_words=False, break_on_hyphens=False)
        lines = [fill(self.about, initial_indent="# ", subsequent_indent="# ")]
        if self.notes:
            lines.append("# Not taken over, or to be looked at:")
        lines += [fill(n, initial_indent="# - ", subsequent_indent="#   ") for n in self.notes]
        sections = [yaml12.dump({key: value}) for key, value in self.data.items()]
        return "\n".join([*lines, "", *sections])


def import_rustle(path: Path, algorithms: Path, datasets: Path) -> list[ImportedStudy]:
    """Make studies of a file of tests, one for every test, algorithm and speed, or of one tuning.

    Paths in RUSTLE's files of algorithms and data sets start from their folders. It is logged what
    no study is made of. A RustleError names the file, the line and the key of a mistake.
    """
    file = _File(path)
    library = _File(algorithms), _File(datasets)
    keys = file.data if isinstance(file.data, dict) else ()
    if "test_definitions" in keys:
        return _of_tests(file, *library)
    if "tuning_algo" in keys:
        return [_of_tuning(file, *library)]
    raise file.error((), "has neither test_definitions, as tests, nor tuning_algo, as a tuning")


class _System(NamedTuple):
    name: str
    settings: dict[str, Any]
    template: Template
    notes: list[str]


def _system(algorithms: _File, name: str, asking: _File, asked: Key) -> _System | None:
    """An algorithm; None if it is one for ROS 2."""
    i, given = algorithms.find("algorithms", name, asking, asked)
    if given.ros_version.lower().replace("_", "") == "ros2":
        return None
    try:
        template = Template((algorithms.path.parent / given.parameters).resolve())
    except OdometryError as error:
        raise algorithms.error(("algorithms", i, "parameters"), str(error)) from error
    topic, *others = given.odom_topics
    settings = {"image": given.image_name, "template": str(template.path), "odometry": topic}
    settings |= {kind: topic for kind in _TOPICS if (topic := _topic(template, kind))}
    notes = [
        "Are the poses those of the LiDAR? If they are those of the IMU or of a camera, say so in "
        "odometry.settings.extrinsic; RUSTLE's errors do not know the difference."
    ]
    if others:
        what = f"{name} has further topics of poses: {', '.join(others)}. Only the first is read."
        notes.insert(0, what)
    return _System(name, settings, template, notes)


def _topic(template: Template, kind: str) -> str:
    for name in _TOPICS[kind]:
        with suppress(OdometryError):
            if (topic := str(template.value(name))).startswith("/"):
                return topic
    return ""


def _sequence(
    datasets: _File, name: str, asking: _File, asked: Key, system: _System
) -> dict[str, Any]:
    """A data set as a sequence for a system, which gets notes on it."""
    _, given = datasets.find("datasets", name, asking, asked)
    folder = datasets.path.parent / given.dataset_path
    bags, topics = sorted(folder.glob("*.bag")), system.settings
    if not bags:
        system.notes.append(f"There is no bag in {folder} here: correct the path of the bag.")
    elif len(bags) > 1:
        what = f"The bags of {folder} are taken for one recording, as RUSTLE plays them."
        system.notes.append(what)
    data: dict[str, Any] = {"bag": str((bags[0] if len(bags) == 1 else folder).resolve())}
    data |= {"points": topics["points"]} if "points" in topics else {}
    data |= {"imu": {"topic": topics["imu"]}} if "imu" in topics else {}
    if given.ground_truth is not None:
        return data | {"reference": given.ground_truth}
    system.notes.append(f"{name} has no ground truth: adaptune estimates a reference.")
    return data


def _name(*parts: str) -> str:
    return "_".join(re.sub(r"[^\w.-]+", "_", part).strip("._-") or "unnamed" for part in parts)


def _of_tests(file: _File, algorithms: _File, datasets: _File) -> list[ImportedStudy]:
    studies: list[ImportedStudy] = []
    for i, test in enumerate(file.check(_Lists).test_definitions):
        key = ("test_definitions", i)
        if test.type in ("drop", "cut"):
            _log.warning(
                f"Test {test.name!r} is left out: adaptune has no {test.type} tests, which take a "
                f"sensor's messages away while a system runs."
            )
            continue
        for j, name in enumerate(test.algo_list):
            system = _system(algorithms, name, file, (*key, "algo_list", j))
            if system is None:
                _log.warning(f"Test {test.name!r} is left out for {name}, an image of ROS 2.")
                continue
            asked = (*key, "dataset_name")
            sequence = _sequence(datasets, test.dataset_name, file, asked, system)
            speeds = _speeds(file, key, test)
            studies += [_of_test(file, test, system, sequence, speed) for speed in speeds]
    if not studies:
        raise RustleError(f"{file.path}: no study can be made of it")
    return studies


def _speeds(file: _File, key: Key, test: _Test) -> list[float]:
    """Speeds of the bag, as RUSTLE makes them."""
    if test.type == "simple":
        return [1.0]
    if test.speed_factors is not None:
        return list(dict.fromkeys((*test.speed_factors, 1.0)))
    if test.speed_range is None or test.speed_step is None:
        what = "give speed_factors, or speed_range and speed_step"
        raise file.error((*key, "test_type"), what)
    n = math.floor((test.speed_range - 1.0) / test.speed_step + 1e-9) + 1
    if n > 100:
        raise file.error((*key, "test_type", "speed_step"), f"makes {n} speeds; 100 at most")
    return [1.0 + i * test.speed_step for i in range(n)]


def _of_test(
    file: _File, test: _Test, system: _System, sequence: Any, speed: float
) -> ImportedStudy:
    if not (parameters := _every_number(system.template)):
        raise file.error((), f"{system.template.path} holds no number that could be tuned")
    names, notes = [test.name, system.name], list(system.notes)
    notes.append(
        f"A test tunes nothing, so the study has one trial, the baseline, which runs "
        f"{test.iterations} times. To tune, keep the parameters that you want, give them ranges "
        f"that make sense (those below are half and twice the value), and raise offline.trials."
    )
    if test.type == "speed":
        names.append(f"x{speed:g}")
        notes.append("RUSTLE's scores over all speeds (TES, FPT, ATAS, RTAS) are not computed.")
    about = (
        f"Made of the test {test.name!r} of {file.path.name}: {system.name} on "
        f"{test.dataset_name}, played {speed:g} times as fast as recorded."
    )
    offline = {"objective": "rpe", "segments": "all", "trials": 1}
    offline |= {"baseline_runs": test.iterations, "workers": test.workers}
    settings = system.settings | {"rate": speed}
    data = _study(settings, parameters, test.dataset_name, sequence, offline)
    return ImportedStudy(_name(*names), about, data, notes)


def _every_number(template: Template) -> _Parameters:
    """Every number of a file that is in no list and not zero, from half of it to twice."""
    parameters: _Parameters = {}
    for name in template.names:
        with suppress(OdometryError):
            value = template.value(name)
            if value and _is_number(value) and not any(map(str.isdigit, name.split("."))):
                low, high = sorted((value / 2, 2 * value))
                if isinstance(value, int):
                    low, high = math.ceil(low), math.floor(high)
                parameters[name.replace(".", "/")] = _range(low, high, value)
    return parameters


def _of_tuning(file: _File, algorithms: _File, datasets: _File) -> ImportedStudy:
    tuning = file.check(_Tuning)
    system = _system(algorithms, tuning.algo_name, file, ("algo_name",))
    if system is None:
        raise file.error(("algo_name",), f"{tuning.algo_name} is an image of ROS 2, not of ROS 1")
    asked, notes = ("dataset_settings", "name"), system.notes
    sequence = _sequence(datasets, tuning.dataset, file, asked, system)
    sequence |= {"start": tuning.start} if tuning.start else {}
    if tuning.duration is not None and tuning.duration > 0:
        sequence["stop"] = tuning.start + tuning.duration
    if {"start", "stop"} & set(sequence) and "points" not in system.settings:
        notes.append(
            "Only a part of the recording is played, from a bag that adaptune writes: "
            "give odometry.settings points, and imu, the topics that the system reads."
        )
    search = _annealing if tuning.tuning_algo == "simulated_annealing" else _grid
    parameters, offline = search(file, tuning, system.template, notes)
    weights = tuning.model_dump(include={"ape", "rpe"}, exclude_none=True) or {"rpe": 1.0}
    if not (total := sum(weights.values())):
        raise file.error(("metric_weights",), "give ape or rpe a weight above 0")
    objective = {key: weight / total for key, weight in weights.items() if weight}
    offline = {"objective": objective, "segments": "all", "workers": 1} | offline
    offline |= {} if tuning.hours is None else {"hours": tuning.hours}
    how = f"{tuning.tuning_algo.replace('_', ' ')} for {system.name} on {tuning.dataset}"
    about = f"Made of the tuning {tuning.name!r}, {file.path.name}: {how}."
    data = _study(system.settings, parameters, tuning.dataset, sequence, offline)
    return ImportedStudy(_name(tuning.name), about, data, notes)


def _study(
    settings: dict[str, Any], parameters: _Parameters, name: str, sequence: Any, offline: Any
) -> dict[str, Any]:
    return {
        "odometry": {"name": "rustle", "settings": settings, "parameters": parameters},
        "sequences": {_name(name): sequence},
        "training": [_name(name)],
        "offline": offline,
    }
