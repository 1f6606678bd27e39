"""The YAML files of RUSTLE: its algorithms, data sets, tests and tunings.

RUSTLE (https://github.com/mjpc13/rustle) ignores keys that it does not know; so does this module,
and tells of them.
"""

import math
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from adaptune import files
from adaptune.errors import AdaptuneError, OdometryError, nearest
from adaptune.odometry.program import Template
from adaptune.strict import Key, Mistake, StrictModel, validated

_Number = int | float
_Count = Annotated[int, Field(ge=0, le=10**9)]
_Speed = Annotated[_Number, Field(gt=0, le=1000)]
_Positive = Annotated[int, Field(ge=1, le=10**6)]


class RustleError(AdaptuneError):
    """A file of RUSTLE that cannot be imported."""


class _Loose(StrictModel):
    model_config = ConfigDict(extra="allow")


class _Algorithm(_Loose):
    name: str
    image_name: str
    parameters: str  # a file
    odom_topics: Annotated[tuple[str, ...], Field(min_length=1)]
    version: str | _Number | None = None
    ros_version: str = "ROS_1"


class _Algorithms(_Loose):
    algorithms: tuple[_Algorithm, ...]


class _Dataset(_Loose):
    name: str
    dataset_path: str  # a folder of bags
    ground_truth_topic: str | None = Field(
        None, validation_alias=AliasChoices("ground_truth_topic", "groundtruth_topic")
    )
    tag: tuple[str, ...] = ()
    ros_version: str = "ROS_1"


class _Datasets(_Loose):
    datasets: tuple[_Dataset, ...]


class _TypeOfTest(_Loose):
    type: Literal["simple", "speed", "drop", "cut"]
    speed_factors: Annotated[tuple[_Speed, ...], Field(min_length=1, max_length=100)] | None = None
    speed_range: Annotated[_Number, Field(ge=1, le=100)] | None = None
    speed_step: Annotated[_Number, Field(ge=1e-2)] | None = None
    drop_list: Any = None
    cut_list: Any = None


class _Test(_Loose):
    name: str
    dataset_name: str
    algo_list: Annotated[tuple[str, ...], Field(min_length=1)]
    test_type: _TypeOfTest
    workers: Annotated[int, Field(ge=1, le=256)] = 1
    iterations: Annotated[int, Field(ge=1, le=1000)] = Field(
        1, validation_alias=AliasChoices("iterations", "num_iterations")
    )


class _Tests(_Loose):
    test_definitions: Annotated[tuple[_Test, ...], Field(min_length=1)]


class _DatasetSettings(_Loose):
    name: str
    start: Annotated[_Number, Field(ge=0)] = 0.0
    duration: _Number | None = None  # seconds; all if it is not positive


class _EarlyStopping(_Loose):
    tolerance: _Positive
    delta: _Number | None = None


class _MetricWeights(_Loose):
    ape: Annotated[_Number, Field(ge=0)] = 0.0
    rpe: Annotated[_Number, Field(ge=0)] = 0.0


class _Temperature(_Loose):
    initial_value: Annotated[_Number, Field(gt=0)]
    function: Literal["fast", "boltzman", "exponential"] | None = None
    alpha: Annotated[_Number, Field(gt=0, le=1)] | None = None


class _Triggers(_Loose):
    # _Numbers of iterations.
    fixed: _Count | None = None
    accepted: _Count | None = None
    best: _Count | None = None


class _Perturbation(_Loose):
    # For parameters that have no step of their own.
    integer_delta_max: _Count | None = None
    float_mean: _Number | None = None
    float_std_dev: Annotated[_Number, Field(ge=0)] | None = None


class _Annealing(_Loose):
    temperature: _Temperature
    # For each parameter its first value, its bounds, and perhaps its step: the longest one, or mean
    # and standard deviation.
    parameter_bounds: dict[str, Annotated[tuple[_Number, ...], Field(min_length=3, max_length=5)]]
    reanneal: _Triggers = _Triggers()
    halting_conditions: _Triggers = _Triggers()
    perturbation_functions: _Perturbation = _Perturbation()
    max_iterations: _Positive | None = None


