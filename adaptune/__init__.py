"""What both stages share: the vocabulary, the data, the black boxes and the error model.

`tune` does all of it in one call; see `adaptune.tuning.tuned.tune`.
"""

# The working folder may have a typing.py until `adaptune.__main__` has set the path.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


def __getattr__(name: str) -> "Any":
    if name == "tune":
        from importlib import import_module

        # Layers below do not see it, though they import this package.
        return import_module("adaptune.tuning.tuned").tune
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("adaptune")
