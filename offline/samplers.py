"""Samplers: what proposes the next parameter set, and no set twice."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import optuna
from numpy.typing import NDArray
from scipy.stats import qmc

from adaptune.errors import in_a_line
from adaptune.space import ODOMETRY, Categorical, Float, ParameterSet, ParameterSpace, PooledSpace
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

_ENUMERABLE = 4096
_DRAWS = 1000


class Proposal(NamedTuple):
    """A parameter set to try."""

    parameters: ParameterSet
    # `baseline`, `portfolio` and `sobol` (initial points), `random`, or the sampler's name
    source: str


Sets = Sequence[ParameterSet]
History = Sequence[tuple[ParameterSet, float]]
"""Sets that were tried and their values, which samplers minimise."""


class Sampler(ABC):
    """Proposes trials one after the other.

    Proposals depend on the seed and on the results that are given, and on nothing else: not on the
    number of trials, nor on who runs them. Trial 0 is the baseline, and no set is proposed twice.
    """

    end = "there is nothing else to try"
    """Why the search ends when the sampler proposes nothing."""

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        self.space = space
        self.config = config

    @abstractmethod
    def propose(self, history: History, running: Sequence[ParameterSet] = ()) -> Proposal | None:
        """Propose the set of the next trial; None if nothing is left to try.

        `history` has the results of the first trials in their order, `running` the sets of those
        that follow and have none yet.
        """


def another(
    space: ParameterSpace, tried: Collection[str], rng: np.random.Generator
) -> Proposal | None:
    """Draw a set whose `key` is not among those that were tried; None if none is left."""
    everything = Grid.of(space)
    if everything is not None and everything.size <= _ENUMERABLE:
        sets = map(everything.__getitem__, range(everything.size))
        left = [parameters for parameters in sets if key(parameters) not in tried]
        return Proposal(left[rng.integers(len(left))], "random") if left else None
    for _ in range(_DRAWS):
        (drawn,) = space.from_unit(rng.random((1, len(space))))
        if key(drawn) not in tried:
            return Proposal(drawn, "random")
    return None


BASELINE_CHANCE = 0.5
"""Chance of a value to be the baseline's."""


def key(parameters: ParameterSet) -> str:
    """Text that identifies a set: True is not 1."""
    return repr(sorted(parameters.items()))


def keys(history: History, running: Iterable[ParameterSet]) -> set[str]:
    """Texts that identify all sets that were tried, or are being tried."""
    return {key(parameters) for parameters in (*(tried for tried, _ in history), *running)}


_SHUFFLED = 1 << 20
"""Points of a grid that are shuffled as a whole; of larger ones, points are drawn."""


class RandomSampler(Sampler):
    """Uniform in the unit cube.

    Each set follows from the number of its trial. One that was tried before is drawn again.
    """

    def propose(self, history: History, running: Sequence[ParameterSet] = ()) -> Proposal | None:
        """See `Sampler`."""
        if not history and not running:
            return Proposal(self.space.baseline, "baseline")
        number = len(history) + len(running)
        (drawn,) = self.space.from_unit(self._rng(number).random((1, len(self.space))))
        if key(drawn) not in (tried := keys(history, running)):
            return Proposal(drawn, "random")
        return another(self.space, tried, self._rng(number, 1))

    def _rng(self, *words: int) -> np.random.Generator:
        return np.random.default_rng((self.config.seed, *words))


