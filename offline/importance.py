"""Which parameters matter: importances by Optuna, and what is drawn of them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from adaptune.charts.chart import Axis, Bars, Chart, Panel
from offline.storage import distribution
from offline.trial_charts import FEW
from offline.trial_table import TrialTable

FOREST: Any = {"n_trees": 16, "max_depth": 8, "seed": 0}
"""Size of the forest, which bounds the time that it takes."""


def importances(table: TrialTable) -> dict[str, float]:
    """Share of each parameter in the variance of the error's logarithm, by falling share.

    It is functional ANOVA, Optuna's default, on a small forest: Optuna's own takes minutes for some
    thousand trials, and gives the same shares.

    Parameters
    ----------
    table
        Trials of one odometry.

    Returns
    -------
    dict
        Empty with fewer than `FEW` finished trials, one parameter, or equal errors.
    """
    known = table.some(np.isfinite(table.values) & (table.values > 0.0))
    parameters = {
        name: p
        for name, p in table.space.parameters.items()
        if all(value is not None for value in known.column(name))
        and len(set(map(repr, known.column(name)))) > 1
    }
    logs = np.log(known.values)
    if len(known) < FEW or len(parameters) < 2 or np.ptp(logs) < 1e-9:
        return {}
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    distributions = {name: distribution(p) for name, p in parameters.items()}
    columns = {name: known.column(name) for name in parameters}
    study = optuna.create_study()
    study.add_trials(
        optuna.trial.create_trial(
            params={name: column[i] for name, column in columns.items()},
            distributions=distributions,
            value=float(log),
        )
        for i, log in enumerate(logs)
    )
    evaluator = optuna.importance.FanovaImportanceEvaluator(**FOREST)
    found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(share) for name, share in found.items()}


def importance_chart(by_odometry: Mapping[str, Mapping[str, float]]) -> Chart | None:
    """Importance of each parameter, a panel for each odometry.

    Parameters
    ----------
    by_odometry
        What `importances` found, by the name of the odometry; "" if there is only one.
    """
    panels = []
    for odometry, shares in by_odometry.items():
        if not shares:
            continue
        names = tuple(reversed(list(shares)))
        percent = [100.0 * shares[name] for name in names]
        bars = Bars(np.arange(len(names)), percent, "", flat=True)
        x = Axis("share of the error's variance [%]", limits=(0.0, 100.0))
        panels.append(Panel(x, Axis("", names=names), (bars,), odometry))
    if not panels:
        return None
    return Chart(
        "importance",
        "Which parameters matter",
        tuple(panels),
        "How much of the variance of the error (of its logarithm) over all trials a parameter "
        "explains (functional ANOVA). Where the search has hardly varied a parameter, it seems "
        "less important than it is. Few trials say little.",
    )
