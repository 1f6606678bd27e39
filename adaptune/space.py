"""The parameters of an odometry: their types, their ranges, and their map to the unit cube."""

import math
from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from adaptune._system.strict import ConfigurationError, StrictModel, in_one_line
from adaptune.errors import AdaptuneError, nearest

Value = float | int | str | bool
ParameterSet = dict[str, Value]
"""A value for every parameter, by name."""


class SpaceError(AdaptuneError):
    """A parameter set that does not fit its space."""


class _Told(StrictModel):
    """Says in a sentence what is wrong with a parameter that code makes."""

    def __new__(cls, *_: Any, **named: Any) -> Self:
        try:
            if named:  # where data are validated, pydantic gives none
                cls.model_validate(named)
        except ValidationError as error:
            given = ", ".join(f"{key}={value!r}" for key, value in named.items())
            said = in_one_line(error, named)
            raise ConfigurationError(f"{cls.__name__}({given}): {said}") from None
        return super().__new__(cls)


class _Range(_Told):
    """Bounds, scale and unit of a real or whole number."""

    _types: ClassVar[tuple[type, ...]] = (int,)

    low: float
    high: float
    baseline: float
    log: bool = False
    unit: str = ""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low ({self.low:g}) must be less than high ({self.high:g})")
        if not self.low <= self.baseline <= self.high:
            what = f"between low ({self.low:g}) and high ({self.high:g})"
            raise ValueError(f"baseline ({self.baseline:g}) must lie {what}")
        if self.log and self.low <= 0:
            raise ValueError(f"a log scale needs low ({self.low:g}) above 0")
        return self

    def contains(self, value: object) -> bool:
        """Whether `value` is a number of the type and in the range."""
        if not isinstance(value, int | float) or isinstance(value, bool):
            return False
        return isinstance(value, self._types) and self.low <= value <= self.high

    def to_unit(self, value: Any) -> float:
        """Map a value to [0, 1], a whole number to the middle of its share."""
        low, high = self._bounds()
        return (self._scale(float(value)) - low) / (high - low)

    def _unscaled(self, unit: float) -> float:
        low, high = self._bounds()
        value = low + min(max(unit, 0.0), 1.0) * (high - low)
        return math.exp(value) if self.log else value

    def _scale(self, value: float) -> float:
        return math.log(value) if self.log else value

    def _bounds(self) -> tuple[float, float]:
        """Ends of the unit interval, scaled."""
        return self._scale(self.low), self._scale(self.high)


class Float(_Range):
    """A real number from `low` to `high`, both included; `log` spaces it evenly in ratio."""

    _types: ClassVar[tuple[type, ...]] = (int, float)

    type: Literal["float"] = "float"

    def from_unit(self, unit: float) -> float:
        """Map from [0, 1] to a value."""
        return self.rounded(self._unscaled(unit))

    def rounded(self, value: float) -> float:
        """Four digits of a value, of a narrow range more: files, tables and drives then agree."""
        finest = min(abs(value), self.high - self.low) or 1.0
        value = round(value, 3 - math.floor(math.log10(finest)))
        return min(max(value, self.low), self.high)


_Whole = Annotated[int, Field(ge=-(2**53), le=2**53)]


class Integer(_Range):
    """A whole number from `low` to `high`, both included."""

    type: Literal["integer"] = "integer"
    low: _Whole
    high: _Whole
    baseline: _Whole

    def from_unit(self, unit: float) -> int:
        """Map from [0, 1] to the value whose share it falls in."""
        return min(max(round(self._unscaled(unit)), self.low), self.high)

    def _bounds(self) -> tuple[float, float]:
        # Half a step on either side gives the first and the last value a whole share.
        return self._scale(self.low - 0.5), self._scale(self.high + 0.5)


