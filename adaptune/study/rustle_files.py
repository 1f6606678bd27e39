"""The YAML files of RUSTLE: its algorithms, data sets, tests and tunings.

RUSTLE (https://github.com/mjpc13/rustle) ignores keys that it does not know; so does this module,
and tells of them.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from adaptune import yaml
from adaptune.errors import AdaptuneError
from adaptune.plain_words import Key
from adaptune.space import nearest
from adaptune.strict import StrictModel
from adaptune.study.mistakes import Mistake, validated

Number = int | float
Count = Annotated[int, Field(ge=0, le=10**9)]
_Speed = Annotated[Number, Field(gt=0, le=1000)]
Positive = Annotated[int, Field(ge=1, le=10**6)]


class RustleError(AdaptuneError):
    """A file of RUSTLE that cannot be imported."""


class _Loose(StrictModel):
    model_config = ConfigDict(extra="allow")


class Algorithm(_Loose):
    """A SLAM system in an image, its parameter file and the topics of its poses."""

    name: str
    image_name: str
    parameters: str
    odom_topics: Annotated[tuple[str, ...], Field(min_length=1)]
    version: str | Number | None = None
    ros_version: str = "ROS_1"


class Algorithms(_Loose):
    """The file of the algorithms."""

    algorithms: tuple[Algorithm, ...]


class Dataset(_Loose):
    """A folder of bags, and the topic of its ground truth."""

    name: str
    dataset_path: str
    ground_truth_topic: str | None = Field(
        None, validation_alias=AliasChoices("ground_truth_topic", "groundtruth_topic")
    )
    tag: tuple[str, ...] = ()
    ros_version: str = "ROS_1"


class Datasets(_Loose):
    """The file of the data sets."""

    datasets: tuple[Dataset, ...]


class TypeOfTest(_Loose):
    """What a test does to the recording."""

    type: Literal["simple", "speed", "drop", "cut"]
    speed_factors: Annotated[tuple[_Speed, ...], Field(min_length=1, max_length=100)] | None = None
    speed_range: Annotated[Number, Field(ge=1, le=100)] | None = None
    speed_step: Annotated[Number, Field(ge=1e-2)] | None = None
    drop_list: Any = None
    cut_list: Any = None


class RustleTest(_Loose):
    """A test: some algorithms on a data set, each run several times."""

    name: str
    dataset_name: str
    algo_list: Annotated[tuple[str, ...], Field(min_length=1)]
    test_type: TypeOfTest
    workers: Annotated[int, Field(ge=1, le=256)] = 1
    iterations: Annotated[int, Field(ge=1, le=1000)] = Field(
        1, validation_alias=AliasChoices("iterations", "num_iterations")
    )


class RustleTests(_Loose):
    """The file of the tests."""

    test_definitions: Annotated[tuple[RustleTest, ...], Field(min_length=1)]


class DatasetSettings(_Loose):
    """The part of a data set that a tuning plays."""

    name: str
    start: Annotated[Number, Field(ge=0)] = 0.0
    duration: Number | None = None  # seconds; all if it is not positive


class EarlyStopping(_Loose):
    """When a grid or a random search gives up."""

    tolerance: Positive
    delta: Number | None = None


class MetricWeights(_Loose):
    """What a tuning minimises."""

    ape: Annotated[Number, Field(ge=0)] = 0.0
    rpe: Annotated[Number, Field(ge=0)] = 0.0


class Temperature(_Loose):
    """How annealing cools down."""

    initial_value: Annotated[Number, Field(gt=0)]
    function: Literal["fast", "boltzman", "exponential"] | None = None
    alpha: Annotated[Number, Field(gt=0, le=1)] | None = None


class Triggers(_Loose):
    """Numbers of iterations."""

    fixed: Count | None = None
    accepted: Count | None = None
    best: Count | None = None


class Perturbation(_Loose):
    """Steps of annealing for parameters that have none of their own."""

    integer_delta_max: Count | None = None
    float_mean: Number | None = None
    float_std_dev: Annotated[Number, Field(ge=0)] | None = None


class Annealing(_Loose):
    """Settings of simulated annealing."""

    temperature: Temperature
    # For each parameter its first value, its bounds, and perhaps its step: the longest one, or mean
    # and standard deviation.
    parameter_bounds: dict[str, Annotated[tuple[Number, ...], Field(min_length=3, max_length=5)]]
    reanneal: Triggers = Triggers()
    halting_conditions: Triggers = Triggers()
    perturbation_functions: Perturbation = Perturbation()
    max_iterations: Positive | None = None


class Tuning(_Loose):
    """A search for parameters."""

    name: str
    algo_name: str
    dataset_settings: DatasetSettings
    tuning_algo: Literal["grid_search", "random_search", "simulated_annealing"]
    metric_weights: MetricWeights = MetricWeights(rpe=1.0)
    early_stopping: EarlyStopping | None = None
    time_limit: Annotated[Number, Field(gt=0, le=1e5)] | None = None  # hours
    parameters: dict[str, Any] | None = None
    tuning_settings: Annealing | None = None


M = TypeVar("M", bound=BaseModel)


class RustleFile(NamedTuple):
    """A file, its text, and where things stand in it."""

    path: Path
    document: yaml.Document

    def error(self, key: Key, message: str) -> RustleError:
        """An error about the value at a key."""
        line = self.document.line(key)
        where = f"{self.path}, line {line}" if line else str(self.path)
        dotted = ".".join(map(str, key))
        return RustleError(f"{where}: {dotted + ': ' if dotted else ''}{message}")

    def check(self, model: type[M]) -> M:
        """The content, or an error that lists the mistakes in it."""
        mistakes: list[Mistake] = []
        found = validated(model, self.document.data, (), mistakes)
        if found is None:
            raise RustleError("\n".join(str(self.error(*mistake)) for mistake in mistakes))
        return found

    def find(self, key: str, names: list[str], name: str, asked: Key, by: "RustleFile") -> int:
        """Place of the entry of a list with a name for which another file asks."""
        if name not in names:
            what = f"{self.path.name} has no {name!r} in {key}: {nearest(name, names)}"
            raise by.error(asked, what)
        return names.index(name)


def read(path: Path) -> RustleFile:
    """Read a file.

    Raises
    ------
    RustleError
        If it cannot be read, or is no YAML with keys.
    """
    try:
        document = yaml.Document.of_file(path)
    except yaml.YamlError as error:
        raise RustleError(str(error)) from error
    if not isinstance(document.data, dict):
        raise RustleError(f"{path}: this is no file of RUSTLE, which has keys and values")
    return RustleFile(path, document)


def unknown_keys(model: BaseModel, key: Key = ()) -> Iterator[str]:
    """Keys that RUSTLE does not have, as far as is known here."""
    for name in model.model_extra or {}:
        yield ".".join(map(str, (*key, name)))
    for name in type(model).model_fields:
        value = getattr(model, name)
        entries = enumerate(value) if isinstance(value, tuple) else [(None, value)]
        for i, entry in entries:
            if isinstance(entry, BaseModel):
                yield from unknown_keys(entry, (*key, name) if i is None else (*key, name, i))
