"""Samplers: what proposes the next parameter sets, in batches, and no set twice."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from itertools import islice, zip_longest
from operator import itemgetter
from typing import Any

import numpy as np
import optuna
from numpy.typing import NDArray
from scipy.stats import qmc

from adaptune.errors import in_a_line
from adaptune.space import (
    ODOMETRY,
    Categorical,
    Float,
    ParameterSet,
    ParameterSpace,
    PooledSpace,
)
from offline.annealing import AnnealingSampler
from offline.config import (
    AnnealingSettings,
    Grid,
    GridSettings,
    OfflineConfig,
    SamplerError,
    distribution,
    make_grid,
    optuna_sampler,
)
from offline.objective import SamplerResult

_ENUMERABLE = 4096
_DRAWS = 1000


class Sampler(ABC):
    """Proposes trials in batches.

    Proposals depend on the seed and on the results of the batches before, and on nothing else: not
    on the number of trials, nor on who runs them. Trial 0 is the baseline, and no set is proposed
    twice.
    """

    end = "there is nothing else to try"
    """Why the search ends when the sampler proposes fewer sets than a batch."""

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        self.space = space
        self.config = config

    def propose(self, history: Sequence[tuple[Any, ...]]) -> list[ParameterSet]:
        """Propose the parameter sets of the next batch.

        The history has the results of all trials of the batches before, in their order:
        `SamplerResult`, or tuples of a set and its value.

        Returns
        -------
        list of dict
            ``config.batch`` parameter sets; fewer where nothing is left to try, which ends the
            search.
        """
        first = len(history)
        if first % self.config.batch:
            raise ValueError(f"batches have {self.config.batch} trials; {first} is not a multiple")
        results = [SamplerResult(*result) for result in history]
        return self._propose(range(first, first + self.config.batch), results)

    @abstractmethod
    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]: ...


def untried(
    space: ParameterSpace, tried: Collection[str], rng: np.random.Generator
) -> ParameterSet | None:
    """Draw a set whose `key` is not among those that were tried; None if none is left."""
    everything = Grid.of(space)
    if everything is not None and everything.size <= _ENUMERABLE:
        sets = map(everything.__getitem__, range(everything.size))
        left = [parameters for parameters in sets if key(parameters) not in tried]
        return left[rng.integers(len(left))] if left else None
    for _ in range(_DRAWS):
        (drawn,) = space.from_unit(rng.random((1, len(space))))
        if key(drawn) not in tried:
            return drawn
    return None


def key(parameters: ParameterSet) -> str:
    """Text that identifies a set: True is not 1."""
    return repr(sorted(parameters.items()))


_SHUFFLED = 1 << 20
"""Points of a grid that are shuffled as a whole; of larger ones, points are drawn."""


class RandomSampler(Sampler):
    """Uniform in the unit cube.

    Each set follows from the number of its trial. One that was tried before is drawn again.
    """

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        tried = {key(result.parameters) for result in history}
        sets: list[ParameterSet] = []
        for number in numbers:
            drawn = self.space.baseline
            if number:
                rng = np.random.default_rng((self.config.seed, number))
                (drawn,) = self.space.from_unit(rng.random((1, len(self.space))))
            again = np.random.default_rng((self.config.seed, number, 1))
            point = untried(self.space, tried, again) if key(drawn) in tried else drawn
            if point is None:
                break
            tried.add(key(point))
            sets.append(point)
        return sets


class GridSampler(Sampler):
    """The baseline, then the other points of a grid, in row-major or in random order."""

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:  # noqa: ARG002
        settings = GridSettings.model_validate(self.config.sampler_settings)
        grid = make_grid(self.space, settings.grid or {})
        order: Iterable[int] = range(grid.size)
        if self.config.sampler == "random":
            order = _shuffled(grid.size, self.config.seed, numbers.stop)
        baseline = self.space.baseline
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


# Without warnings that a sampler draws some parameters independently.
optuna.logging.set_verbosity(optuna.logging.ERROR)

_ATTEMPTS = 32


def sobol_points(space: ParameterSpace, seed: int, numbers: range) -> list[ParameterSet]:
    """Points `numbers` of a scrambled Sobol sequence."""
    if not numbers:
        return []
    sobol = qmc.Sobol(len(space), rng=np.random.default_rng((seed, 0)))
    # One by one: scipy warns if the number of points is not a power of two.
    points = [sobol.random(1) for _ in range(numbers.stop)]
    return space.from_unit(np.concatenate(points[numbers.start :]))


class AskedSampler(Sampler):
    """Begins with points of a Sobol sequence, and then asks an Optuna sampler.

    Many Optuna samplers keep notes on the trials that they proposed. A resumed search therefore
    asks again for the earlier proposals, and answers from the history. Samplers without notes
    receive the history instead, and begin every batch with a seed of its own; so do those that no
    longer propose what they did, because sequences were added, or another version is installed.

    If the sampler proposes a set that was tried before, it receives the known value at once and is
    asked again. After many attempts, a random set is taken.
    """

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        super().__init__(space, config)
        self._distributions = {
            name: optuna.distributions.CategoricalDistribution(range(len(p.choices)))
            if isinstance(p, Categorical)
            else distribution(p)
            for name, p in space.parameters.items()
        }
        self._forgetful = config.sampler == "tpe"
        self._begin(0, ())

    def _begin(self, seed: int, history: Sequence[SamplerResult]) -> None:
        self._study = optuna.create_study(sampler=self._sampler(seed))
        self._study.add_trials(
            optuna.trial.create_trial(
                params=self._encode(result.parameters),
                distributions=self._distributions,
                value=result.value,
            )
            for result in history
        )
        self._history = list(history)
        self._known = {key(result.parameters): result for result in history}
        self._waiting: dict[str, tuple[ParameterSet, list[Any]]] = {}

    def _sampler(self, batch: int) -> Any:
        config = self.config
        if config.sampler == "annealing":
            settings = AnnealingSettings.model_validate(config.sampler_settings)
            return AnnealingSampler(settings, n_startup_trials=config.initial, seed=config.seed)
        # The initial points are the start-up; TPE needs no random points of its own.
        usual = {"n_startup_trials": 1} if config.sampler == "tpe" else {}
        seed = int(np.random.SeedSequence((config.seed, batch)).generate_state(1)[0])
        return optuna_sampler(config.sampler, usual | config.sampler_settings, seed)

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        if self._history != list(history[: len(self._history)]):
            self._begin(0, ())
        while len(self._history) < numbers.start and not self._forgetful:
            first = len(self._history)
            batch = range(first, first + self.config.batch)
            self._ask(batch)
            self._answer(history[batch.start : batch.stop])
        if self._forgetful:
            self._begin(numbers.start // self.config.batch, history)
        return self._ask(numbers)

    def _ask(self, numbers: range) -> list[ParameterSet]:
        """Sets of the next batch; the same sets until they are answered."""
        sampler = self._study.sampler
        if isinstance(sampler, AnnealingSampler) and sampler.stalled(self._study):
            self.end = "all chains have stalled"
        elif not self._waiting:
            tried = {key(result.parameters) for result in self._history}
            given = [self.space.baseline][numbers.start :]
            rest = range(numbers.start + len(given), min(numbers.stop, self.config.initial))
            given += sobol_points(self.space, self.config.seed, rest)
            for number, first in zip_longest(numbers, given):
                if not self._ask_once(number, first, tried):
                    break
        return [parameters for parameters, _ in self._waiting.values()]

    def _ask_once(self, number: int, given: ParameterSet | None, tried: set[str]) -> bool:
        for attempt in range(_ATTEMPTS):
            if attempt == _ATTEMPTS - 1:
                rng = np.random.default_rng((self.config.seed, number, 1))
                given = untried(self.space, tried, rng)
                if given is None:
                    return False
            if given is not None:
                self._study.enqueue_trial(self._encode(given))
            trial = self._call(self._study.ask, self._distributions)
            parameters, given = given or self._decode(trial.params), None
            name = key(parameters)
            if name in self._known:
                self._tell(trial, self._known[name])
            elif name in self._waiting:
                self._waiting[name][1].append(trial)
            else:
                self._waiting[name] = (parameters, [trial])
                tried.add(name)
                return True
        raise AssertionError

    def _answer(self, results: Sequence[SamplerResult]) -> None:
        asked = [parameters for parameters, _ in self._waiting.values()]
        if asked != [result.parameters for result in results]:
            self._forgetful = True
            return
        for (_, trials), result in zip(self._waiting.values(), results, strict=True):
            for trial in trials:
                self._tell(trial, result)
            self._known[key(result.parameters)] = result
        self._history += results
        self._waiting = {}

    def _tell(self, trial: optuna.Trial, result: SamplerResult) -> None:
        self._call(self._study.tell, trial, result.value)

    def _call(self, method: Callable[..., Any], *given: Any) -> Any:
        """Call a sampler that may be the user's own."""
        try:
            return method(*given)
        except Exception as error:
            what = f"offline.sampler: {self.config.sampler}"
            raise SamplerError(f"{what}: {in_a_line(error)}") from error

    # For Optuna, as for Python, the choices 1 and True are equal: it receives their index.

    def _encode(self, parameters: ParameterSet) -> dict[str, Any]:
        return {
            name: p.index(parameters[name]) if isinstance(p, Categorical) else parameters[name]
            for name, p in self.space.parameters.items()
        }

    def _decode(self, params: dict[str, Any]) -> ParameterSet:
        decoded: ParameterSet = {}
        for name, p in self.space.parameters.items():
            value = params[name]
            if isinstance(p, Categorical):
                decoded[name] = p.choices[value]
                continue
            inside = min(max(value, p.low), p.high)
            decoded[name] = float(inside) if isinstance(p, Float) else int(inside)
        return decoded


