"""Samplers: what proposes the next parameter sets."""

from typing import TYPE_CHECKING

from adaptune.space import ParameterSpace, PooledSpace
from offline.samplers.settings import is_user_sampler

if TYPE_CHECKING:
    from offline.config import OfflineConfig
    from offline.samplers.samplers import Sampler


def make_sampler(space: ParameterSpace, config: "OfflineConfig") -> "Sampler":
    """Make the sampler that a configuration names."""
    from offline.samplers.samplers import (
        AskedSampler,
        GridSampler,
        HostedSampler,
        RandomSampler,
        SobolSampler,
    )

    if isinstance(space, PooledSpace):
        from offline.samplers.samplers import PooledSampler

        return PooledSampler(space, config, make_sampler)
    own: dict[str, type[Sampler]] = {
        "grid": GridSampler,
        "random": RandomSampler,
        "sobol": SobolSampler,
    }
    other = HostedSampler if is_user_sampler(config.sampler) else AskedSampler
    return own.get(config.sampler, other)(space, config)