class _Tuning(_Loose):
    name: str
    algo_name: str
    dataset_settings: _DatasetSettings
    tuning_algo: Literal["grid_search", "random_search", "simulated_annealing"]
    metric_weights: _MetricWeights = _MetricWeights(rpe=1.0)
    early_stopping: _EarlyStopping | None = None
    time_limit: Annotated[_Number, Field(gt=0, le=1e5)] | None = None  # hours
    parameters: dict[str, Any] | None = None
    tuning_settings: _Annealing | None = None


M = TypeVar("M", bound=BaseModel)


class _File:
    """A file, its content, and where things stand in it."""

    def __init__(self, path: Path):
        self.path = path
        try:
            self.document = files.Document.of_file(path)
        except files.YamlError as error:
            raise RustleError(str(error)) from error
        self.data: Any = self.document.data
        if not isinstance(self.data, dict):
            raise RustleError(f"{path}: this is no file of RUSTLE, which has keys and values")

    def error(self, key: Key, message: str) -> RustleError:
        """An error about the value at a key."""
        line = self.document.line(key)
        where = f"{self.path}, line {line}" if line else str(self.path)
        dotted = ".".join(map(str, key))
        return RustleError(f"{where}: {dotted + ': ' if dotted else ''}{message}")

    def check(self, model: type[M], notes: list[str]) -> M:
        """The content, or an error that lists the mistakes in it; notes tell of unknown keys."""
        mistakes: list[Mistake] = []
        content = validated(model, self.data, (), mistakes)
        if content is None:
            raise RustleError("\n".join(str(self.error(*mistake)) for mistake in mistakes))
        ignored = "is not known here, and is ignored."
        notes += [f"{self.path.name}: {key} {ignored}" for key in _unknown_keys(content)]
        return content


def _unknown_keys(model: BaseModel, key: Key = ()) -> Iterator[str]:
    for name in model.model_extra or {}:
        yield ".".join(map(str, (*key, name)))
    for name in type(model).model_fields:
        value = getattr(model, name)
        entries = enumerate(value) if isinstance(value, tuple) else [(None, value)]
        for i, entry in entries:
            if isinstance(entry, BaseModel):
                yield from _unknown_keys(entry, (*key, name) if i is None else (*key, name, i))


# Searches for parameters in RUSTLE's tunings, as settings of the offline stage.


_MOST_POINTS = 10**6
"""Trials of a random search over a grid, and points on an axis."""
_ALPHA = 0.95
"""What RUSTLE's exponential cooling multiplies the temperature by."""

Search = tuple[dict[str, Any], dict[str, Any]]
"""The parameters, and the settings of the search."""


def _range(low: _Number, high: _Number, baseline: _Number) -> dict[str, Any]:
    """A parameter of a study; it is a whole number if all three are."""
    whole = all(isinstance(value, int) for value in (low, high, baseline))
    ends = {"low": low, "high": high, "baseline": baseline}
    if whole:
        return {"type": "integer", **ends}
    return {"type": "float", **{key: float(value) for key, value in ends.items()}}


def _default(file: _File, key: Key, template: Template) -> Any:
    """What a parameter is in the parameter file, which has its type."""
    try:
        return template.value(str(key[-1]))
    except OdometryError as error:
        raise file.error(key, str(error)) from error


def _number_default(file: _File, key: Key, template: Template) -> _Number:
    default: _Number = _default(file, key, template)
    if not _is_number(default):
        raise file.error(key, f"is {default!r} in the parameter file, which cannot be tuned")
    return default


def _grid(file: _File, tuning: _Tuning, template: Template, notes: list[str]) -> Search:
    if not tuning.parameters:
        raise file.error(("parameters",), "give the parameters, each [first, step, number]")
    parameters: dict[str, Any] = {}
    axes: dict[str, Any] = {}
    size = 1
    for name, given in tuning.parameters.items():
        key = ("parameters", name)
        default = _default(file, key, template)
        if not isinstance(given, list):
            notes.append(f"{name} is fixed at {given!r}: write that into {template.path}.")
            continue
        if isinstance(default, str | bool):
            parameters[name], axes[name] = _categories(file, key, given, default), given
            size *= len(given)
        else:
            parameters[name] = _axis(file, key, given, _number_default(file, key, template))
            axes[name] = given
            size *= given[2]
    if not parameters:
        raise file.error(("parameters",), "all of them are fixed; give one [first, step, number]")
    offline: dict[str, Any] = {"sampler": "grid", "sampler_settings": {"grid": axes}}
    if tuning.tuning_algo == "random_search":
        offline["sampler"] = "random"
        if tuning.time_limit is None:
            offline["trials"] = min(size + 1, _MOST_POINTS)
    stopping = tuning.early_stopping
    if stopping is not None and tuning.time_limit is None:
        offline["stagnation"] = stopping.tolerance
        notes.append(
            "early_stopping.delta has no counterpart: any better trial counts as a new best."
        )
    elif stopping is not None:
        notes.append("early_stopping has no effect in RUSTLE beside a time_limit, nor here.")
    return parameters, offline


