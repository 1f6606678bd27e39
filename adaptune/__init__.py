"""What both stages share: the vocabulary, the data, the black boxes and the error model.

`tune` does all of it in one call, see `adaptune.tuning.tuned.tune`; `evaluate` judges trajectories,
see `adaptune.evaluation.evaluated.evaluate`.
"""

# The working folder may have a typing.py until `adaptune.__main__` has set the path.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


def __getattr__(name: str) -> "Any":
    if name in ("tune", "evaluate"):
        from importlib import import_module

        # Layers below do not see them, though they import this package.
        homes = {"tune": "adaptune.tuning.tuned", "evaluate": "adaptune.evaluation.evaluated"}
        return getattr(import_module(homes[name]), name)
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("adaptune")
