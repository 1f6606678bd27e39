"""A few parameter sets that complement each other."""

from dataclasses import replace

from adaptune.model.base import complementary
from adaptune.model.file import ErrorModel


def portfolio(model: ErrorModel, size: int) -> list[int]:
    """Choose complementary sets of a model, the fixed one first; see `complementary`."""
    return complementary(model.errors, model.sequence, model.fixed, size)


def restrict(model: ErrorModel, chosen: list[int]) -> ErrorModel:
    """Make a model of some of the sets only, the first of which counts as the fixed one."""
    # They were chosen already, unless the fixed one is always to be taken.
    paired = model.paired
    if paired.n_sets != 1:
        paired = paired.model_copy(update={"n_sets": None})
    return replace(
        model,
        sets=[model.sets[i] for i in chosen],
        errors=model.errors[:, chosen],
        fixed=0,
        paired=paired,
    )