def _categories(file: _File, key: Key, given: list[Any], default: str | bool) -> dict[str, Any]:
    if not given or any(type(value) is not type(default) for value in given):
        raise file.error(key, f"give a list of values like {default!r}")
    choices = given if default in given else [default, *given]
    if len(choices) < 2:
        raise file.error(key, "has one value; leave it out")
    return {"type": "categorical", "choices": choices, "baseline": default}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _axis(file: _File, key: Key, given: list[Any], default: Any) -> dict[str, Any]:
    """A range that holds the grid's points and the default."""
    form = "give [first, step, number]"
    if len(given) != 3 or not all(map(_is_number, given)) or not isinstance(given[2], int):
        raise file.error(key, f"{form}, not {given!r}")
    first, step, number = given
    if not 1 <= number <= _MOST_POINTS or (step == 0 and number > 1):
        raise file.error(key, f"{form}, the number from 1 on and the step not 0")
    last = first + step * (number - 1)
    low, high = min(first, last, default), max(first, last, default)
    return _range(low, high if high > low else low + (abs(step) or 1), default)


def _annealing(file: _File, tuning: _Tuning, template: Template, notes: list[str]) -> Search:
    given = tuning.tuning_settings
    if given is None:
        raise file.error(("tuning_settings",), "is missing")
    if not given.parameter_bounds:
        raise file.error(("tuning_settings", "parameter_bounds"), "names no parameter")
    walks = {
        name: _walk(file, ("tuning_settings", "parameter_bounds", name), bounds, given, template)
        for name, bounds in given.parameter_bounds.items()
    }
    notes += [
        f"The default of {name} lies outside of its bounds; the walk keeps to them."
        for name, walk in walks.items()
        if {"low", "high"} & set(walk.step)
    ]
    settings = _schedule(given, notes)
    settings["start"] = {name: walk.start for name, walk in walks.items()}
    settings["steps"] = {name: walk.step for name, walk in walks.items() if walk.step}
    offline: dict[str, Any] = {"sampler": "annealing", "sampler_settings": settings}
    offline |= {"initial": 1, "batch": 1, "seed": 0}
    if given.max_iterations is not None:
        offline["trials"] = given.max_iterations + 1  # and the baseline
    if tuning.early_stopping is not None:
        notes.append("early_stopping has no effect on annealing in RUSTLE, nor here.")
    notes.append("A step beyond a bound is reflected; RUSTLE cuts it off.")
    return {name: walk.parameter for name, walk in walks.items()}, offline


def _schedule(given: _Annealing, notes: list[str]) -> dict[str, Any]:
    """Temperatures and triggers."""
    settings: dict[str, Any] = {"chains": 1, "energy_scale": 1.0}
    settings["initial_temperature"] = float(given.temperature.initial_value)
    settings["alpha"] = float(given.temperature.alpha or _ALPHA)
    if given.temperature.function in ("fast", "boltzman"):
        what = f"temperature.function {given.temperature.function} has no counterpart: adaptune"
        notes.append(f"{what} multiplies the temperature by alpha after every step.")
    heats, stalls = given.reanneal, given.halting_conditions
    counts = {
        "reanneal_fixed": heats.fixed,
        "reanneal_accepted": heats.accepted,
        "reanneal_best": heats.best,
        "stall_accepted": stalls.accepted,
        "stall_best": stalls.best,
    }
    return settings | {name: count for name, count in counts.items() if count}


class _Walk(NamedTuple):
    parameter: dict[str, Any]
    start: _Number
    step: dict[str, Any]


def _walk(
    file: _File, key: Key, bounds: Sequence[_Number], given: _Annealing, template: Template
) -> _Walk:
    default = _number_default(file, key, template)
    first, low, high = bounds[:3]
    if not low <= first <= high or low == high:
        raise file.error(key, "give [first, low, high, ...], low below high and first in them")
    # A range must hold the default; the walk keeps RUSTLE's bounds.
    parameter = _range(min(low, default), max(high, default), default)
    step = _step(file, key, bounds, parameter["type"], given)
    step |= {"low": low} if default < low else {}
    step |= {"high": high} if default > high else {}
    return _Walk(parameter, first, step)


