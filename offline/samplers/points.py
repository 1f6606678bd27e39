"""Samplers that do not learn: they need only the number of a trial."""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from adaptune.space import ParameterSet, ParameterSpace
from offline.config import OfflineConfig
from offline.objective import SamplerResult
from offline.samplers.base import Sampler, Tried
from offline.samplers.grid import Grid, make_grid
from offline.samplers.settings import GridSettings, RandomSettings

_SHUFFLED = 1 << 20


class PointSampler(Sampler):
    """Proposes one set for every trial number, or another one if that set was tried before."""

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        tried = Tried(result.parameters for result in history)
        sets: list[ParameterSet] = []
        points = [self.space.baseline] if numbers.start == 0 else []
        points += self._points(range(numbers.start + len(points), numbers.stop))
        for number, drawn in zip(numbers, points, strict=True):
            point: ParameterSet | None = drawn
            if drawn in tried:
                rng = np.random.default_rng((self.config.seed, number, 1))
                point = tried.another(self.space, rng)
            if point is None:
                break
            tried.add(point)
            sets.append(point)
        return sets

    @abstractmethod
    def _points(self, numbers: range) -> list[ParameterSet]: ...


class SobolSampler(PointSampler):
    """Points of a scrambled Sobol sequence."""

    def _points(self, numbers: range) -> list[ParameterSet]:
        return sobol_points(self.space, self.config.seed, numbers)


def sobol_points(space: ParameterSpace, seed: int, numbers: range) -> list[ParameterSet]:
    """Points `numbers` of a scrambled Sobol sequence."""
    if not numbers:
        return []
    sobol = qmc.Sobol(len(space), rng=np.random.default_rng((seed, 0)))
    if numbers.start:
        sobol.fast_forward(numbers.start)
    # One by one: scipy warns if the number of points is not a power of two.
    return space.from_unit(np.concatenate([sobol.random(1) for _ in numbers]))


class RandomSampler(PointSampler):
    """Uniform in the unit cube, or points of a grid in random order."""

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        super().__init__(space, config)
        axes = RandomSettings.model_validate(config.sampler_settings).grid
        self._grid = None if axes is None else make_grid(space, axes)

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        if self._grid is None:
            return super()._propose(numbers, history)
        order = _shuffled(self._grid.size, self.config.seed, numbers.stop)
        return _walk(self._grid, order, self.space.baseline, numbers)

    def _points(self, numbers: range) -> list[ParameterSet]:
        seed, size = self.config.seed, len(self.space)
        drawn = [np.random.default_rng((seed, n)).random(size) for n in numbers]
        return self.space.from_unit(np.array(drawn).reshape(len(drawn), size))


class GridSampler(Sampler):
    """Points of a grid in row-major order: the last parameter changes fastest."""

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        super().__init__(space, config)
        axes = GridSettings.model_validate(config.sampler_settings).grid
        self._grid = make_grid(space, axes)

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:  # noqa: ARG002
        order = iter(range(min(numbers.stop, self._grid.size)))
        return _walk(self._grid, order, self.space.baseline, numbers)


def _walk(
    grid: Grid, order: Iterator[int], baseline: ParameterSet, numbers: range
) -> list[ParameterSet]:
    """Sets `numbers` of a list: the baseline, then the other points of a grid in their order."""
    known = grid.index(baseline)
    rest = islice((i for i in order if i != known), max(numbers.start - 1, 0), numbers.stop - 1)
    return [baseline] * (numbers.start == 0) + [grid[i] for i in rest]


def _shuffled(size: int, seed: int, n: int) -> Iterator[int]:
    """Numbers below `size` in random order, at least `n` of them; `n` does not change the order."""
    rng = np.random.default_rng((seed, 0))
    if size <= _SHUFFLED:
        yield from rng.permutation(size).tolist()
        return
    drawn: NDArray[np.int64] = rng.integers(size, size=2 * n + 64)
    _, at = np.unique(drawn, return_index=True)
    yield from drawn[np.sort(at)].tolist()