class Categorical(_Told):
    """One of a list of values, without an order."""

    type: Literal["categorical"] = "categorical"
    choices: tuple[Value, ...] = Field(min_length=2, max_length=1000)
    baseline: Value
    unit: str = ""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(set(map(repr, self.choices))) < len(self.choices):
            raise ValueError("choices repeat themselves")
        if not self.contains(self.baseline):
            raise ValueError(f"baseline {self.baseline!r} is not one of the choices")
        return self

    def contains(self, value: object) -> bool:
        """Whether `value` is one of the choices, of the same type."""
        return any(self._alike(value))

    def index(self, value: object) -> int:
        """Index of a choice."""
        return self._alike(value).index(True)

    def _alike(self, value: object) -> list[bool]:
        # Types are compared because True is equal to 1.
        return [type(value) is type(choice) and value == choice for choice in self.choices]

    def to_unit(self, value: Any) -> float:
        """Map a choice to the middle of its share of [0, 1]."""
        return (self.index(value) + 0.5) / len(self.choices)

    def from_unit(self, unit: float) -> Value:
        """Map from [0, 1] to the choice whose share it falls in."""
        n = len(self.choices)
        return self.choices[min(int(min(max(unit, 0.0), 1.0) * n), n - 1)]


Parameter = Annotated[Float | Integer | Categorical, Field(discriminator="type")]
_adapter: TypeAdapter[Float | Integer | Categorical] = TypeAdapter(Parameter)


class ParameterSpace:
    """The tuned parameters by name, in their order."""

    def __init__(self, parameters: Mapping[str, Float | Integer | Categorical]):
        self.parameters = dict(parameters)

    @classmethod
    def of(cls, **parameters: Float | Integer | Categorical) -> Self:
        """Make a space of parameters whose names are Python's."""
        return cls(parameters)

    def __eq__(self, other: object) -> bool:
        # As text, so that the order counts.
        return isinstance(other, ParameterSpace) and repr(self.dump()) == repr(other.dump())

    __hash__ = None  # type: ignore[assignment]

    def __len__(self) -> int:
        return len(self.parameters)

    def __repr__(self) -> str:
        ranges = (f"{name} {describe(parameter)}" for name, parameter in self.parameters.items())
        return f"<ParameterSpace: {', '.join(ranges)}>"

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(self.parameters)

    @property
    def logarithmic(self) -> list[str]:
        """Those of `names` whose range is spaced evenly in ratio."""
        return [name for name, p in self.parameters.items() if getattr(p, "log", False)]

    @property
    def labels(self) -> dict[str, str]:
        """What an axis says of each of `names`: the name and, if it is known, the unit."""
        return {name: label(name, parameter) for name, parameter in self.parameters.items()}

    @property
    def baseline(self) -> ParameterSet:
        """The odometry's own value of every parameter."""
        return {name: parameter.baseline for name, parameter in self.parameters.items()}

    @property
    def baselines(self) -> list[ParameterSet]:
        """The baseline of every odometry: of the only one."""
        return [self.baseline]

    def complete(self, parameters: Mapping[str, Value]) -> ParameterSet:
        """The whole set: what is not given is at its baseline."""
        return self.baseline | dict(parameters)

    def flat(self, parameters: ParameterSet) -> ParameterSet:
        """The set with the names that `parameters` of this space has."""
        return parameters

    def check(self, parameters: Mapping[str, object]) -> None:
        """Raise a SpaceError for a set with missing, unknown or out-of-range parameters."""
        for name, value in parameters.items():
            if name not in self.parameters:
                raise SpaceError(f"unknown parameter {name!r}: {nearest(name, self.names)}")
            if not self.parameters[name].contains(value):
                raise SpaceError(f"{name} = {value!r} is outside {describe(self.parameters[name])}")
        if missing := [name for name in self.names if name not in parameters]:
            raise SpaceError(f"no value for {', '.join(missing)}")

    def to_unit(self, sets: Sequence[Mapping[str, Value]]) -> NDArray[np.float64]:
        """Map parameter sets to the unit cube, of shape (n_sets, n_parameters)."""
        parameters = self.parameters.items()
        unit = [[p.to_unit(given[name]) for name, p in parameters] for given in sets]
        return np.array(unit, np.float64).reshape(len(sets), len(self))

    def from_unit(self, unit: NDArray[np.float64]) -> list[ParameterSet]:
        """Map points of the unit cube, of shape (n_sets, n_parameters), to parameter sets."""
        parameters = self.parameters.items()
        return [
            {name: p.from_unit(u) for (name, p), u in zip(parameters, row, strict=True)}
            for row in unit.tolist()
        ]

    def dump(self, units: bool = False) -> dict[str, dict[str, Any]]:
        """The space as plain data, without units: what trials depend on."""
        made = {}
        for name, p in self.parameters.items():
            made[name] = p.model_dump(mode="json", exclude={"unit"})
            if units and p.unit:
                made[name]["unit"] = p.unit
        return made

    def definition(self) -> dict[str, dict[str, Any]]:
        """The space as plain data, with the units that are known: what a study file may say."""
        return self.dump(units=True)

    @classmethod
    def load(cls, data: Mapping[str, Any]) -> Self:
        """Make a space of what `dump` or `definition` returned; else a pydantic.ValidationError."""
        return cls({name: _adapter.validate_python(p) for name, p in data.items()})