def _step(
    file: _File,
    key: Key,
    bounds: Sequence[_Number],
    kind: str,
    given: _Annealing,
) -> dict[str, Any]:
    """A step of its own, or the one of all parameters."""
    own, usual = bounds[3:], given.perturbation_functions
    if kind == "integer":
        if len(own) > 1 or any(not isinstance(value, int) for value in own):
            raise file.error(key, "a whole number has [first, low, high, longest step]")
        longest = own[0] if own else usual.integer_delta_max
        return {} if longest is None else {"delta_max": longest}
    if len(own) == 1 or any(value < 0 for value in own[1:]):
        raise file.error(key, "a real number has [first, low, high, mean, standard deviation]")
    mu, sigma = own or (usual.float_mean, usual.float_std_dev)
    step = {"mu": mu, "sigma": sigma}
    return {name: float(value) for name, value in step.items() if value is not None}


# Studies made of RUSTLE's tests and tunings.


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
        lines = _wrapped("# ", self.about)
        if self.notes:
            lines.append("# Not taken over, or to be looked at:")
        for note in self.notes:
            lines += _wrapped("# - ", note)
        sections = [files.dump({key: value}) for key, value in self.data.items()]
        return "\n".join([*lines, "", "\n".join(sections)])


def _wrapped(begin: str, text: str) -> list[str]:
    lines = textwrap.wrap(text, 98 - len(begin), break_long_words=False, break_on_hyphens=False)
    return [f"{'# '.ljust(len(begin)) if i else begin}{line}" for i, line in enumerate(lines)]


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
    file = _File(path)
    library = _Library(file, algorithms, datasets)
    if "test_definitions" in file.data:
        return _of_tests(file, library)
    if "tuning_algo" in file.data:
        return [_of_tuning(file, library)], []
    raise file.error((), "has neither test_definitions, as tests, nor tuning_algo, as a tuning")


class _Library:
    """The algorithms and the data sets, as sections of a study."""

    def __init__(self, asking: _File, algorithms: Path, datasets: Path):
        self.notes: list[str] = []
        self._asking = asking
        self._algorithms, self._datasets = _File(algorithms), _File(datasets)
        self.algorithms = self._algorithms.check(_Algorithms, self.notes).algorithms
        self.datasets = self._datasets.check(_Datasets, self.notes).datasets

    def _place(self, file: _File, key: str, names: list[str], name: str, asked: Key) -> int:
        """Place of the entry for which the file of the studies asks."""
        if name not in names:
            what = f"{file.path.name} has no {name!r} in {key}: {nearest(name, names)}"
            raise self._asking.error(asked, what)
        return names.index(name)

    def system(self, name: str, asked: Key) -> "_System | None":
        """An algorithm; None if it is one for ROS 2."""
        file, names = self._algorithms, [each.name for each in self.algorithms]
        i = self._place(file, "algorithms", names, name, asked)
        given = self.algorithms[i]
        if given.ros_version.lower().replace("_", "") == "ros2":
            return None
        try:
            template = Template((file.path.parent / given.parameters).resolve())
        except OdometryError as error:
            raise file.error(("algorithms", i, "parameters"), str(error)) from error
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

    def sequence(
        self, name: str, asked: Key, topics: Mapping[str, str]
    ) -> tuple[dict[str, Any], list[str]]:
        """A data set as a sequence, for a system that reads these topics, and notes on it."""
        file, names = self._datasets, [each.name for each in self.datasets]
        given = self.datasets[self._place(file, "datasets", names, name, asked)]
        folder = file.path.parent / given.dataset_path
        bags, notes = sorted(folder.glob("*.bag")), []
        if not folder.exists():
            notes.append(f"There is no {folder} here: correct the path of the bag.")
        elif not bags:
            notes.append(f"There is no bag in {folder}: correct the path of the bag.")
        elif len(bags) > 1:
            notes.append(f"The bags of {folder} are taken for one recording, as RUSTLE plays them.")
        bag = bags[0] if len(bags) == 1 else folder
        data: dict[str, Any] = {"bag": str(bag.resolve())}
        data |= {"points": topics["points"]} if "points" in topics else {}
        data |= {"imu": {"topic": topics["imu"]}} if "imu" in topics else {}
        if given.ground_truth_topic is not None:
            data["reference"] = given.ground_truth_topic
        else:
            notes.append(f"{name} has no ground truth: adaptune estimates a reference.")
        return data, notes