class PooledSampler(Sampler):
    """A sampler for each odometry, over its own parameters and with the results of its own sets.

    The first trials are the baselines of all odometries. Then the odometries take turns until
    ``config.initial`` trials. After that each batch is split: an odometry whose best value so far
    is the k-th best of all gets a share in proportion to 1 / k. It gets one set at least where the
    batch has enough.
    """

    space: PooledSpace

    def __init__(self, space: PooledSpace, config: OfflineConfig):
        super().__init__(space, config)
        n = len(space.spaces)
        self._n_initial = max(config.initial, n)
        turns = [len(range(i, self._n_initial, n)) for i in range(n)]
        seeds = np.random.SeedSequence((config.seed, 1)).generate_state(n).tolist()
        of_each = zip(space.spaces.items(), turns, seeds, strict=True)
        self._samplers = {
            label: make_sampler(own, config.model_copy(update={"initial": initial, "seed": seed}))
            for (label, own), initial, seed in of_each
        }

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        of = {label: self._own(label, history) for label in self._samplers}
        sets: dict[str, list[ParameterSet]] = {label: [] for label in of}
        able = list(of)
        while (n := sum(map(len, sets.values()))) < len(numbers) and able:
            for label, more in self._split(range(numbers.start + n, numbers.stop), of, able):
                wanted, first = len(sets[label]) + more, len(of[label])
                # Asked for more, a sampler proposes the same sets first.
                own = self._samplers[label]._propose(range(first, first + wanted), of[label])
                sets[label] = [{ODOMETRY: label, **parameters} for parameters in own]
                if len(own) < wanted:
                    able.remove(label)
        return _spread(sets, numbers.start)

    def _own(self, label: str, history: Sequence[SamplerResult]) -> list[SamplerResult]:
        """The results of the sets of one odometry, as its sampler takes them."""
        own = []
        for result in history:
            of, parameters = self.space.split(result.parameters)
            if of == label:
                own.append(result._replace(parameters=parameters))
        return own

    def _split(
        self, numbers: range, of: dict[str, list[SamplerResult]], labels: Sequence[str]
    ) -> list[tuple[str, int]]:
        """How many of the next trials each odometry gets; those that get none are left out."""
        initial = range(numbers.start, max(numbers.start, min(numbers.stop, self._n_initial)))
        counts = dict.fromkeys(labels, 0)
        for number in initial:
            counts[labels[number % len(labels)]] += 1
        rest = len(numbers) - len(initial)
        ranked = sorted(labels, key=lambda label: _best(of[label]))
        shares = 1.0 / np.arange(1, len(ranked) + 1)
        ideal = rest * shares / shares.sum()
        whole = np.floor(ideal).astype(int)
        whole[np.argsort(whole - ideal, kind="stable")[: rest - whole.sum()]] += 1
        while rest >= len(whole) and not whole.all():
            # Nobody is given up for a bad beginning.
            whole[whole.argmax()] -= 1
            whole[whole.argmin()] += 1
        for label, n in zip(ranked, whole.tolist(), strict=True):
            counts[label] += n
        return [(label, n) for label, n in counts.items() if n]


