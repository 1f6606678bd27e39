"""The parameters of several odometries: a parameter set says which odometry it is for."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.space import (
    Categorical,
    Float,
    Integer,
    ParameterSet,
    ParameterSpace,
    SpaceError,
    Value,
    nearest,
)

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
        """Those of `names` that every odometry which has them spaces evenly in ratio."""
        every = self.spaces.values()
        return [
            name
            for name in self.names[1:]
            if all(name in space.logarithmic for space in every if name in space.names)
        ]

    @property
    def labels(self) -> dict[str, str]:
        """See `ParameterSpace.labels`; with a unit only where all odometries have the same."""
        every: dict[str, set[str]] = {name: set() for name in self.names}
        for space in self.spaces.values():
            for name, said in space.labels.items():
                every[name].add(said)
        return {name: said.pop() if len(said) == 1 else name for name, said in every.items()}

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

        Raises
        ------
        SpaceError
            If there is no such odometry.
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
        """Map parameter sets to the unit cube.

        Returns
        -------
        ndarray of shape (n_sets, n_odometries + n_parameters)
            For each odometry 1 or 0, for whether the set is its; then its parameters, 0.5 where the
            set is another's. So sets of two odometries are farther apart than most of one.
        """
        sizes = [len(space) for space in self.spaces.values()]
        begins = len(sizes) + np.concatenate([[0], np.cumsum(sizes)])
        unit = np.full((len(sets), int(begins[-1])), 0.5)
        unit[:, : len(sizes)] = 0.0
        labels = list(self.spaces)
        for row, given in zip(unit, sets, strict=True):
            label, own = self.split(given)
            at = labels.index(label)
            row[at] = 1.0
            row[begins[at] : begins[at + 1]] = self.spaces[label].to_unit([own])[0]
        return unit

    def from_unit(self, unit: NDArray[np.float64]) -> list[ParameterSet]:
        """Map what `to_unit` returns to parameter sets; the highest of the first columns counts."""
        sizes = [len(space) for space in self.spaces.values()]
        begins = len(sizes) + np.concatenate([[0], np.cumsum(sizes)])
        labels, sets = list(self.spaces), []
        for row in unit:
            at = int(np.argmax(row[: len(sizes)]))
            own = self.spaces[labels[at]].from_unit(row[None, begins[at] : begins[at + 1]])
            sets.append({ODOMETRY: labels[at], **own[0]})
        return sets

    def dump(self) -> dict[str, dict[str, Any]]:
        """The spaces by label, as plain data."""
        return {label: space.dump() for label, space in self.spaces.items()}

    def definition(self) -> dict[str, dict[str, Any]]:
        """The spaces by label, as plain data with units."""
        return {label: space.definition() for label, space in self.spaces.items()}


def load_space(data: Mapping[str, Any]) -> ParameterSpace:
    """Make a space, of one odometry or of several, from the result of its `dump`.

    Raises
    ------
    pydantic.ValidationError
        If it is none.
    """
    # A parameter has a type, and an odometry has parameters.
    spaces = [of for of in data.values() if isinstance(of, Mapping)]
    pooled = len(spaces) == len(data) and not any(isinstance(of.get("type"), str) for of in spaces)
    if data and pooled:
        return PooledSpace({label: ParameterSpace.load(of) for label, of in data.items()})
    return ParameterSpace.load(data)
