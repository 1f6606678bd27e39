"""Effect of weather on a LiDAR."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Weather:
    """Effect of the air on rays."""

    extinction: float  # share of the light lost in a metre, each way (1/m)
    # Chance in a metre that drops send back an echo before the target does (1/m).
    backscatter: float
    reach: float  # metres within which such an echo is strong enough to be seen


WEATHERS: Mapping[str, Weather] = MappingProxyType(
    {
        "clear": Weather(0.0, 0.0, 0.0),
        # 10 mm/h, and fog through which one sees some 150 m (3.9 / extinction).
        "rain": Weather(0.003, 0.0015, 20.0),
        "fog": Weather(0.026, 0.012, 12.0),
    }
)
"""Weathers by name."""
