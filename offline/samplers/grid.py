"""Grids of parameter sets, whose points are computed when they are asked for."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from adaptune.space import (
    Categorical,
    Float,
    Integer,
    ParameterSet,
    ParameterSpace,
    Value,
    describe,
    nearest,
)
from adaptune.study.mistakes import Mistake
from offline.samplers.settings import Span

LARGEST = 10_000
"""Points of the largest grid that a search without a budget may try."""


@dataclass(frozen=True)
class GridAxis:
    """The values of one parameter that a grid tries."""

    parameter: Float | Integer | Categorical
    count: int  # number of values
    first: float = 0.0  # the first number, in log scale if `log`
    step: float = 0.0  # from one number to the next
    log: bool = False
    choices: tuple[Value, ...] = ()  # the values of a category

    def __getitem__(self, i: int) -> Value:
        if self.choices:
            return self.choices[i]
        value = self.first + i * self.step
        value = math.exp(value) if self.log else value
        if isinstance(self.parameter, Integer):
            return round(value)
        assert isinstance(self.parameter, Float)
        for bound in (self.parameter.low, self.parameter.high):
            if math.isclose(value, bound, abs_tol=1e-12):
                return bound  # rounding may miss it
        return value

    def index(self, value: Value) -> int | None:
        """Index of a value, up to rounding; None if it is not on the axis."""
        if self.choices:
            alike = (i for i, c in enumerate(self.choices) if type(c) is type(value) and c == value)
            return next(alike, None)
        x = float(value)
        steps = ((math.log(x) if self.log else x) - self.first) / (self.step or 1.0)
        i = min(max(round(steps), 0), self.count - 1)
        return i if math.isclose(float(self[i]), x, rel_tol=1e-9, abs_tol=1e-12) else None


class Grid:
    """All combinations of the axes' values, in row-major order: the last axis changes fastest.

    Attributes
    ----------
    size : int
        Number of points.
    """

    def __init__(self, axes: Mapping[str, GridAxis]):
        self.axes = dict(axes)
        self.size = math.prod(axis.count for axis in self.axes.values())

    def __getitem__(self, index: int) -> ParameterSet:
        values: ParameterSet = {}
        for name, axis in reversed(self.axes.items()):
            index, i = divmod(index, axis.count)
            values[name] = axis[i]
        return {name: values[name] for name in self.axes}

    def index(self, parameters: ParameterSet) -> int | None:
        """Index of a point; None if it is not on the grid."""
        index = 0
        for name, axis in self.axes.items():
            i = axis.index(parameters[name])
            if i is None:
                return None
            index = index * axis.count + i
        return index

    @classmethod
    def of(cls, space: ParameterSpace) -> "Grid | None":
        """All sets of a space; None if there are infinitely many."""
        axes = {}
        for name, p in space.parameters.items():
            if isinstance(p, Float):
                return None
            axes[name] = (
                GridAxis(p, len(p.choices), choices=p.choices)
                if isinstance(p, Categorical)
                else GridAxis(p, int(p.high - p.low) + 1, p.low, 1.0)
            )
        return cls(axes)


def make_grid(space: ParameterSpace, grid: Mapping[str, Span | Sequence[Value]]) -> Grid:
    """Make a grid from its settings, which have no mistakes."""
    return Grid({name: _axis(p, grid.get(name)) for name, p in space.parameters.items()})


def _axis(
    parameter: Float | Integer | Categorical, given: Span | Sequence[Value] | None
) -> GridAxis:
    if isinstance(parameter, Categorical):
        return _choices(parameter, parameter.choices if given is None else given)
    if given is None:
        raise ValueError("is missing; give [first, step, count] or {low, high, count}")
    axis = _span(parameter, given) if isinstance(given, Span) else _steps(parameter, given)
    for end in (axis[0], axis[axis.count - 1]):
        if not parameter.contains(end):
            raise ValueError(f"{end:g} is outside {describe(parameter)}")
    return axis


def _choices(parameter: Categorical, given: Span | Sequence[Value]) -> GridAxis:
    if isinstance(given, Span) or not given:
        raise ValueError("give a list of its choices")
    for choice in given:
        if not parameter.contains(choice):
            raise ValueError(f"{choice!r} is not one of {describe(parameter)}")
    if len(set(map(repr, given))) < len(given):
        raise ValueError("choices repeat themselves")
    return GridAxis(parameter, len(given), choices=tuple(given))


def _span(parameter: Float | Integer, given: Span) -> GridAxis:
    low, high, count = given.low, given.high, given.count
    if low > high or (count > 1 and low == high):
        raise ValueError(f"low ({low:g}) must be less than high ({high:g})")
    if isinstance(parameter, Integer) and count > high - low + 1:
        raise ValueError(f"there are no {count} whole numbers from {low:g} to {high:g}")
    if parameter.log:
        if low <= 0:
            raise ValueError(f"a log scale needs low ({low:g}) above 0")
        low, high = math.log(low), math.log(high)
    return GridAxis(parameter, count, low, (high - low) / max(count - 1, 1), parameter.log)


def _steps(parameter: Float | Integer, given: Sequence[Value]) -> GridAxis:
    if len(given) != 3 or any(isinstance(v, bool | str) for v in given):
        raise ValueError("give [first, step, count], three numbers, or {low, high, count}")
    first, step, count = map(float, given)
    if not (count >= 1 and count.is_integer()):
        raise ValueError("count, the last number, must be a whole one of at least 1")
    if step == 0 and count > 1:
        raise ValueError("a step of 0 gives the same value again and again")
    if isinstance(parameter, Integer) and not (first.is_integer() and step.is_integer()):
        raise ValueError("first and step must be whole numbers, as the parameter is")
    return GridAxis(parameter, int(count), first, step)


def check_grid(
    axes: Mapping[str, Span | Sequence[Value]], space: ParameterSpace, bounded: bool
) -> Iterable[Mistake]:
    """Find mistakes in a grid.

    Yields
    ------
    Mistake
        Its key begins below the sampler's settings.
    """
    for name in axes:
        if name not in space.names:
            help_ = nearest(name, space.names)
            yield Mistake(("grid", name), f"no parameter {name!r} is tuned: {help_}")
            return
    made = {}
    for name, parameter in space.parameters.items():
        try:
            made[name] = _axis(parameter, axes.get(name))
        except ValueError as error:
            yield Mistake(("grid", name), str(error))
    if len(made) < len(space):
        return
    grid = Grid(made)
    if not bounded and grid.size > LARGEST:
        yield Mistake(
            ("grid",),
            f"has {grid.size:,} points, and the study sets no budget; give offline.trials, hours, "
            f"stagnation or target, or a coarser grid (up to {LARGEST:,} points)",
        )
    elif grid.size >= 2**62:
        yield Mistake(("grid",), "has more points than can be numbered; give a coarser grid")