def label(name: str, parameter: Float | Integer | Categorical) -> str:
    """What an axis says of a parameter."""
    return f"{name} [{parameter.unit}]" if parameter.unit else name


def describe(parameter: Float | Integer | Categorical) -> str:
    """A parameter's range in a few words."""
    if isinstance(parameter, Categorical):
        return "{" + ", ".join(map(repr, parameter.choices)) + "}"
    return f"[{parameter.low:g}, {parameter.high:g}]"


@dataclass(frozen=True, eq=False)
class ParameterSets:
    """Parameter sets by the numbers of their trials.

    A set is known by its trial's number everywhere. Arrays with one column for each set have their
    columns in the order of this table; `columns` finds them.

    Attributes
    ----------
    space : ParameterSpace
    trials : tuple of int
        Numbers of the trials, each of them once.
    parameters : tuple of dict
        The sets, in the same order.
    """

    space: ParameterSpace
    trials: tuple[int, ...]
    parameters: tuple[ParameterSet, ...]

    def __post_init__(self) -> None:
        if not len(set(self.trials)) == len(self.trials) == len(self.parameters):
            raise ValueError("each parameter set needs a trial number of its own")

    def __len__(self) -> int:
        return len(self.trials)

    def __iter__(self) -> Iterator[int]:
        return iter(self.trials)

    def __contains__(self, trial: object) -> bool:
        return trial in self._columns

    def __getitem__(self, trial: int) -> ParameterSet:
        return self.parameters[self._columns[trial]]

    @cached_property
    def _columns(self) -> dict[int, int]:
        return {trial: column for column, trial in enumerate(self.trials)}

    @cached_property
    def unit(self) -> NDArray[np.float64]:
        """The sets in the unit cube, of shape (n_sets, n_parameters)."""
        return self.space.to_unit(self.parameters)

    def column(self, trial: int) -> int:
        """Column of a set in arrays that go with this table."""
        return self._columns[trial]

    def columns(self, trials: Iterable[int]) -> NDArray[np.intp]:
        """Columns of several sets."""
        return np.array([self._columns[trial] for trial in trials], np.intp)

    @property
    def defaults(self) -> list[int]:
        """Trial numbers of the sets that are the baseline of an odometry."""
        return [trial for trial in self.trials if self[trial] in self.space.baselines]

    def subset(self, trials: Sequence[int]) -> "ParameterSets":
        """A table of some of the sets."""
        return ParameterSets(self.space, tuple(trials), tuple(self[trial] for trial in trials))


