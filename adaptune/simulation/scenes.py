"""The kinds of place a course can lead through."""

from collections.abc import Mapping

from adaptune.simulation.corridor import CORRIDOR
from adaptune.simulation.garden import GARDEN
from adaptune.simulation.open_ground import OPEN
from adaptune.simulation.street import STREET
from adaptune.simulation.tiles import Scene
from adaptune.simulation.underground import CAVE, MINE

SCENES: Mapping[str, Scene] = {
    "cave": CAVE,
    "open": OPEN,
    "street": STREET,
    "garden": GARDEN,
    "corridor": CORRIDOR,
    "mine": MINE,
}
"""Scenes by name."""
