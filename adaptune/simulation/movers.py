"""Cars and walkers that move about."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptune.simulation.mesh import Mesh
from adaptune.simulation.road import Road
from adaptune.simulation.scenes import parts

Floats = NDArray[np.float64]

_SPEED = {"car": 6.0, "walker": 1.2}
_EVERY = {"car": 35.0, "walker": 18.0}
"""Metres of road for each of them."""

RADIUS = {"car": 2.7, "walker": 1.9}
"""Metres around its origin within which all of it lies."""


def model(kind: str) -> Mesh:
    """Shape of a kind of mover, with its origin on the ground and x ahead."""
    return parts.car() if kind == "car" else parts.walker()


@dataclass(frozen=True)
class Mover:
    """A car or walker that goes to and fro along the road and slows down to turn back."""

    kind: str  # "car" or "walker"
    # Station about which it moves, and metres to either side.
    middle: float
    swing: float
    offset: float  # metres to the left of the road's middle
    # Radians in a second and at the start.
    pace: float
    phase: float

    def at(self, road: Road, t: Floats) -> tuple[Floats, Floats]:
        """Positions of shape (n, 3) and headings of shape (n,) at `t` seconds."""
        angle = self.pace * t + self.phase
        s = self.middle + self.swing * np.sin(angle)
        x, y = road.plane(s, np.full_like(s, self.offset))
        # A car backs up; a walker turns round.
        back = (np.cos(angle) < 0.0) & (self.kind == "walker")
        return np.stack([x, y, road.ground(x, y)], axis=1), road.heading(s) + np.pi * back


def populate(road: Road) -> list[Mover]:
    """Place the movers of every leg."""
    rng = np.random.default_rng([road.seed, 4])
    movers = []
    for leg in road.legs:
        for kind, offset in leg.scene.movers:
            for _ in range(max(int((leg.stop - leg.start) / _EVERY[kind]), 1)):
                # At most a third of the leg, away from where another scene begins.
                swing = min(rng.uniform(15.0, 40.0), (leg.stop - leg.start) / 3.0)
                middle = rng.uniform(leg.start + swing + 3.0, leg.stop - swing - 3.0)
                speed = _SPEED[kind] * rng.uniform(0.7, 1.3)
                aside, phase = offset + rng.uniform(-0.3, 0.3), rng.uniform(0.0, 2.0 * np.pi)
                movers.append(Mover(kind, float(middle), swing, aside, speed / swing, phase))
    return movers