def _best(history: Sequence[SamplerResult]) -> float:
    """The least value."""
    return min((result.value for result in history), default=np.inf)


def _spread(sets: dict[str, list[ParameterSet]], first: int) -> list[ParameterSet]:
    """The sets of a batch, those of each odometry evenly; trial `first` says who begins."""
    labels = list(sets)
    order = [*labels[first % len(labels) :], *labels[: first % len(labels)]]
    placed = [(k / len(sets[label]), own) for label in order for k, own in enumerate(sets[label])]
    return [own for _, own in sorted(placed, key=itemgetter(0))]


def make_sampler(space: ParameterSpace, config: OfflineConfig) -> Sampler:
    """Make the sampler that a configuration names."""
    if isinstance(space, PooledSpace):
        return PooledSampler(space, config)
    if config.sampler == "random" and config.sampler_settings.get("grid") is None:
        return RandomSampler(space, config)
    if config.sampler in ("grid", "random"):
        return GridSampler(space, config)
    if ":" in config.sampler:
        # One that cannot sample these parameters says so before anything is run.
        rehearsal = AskedSampler(space, config.model_copy(update={"initial": 1}))
        proposed = rehearsal.propose([])
        if len(proposed) == config.batch:
            rehearsal.propose([(parameters, 1.0 + i) for i, parameters in enumerate(proposed)])
    return AskedSampler(space, config)
