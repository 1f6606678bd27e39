"""Ways of carrying a sensor."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Motion:
    """A way of carrying a sensor."""

    speed: float  # usual speed in m/s
    acceleration: float  # greatest acceleration and braking in m/s^2
    turning: float  # greatest lateral acceleration in m/s^2: it goes slower through bends
    height: float  # metres of the sensor above the ground
    base: tuple[float, float]  # length and width in metres over which the ground carries it
    weave: float  # metres by which it strays from the road's middle, about
    # Standard deviation along x, y and z of the mount's shake on a paved road, in metres.
    shift: tuple[float, float, float]
    turn: tuple[float, float, float]  # standard deviation about x, y and z of the same, in radians
    band: tuple[float, float]  # least and greatest frequency of the shake in Hz

    @property
    def least_rate(self) -> float:
        """Scans a second below which its shake is lost or scans lie two metres apart."""
        return max(2.0 * self.band[1], self.speed / 2.0)


MOTIONS: Mapping[str, Motion] = MappingProxyType(
    {
        # Speed, acceleration, turning, height, base and weave; shift, turn and band of the shake.
        "robot": Motion(
            *(3.0, 0.8, 1.0, 0.9, (0.8, 0.6), 0.15),
            *((0.002, 0.003, 0.004), (0.0015, 0.0015, 0.001), (0.5, 3.5)),
        ),
        "car": Motion(
            *(10.0, 2.0, 2.5, 1.75, (2.7, 1.6), 0.15),
            *((0.003, 0.006, 0.010), (0.0015, 0.0020, 0.0007), (0.6, 2.5)),
        ),
        "handheld": Motion(
            *(1.3, 0.6, 0.8, 1.5, (0.4, 0.4), 0.3),
            *((0.012, 0.020, 0.022), (0.012, 0.012, 0.015), (0.4, 2.5)),
        ),
    }
)
"""Ways of carrying a sensor, by name."""
