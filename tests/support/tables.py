"""Parameter sets, and rows of comparisons, for tests."""

from dataclasses import replace

import numpy as np

from adaptune.space import Float, ParameterSets, ParameterSpace


def table(unit, trials=None):
    """Sets at these points of a cube, of shape (n_sets, n_parameters)."""
    unit = np.asarray(unit, float)
    space = ParameterSpace(
        {f"p{i}": Float(low=0.0, high=1.0, baseline=0.5) for i in range(unit.shape[1])}
    )
    sets = tuple({f"p{i}": x for i, x in enumerate(row)} for row in unit.tolist())
    return ParameterSets(space, tuple(range(len(unit)) if trials is None else trials), sets)


def with_run(row, **measured):
    """The row of a comparison, with other figures of its run."""
    return replace(row, run=row.run.model_copy(update=measured))