class GridSampler(Sampler):
    """The baseline, then the other points of a grid, in row-major or in random order."""

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        super().__init__(space, config)
        settings = GridSettings.model_validate(config.sampler_settings)
        self._grid = make_grid(space, settings.grid or {})
        self._order: list[int] = []

    def propose(self, history: History, running: Sequence[ParameterSet] = ()) -> Proposal | None:
        """See `Sampler`."""
        number, name, grid = len(history) + len(running), self.config.sampler, self._grid
        if not number:
            return Proposal(self.space.baseline, "baseline")
        if number > len(self._order):
            order: Iterable[int] = range(grid.size)
            if name == "random":
                order = _shuffled(grid.size, self.config.seed, 2 * number)
            known = grid.index(self.space.baseline)
            self._order = list(islice((i for i in order if i != known), 2 * number))
        return Proposal(grid[self._order[number - 1]], name) if number <= len(self._order) else None


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
    """Begins with sets that are given and points of a Sobol sequence, then asks Optuna's sampler.

    Many Optuna samplers keep notes on the trials that they proposed. A resumed search therefore
    asks again for the earlier proposals, and answers from the history. Samplers without notes
    receive the history instead, with a seed of its own for every trial; so do those that no longer
    propose what they did, because sequences were added, or another version is installed.

    If the sampler proposes a set that was tried before, it receives the known value at once and is
    asked again. After many attempts, a random set is taken.
    """

    def __init__(self, space: ParameterSpace, config: OfflineConfig, first: Sets = ()):
        super().__init__(space, config)
        self._first, self._n_initial = first, max(config.n_initial, 1 + len(first))
        self._distributions = {
            name: optuna.distributions.CategoricalDistribution(range(len(p.choices)))
            if isinstance(p, Categorical)
            else distribution(p)
            for name, p in space.parameters.items()
        }
        self._forgetful = config.sampler in ("tpe", "annealing")
        self._begin(0, (), ())

    def propose(self, history: History, running: Sequence[ParameterSet] = ()) -> Proposal | None:
        """See `Sampler`."""
        number = len(history) + len(running)
        if not self._forgetful:
            self._replay([parameters for parameters, _ in history] + list(running), history)
        if self._forgetful:
            self._begin(number, history, running)
        sampler = self._study.sampler
        if isinstance(sampler, AnnealingSampler) and sampler.stalled(self._study):
            self.end = "all chains have stalled"
            return None
        return self._ask(number)

    def _begin(self, number: int, history: History, running: Sequence[ParameterSet]) -> None:
        """Begin anew, with these trials; the next one has this number."""
        self._study = optuna.create_study(sampler=self._sampler(number))
        self._asked: list[ParameterSet] = []
        self._waiting: dict[str, list[Any]] = {}  # trials without a value
        self._values = {key(parameters): value for parameters, value in history}
        make = partial(optuna.trial.create_trial, distributions=self._distributions)
        state = optuna.trial.TrialState.RUNNING
        self._study.add_trials(
            [make(params=self._encode(parameters), value=value) for parameters, value in history]
            + [make(params=self._encode(parameters), state=state) for parameters in running]
        )
        self._tried = keys(history, running)

    def _replay(self, sets: Sequence[ParameterSet], history: History) -> None:
        """Ask for all sets that were proposed so far, and answer as it was done then."""
        if self._asked != list(sets[: len(self._asked)]):
            self._begin(0, (), ())
        for number in range(len(self._asked), len(sets) + 1):
            for parameters, value in history[: max(0, number - self.config.batch + 1)]:
                self._values[name := key(parameters)] = value
                for trial in self._waiting.pop(name, ()):
                    self._call(self._study.tell, trial, value)
            if number < len(sets):
                proposed = self._ask(number)
                if proposed is None or proposed.parameters != sets[number]:
                    self._forgetful = True
                    return

    def _sampler(self, number: int) -> Any:
        config = self.config
        if config.sampler == "annealing":
            settings = AnnealingSettings.model_validate(config.sampler_settings)
            return AnnealingSampler(settings, n_startup_trials=self._n_initial, seed=config.seed)
        # The initial points are the start-up; TPE needs no random points of its own.
        usual = {"n_startup_trials": 1} if config.sampler == "tpe" else {}
        seed = int(np.random.SeedSequence((config.seed, number)).generate_state(1)[0])
        return optuna_sampler(config.sampler, usual | config.sampler_settings, seed)

    def _ask(self, number: int) -> Proposal | None:
        """Ask for the set of a trial."""
        given = self._initial(number)
        for attempt in range(_ATTEMPTS):
            if attempt == _ATTEMPTS - 1:
                rng = np.random.default_rng((self.config.seed, number, 1))
                if (given := another(self.space, self._tried, rng)) is None:
                    return None
            if given is not None:
                self._study.enqueue_trial(self._encode(given.parameters))
            trial = self._call(self._study.ask, self._distributions)
            found = given or Proposal(self._decode(trial.params), self.config.sampler)
            if given is None and not attempt:
                found = self._crossed(found, number)
            name, given = key(found.parameters), None
            if name in self._values:
                self._call(self._study.tell, trial, self._values[name])
                continue
            self._waiting.setdefault(name, []).append(trial)
            if name not in self._tried:
                self._tried.add(name)
                self._asked.append(found.parameters)
                return found
        raise AssertionError

    def _initial(self, number: int) -> Proposal | None:
        """The set of a trial that no result proposes."""
        if not number:
            return Proposal(self.space.baseline, "baseline")
        if number <= len(self._first):
            return Proposal(self._first[number - 1], "portfolio")
        if number >= self._n_initial:
            return None
        (point,) = sobol_points(self.space, self.config.seed, range(number, number + 1))
        return self._crossed(Proposal(point, "sobol"), number)

    def _crossed(self, found: Proposal, number: int) -> Proposal:
        """Of TPE, give every second set about half of the baseline's values.

        So some sets cost about as much as the baseline, whatever it is that costs, and what errs
        less is tried at that cost, too.
        """
        if number % 2 or self.config.sampler != "tpe":
            return found
        rng, base = np.random.default_rng((self.config.seed, number, 2)), self.space.baseline
        kept = zip(found.parameters.items(), rng.random(len(base)) < BASELINE_CHANCE, strict=True)
        return found._replace(parameters={k: base[k] if keep else v for (k, v), keep in kept})

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
            decoded[name] = p.rounded(float(inside)) if isinstance(p, Float) else int(inside)
        return decoded


