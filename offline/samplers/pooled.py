"""Proposals for several odometries: a sampler for each, which share the batches."""

from collections.abc import Callable, Sequence
from operator import itemgetter

import numpy as np

from adaptune.pooled_space import ODOMETRY, PooledSpace
from adaptune.space import ParameterSet, ParameterSpace
from offline.config import OfflineConfig
from offline.objective import SamplerResult, exceeded
from offline.samplers.base import Sampler

Make = Callable[[ParameterSpace, OfflineConfig], Sampler]
"""Makes a sampler for one odometry."""


class PooledSampler(Sampler):
    """A sampler for each odometry, over its own parameters and with the results of its own sets.

    The first trials are the baselines of all odometries. Then the odometries take turns until
    ``config.initial`` trials. After that each batch is split: an odometry whose best value so far
    is the k-th best of all gets a share in proportion to 1 / k. It gets one set at least where the
    batch has enough.
    """

    space: PooledSpace

    def __init__(self, space: PooledSpace, config: OfflineConfig, make: Make):
        super().__init__(space, config)
        n = len(space.spaces)
        self._n_initial = max(config.initial, n)
        turns = [len(range(i, self._n_initial, n)) for i in range(n)]
        of_each = zip(space.spaces.items(), turns, _seeds(config, n), strict=True)
        self._samplers = {
            label: make(own, config.model_copy(update={"initial": initial, "seed": seed}))
            for (label, own), initial, seed in of_each
        }
        self.constrained = all(sampler.constrained for sampler in self._samplers.values())

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        of = {label: self._own(label, history) for label in self._samplers}
        sets: dict[str, list[ParameterSet]] = {label: [] for label in of}
        able = list(of)
        while (n := sum(map(len, sets.values()))) < len(numbers) and able:
            for label, more in self._split(range(numbers.start + n, numbers.stop), of, able):
                wanted = len(sets[label]) + more
                # Asked for more, a sampler proposes the same sets first.
                sets[label] = self._asked(label, wanted, of[label])
                if len(sets[label]) < wanted:
                    able.remove(label)
        return _spread(sets, numbers.start)

    def _asked(self, label: str, n: int, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        """The next `n` sets of one odometry; fewer where nothing else is left."""
        first = len(history)
        proposed = self._samplers[label]._propose(range(first, first + n), history)
        return [{ODOMETRY: label, **own} for own in proposed]

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
        best = {label: _best(of[label]) for label in labels}
        ranked = sorted(labels, key=lambda label: best[label])
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
    """The least first value of a set that keeps the limits."""
    kept = (result.value for result in history if not exceeded(result.constraints))
    return min((float(np.atleast_1d(value)[0]) for value in kept), default=np.inf)


def _seeds(config: OfflineConfig, n: int) -> list[int]:
    """A seed for each of `n` odometries."""
    state = np.random.SeedSequence((config.seed, 1)).generate_state(n)
    return [int(seed) for seed in state]


def _spread(sets: dict[str, list[ParameterSet]], first: int) -> list[ParameterSet]:
    """The sets of a batch, those of each odometry evenly along it; trial `first` says who begins.

    So the first half of a batch, which a search for a bank takes, has sets of all.
    """
    labels = list(sets)
    order = [*labels[first % len(labels) :], *labels[: first % len(labels)]]
    placed = [(k / len(sets[label]), own) for label in order for k, own in enumerate(sets[label])]
    return [own for _, own in sorted(placed, key=itemgetter(0))]
