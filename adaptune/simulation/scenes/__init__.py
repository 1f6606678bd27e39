"""The kinds of place a course can lead through."""

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from adaptune.simulation.scenes.base import Scene

SCENES: Mapping[str, str] = MappingProxyType(
    {
        "cave": "cave:CAVE",
        "open": "open_ground:OPEN",
        "street": "street:STREET",
        "garden": "garden:GARDEN",
        "corridor": "corridor:CORRIDOR",
        "field": "field:FIELD",
    }
)
"""Scenes by name: module of this package and attribute. `scene` imports them."""


def scene(name: str) -> "Scene":
    """Import the scene of a name."""
    module, _, attribute = SCENES[name].partition(":")
    found: Scene = getattr(import_module(f"{__name__}.{module}"), attribute)
    return found