class PooledSampler(Sampler):
    """A sampler for each odometry, over its own parameters and with the results of its own sets.

    The first trials are the baselines of all odometries. Then the odometries take turns until
    ``config.n_initial`` trials. After that the odometry whose best value so far is the k-th best of
    all gets a share in proportion to 1 / k (Sainte-Lague's method).
    """

    space: PooledSpace

    def __init__(self, space: PooledSpace, config: OfflineConfig, first: Sets = ()):
        super().__init__(space, config)
        n = len(space.spaces)
        firsts: dict[str, list[ParameterSet]] = {label: [] for label in space.spaces}
        for label, own_set in map(space.split, first):
            firsts[label].append(own_set)
        self._n_initial = max(config.n_initial, n * (1 + max(map(len, firsts.values()))))
        turns = [len(range(i, self._n_initial, n)) for i in range(n)]
        seeds = np.random.SeedSequence((config.seed, 1)).generate_state(n).tolist()
        of_each = zip(space.spaces.items(), turns, seeds, strict=True)
        self._samplers = {
            label: make_sampler(
                own, config.model_copy(update={"initial": initial, "seed": seed}), firsts[label]
            )
            for (label, own), initial, seed in of_each
        }

    def propose(self, history: History, running: Sequence[ParameterSet] = ()) -> Proposal | None:
        """See `Sampler`."""
        tried: dict[str, list[tuple[ParameterSet, float]]] = {one: [] for one in self._samplers}
        tries: dict[str, list[ParameterSet]] = {one: [] for one in self._samplers}
        labels = []  # whose turn it was
        for parameters, value in history:
            label, own = self.space.split(parameters)
            tried[label].append((own, value))
            labels.append(label)
        for parameters in running:
            label, own = self.space.split(parameters)
            tries[label].append(own)
            labels.append(label)
        for label in self._order(labels, tried):
            if (found := self._samplers[label].propose(tried[label], tries[label])) is not None:
                return found._replace(parameters={ODOMETRY: label, **found.parameters})
        return None

    def _order(
        self, labels: Sequence[str], tried: Mapping[str, Sequence[tuple[ParameterSet, float]]]
    ) -> list[str]:
        """The odometries, the one whose turn it is first."""
        every, number = list(tried), len(labels)
        if number < self._n_initial:
            first = number % len(every)
            return every[first:] + every[:first]
        ranked = sorted(every, key=lambda label: min((v for _, v in tried[label]), default=np.inf))
        had = Counter(labels[self._n_initial :])
        return sorted(every, key=lambda one: (1 + ranked.index(one)) * (2 * had[one] + 1))


def make_sampler(space: ParameterSpace, config: OfflineConfig, first: Sets = ()) -> Sampler:
    """Make the sampler that a configuration names; `first` are sets to try after the baseline."""
    if isinstance(space, PooledSpace):
        return PooledSampler(space, config, first)
    if config.sampler == "random" and config.sampler_settings.get("grid") is None:
        return RandomSampler(space, config)
    if config.sampler in ("grid", "random"):
        return GridSampler(space, config)
    if ":" in config.sampler:
        # One that cannot sample these parameters says so before anything is run.
        rehearsal = AskedSampler(space, config.model_copy(update={"initial": 1, "batch": 1}))
        history: list[tuple[ParameterSet, float]] = []
        while len(history) < 3 and (proposed := rehearsal.propose(history)) is not None:
            history.append((proposed.parameters, 1.0 + len(history)))
    return AskedSampler(space, config, first)
