"""What rules that select single sets give, on a table of errors: nothing is driven.

    adaptune trials runs/toy_gicp --errors errors.csv
    python benchmarks/rules.py errors.csv [--seed 0]

Each fold of the table, a recording or a segment of one, is left out in turn. The script prints for
each rule its mean RTE, the geometric mean over the folds of its ratio to the fixed set's, a 95 %
interval of that (bootstrap over folds), and its worst fold. `hindsight` is the best single set of
each fold, which no rule knows.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.model.knn import NearestNeighbours
from adaptune.model.rules import BASELINE, ERROR_FLOOR, FixedSet
from offline.scenario import Scenario, read_scenario

RESAMPLES = 2000


def scores(table: Scenario) -> dict[str, NDArray[np.float64]]:
    """Clipped errors of each rule at every frame, of shape (n,)."""
    errors = cap(table.performances)
    hindsight, every = np.empty(len(errors)), np.arange(len(errors))
    for fold in np.unique(table.fold):
        here = table.fold == fold
        hindsight[here] = errors[here, errors[here].mean(axis=0).argmin()]
    rules = {f"paper, k={k}": NearestNeighbours(k) for k in (1, 5, 25, 125)}
    return {
        "fixed": errors[every, table.select(FixedSet())],
        "baseline": errors[:, table.sets.column(BASELINE)],
        **{name: errors[every, table.select(rule)] for name, rule in rules.items()},
        "hindsight": hindsight,
    }


def main() -> None:
    """Print a line for each rule."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    table, rng = read_scenario(args.table), np.random.default_rng(args.seed)
    folds = np.unique(table.fold)
    print(
        f"{len(table.frame)} frames, {len(table.sets)} sets, {len(folds)} folds, seed {args.seed}"
    )
    found = scores(table)
    means = {
        name: np.array([errors[table.fold == fold].mean() for fold in folds])
        for name, errors in found.items()
    }
    drawn = rng.integers(0, len(folds), (RESAMPLES, len(folds)))
    for name, mean in means.items():
        logs = np.log((mean + ERROR_FLOOR) / (means["fixed"] + ERROR_FLOOR))
        low, high = np.exp(np.percentile(logs[drawn].mean(axis=1), [2.5, 97.5]))
        print(
            f"{name:14} {mean.mean():.3f} %  x{np.exp(logs.mean()):.2f} ({low:.2f}-{high:.2f})  "
            f"worst fold x{np.exp(logs.max()):.2f}"
        )


if __name__ == "__main__":
    main()
