"""The kinds of place a course can lead through."""

from collections.abc import Mapping
from types import MappingProxyType

from adaptune.simulation.scenes.base import Scene
from adaptune.simulation.scenes.cave import CAVE
from adaptune.simulation.scenes.corridor import CORRIDOR
from adaptune.simulation.scenes.field import FIELD
from adaptune.simulation.scenes.garden import GARDEN
from adaptune.simulation.scenes.open_ground import OPEN
from adaptune.simulation.scenes.street import STREET

SCENES: Mapping[str, Scene] = MappingProxyType(
    {
        "cave": CAVE,
        "open": OPEN,
        "street": STREET,
        "garden": GARDEN,
        "corridor": CORRIDOR,
        "field": FIELD,
    }
)
"""Scenes by name."""

__all__ = ["SCENES", "Scene"]
