"""The parameters of an odometry: their types, their ranges, and their map to the unit cube."""

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, model_validator

from adaptune.errors import AdaptuneError
from adaptune.strict import StrictModel

Value = float | int | str | bool
ParameterSet = dict[str, Value]
"""A value for every parameter, by name."""


class SpaceError(AdaptuneError):
    """A parameter set that does not fit its space."""


def nearest(name: str, names: Iterable[str]) -> str:
    """The nearest valid name as half a sentence, or all valid names."""
    names = sorted(names)
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"there is {', '.join(map(repr, names))}" if names else "there is none"


class _Range(StrictModel):
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
        # The exponential may overshoot a bound by a rounding error.
        return min(max(self._unscaled(unit), self.low), self.high)


_Whole = Annotated[int, Field(ge=-(2**53), le=2**53)]


class Integer(_Range):
    """A whole number from `low` to `high`, both included."""

    type: Literal["integer"] = "integer"
    low: _Whole
    high: _Whole
    baseline: _Whole
    log: bool = False

    def from_unit(self, unit: float) -> int:
        """Map from [0, 1] to the value whose share it falls in."""
        return min(max(round(self._unscaled(unit)), self.low), self.high)

    def _bounds(self) -> tuple[float, float]:
        # Half a step on either side gives the first and the last value a whole share.
        return self._scale(self.low - 0.5), self._scale(self.high + 0.5)


class Categorical(StrictModel):
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

    def row(self, parameters: Mapping[str, Value]) -> dict[str, Value | None]:
        """The set as columns of a table, in the order of `names`; None where it has no value."""
        return {name: parameters.get(name) for name in self.names}

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

    def dump(self) -> dict[str, dict[str, Any]]:
        """The space as plain data, without units: what trials depend on."""
        return {
            name: p.model_dump(mode="json", exclude={"unit"}) for name, p in self.parameters.items()
        }

    def definition(self) -> dict[str, dict[str, Any]]:
        """The space as plain data, with the units that are known: what a study file may say."""
        return {
            name: of | ({"unit": unit} if (unit := self.parameters[name].unit) else {})
            for name, of in self.dump().items()
        }

    @classmethod
    def load(cls, data: Mapping[str, Any]) -> Self:
        """Make a space from what `dump` or `definition` returned.

        Raises
        ------
        pydantic.ValidationError
            If it is none.
        """
        return cls({name: _adapter.validate_python(p) for name, p in data.items()})


def label(name: str, parameter: Float | Integer | Categorical) -> str:
    """What an axis says of a parameter."""
    return f"{name} [{parameter.unit}]" if parameter.unit else name


def describe(parameter: Float | Integer | Categorical) -> str:
    """A parameter's range in a few words."""
    if isinstance(parameter, Categorical):
        return "{" + ", ".join(map(repr, parameter.choices)) + "}"
    return f"[{parameter.low:g}, {parameter.high:g}]"