def in_words(parameters: Mapping[str, Value]) -> str:
    """A set in a few words, with three digits of each number."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in parameters.items()
    )


# The parameters of several odometries: a parameter set says which odometry it is for.


ODOMETRY = "odometry"
"""Key of a parameter set under which its odometry stands."""


class PooledSpace(ParameterSpace):
    """The spaces of several odometries.

    A parameter set holds the label of an odometry under `ODOMETRY`, and a value for each of its
    parameters alone. In `parameters` and `flat`, the label stands before each name:
    ``gicp.keyframe_interval``.

    Parameters
    ----------
    spaces
        By label, the parameters of each odometry. The first one's baseline is that of all.
    """

    def __init__(self, spaces: Mapping[str, ParameterSpace]):
        self.spaces = dict(spaces)
        labels = tuple(self.spaces)
        flat: dict[str, Float | Integer | Categorical] = {}
        if len(labels) > 1:
            flat[ODOMETRY] = Categorical(choices=labels, baseline=labels[0])
        for label, space in self.spaces.items():
            flat |= {f"{label}.{name}": p for name, p in space.parameters.items()}
        super().__init__(flat)

    def __len__(self) -> int:
        return len(self.spaces) + sum(map(len, self.spaces.values()))

    @property
    def names(self) -> tuple[str, ...]:
        """The keys of parameter sets: `ODOMETRY`, and every name that any odometry has."""
        own = (name for space in self.spaces.values() for name in space.names)
        return tuple(dict.fromkeys((ODOMETRY, *own)))

    @property
    def logarithmic(self) -> list[str]:
        """Those of `names` that some odometry spaces evenly in ratio."""
        every = [name for space in self.spaces.values() for name in space.logarithmic]
        return list(dict.fromkeys(every))

    @property
    def labels(self) -> dict[str, str]:
        """See `ParameterSpace.labels`; of a name that several odometries have, by the first one."""
        return {ODOMETRY: ODOMETRY, **ChainMap(*(space.labels for space in self.spaces.values()))}

    @property
    def baselines(self) -> list[ParameterSet]:
        """See `ParameterSpace.baselines`."""
        return [{ODOMETRY: label, **space.baseline} for label, space in self.spaces.items()]

    @property
    def baseline(self) -> ParameterSet:
        """That of the first odometry."""
        return self.baselines[0]

    def split(self, parameters: Mapping[str, object]) -> tuple[str, dict[str, Any]]:
        """The label of a set's odometry, and the values of its parameters.

        There is a `SpaceError` if there is no such odometry.
        """
        own = dict(parameters)
        label = own.pop(ODOMETRY, None)
        if label not in self.spaces:
            what = "names no odometry" if label is None else f"there is no odometry {label!r}"
            raise SpaceError(f"{ODOMETRY}: {what}; {nearest(str(label), self.spaces)}")
        return str(label), own

    def complete(self, parameters: Mapping[str, Value]) -> ParameterSet:
        """See `ParameterSpace.complete`; a SpaceError if there is no such odometry."""
        label, own = self.split(parameters)
        return {ODOMETRY: label, **self.spaces[label].complete(own)}

    def flat(self, parameters: ParameterSet) -> ParameterSet:
        """See `ParameterSpace.flat`."""
        label, own = self.split(parameters)
        return {ODOMETRY: label} | {f"{label}.{name}": value for name, value in own.items()}

    def check(self, parameters: Mapping[str, object]) -> None:
        """See `ParameterSpace.check`."""
        label, own = self.split(parameters)
        self.spaces[label].check(own)

    def to_unit(self, sets: Sequence[Mapping[str, Value]]) -> NDArray[np.float64]:
        """Map parameter sets to the unit cube, of shape (n_sets, n_odometries + n_parameters).

        For each odometry 1 or 0, for whether the set is its; then its parameters, 0.5 where the set
        is another's. So sets of two odometries are farther apart than most of one.
        """
        labels = list(self.spaces)
        unit = np.full((len(sets), len(self)), 0.5)
        unit[:, : len(labels)] = 0.0
        for row, given in zip(unit, sets, strict=True):
            label, own = self.split(given)
            row[labels.index(label)] = 1.0
            row[self._columns(label)] = self.spaces[label].to_unit([own])[0]
        return unit

    def from_unit(self, unit: NDArray[np.float64]) -> list[ParameterSet]:
        """Map what `to_unit` returns to parameter sets; the highest of the first columns counts."""
        labels, sets = list(self.spaces), []
        for row in unit:
            label = labels[int(np.argmax(row[: len(labels)]))]
            own = self.spaces[label].from_unit(row[None, self._columns(label)])
            sets.append({ODOMETRY: label, **own[0]})
        return sets

    def _columns(self, label: str) -> slice:
        """Where the parameters of an odometry are in the unit cube."""
        before = list(self.spaces).index(label)
        begin = len(self.spaces) + sum(map(len, list(self.spaces.values())[:before]))
        return slice(begin, begin + len(self.spaces[label]))

    def dump(self, units: bool = False) -> dict[str, dict[str, Any]]:
        """The spaces by label, as plain data."""
        return {label: space.dump(units) for label, space in self.spaces.items()}


def load_space(data: Mapping[str, Any]) -> ParameterSpace:
    """Make a space, of one odometry or of several, of what its `dump` returned; see `load`."""
    # A parameter has a type, and an odometry has parameters.
    spaces = [of for of in data.values() if isinstance(of, Mapping)]
    pooled = len(spaces) == len(data) and not any(isinstance(of.get("type"), str) for of in spaces)
    if data and pooled:
        return PooledSpace({label: ParameterSpace.load(of) for label, of in data.items()})
    return ParameterSpace.load(data)


State = Literal["unknown", "good", "doubtful", "lost"]
"""Whether to believe a pose."""
IN_DOUBT: frozenset[State] = frozenset({"doubtful", "lost"})
"""States in which something speaks against it."""


class Selection(NamedTuple):
    """A parameter set, or in a bank the weights of its members.

    Attributes
    ----------
    trial : int
        Number of the set's trial; in a bank that of the member with the largest weight.
    parameters : dict
        The set.
    weights : dict, optional
        In a bank, the weight of every member by its trial number. They add up to 1.
    predicted_error : float
        Percent.
    predicted_fixed : float
        Percent, the predicted error of the fixed set at this scan.
    similarity : float
        Share of the training frames that are farther from the other training segments than the
        scan is from all of them; NaN where the rule does not compute it.
    estimated_error, estimated_low, estimated_high : float
        Percent, the odometry's own error over the last metres as it was measured without ground
        truth, and its 95 % interval; NaN where nothing was measured.
    state : str
        Whether to believe the pose: unknown, good, doubtful or lost, see `adaptune.live.monitor`.
    why : str
        What speaks against it, in words.
    restart : frozenset of int
        Trial numbers of members of a bank that have lost track: they start again at its pose.
    resting : frozenset of int
        Trial numbers of members of a bank that need not work now.
    """

    trial: int
    parameters: ParameterSet
    weights: Mapping[int, float] | None = None
    predicted_error: float = math.nan
    predicted_fixed: float = math.nan
    similarity: float = math.nan
    estimated_error: float = math.nan
    estimated_low: float = math.nan
    estimated_high: float = math.nan
    state: State = "unknown"
    why: str = ""
    restart: frozenset[int] = frozenset()
    resting: frozenset[int] = frozenset()

    def same_as(self, other: "Selection") -> bool:
        """Whether both have the odometry do the same, whatever is predicted."""
        return self[:3] == other[:3]

    @property
    def lost(self) -> bool:
        """Whether the odometry, or the bank, has lost track."""
        return self.state == "lost"

    @property
    def in_doubt(self) -> bool:
        """Whether something speaks against the pose."""
        return self.state in IN_DOUBT
