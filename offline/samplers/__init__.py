"""Where the next parameter sets come from."""

from adaptune.space import ParameterSpace
from adaptune.study import OfflineConfig
from offline.samplers.annealing import AnnealingSampler
from offline.samplers.asked import AskedSampler
from offline.samplers.base import Sampler
from offline.samplers.points import GridSampler, RandomSampler, SobolSampler

__all__ = ["AnnealingSampler", "Sampler", "make_sampler"]

OURS: dict[str, type[Sampler]] = {
    "grid": GridSampler,
    "random": RandomSampler,
    "sobol": SobolSampler,
}


def make_sampler(space: ParameterSpace, config: OfflineConfig) -> Sampler:
    """Make the sampler that a configuration names.

    Parameters
    ----------
    space
        The parameters.
    config
        Sampler, seed, and sizes.
    """
    return OURS.get(config.sampler, AskedSampler)(space, config)
