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
        "robot": Motion(
            speed=3.0,
            acceleration=0.8,
            turning=1.0,
            height=0.9,
            base=(0.8, 0.6),
            weave=0.15,
            shift=(0.002, 0.003, 0.004),
            turn=(0.0015, 0.0015, 0.001),
            band=(0.5, 3.5),
        ),
        "car": Motion(
            speed=10.0,
            acceleration=2.0,
            turning=2.5,
            height=1.75,
            base=(2.7, 1.6),
            weave=0.15,
            shift=(0.003, 0.006, 0.010),
            turn=(0.0015, 0.0020, 0.0007),
            band=(0.6, 2.5),
        ),
        "handheld": Motion(
            speed=1.3,
            acceleration=0.6,
            turning=0.8,
            height=1.5,
            base=(0.4, 0.4),
            weave=0.3,
            shift=(0.012, 0.020, 0.022),
            turn=(0.012, 0.012, 0.015),
            band=(0.4, 2.5),
        ),
    }
)
"""Ways of carrying a sensor, by name."""
