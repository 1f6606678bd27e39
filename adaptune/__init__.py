"""What both stages share: the vocabulary, the data, the black boxes and the error model.

`tune` does all of it in one call, see `adaptune.tuning.tuned.tune`; `compare` says whether one
odometry is worse than another, see `adaptune.tuning.sides.compare`; `evaluate` judges trajectories,
see `adaptune.evaluation.evaluated.evaluate`.
"""

# The working folder may have a typing.py until `adaptune.__main__` has set the path.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

_FUNCTIONS = {
    "compare": "adaptune.tuning.sides",
    "evaluate": "adaptune.evaluation.evaluated",
    "tune": "adaptune.tuning.tuned",
}
"""By name, the modules of functions. Layers below do not see them, though they import this one."""


def __dir__() -> list[str]:
    return ["__version__", *_FUNCTIONS]


def __getattr__(name: str) -> "Any":
    if name in _FUNCTIONS:
        from importlib import import_module

        return getattr(import_module(_FUNCTIONS[name]), name)
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("adaptune")