class _System(NamedTuple):
    name: str
    settings: dict[str, Any]
    template: Template
    notes: list[str]


def _topic(template: Template, kind: str) -> str | None:
    for name in _TOPICS[kind]:
        try:
            value = template.value(name)
        except OdometryError:
            continue
        if isinstance(value, str) and value.startswith("/"):
            return value
    return None


def _name(*parts: str) -> str:
    return "_".join(re.sub(r"[^\w.-]+", "_", part).strip("._-") or "unnamed" for part in parts)


def _study(
    settings: dict[str, Any], parameters: Any, name: str, sequence: Any, offline: Any
) -> dict[str, Any]:
    return {
        "odometry": {"name": "rustle", "settings": settings, "parameters": parameters},
        "sequences": {_name(name): sequence},
        "training": [_name(name)],
        "offline": offline,
    }


def _of_tests(file: _File, library: _Library) -> tuple[list[ImportedStudy], list[str]]:
    studies, skipped = list[ImportedStudy](), list[str]()
    tests = file.check(_Tests, skipped)
    skipped += library.notes
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
            sequence, notes = library.sequence(
                test.dataset_name, (*key, "dataset_name"), system.settings
            )
            studies += [
                _of_test(file, test, system._replace(notes=system.notes + notes), sequence, speed)
                for speed in _speeds(file, key, test)
            ]
    if not studies:
        raise RustleError("\n".join([f"{file.path}: no study can be made of it", *skipped]))
    return studies, skipped


def _speeds(file: _File, key: Key, test: _Test) -> list[float]:
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
    file: _File, test: _Test, system: _System, sequence: Any, speed: float
) -> ImportedStudy:
    parameters = dict(_every_number(system.template))
    if not parameters:
        raise file.error((), f"{system.template.path} holds no number that could be tuned")
    offline = {"objective": "rpe", "runs": "whole", "trials": 1}
    offline |= {"baseline_runs": test.iterations, "workers": test.workers}
    notes = [
        *system.notes,
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
    settings = system.settings | {"rate": speed}
    data = _study(settings, parameters, test.dataset_name, sequence, offline)
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
        yield "/".join(parts), _range(ends[0], ends[1], value)


def _of_tuning(file: _File, library: _Library) -> ImportedStudy:
    notes: list[str] = []
    tuning = file.check(_Tuning, notes)
    system = library.system(tuning.algo_name, ("algo_name",))
    if system is None:
        raise file.error(("algo_name",), f"{tuning.algo_name} is an image of ROS 2, not of ROS 1")
    of = tuning.dataset_settings
    sequence, of_data = library.sequence(of.name, ("dataset_settings", "name"), system.settings)
    part = {"start": float(of.start)} if of.start else {}
    if of.duration is not None and of.duration > 0:
        part["stop"] = float(of.start + of.duration)
    notes += [*library.notes, *system.notes, *of_data]
    if part and "points" not in system.settings:
        notes.append(
            "Only a part of the recording is played, from a bag that adaptune writes: "
            "give odometry.settings points, and imu, the topics that the system reads."
        )
    search = _annealing if tuning.tuning_algo == "simulated_annealing" else _grid
    parameters, offline = search(file, tuning, system.template, notes)
    weights = {k: float(w) for k, w in tuning.metric_weights if w and k in ("ape", "rpe")}
    if not weights:
        raise file.error(("metric_weights",), "give ape or rpe a weight above 0")
    total = sum(weights.values())
    objective = {key: weight / total for key, weight in weights.items()}
    offline = {"objective": objective, "runs": "whole", "workers": 1} | offline
    if tuning.time_limit is not None:
        offline["hours"] = float(tuning.time_limit)
    data = _study(system.settings, parameters, of.name, sequence | part, offline)
    how = tuning.tuning_algo.replace("_", " ")
    what = f"Made of the tuning {tuning.name!r}, {file.path.name}"
    about = f"{what}: {how} for {system.name} on {of.name}."
    return ImportedStudy(_name(tuning.name), about, data, notes)
